"""The estimate by a satellite receiver's velocity (method `velocity`), where an ordinary flight has one and no VPS: all
triads, the receiver's lag and its antenna's arm, axis by axis judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_velocity.fit import VelocityFit, fit_by_velocity
from fieldcal.estimation.by_velocity.information import observed
from fieldcal.estimation.by_velocity.known import ARM_SD_M, UNKNOWN_FIELD_SD_RAD
from fieldcal.estimation.by_velocity.problem import LARGEST_LAG_S, SMALLEST_LAG_S, Epochs
from fieldcal.estimation.joint.information import GAIN
from fieldcal.estimation.joint.ladder import LEAST_TILT
from fieldcal.estimation.joint.problem import PriorConstants, Readings
from fieldcal.estimation.normal_equations import Name
from fieldcal.geometry.rotation import Array
from fieldcal.names import FIELD_ASSUMED, SENSORS, Json, Method, Rung, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import vector_constants
from fieldcal.stages.inputs import Tables, mean_temperature
from fieldcal.stages.joint.found import (
    UNITS,
    Found,
    axes_of,
    chosen,
    constant_rows,
    found_of,
    priors,
    refusals,
    status_of,
    trajectory_table,
)
from fieldcal.stages.joint.information import table_of
from fieldcal.stages.joint.judgement import (
    LARGEST_PRIOR_DISTANCE_SD,
    LEAST_MEAN_WEIGHT,
    MAX_DIP_DIFFERENCE_DEG,
    SCALE_ALONE,
    informed,
    judged_scales,
)
from fieldcal.stages.results import StageResult, quantity_rows
from fieldcal.stages.tables import AXES, CalibrationRow, calibration_rows, covariance_table, matrix, seconds

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import JointSettings

# Share of epochs that bring a new velocity; with fewer it is held over the rows of a faster log.
LEAST_FRESH = 0.9
VELOCITY = ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps")
GNSS_LAG, GNSS_LEVER_ARM = "gnss_lag", "gnss_lever_arm"
# Sd beyond which a number says nothing and is no row: s, and of what was known before.
LARGEST_LAG_SD_S, LARGEST_ARM_SD_M = 0.05, 0.5 * ARM_SD_M
# Rms of an axis' specific force about its mean, over g, as for a triad by vectors: with less, axes out of square by a
# fraction of a degree pass for its scale, however small its sd. A level axis of a vehicle that banks to accelerate
# feels drag alone.
LEAST_FORCE_SHARE = LEAST_TILT
# Of readings that come more slowly than this, s: rms of what lies between two neighbours' mean and the reading there,
# over the readings' own. A vehicle's vibration, logged at 25 Hz without its filter, has 0.4–1, motion alone 0.2.
SLOW_S, LARGEST_BETWEEN_SHARE = 0.02, 0.3
# The receiver's noise over what it claims, and the velocity's own walk, m/s in a second: more, and one of them is not
# what it is taken for.
LARGEST_RECEIVER_RATIO, LARGEST_PUSH_MPS = 5.0, 0.5
# Rms speed from which on a vehicle is not near one place: what the vectors alone take for granted.
TRAVELLED_MPS = 1.0


def epochs_of(tables: Tables, s: JointSettings) -> Epochs | None:
    """The receiver's velocities on the clock of the samples, each once; None without one, or where it is not wanted."""
    table = tables.get("gnss_velocity")
    if not s.use_velocity or table is None or table.is_empty():
        return None
    t = seconds(table["t_ns"], tables["samples"]["t_ns"][0])
    velocity, sd = matrix(table, VELOCITY), matrix(table, ["velocity_sd_mps"])[:, 0]
    order = np.argsort(t, kind="stable")
    known = order[np.isfinite(velocity[order]).all(axis=1)]
    fresh = np.any(np.diff(velocity[known], axis=0) != 0.0, axis=1)
    if len(known) > 1 and fresh.mean() < LEAST_FRESH:
        known = known[np.r_[True, fresh]]
    return Epochs(t[known], velocity[known], sd[known]) if len(known) else None


def travelled(epochs: Epochs, readings: Readings) -> bool:
    """Whether the vehicle was not near one place."""
    inside = (epochs.t >= readings.t[0]) & (epochs.t <= readings.t[-1])
    return bool(inside.any()) and float(np.sqrt(np.mean(np.sum(epochs.velocity[inside] ** 2, axis=1)))) > TRAVELLED_MPS


def estimate_by_velocity(readings: Readings, epochs: Epochs, tables: Tables, s: JointSettings) -> StageResult:
    """Rows with a status by sensor and axis, the attitude, what the flight says, and the numbers that decided. Raises
    UnusableFlight, EstimationError where there is no estimate."""
    known = priors(s)
    if readings.accelerometer is None or Sensor.GYROSCOPE not in known or Sensor.ACCELEROMETER not in known:
        raise UnusableFlight(
            ReasonCode.NO_NOMINAL_SCALE,
            "A receiver's velocity needs an accelerometer, and units or nominal scales of both inertial triads.",
        )
    start: dict[str, tuple[Array, Array]] = {
        name: (known[name].scale, known[name].bias) for name in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER)
    }
    if readings.magnetometer is not None:
        found, _ = vector_constants(tables, s, Sensor.MAGNETOMETER)
        if found is not None:
            start[Sensor.MAGNETOMETER] = np.diagonal(found[0]).copy(), found[1]
            known.setdefault(Sensor.MAGNETOMETER, _unknown(start[Sensor.MAGNETOMETER], s))
    fit = fit_by_velocity(readings, epochs, start, known, field_known=s.field_source != FIELD_ASSUMED)
    triads = {
        sensor: _judged(fit, sensor, s, known[sensor], unshown(fit, readings, sensor))
        for sensor in chosen(s)
        if sensor in fit.layout
    }
    return _written(fit, triads, readings, tables, s)


def _unknown(start: tuple[Array, Array], s: JointSettings) -> PriorConstants:
    """Of a magnetometer whose unit nobody knows: half of the scale that it started from."""
    scale, bias = start
    length = float(np.linalg.norm(s.field_ned))
    covariance = np.diag(np.r_[(0.5 * scale) ** 2, np.full(3, (2.0 * s.prior_magnetometer_zero * length) ** 2)])
    return PriorConstants(scale, bias, covariance)


def doubt(fit: VelocityFit) -> ReasonCode | None:
    """Why nothing of the fit is to be believed, or None."""
    lag = fit.state.lag_s
    at_limit = min(LARGEST_LAG_S - lag, lag - SMALLEST_LAG_S) < 1e-3
    unlike = float(np.sqrt(np.max(fit.levels.receiver))) > LARGEST_RECEIVER_RATIO
    rough = np.sqrt(fit.levels.push) > LARGEST_PUSH_MPS
    if at_limit or unlike or rough or float(fit.weight.mean()) < LEAST_MEAN_WEIGHT:
        return ReasonCode.VELOCITY_CONTRADICTS
    return None


def unshown(fit: VelocityFit, readings: Readings, sensor: Sensor) -> list[ReasonCode | None]:
    """Why an axis' scale is none that this motion shows, however small its sd, or None."""
    logged = {Sensor.GYROSCOPE: readings.gyroscope, Sensor.ACCELEROMETER: readings.accelerometer}.get(sensor)
    if logged is None:
        return [None] * 3
    x = logged[np.isfinite(logged).all(axis=1)]
    between = x[1:-1] - 0.5 * (x[:-2] + x[2:])
    slow = float(np.median(np.diff(readings.t))) > SLOW_S
    unknown = slow & (np.sqrt(np.mean(between**2, axis=0)) > LARGEST_BETWEEN_SHARE * x.std(axis=0))
    felt = force_share(fit) >= LEAST_FORCE_SHARE if sensor == Sensor.ACCELEROMETER else np.ones(3, dtype=bool)
    return [
        ReasonCode.UNDERSAMPLED if unknown[i] else None if felt[i] else ReasonCode.HELD_AT_NOMINAL for i in range(3)
    ]


def _judged(
    fit: VelocityFit, sensor: Sensor, s: JointSettings, prior: PriorConstants, unseen: list[ReasonCode | None]
) -> Found:
    scale, bias, covariance = fit.constants(sensor)
    limit = s.gyro_max_scale_sd if sensor == Sensor.GYROSCOPE else s.ellipsoid_max_scale_sd
    before = np.sqrt(np.diagonal(prior.covariance))
    codes: list[ReasonCode | None]
    code = doubt(fit)
    if code is None and sensor == Sensor.MAGNETOMETER:
        code = _field_contradicts(fit, s)
    if code is not None:
        codes = [code] * 3
    elif np.any(np.abs(np.r_[scale - prior.scale, bias - prior.bias]) > LARGEST_PRIOR_DISTANCE_SD * before):
        codes = [ReasonCode.PRIOR_CONTRADICTED] * 3
    else:
        codes = judged_scales(
            scale,
            covariance,
            polarity=s.polarity[sensor],
            nominal_scale=s.nominal_scale[sensor],
            max_scale_sd=limit,
        )
        codes = [own or unseen[i] for i, own in enumerate(informed(codes, covariance, prior))]
    return found_of(np.diag(scale), bias, covariance, None, codes, prior)


def _field_contradicts(fit: VelocityFit, s: JointSettings) -> ReasonCode | None:
    gain = np.abs(fit.state.values["magnetometer"][:3]).mean()
    misfit = np.sqrt(3.0 * fit.levels.field) / gain / float(np.linalg.norm(s.field_ned))
    if misfit > s.ellipsoid_max_residual or fit.field_weight < LEAST_MEAN_WEIGHT:
        return ReasonCode.NOT_A_SPHERE
    turned = np.degrees(np.abs(fit.state.values["field"]))
    assumed = s.field_source == FIELD_ASSUMED
    limit = np.degrees(UNKNOWN_FIELD_SD_RAD) * LARGEST_PRIOR_DISTANCE_SD if assumed else MAX_DIP_DIFFERENCE_DEG
    return ReasonCode.FIELD_CONTRADICTED if np.any(turned > limit) else None


def force_share(fit: VelocityFit) -> Array:
    """Rms of each axis' specific force about its mean over the flight, over gravity, (3,): means over intervals."""
    knots = fit.setting.knots
    force = np.einsum("nji,nj->ni", fit.path.turned[:-1], fit.path.push)[knots.joined]
    force /= knots.interval_s[knots.joined, None]
    return np.asarray(force.std(axis=0) / np.linalg.norm(fit.setting.gravity))


def _written(
    fit: VelocityFit, triads: Mapping[Sensor, Found], readings: Readings, tables: Tables, s: JointSettings
) -> StageResult:
    axes, temperature = axes_of(s), mean_temperature(tables)
    rows = constant_rows(triads, Method.VELOCITY, tables, s)
    rows += _receiver_rows(fit, triads, axes, temperature)
    codes = refusals(triads)
    reason = None
    if codes:
        reason = f"Refused by the receiver's velocity ({', '.join(f'{axis}: {code}' for axis, code in codes)})."
    result = {
        "calibration": calibration_rows(rows),
        "covariance": covariance_table(fit.covariance),
        "information": _information(fit, triads, readings, s, temperature),
    }
    if Sensor.GYROSCOPE in triads and not any(triads[Sensor.GYROSCOPE].codes):
        result["trajectory"] = trajectory_table(fit.attitude(readings), tables, axes)
    return StageResult(
        result,
        status_of(triads),
        next((code for _, code in codes), None),
        reason,
        _measured(fit, triads, axes, len(readings.t)),
    )


def _receiver_rows(
    fit: VelocityFit, triads: Mapping[Sensor, Found], axes: Array, temperature_degc: float | None
) -> list[CalibrationRow]:
    """Lag and antenna arm (body axes, from the sensor), where the flight shows them and is believed."""
    found = triads.get(Sensor.ACCELEROMETER)
    if found is None or all((*found.codes, *found.zero_codes)):
        return []
    out: list[CalibrationRow] = []
    (lag, lag_covariance), (arm, arm_covariance) = fit.found("lag"), fit.found("arm")
    lag_sd, arm_sd = np.sqrt(np.diagonal(lag_covariance)), np.sqrt(np.diagonal(axes @ arm_covariance @ axes.T))
    told = [None if sd < LARGEST_ARM_SD_M else ReasonCode.TOO_LITTLE_MOTION for sd in arm_sd]
    for parameter, at, value, sd, unit, codes in (
        (GNSS_LAG, ("",), lag, lag_sd, "s", [None if lag_sd[0] < LARGEST_LAG_SD_S else ReasonCode.TOO_LITTLE_MOTION]),
        (GNSS_LEVER_ARM, AXES, axes @ arm, arm_sd, "m", told),
    ):
        out += quantity_rows(
            Sensor.ACCELEROMETER,
            Method.VELOCITY,
            parameter,
            at,
            value,
            sd,
            unit=unit,
            temperature_degc=temperature_degc,
            reason_code=codes,
        )
    return out


def _information(
    fit: VelocityFit,
    triads: Mapping[Sensor, Found],
    readings: Readings,
    s: JointSettings,
    temperature_degc: float | None,
) -> pl.DataFrame:
    """What the flight says of all constants together; of a sensor that contradicts itself, and of a scale that passes
    for something else, nothing counts."""
    found = observed(fit)
    found = found.of([name for name in found.names if name[0] in triads])
    refused: dict[Name, ReasonCode] = {}
    for sensor, own in triads.items():
        wrong = [code for code in own.codes if code is not None and code not in SCALE_ALONE]
        refused |= {name: wrong[0] for name in found.names if wrong and name[0] == sensor}
        for axis, code in zip(AXES, unshown(fit, readings, sensor), strict=True):
            if code is not None:
                refused.setdefault((str(sensor), GAIN, axis), code)
    units = {sensor: (UNITS[sensor] or s.field_unit, s.units[sensor]) for sensor in SENSORS}
    table = table_of(found, [refused.get(name) for name in found.names], units)
    return table.with_columns(temperature_degc=pl.lit(temperature_degc, pl.Float64))


def _measured(fit: VelocityFit, triads: Mapping[Sensor, Found], axes: Array, n: int) -> dict[str, Json]:
    (lag, lag_covariance), (arm, arm_covariance) = fit.found("lag"), fit.found("arm")
    out: dict[str, Json] = {
        "rung": Rung.BY_VELOCITY,
        "use_velocity": True,
        "n_samples": n,
        "iterations": fit.iterations,
        "velocity_epochs": len(fit.t),
        "velocity_residual_mps": [float(v) for v in np.sqrt(np.mean(fit.residual**2, axis=0))],
        "velocity_noise_ratio": [float(v) for v in np.sqrt(fit.levels.receiver)],
        "velocity_colour": [float(v) for v in fit.levels.colour],
        "velocity_mean_weight": float(fit.weight.mean()),
        "gnss_lag_s": float(lag[0]),
        "gnss_lag_sd_s": float(np.sqrt(lag_covariance[0, 0])),
        "gnss_lever_arm_m": [float(v) for v in axes @ arm],
        "gnss_lever_arm_sd_m": [float(v) for v in np.sqrt(np.diagonal(axes @ arm_covariance @ axes.T))],
        "gyro_walk_deg_per_sqrt_s": float(np.degrees(np.sqrt(fit.levels.turn))),
        "velocity_walk_mps_per_sqrt_s": float(np.sqrt(fit.levels.push)),
        "force_share": [float(v) for v in force_share(fit)],
        "scale_relative_sd": {
            str(name): (np.sqrt(np.diagonal(found.covariance)[:3]) / np.abs(np.diagonal(found.matrix))).tolist()
            for name, found in triads.items()
        },
    }
    if "field" in fit.layout:
        field, covariance = fit.found("field")
        out["field_turned_deg"] = [float(v) for v in np.degrees(field)]
        out["field_turned_sd_deg"] = [float(v) for v in np.degrees(np.sqrt(np.diagonal(covariance)))]
    return out


def better(by_velocity: StageResult, by_vectors: StageResult) -> bool:
    """Whether, near one place, where both hold, the velocity's estimate takes nothing from what the vectors' publishes:
    every row of theirs is there, with an sd that is no larger."""
    own, theirs = (_published(result) for result in (by_velocity, by_vectors))
    return bool(own) and all(name in own and own[name] <= sd for name, sd in theirs.items())


def _published(result: StageResult) -> dict[tuple[str, str, str], float]:
    """Sd of each scale and zero that is not refused."""
    if "calibration" not in result.tables:
        return {}
    told = (pl.col("status") == Status.OK) & pl.col("parameter").is_in(["scale", "zero"])
    rows = result.tables["calibration"].filter(told).select("sensor", "parameter", "axis", "sd")
    return {(sensor, parameter, axis): sd for sensor, parameter, axis, sd in rows.iter_rows()}


def not_taken(code: ReasonCode | None, sentence: str | None) -> dict[str, Json]:
    """Why the velocity was not used, for `measured`."""
    return {"use_velocity": False, "use_velocity_reason": code, "use_velocity_sentence": sentence}


def noted(result: StageResult, told: Mapping[str, Json]) -> StageResult:
    """A result with why the velocity was not used."""
    return replace(result, measured={**result.measured, **told})
