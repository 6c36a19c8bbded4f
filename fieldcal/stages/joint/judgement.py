"""Which constants of the joint estimate are believed, axis by axis, and the numbers that decide it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation.joint.covariance import advice
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.estimation.joint.measurement_model import body_jumps
from fieldcal.estimation.joint.problem import PriorConstants
from fieldcal.geometry.earth_field import dip_rad
from fieldcal.geometry.rotation import Array
from fieldcal.names import SENSORS, Json, Sensor
from fieldcal.reason_codes import ReasonCode

# Of a gyroscope: what the attitude jumps at the knots over what it turns between them.
MAX_GYRO_NOISE_SHARE = 0.5
# Constants known beforehand to less than this are held, not estimated; others that come out so many of their prior's sd
# off contradict it, and show that something is not as the model has it.
HELD_SD, LARGEST_PRIOR_DISTANCE_SD = 1e-4, 4.0
# Refusals that concern the scale alone, and the share of a prior sd below which a recording has told a constant.
SCALE_ALONE = (
    ReasonCode.SCALE_UNCERTAIN,
    ReasonCode.AXIS_NOT_TURNED,
    ReasonCode.HELD_AT_NOMINAL,
    ReasonCode.UNDERSAMPLED,
)
INFORMED_SHARE = 0.5
# Of the field's dip from the configured one, °: more is another place, or an accelerometer or world upside down.
MAX_DIP_DIFFERENCE_DEG = 20.0
# Of the magnetometer's readings: where more are those of a passing field, none says which field is the local one.
MAX_PASSING_SHARE = 0.4
# √3 times the rms of |calibrated specific force| − g, over g, and the mean robust weight: numbers that no weight and no
# fitted noise level touches. Hand-held recordings with right scales had 0.08–0.10, those 5–11 % off 0.13 and more.
MAX_TRANSLATION_SHARE, LEAST_MEAN_WEIGHT = 0.12, 0.6
# Of a magnetometer's scale where the accelerometer is held, relative: what banks to accelerate feels gravity along its
# own axes and seems to stay level, so that scales are off by some per cent, which is in no sd. Simulated missions and
# hovers stood at 1.2 to 1.8 of their sd, all too small; lively flights, known to 0.2 %, at 0.6.
MAX_LEVEL_SCALE_SD = 0.005


def triad_of(fit: JointFit, name: str) -> tuple[Array, Array, Array, Array | None]:
    """Λ (3, 3), b (3,), covariance (6, 6) of its diagonal and b, and the sd (3, 3) of Λ where it has cross-axis
    terms."""
    if f"{name}_cross" not in fit.layout:
        scale, bias, covariance = fit.constants(name)
        return np.diag(scale), bias, covariance, None
    full, bias, covariance = fit.full_constants(name)
    diagonal = np.ix_([0, 4, 8, 9, 10, 11], [0, 4, 8, 9, 10, 11])
    return full, bias, covariance[diagonal], np.sqrt(np.diagonal(covariance)[:9]).reshape(3, 3)


def judged(
    name: Sensor,
    fit: JointFit,
    scale: Array,
    covariance: Array,
    *,
    polarity: ArrayLike,
    nominal_scale: ArrayLike | None,
    max_scale_sd: float,
    max_residual: float,
) -> list[ReasonCode | None]:
    """Why an axis is refused, or None: scale (3,), covariance (6, 6) of scale and bias, `polarity` (3,) of ±1,
    `nominal_scale` (3,) where it is known; limits are relative."""
    if name == Sensor.GYROSCOPE:
        unsupported = fit.vps is None and all(misfit(fit, vector) > max_residual for vector in fit.model.vectors)
        if gyro_noise_share(fit) > MAX_GYRO_NOISE_SHARE or unsupported:
            return [ReasonCode.GYRO_CONTRADICTS_ATTITUDE] * 3
    elif misfit(fit, name) > max_residual:
        return [ReasonCode.NOT_A_SPHERE] * 3
    if (wrong := dip_contradicts(fit)) is not None:
        return [wrong] * 3
    if name == Sensor.MAGNETOMETER and passing_field_share(fit) > MAX_PASSING_SHARE:
        return [ReasonCode.VECTORS_CONTRADICT] * 3
    prior = fit.priors.get(name)
    if prior is not None:
        known = np.sqrt(np.diagonal(prior.covariance)[:3])
        if is_held(prior):
            return [ReasonCode.HELD_AT_NOMINAL] * 3
        if name != Sensor.MAGNETOMETER and np.any(np.abs(scale - prior.scale) > LARGEST_PRIOR_DISTANCE_SD * known):
            return [ReasonCode.PRIOR_CONTRADICTED] * 3
    if name == Sensor.ACCELEROMETER and translation_share(fit) > MAX_TRANSLATION_SHARE:
        return [ReasonCode.TRANSLATION_DOMINATES] * 3
    if name != Sensor.GYROSCOPE and mean_weight(fit, name) < LEAST_MEAN_WEIGHT:
        return [ReasonCode.NOT_A_SPHERE] * 3
    noisy = axis_noise_share(fit) > MAX_GYRO_NOISE_SHARE if name == Sensor.GYROSCOPE else np.zeros(3, dtype=bool)
    if name == Sensor.MAGNETOMETER and stays_level(fit):
        max_scale_sd = min(max_scale_sd, MAX_LEVEL_SCALE_SD)
    codes = judged_scales(scale, covariance, polarity=polarity, nominal_scale=nominal_scale, max_scale_sd=max_scale_sd)
    codes = informed(codes, covariance, prior)
    return [
        ReasonCode.AXIS_NOT_TURNED if noisy[i] and code != ReasonCode.SCALE_UNCERTAIN else code
        for i, code in enumerate(codes)
    ]


def is_held(prior: PriorConstants) -> bool:
    """Whether scales are held at what is known beforehand."""
    return bool(np.all(np.diagonal(prior.covariance)[:3] < (HELD_SD * prior.scale) ** 2))


def stays_level(fit: JointFit) -> bool:
    """Whether attitudes are by an accelerometer that is held: gravity hardly moves in its axes, or nothing else had a
    minimum."""
    prior = fit.priors.get("accelerometer")
    return fit.vps is None and "accelerometer" in fit.model.vectors and prior is not None and is_held(prior)


def dip_contradicts(fit: JointFit) -> ReasonCode | None:
    """Why the angle between field and gravity can't be that of the configured place, or None; where it is estimated."""
    if "dip" not in fit.layout:
        return None
    found, expected = fit.state.values["dip"][0], dip_rad(fit.model.readings.field_ned)
    off = np.degrees(np.abs(np.angle(np.exp(1j * (found - np.array([expected, -expected]))))))
    if off[0] <= MAX_DIP_DIFFERENCE_DEG:
        return None
    upside_down = off[1] <= MAX_DIP_DIFFERENCE_DEG
    return ReasonCode.GRAVITY_SIGN_CONTRADICTION if upside_down else ReasonCode.FIELD_CONTRADICTED


def judged_scales(
    scale: Array,
    covariance: Array,
    *,
    polarity: ArrayLike,
    nominal_scale: ArrayLike | None,
    max_scale_sd: float,
) -> list[ReasonCode | None]:
    """The same by scales and their covariance alone."""
    relative = np.sqrt(np.diagonal(covariance)[:3]) / np.abs(scale)
    polarity = np.asarray(polarity, dtype=float)
    nominal = None if nominal_scale is None else np.asarray(nominal_scale, dtype=float)
    out: list[ReasonCode | None] = []
    for i in range(3):
        ratio = 1.0 if nominal is None else abs(scale[i] / nominal[i])
        if not relative[i] <= max_scale_sd:
            out.append(ReasonCode.SCALE_UNCERTAIN)
        elif np.sign(scale[i]) != polarity[i]:
            out.append(ReasonCode.POLARITY_CONTRADICTION)
        else:
            out.append(None if 0.5 <= ratio <= 2.0 else ReasonCode.SCALE_NOT_NOMINAL)
    return out


def informed(
    codes: list[ReasonCode | None], covariance: Array, prior: PriorConstants | None
) -> list[ReasonCode | None]:
    """The same, refused too where the scale is hardly better known than before: what is published is the recording's,
    not its prior."""
    if prior is None:
        return codes
    share = np.sqrt(np.diagonal(covariance)[:3] / np.diagonal(prior.covariance)[:3])
    return [own or (None if share[i] < INFORMED_SHARE else ReasonCode.SCALE_UNCERTAIN) for i, own in enumerate(codes)]


def judged_zeros(
    codes: list[ReasonCode | None], zero_sd: Array, prior: PriorConstants | None
) -> list[ReasonCode | None]:
    """Why an axis' zero is refused, or None: as its scale, but that a scale which the recording does not show spoils no
    zero where the unit is known. `zero_sd` (3,) logged units; it has to be half of what was known before."""
    if prior is None:
        return codes
    before = np.sqrt(np.diagonal(prior.covariance)[3:]) / np.abs(prior.scale)
    return [
        None if code in SCALE_ALONE and zero_sd[i] < INFORMED_SHARE * before[i] else code
        for i, code in enumerate(codes)
    ]


def gyro_noise_share(fit: JointFit) -> float:
    """What the attitude had to jump at the knots over what the gyroscope turned between them, rms."""
    turned = np.sqrt(np.mean(np.sum(fit.path.rate**2, axis=1))) * fit.model.knots.interval_s
    jumped = np.linalg.norm(fit.path.jump, axis=1)
    return float(np.sqrt(np.mean(jumped**2) / np.mean(turned**2)))


def translation_share(fit: JointFit) -> float:
    """√3 times the rms of what the calibrated accelerometer's length differs from gravity, over gravity."""
    full, bias, _, _ = triad_of(fit, "accelerometer")
    triad = fit.model.triads["accelerometer"]
    force = (triad.centre + triad.spread * triad.x[triad.valid]) @ full.T + bias
    g = abs(fit.model.readings.gravity_mps2)
    return float(np.sqrt(3.0 * np.mean((np.linalg.norm(force, axis=1) - g) ** 2)) / g)


def mean_weight(fit: JointFit, name: str) -> float:
    """Mean robust weight of a vector triad's readings."""
    return float(fit.weight[fit.model.triads[name].valid, 3 * fit.model.vectors.index(name)].mean())


def axis_noise_share(fit: JointFit) -> Array:
    """The same of each gyroscope axis (3,). Of an axis about which the vehicle hardly turned noise is all there is, and
    a regressor that is noise says nothing of its scale, however small its sd."""
    knots = fit.model.knots
    jump = body_jumps(fit.state, fit.path)[knots.joined]
    samples = np.diff(knots.index)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(fit.path.rate, axis=0)])
    mean = (total[knots.index[1:]] - total[knots.index[:-1]]) / samples[:, None]
    turned = (mean * knots.interval_s[:, None])[knots.joined]
    return np.asarray(np.sqrt(np.mean(jump**2, axis=0) / np.mean(turned**2, axis=0)))


def misfit(fit: JointFit, name: str) -> float:
    """Rms of what a vector triad reads beside the field or gravity, over their length: its residual (robust level) and,
    for the accelerometer, the translation, which stands in the model but says nothing of a scale."""
    row = 3 * fit.model.vectors.index(name)
    scale = fit.state.values[name][:3]
    square = np.sum(fit.levels.variance[row : row + 3] * scale**2)
    readings = fit.model.readings
    if name == "accelerometer":
        return float(np.sqrt(square + 3.0 * fit.levels.strength**2) / abs(readings.gravity_mps2))
    return float(np.sqrt(square) / np.linalg.norm(readings.field_ned))


def passing_field_share(fit: JointFit) -> float:
    """Share of the magnetometer's readings left out as those of a passing field; 0 without one."""
    logged = fit.model.readings.magnetometer
    if logged is None or "magnetometer" not in fit.model.vectors:
        return 0.0
    given = np.isfinite(logged[fit.model.at]).all(axis=1)
    return float(1.0 - fit.model.triads["magnetometer"].valid.sum() / given.sum())


def measured_of(fit: JointFit, axes: Array) -> dict[str, Json]:
    """The numbers that decided, and what else the fit found; `axes` (3, 3) turns sensor axes into body axes."""
    relative: dict[str, list[float]] = {}
    for name in SENSORS:
        if name in fit.layout:
            scale, _, covariance = fit.constants(name)
            relative[name] = [float(v) for v in np.sqrt(np.diagonal(covariance)[:3]) / np.abs(scale)]
    measured: dict[str, Json] = {
        "n_samples": len(fit.model.readings.t),
        "iterations": fit.iterations,
        "scale_relative_sd": relative,
        "mean_robust_weight": {name: mean_weight(fit, name) for name in fit.model.vectors},
        "passing_field_share": passing_field_share(fit),
        "misfit": {name: misfit(fit, name) for name in fit.model.vectors},
        "gyro_walk_deg_per_sqrt_s": float(np.degrees(np.sqrt(fit.levels.walk))),
        "gyro_bias_walk_radps_per_sqrt_s": fit.bias_walk,
        "gyro_noise_share": gyro_noise_share(fit),
        "axis_noise_share": [float(v) for v in axis_noise_share(fit)],
        "translation_rms_mps2": float(np.sqrt(3.0) * fit.levels.strength),
        "translation_share": translation_share(fit) if "accelerometer" in fit.layout else None,
        "advice": advice(fit.model, fit.state, fit.layout, fit.covariance, axes),
    }
    if "dip" in fit.layout:
        columns = fit.layout["dip"].start
        measured |= {
            "dip_deg": float(np.degrees(fit.state.values["dip"][0])),
            "dip_sd_deg": float(np.degrees(np.sqrt(fit.covariance[columns, columns]))),
        }
    if fit.lever_arm_test is not None:
        measured["lever_arm_test"] = fit.lever_arm_test
    if "lever_arm" in fit.layout:
        columns = fit.layout["lever_arm"]
        measured["lever_arm_m"] = [float(v) for v in axes @ fit.state.values["lever_arm"]]
        measured["lever_arm_sd_m"] = [
            float(v) for v in np.sqrt(np.diagonal(axes @ fit.covariance[columns, columns] @ axes.T))
        ]
    return measured
