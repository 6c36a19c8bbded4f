"""The joint estimate of all triads and the attitude (method `joint`): start, fit, judge, validate, write."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from numpy.typing import ArrayLike

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.joint import initialise, model_selection
from fieldcal.estimation.joint.covariance import advice
from fieldcal.estimation.joint.fit import JointFit, fit_joint
from fieldcal.estimation.joint.measurement_model import body_jumps
from fieldcal.estimation.joint.problem import TERMS, Readings
from fieldcal.geometry import sensor_model
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import Array, from_matrix, multiply
from fieldcal.names import SENSORS, Approach, Json, Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import logged_constants
from fieldcal.stages.inputs import Tables, is_sound, mean_temperature, reference_reading, refusal
from fieldcal.stages.joint_reference import Poses, poses_of, with_poses
from fieldcal.stages.results import StageResult, fatal_fault, triad_rows, zero_slope_rows
from fieldcal.stages.tables import (
    AXES,
    QUATERNION,
    CalibrationRow,
    calibration_rows,
    columns_of,
    constants,
    covariance_table,
    matrix,
    seconds,
    triad,
)

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import JointSettings

SERIAL_METHODS: dict[Sensor, tuple[Method | None, ...]] = {
    Sensor.MAGNETOMETER: (None,),
    Sensor.ACCELEROMETER: (None,),
    Sensor.GYROSCOPE: (Method.OUTPUT_ERROR, Method.EQUATION_ERROR),
}
UNITS = {Sensor.MAGNETOMETER: "", Sensor.ACCELEROMETER: "m/s^2", Sensor.GYROSCOPE: "rad/s"}
# A magnetometer's readings count as one each only where they are about as many as the gyroscope's.
SPARSE = 0.9
HELD_IN_SHARE = 0.7
MAX_GYRO_NOISE_SHARE = 0.5


def estimate_jointly(tables: Tables, s: JointSettings) -> StageResult:
    """samples, serial constants → calibration, covariance, trajectory, held_out: everything in one likelihood."""
    if not chosen(s):
        return StageResult(status=Status.ABSENT, reason_code=ReasonCode.NOT_SELECTED, reason='The method is "serial".')
    if "samples" not in tables:
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NO_SAMPLES, reason="No segment of the log is usable."
        )
    fault = fatal_fault(tables["faults"], ("gyroscope",)) if "faults" in tables else None
    if fault is not None:
        return StageResult(status=Status.REFUSED, reason_code=ReasonCode(fault["reason_code"]), reason=fault["reason"])
    if tables["samples"]["gyroscope_x"].null_count():
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NO_GYROSCOPE, reason="The joint estimate needs a gyroscope."
        )
    readings = readings_of(tables, s)
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    arm = None if s.lever_arm_m is None else axes.T @ np.asarray(s.lever_arm_m, dtype=float)
    try:
        model, start = initialise.prepare(readings, start_constants(tables, s, readings), lever_arm=arm)
        fit = fit_joint(model, start, try_lever_arm=arm is None)
    except (UnusableFlight, EstimationError) as error:
        return refusal(error, "joint estimate")
    poses = poses_of(tables, s)
    fit, by_vps = with_poses(fit, poses, s)
    fit, tests = model_selection.add_terms(fit)
    result = _written(fit, tables, s, axes)
    return replace(
        result,
        tables={**result.tables, **_held_out(fit, readings, tables, s, arm, poses)},
        measured={**result.measured, **by_vps, "terms": model_selection.summary(tests, fit)},
    )


def chosen(s: JointSettings) -> tuple[Sensor, ...]:
    """Sensors whose constants this method is to give."""
    return tuple(name for name in SENSORS if s.method[name] == Approach.JOINT)


def _held_out(
    fit: JointFit, readings: Readings, tables: Tables, s: JointSettings, arm: Array | None, poses: Poses | None
) -> dict[str, pl.DataFrame]:
    """Gyroscope constants from the first part of the flight alone, with `from_ns`, where the rest begins: `verify`
    predicts that. None where the part determines nothing, or another method gives the gyroscope's."""
    if Sensor.GYROSCOPE not in chosen(s):
        return {}
    split = int(HELD_IN_SHARE * len(readings.t))
    part = readings.part(slice(0, split))
    start: dict[str, tuple[Array, Array] | None] = {
        name: fit.constants(name)[:2] for name in SENSORS if name in fit.layout
    }
    try:
        early = fit_joint(*initialise.prepare(part, start, lever_arm=arm), try_lever_arm=arm is None)
        early, _ = with_poses(early, poses, s)
        kept = [name for name in TERMS if name in fit.layout]
        early = model_selection.with_terms(early, kept) if kept else early
    except (UnusableFlight, EstimationError):
        return {}
    matrix, bias, covariance, _ = triad_of(early, "gyroscope")
    rows = triad_rows(
        Sensor.GYROSCOPE,
        Method.JOINT,
        matrix,
        bias,
        covariance,
        unit="rad/s",
        logged_unit=s.units[Sensor.GYROSCOPE],
        reference_reading=reference_reading(s, Sensor.GYROSCOPE, readings.gyroscope),
        temperature_degc=mean_temperature(tables),
    )
    return {"held_out": calibration_rows(rows).with_columns(from_ns=pl.lit(int(tables["samples"]["t_ns"][split])))}


def readings_of(tables: Tables, s: JointSettings) -> Readings:
    """Logged readings of the used segments; a slow magnetometer's only at the samples nearest to its
    own stamps; none of a triad with a fatal fault."""
    samples = tables["samples"]
    t = seconds(samples["t_ns"], samples["t_ns"][0])
    segment = samples["segment"].to_numpy()
    logged: dict[str, Array] = {name: matrix(samples, triad(name)) for name in SENSORS}
    magnetometer = tables.get("magnetometer_log")
    if magnetometer is not None and len(magnetometer) < SPARSE * len(tables["imu"]):
        has_reading = np.zeros(len(t), dtype=bool)
        at = seconds(magnetometer["t_ns"], samples["t_ns"][0])
        before = interval_of(t, at, on_stamp="ends")
        nearest = np.where(at - t[before] < t[before + 1] - at, before, before + 1)
        has_reading[nearest[np.abs(t[nearest] - at) < 2.0 * float(np.median(np.diff(t)))]] = True
        logged["magnetometer"] = np.where(has_reading[:, None], logged["magnetometer"], np.nan)
    vectors = {name: x for name, x in logged.items() if name != "gyroscope"}
    given = {name: x if is_sound(tables, name) and np.isfinite(x).any() else None for name, x in vectors.items()}
    return Readings(
        warmth=_warmth(tables, t),
        t=t,
        segment=segment,
        gyroscope=logged["gyroscope"],
        gravity_mps2=sensor_model.GRAVITY_SIGNS[s.gravity_sign] * s.gravity_mps2,
        field_ned=np.asarray(s.field_ned, dtype=float),
        turning=initialise.turning(t, segment, logged["gyroscope"]),
        **given,
    )


def _warmth(tables: Tables, t: Array) -> Array | None:
    """Temperature at the samples less its mean, °C (n,); None without one."""
    table = tables.get("temperature")
    if table is None or (table := table.drop_nulls()).is_empty():
        return None
    at = seconds(table["t_ns"], tables["samples"]["t_ns"][0])
    warm = np.interp(t, at, table["temperature_degc"].to_numpy())
    return np.asarray(warm - warm.mean())


def start_constants(tables: Tables, s: JointSettings, readings: Readings) -> dict[str, tuple[Array, Array] | None]:
    """The serial chain's constants where it has them, else what the logged unit says, else refused values, else an
    ellipsoid fit."""
    out: dict[str, tuple[Array, Array] | None] = {}
    magnitudes = {
        Sensor.MAGNETOMETER: float(np.linalg.norm(s.field_ned)),
        Sensor.ACCELEROMETER: s.gravity_mps2,
    }
    for name in SENSORS:
        found = None
        for method in SERIAL_METHODS[name]:
            if found is None and name in tables:
                found = constants(tables[name], name, method)
        found = found or logged_constants(s, name)
        out[name] = None if found is None else (np.diagonal(found[0]).copy(), found[1])
        logged = getattr(readings, name)
        if out[name] is None and name in magnitudes and logged is not None:
            polarity = np.array(s.polarity[name], dtype=np.float64)
            out[name] = initialise.start_of_triad(logged, magnitudes[name], polarity)
    return out


def _written(fit: JointFit, tables: Tables, s: JointSettings, axes: Array) -> StageResult:
    """Rows with a status by sensor and axis, the attitude, the covariance, and the numbers that decided."""
    rows: list[CalibrationRow] = []
    codes: dict[Sensor, list[ReasonCode | None]] = {}
    for name in chosen(s):
        if name not in fit.layout:
            continue
        full, bias, covariance, cross_sd = triad_of(fit, name)
        codes[name] = _judged(name, fit, np.diagonal(full), covariance, s)
        rows += triad_rows(
            name,
            Method.JOINT,
            full,
            bias,
            covariance,
            unit=UNITS[name] or s.field_unit,
            logged_unit=s.units[name],
            reference_reading=reference_reading(s, name, matrix(tables["samples"], triad(name))),
            temperature_degc=mean_temperature(tables),
            reason_code=codes[name],
            cross_sd=cross_sd,
        )
    if Sensor.GYROSCOPE in codes:
        rows += _slope_rows(fit, tables, s, codes[Sensor.GYROSCOPE])
    bad = [f"{name} {axis}: {c}" for name, of_axis in codes.items() for axis, c in zip(AXES, of_axis, strict=True) if c]
    every = len(bad) == 3 * len(codes)
    measured = _measured(fit, axes)
    first = next((code for of_axis in codes.values() for code in of_axis if code), None)
    reason = f"Refused by the joint estimate ({', '.join(bad)}). {measured['advice']}".strip() if bad else None
    if not codes:
        first, reason = (
            ReasonCode(f"no_{chosen(s)[0]}"),
            "None of the sensors that method joint is chosen for has readings.",
        )
    result = {"calibration": calibration_rows(rows), "covariance": covariance_table(fit.covariance)}
    full, _, covariance, _ = triad_of(fit, "gyroscope")
    if not any(_judged(Sensor.GYROSCOPE, fit, np.diagonal(full), covariance, s)):
        result["trajectory"] = _trajectory(fit, tables, axes)
    return StageResult(result, Status.REFUSED if every else Status.OK, first, reason, measured)


def triad_of(fit: JointFit, name: str) -> tuple[Array, Array, Array, Array | None]:
    """Λ (3, 3), b (3,), covariance (6, 6) of its diagonal and b, and the sd (3, 3) of Λ where it has cross-axis
    terms."""
    if f"{name}_cross" not in fit.layout:
        scale, bias, covariance = fit.constants(name)
        return np.diag(scale), bias, covariance, None
    full, bias, covariance = fit.full_constants(name)
    diagonal = np.ix_([0, 4, 8, 9, 10, 11], [0, 4, 8, 9, 10, 11])
    return full, bias, covariance[diagonal], np.sqrt(np.diagonal(covariance)[:9]).reshape(3, 3)


def _slope_rows(
    fit: JointFit, tables: Tables, s: JointSettings, codes: list[ReasonCode | None]
) -> list[CalibrationRow]:
    """The gyroscope's zero against temperature, where the flight shows it."""
    if "gyroscope_temperature" not in fit.layout:
        return []
    spread = fit.model.triads["gyroscope"].spread
    value = -fit.state.values["gyroscope_temperature"] * spread
    sd = np.sqrt(np.diagonal(fit.covariance)[fit.layout["gyroscope_temperature"]]) * spread
    return zero_slope_rows(
        Sensor.GYROSCOPE,
        Method.JOINT,
        value,
        sd,
        logged_unit=s.units[Sensor.GYROSCOPE],
        temperature_degc=mean_temperature(tables),
        reason_code=codes,
    )


def _judged(name: Sensor, fit: JointFit, scale: Array, covariance: Array, s: JointSettings) -> list[ReasonCode | None]:
    """`judged` by the flight's settings."""
    return judged(
        name,
        fit,
        scale,
        covariance,
        polarity=s.polarity[name],
        nominal_scale=s.nominal_scale[name],
        max_scale_sd=s.gyro_max_scale_sd if name == Sensor.GYROSCOPE else s.ellipsoid_max_scale_sd,
        max_residual=s.ellipsoid_max_residual,
    )


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
        if gyro_noise_share(fit) > MAX_GYRO_NOISE_SHARE:
            return [ReasonCode.GYRO_CONTRADICTS_ATTITUDE] * 3
    elif misfit(fit, name) > max_residual:
        return [ReasonCode.NOT_A_SPHERE] * 3
    relative = np.sqrt(np.diagonal(covariance)[:3]) / np.abs(scale)
    polarity = np.asarray(polarity, dtype=float)
    nominal = None if nominal_scale is None else np.asarray(nominal_scale, dtype=float)
    noisy = axis_noise_share(fit) > MAX_GYRO_NOISE_SHARE if name == Sensor.GYROSCOPE else np.zeros(3, dtype=bool)
    out: list[ReasonCode | None] = []
    for i in range(3):
        ratio = 1.0 if nominal is None else abs(scale[i] / nominal[i])
        if not relative[i] <= max_scale_sd:
            out.append(ReasonCode.SCALE_UNCERTAIN)
        elif noisy[i]:
            out.append(ReasonCode.AXIS_NOT_TURNED)
        elif np.sign(scale[i]) != polarity[i]:
            out.append(ReasonCode.POLARITY_CONTRADICTION)
        else:
            out.append(None if 0.5 <= ratio <= 2.0 else ReasonCode.SCALE_NOT_NOMINAL)
    return out


def gyro_noise_share(fit: JointFit) -> float:
    """What the attitude had to jump at the knots over what the gyroscope turned between them, rms."""
    turned = np.sqrt(np.mean(np.sum(fit.path.rate**2, axis=1))) * fit.model.knots.interval_s
    jumped = np.linalg.norm(fit.path.jump, axis=1)
    return float(np.sqrt(np.mean(jumped**2) / np.mean(turned**2)))


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


def _measured(fit: JointFit, axes: Array) -> dict[str, Json]:
    relative: dict[str, list[float]] = {}
    for name in SENSORS:
        if name in fit.layout:
            scale, _, covariance = fit.constants(name)
            relative[name] = [float(v) for v in np.sqrt(np.diagonal(covariance)[:3]) / np.abs(scale)]
    measured: dict[str, Json] = {
        "n_samples": len(fit.model.readings.t),
        "iterations": fit.iterations,
        "scale_relative_sd": relative,
        "mean_robust_weight": {
            name: float(fit.weight[fit.model.triads[name].valid, 3 * i].mean())
            for i, name in enumerate(fit.model.vectors)
        },
        "passing_field_share": passing_field_share(fit),
        "misfit": {name: misfit(fit, name) for name in fit.model.vectors},
        "gyro_walk_deg_per_sqrt_s": float(np.degrees(np.sqrt(fit.levels.walk))),
        "gyro_bias_walk_radps_per_sqrt_s": fit.bias_walk,
        "gyro_noise_share": gyro_noise_share(fit),
        "axis_noise_share": [float(v) for v in axis_noise_share(fit)],
        "translation_rms_mps2": float(np.sqrt(3.0) * fit.levels.strength),
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


def _trajectory(fit: JointFit, tables: Tables, axes: Array) -> pl.DataFrame:
    """Attitude of the body at every sample."""
    samples = tables["samples"]
    q = multiply(fit.path.q, from_matrix(axes))
    return samples.select("t_ns", "segment").with_columns(
        **{name: pl.Series(values) for name, values in columns_of(q, QUATERNION).items()}
    )
