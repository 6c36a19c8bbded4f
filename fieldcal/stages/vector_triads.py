"""Magnetometer and accelerometer: ellipsoid fits, the accelerometer's second pass, and their refusals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import polars as pl

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation import ellipsoid, motion_selection
from fieldcal.estimation.ellipsoid import TriadFit
from fieldcal.estimation.ellipsoid_refusals import require_determined
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array
from fieldcal.names import VECTOR_SENSORS, EllipsoidFit, Json, Method, Sensor, Status, Triple
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import logged_constants
from fieldcal.stages.beside.motor_field import allow_for_motor_field, check_motor_field
from fieldcal.stages.inputs import (
    Tables,
    differentiate_by_segment,
    in_used_segments,
    mean_temperature,
    reference_reading,
    refusal,
)
from fieldcal.stages.results import StageResult, fatal_fault, fault_rows, quantity_rows, triad_rows
from fieldcal.stages.tables import AXES, calibration_rows, constants, covariance_table, matrix, seconds, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import (
        AccelerometerSettings,
        EllipsoidSettings,
        GatedAccelerometerSettings,
        MagnetometerSettings,
        VectorsSettings,
    )

ELLIPSOID_METHOD: dict[EllipsoidFit, Method] = {
    "robust": Method.ELLIPSOID_ROBUST,
    "li": Method.ELLIPSOID,
    "li_full": Method.ELLIPSOID_FULL,
    "two_step": Method.ELLIPSOID_TWO_STEP,
    "tls": Method.ELLIPSOID_TLS,
}


GATE_FROM_RMS = 0.01
PROVISIONAL = 0.5


REST_WINDOW_S = 0.5


def calibrate_magnetometer(tables: Tables, s: MagnetometerSettings) -> StageResult:
    """magnetometer, segments → calibration: hard iron and scale from the length of the local field."""
    strength = float(np.linalg.norm(s.field_ned))
    return _ellipsoid_stage(
        Sensor.MAGNETOMETER, tables, s, strength, s.field_unit, _used_readings(tables, Sensor.MAGNETOMETER)
    )


def calibrate_accelerometer(tables: Tables, s: AccelerometerSettings) -> StageResult:
    """samples → calibration: first pass, every sample. Provisional: it only starts the second pass, so its limits are
    wide and, where the refinement does not converge, the algebraic fit is taken."""
    wide = replace(s, ellipsoid_max_scale_sd=PROVISIONAL, ellipsoid_max_residual=PROVISIONAL)
    logged = _used_readings(tables, Sensor.ACCELEROMETER)
    result = _ellipsoid_stage(Sensor.ACCELEROMETER, tables, wide, s.gravity_mps2, "m/s^2", logged)
    if result.reason_code == ReasonCode.ELLIPSOID_DIVERGED:
        result = _ellipsoid_stage(
            Sensor.ACCELEROMETER, tables, replace(wide, ellipsoid="li"), s.gravity_mps2, "m/s^2", logged
        )
    return result


def _used_readings(tables: Tables, name: Sensor) -> Array | None:
    """Unsmoothed readings (n, 3) of the used segments at the sensor's stamps; None when the log has none."""
    if name == Sensor.MAGNETOMETER:
        table = tables.get("magnetometer")
        if table is None or table.is_empty():
            return None
        values = matrix(table, triad(name))[in_used_segments(table, tables["segments"])]
    else:
        values = matrix(tables["samples"], triad(name))
    return None if len(values) == 0 or np.isnan(values).all() else values[np.isfinite(values).all(axis=1)]


def _ellipsoid_stage(
    name: Sensor, tables: Tables, s: EllipsoidSettings, magnitude: float, unit: str, logged: Array | None
) -> StageResult:
    """Fit, judge, and write rows; a refused fit keeps its numbers."""
    if logged is None:
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode(f"no_{name}"), reason=f"The log has no {name} readings."
        )
    method = s.ellipsoid
    source = logged if method == "robust" else _smoothed_or(tables, name, logged)
    try:
        fit = ellipsoid.fit_ellipsoid(source, magnitude, method=method, polarity=s.polarity[name])
    except (UnusableFlight, EstimationError, ValueError) as error:
        return refusal(error, name)
    return _judged(name, fit, tables, s, unit, logged, {})


def _smoothed_or(tables: Tables, name: Sensor, logged: Array) -> Array:
    """Smoothed readings for the algebraic fits (their bias under noise is several per cent on raw counts)."""
    samples = tables.get("samples")
    if samples is None:
        return logged
    smoothed = matrix(samples, triad(name, "smoothed_"))
    return logged if np.isnan(smoothed).any() else smoothed


def _judged(
    name: Sensor, fit: TriadFit, tables: Tables, s: EllipsoidSettings, unit: str, logged: Array, extra: dict[str, Json]
) -> StageResult:
    """Rows of a triad fit, refused ones included, with the numbers that decided."""
    code = reason = None
    measured = {**fit.measured(), **extra}
    try:
        require_determined(
            fit,
            max_condition=s.ellipsoid_max_condition,
            max_scale_sd=s.ellipsoid_max_scale_sd,
            max_residual=s.ellipsoid_max_residual,
            nominal_scale=s.nominal_scale[name],
        )
    except UnusableFlight as refusal:
        code, reason = refusal.reason_code, f"{name.capitalize()}: {refusal}"
        measured |= refusal.measured
    status = Status.OK if code is None else Status.REFUSED
    rows = triad_rows(
        name,
        ELLIPSOID_METHOD[s.ellipsoid],
        fit.scale,
        fit.bias,
        fit.covariance,
        unit=unit,
        logged_unit=s.units[name],
        reference_reading=reference_reading(s, name, logged),
        temperature_degc=mean_temperature(tables),
        reason_code=(code,) * 3,
    )
    result = {"calibration": calibration_rows(rows), "covariance": covariance_table(fit.covariance)}
    return StageResult(result, status, code, reason, measured)


def calibrate_accelerometer_gated(tables: Tables, s: GatedAccelerometerSettings) -> StageResult:
    """samples, first-pass constants and rates → calibration: second pass, corrected for the lever arm (Eq. 3), gated.

    Where the smoothed norm differs from g by more than 1 % rms, other accelerations than gravity were measured: samples
    are then gated (norm near g, slow rotation), if those that pass make the scales more certain."""
    samples = tables["samples"]
    fitted = constants(tables["accelerometer"], Sensor.ACCELEROMETER) if "accelerometer" in tables else None
    calibration = fitted or logged_constants(s, Sensor.ACCELEROMETER)
    if calibration is None or samples["gyroscope_x"].null_count() or samples["accelerometer_x"].null_count():
        # Without rates there is no gate: the first pass again, under the final limits.
        used = _used_readings(tables, Sensor.ACCELEROMETER)
        return _ellipsoid_stage(Sensor.ACCELEROMETER, tables, s, s.gravity_mps2, "m/s^2", used)
    gyro = logged_constants(s, Sensor.GYROSCOPE)
    if gyro is None and "gyroscope" in tables:
        gyro = constants(tables["gyroscope"], Sensor.GYROSCOPE, refused_too=True)
    logged, smoothed = matrix(samples, triad("accelerometer")), matrix(samples, triad("accelerometer", "smoothed_"))
    measured: dict[str, Json] = {"lever_arm_applied": s.lever_arm_m is not None and gyro is not None}
    if gyro is None:
        # Rates in counts: without a scale only rest can be told, against the noise.
        level, noise = motion_selection.windowed_rate(
            seconds(samples["t_ns"], samples["t_ns"][0]), matrix(samples, triad("gyroscope")), REST_WINDOW_S
        )
        slow = level < 4.0 * noise
    else:
        axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
        rate = sensor_model.calibrate(matrix(samples, triad("gyroscope", "smoothed_")), *gyro) @ axes.T
        slow = np.linalg.norm(rate, axis=1) < s.gate_rate_radps
        if s.lever_arm_m is not None:
            arm = _lever_arm(samples, rate, s.lever_arm_m, s.differentiation_window_s)
            logged, smoothed = (
                sensor_model.to_centre_of_mass(x, calibration[0], arm, axes, s.gravity_sign) for x in (logged, smoothed)
            )
    norm = np.linalg.norm(sensor_model.calibrate(smoothed, *calibration), axis=1) / s.gravity_mps2
    quiet = (np.abs(norm - 1.0) < s.gate_norm) & slow
    other = float(np.sqrt(np.mean((norm - 1.0) ** 2)))
    measured |= {"gate_passed": int(quiet.sum()), "gate_share": float(quiet.mean()), "other_acceleration_rms_g": other}
    method, polarity = s.ellipsoid, s.polarity[Sensor.ACCELEROMETER]
    source = logged if method == "robust" else smoothed
    refused: Exception | None = None
    try:
        fit = ellipsoid.fit_ellipsoid(source, s.gravity_mps2, method=method, polarity=polarity)
    except (UnusableFlight, EstimationError, ValueError) as error:
        fit, refused = None, error
    gated = _gated_fit(source, quiet, s) if other > GATE_FROM_RMS else None
    measured["gate_kept"] = gated is not None and (fit is None or _scale_doubt(gated) < _scale_doubt(fit))
    chosen = gated if measured["gate_kept"] else fit
    if chosen is None:
        return refusal(refused or ValueError("no fit"), "accelerometer", measured)
    return _judged(Sensor.ACCELEROMETER, chosen, tables, s, "m/s^2", logged, measured)


def _scale_doubt(fit: TriadFit) -> float:
    """Largest claimed relative sd of a scale."""
    return max(fit.scale_relative_sd)


def _gated_fit(source: Array, quiet: np.ndarray, s: GatedAccelerometerSettings) -> TriadFit | None:
    """Fit of the samples that passed the gate; None where they are few or their directions too alike."""
    if quiet.sum() < 100:
        return None
    try:
        fit = ellipsoid.fit_ellipsoid(
            source[quiet], s.gravity_mps2, method=s.ellipsoid, polarity=s.polarity[Sensor.ACCELEROMETER]
        )
    except (UnusableFlight, EstimationError):
        return None
    enough = fit.condition < s.ellipsoid_max_condition
    return fit if enough else None


def _lever_arm(samples: pl.DataFrame, rate: Array, arm_m: Triple, window_s: float) -> Array:
    """Acceleration of the sensor about the centre of mass, m/s², body axes, from smoothed rates (Eq. 3)."""
    rate_dot = differentiate_by_segment(samples, rate, window_s)
    return sensor_model.lever_arm_acceleration(rate, rate_dot, arm_m)


def _motor_rows(measured: Mapping[str, Json], tables: Tables, s: VectorsSettings) -> pl.DataFrame:
    """What the motors' current, or the throttle, adds to the magnetometer's readings, as rows of the history."""
    found = cast(dict[str, list[float] | str], measured["motor_field"])
    drive = "current" if found["drive"] == "current_a" else "throttle"
    rows = quantity_rows(
        Sensor.MAGNETOMETER,
        Method.MOTOR_FIELD,
        f"field_per_{drive}",
        AXES,
        cast(list[float], found["slope"]),
        cast(list[float], found["slope_sd"]),
        unit=f"{s.field_unit}/A" if drive == "current" else s.field_unit,
        temperature_degc=tables["magnetometer"]["temperature_degc"][0] if "magnetometer" in tables else None,
    )
    return calibration_rows(rows)


def judge_vectors(tables: Tables, s: VectorsSettings) -> StageResult:
    """Both vector triads' calibrations, the attitude's faults and the motors' current → calibration, faults.

    A fit by length alone does not determine polarity or axes: where the attitude found that the triads contradict each
    other, both are refused."""
    measured, motor_faults = check_motor_field(tables, s)
    motor = next((fault for fault in motor_faults if fault.code == ReasonCode.MOTOR_FIELD), None)
    faults = fault_rows(motor_faults)
    if "faults" in tables:
        faults = pl.concat([faults, tables["faults"]])
    parts = []
    for name in VECTOR_SENSORS:
        if name not in tables:
            continue
        fault = fatal_fault(faults, (name,))
        if fault is not None:
            code = pl.when(pl.col("status") == Status.OK).then(pl.lit(fault["reason_code"])).otherwise("reason_code")
            parts.append(tables[name].with_columns(status=pl.lit(Status.REFUSED), reason_code=code))
        elif name == Sensor.MAGNETOMETER and motor is not None:
            parts.append(allow_for_motor_field(tables[name], motor.value, float(np.linalg.norm(s.field_ned))))
        else:
            parts.append(tables[name])
    if "motor_field" in measured:
        parts.append(_motor_rows(measured, tables, s))
    if not parts:
        return StageResult(
            status=Status.ABSENT, reason_code=ReasonCode.NO_VECTORS, reason="Neither vector triad was calibrated."
        )
    fault_table = {}
    if motor_faults:
        measured["faults"] = [fault.plain() for fault in motor_faults]
        fault_table = {"faults": fault_rows(motor_faults)}
    return StageResult(
        {"calibration": pl.concat(parts), **fault_table},
        reason_code=motor_faults[0].code if motor_faults else None,
        reason=" ".join(fault.sentence for fault in motor_faults) or None,
        measured=measured,
    )
