"""The joint estimate of all triads and the attitude: by the VPS where there is one, else by a satellite receiver's
velocity (method `velocity`) or by vectors; judged, tried on held-out data, written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import EstimationError, FieldcalError, UnusableFlight
from fieldcal.estimation.by_pose.triad import TriadByPose
from fieldcal.estimation.by_velocity.problem import Epochs
from fieldcal.estimation.faults import Fault
from fieldcal.estimation.joint import model_selection
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.estimation.joint.ladder import fit_with_fallbacks
from fieldcal.estimation.joint.problem import Readings
from fieldcal.geometry.rotation import Array, multiply
from fieldcal.names import SENSORS, Json, Method, Rung, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables, mean_temperature, reference_reading, refusal
from fieldcal.stages.joint.beside import beside_rows
from fieldcal.stages.joint.by_velocity import better, epochs_of, estimate_by_velocity, not_taken, noted, travelled
from fieldcal.stages.joint.by_vps import (
    ByVps,
    estimate_by_vps,
    not_used,
    poses_of,
)
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
from fieldcal.stages.joint.information import information_of
from fieldcal.stages.joint.judgement import judged, judged_scales, measured_of, triad_of
from fieldcal.stages.joint.readings import readings_of, start_constants
from fieldcal.stages.results import StageResult, fatal_fault, fault_rows, triad_rows, zero_slope_rows
from fieldcal.stages.tables import (
    CalibrationRow,
    calibration_rows,
    covariance_table,
)
from fieldcal.stages.vps_poses import AdmittedPoses

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import JointSettings

HELD_IN_SHARE = 0.7


def estimate_jointly(tables: Tables, s: JointSettings) -> StageResult:
    """samples, serial constants, VPS → calibration, covariance, trajectory, held_out: everything in one likelihood."""
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
    poses = poses_of(tables, s)
    by_vps: Mapping[str, Json] = {"use_vps": False} if s.use_vps is True else {}
    if poses is not None:
        try:
            return _with_vps(estimate_by_vps(readings, poses, s), readings, tables, s, poses)
        except (UnusableFlight, EstimationError) as error:
            by_vps = not_used(error)
    epochs = epochs_of(tables, s) if poses is None else None
    if epochs is None:
        return _with_vectors(readings, tables, s, by_vps)
    return _with_velocity(epochs, readings, tables, s, by_vps)


def _with_velocity(
    epochs: Epochs, readings: Readings, tables: Tables, s: JointSettings, by_vps: Mapping[str, Json]
) -> StageResult:
    """By the receiver's velocity where the vehicle travelled, which the vectors' model has no place for, or where that
    takes nothing from what they publish; else by vectors, with the reason."""
    try:
        by_velocity = estimate_by_velocity(readings, epochs, tables, s)
    except (UnusableFlight, EstimationError) as error:
        return noted(_with_vectors(readings, tables, s, by_vps), not_taken(error.reason_code, str(error)))
    if by_velocity.status == Status.OK and travelled(epochs, readings):
        return by_velocity
    by_vectors = _with_vectors(readings, tables, s, by_vps)
    if better(by_velocity, by_vectors):
        return by_velocity
    code = ReasonCode.OTHER_METHOD_CHOSEN if by_velocity.status == Status.OK else by_velocity.reason_code
    return noted(by_vectors, {**not_taken(code, by_velocity.reason), "by_velocity": by_velocity.measured})


def _with_vps(found: ByVps, readings: Readings, tables: Tables, s: JointSettings, poses: AdmittedPoses) -> StageResult:
    fit, tests = model_selection.add_terms(found.fit)
    triads = {}
    for sensor in chosen(s):
        by_pose = found.triads.get(sensor)
        if sensor in fit.layout:
            triads[sensor] = _of_fit(fit, sensor, s)
        elif isinstance(by_pose, TriadByPose):
            triads[sensor] = _by_pose(by_pose, sensor, s)
    measured = {
        **measured_of(fit, axes_of(s)),
        **found.measured,
        "rung": Rung.BY_VPS,
        "terms": model_selection.summary(tests, fit),
    }
    ned = multiply(found.world, found.close.path.q)
    result = _written(triads, fit, ned, tables, s, measured, found.triads)
    return replace(result, tables={**result.tables, **_held_out(fit, readings, tables, s)})


def _by_pose(triad: TriadByPose, sensor: Sensor, s: JointSettings) -> Found:
    """A vector triad by the VPS's trajectory, judged by the flight's settings."""
    codes: list[ReasonCode | None] = [ReasonCode.NOT_A_SPHERE] * 3
    if triad.misfit <= s.ellipsoid_max_residual:
        codes = judged_scales(
            np.diagonal(triad.matrix),
            triad.diagonal_covariance,
            polarity=s.polarity[sensor],
            nominal_scale=s.nominal_scale[sensor],
            max_scale_sd=s.ellipsoid_max_scale_sd,
        )
    return found_of(triad.matrix, triad.bias, triad.diagonal_covariance, triad.cross_sd, codes, priors(s).get(sensor))


def _with_vectors(readings: Readings, tables: Tables, s: JointSettings, by_vps: Mapping[str, Json]) -> StageResult:
    axes = axes_of(s)
    try:
        outcome = fit_with_fallbacks(readings, start_constants(tables, s, readings), priors(s), lever_arm=_lever_arm(s))
    except UnusableFlight as error:
        return refusal(error, "joint estimate", by_vps)
    except EstimationError as error:
        # It could run and found that the readings contradict each other: no other method is to be believed instead.
        found = refusal(error, "joint estimate", by_vps)
        faults = [
            Fault(sensor, "", error.reason_code, 0.0, 0.0, True, found.reason or str(error)) for sensor in chosen(s)
        ]
        return replace(found, tables={"faults": fault_rows(faults)})
    fit, tests = model_selection.add_terms(outcome.fit)
    triads = {sensor: _of_fit(fit, sensor, s) for sensor in chosen(s) if sensor in fit.layout}
    measured = {
        **measured_of(fit, axes),
        **by_vps,
        "rung": outcome.rung,
        "rungs_without_a_minimum": dict(outcome.failed),
        "terms": model_selection.summary(tests, fit),
    }
    result = _written(triads, fit, fit.path.q, tables, s, measured, {})
    told: dict[str, pl.DataFrame] = {}
    if (code := by_vps.get("use_vps_reason")) == ReasonCode.CLOCK_RATES_DIFFER:
        fault = Fault(Sensor.GYROSCOPE, "", ReasonCode(code), 0.0, 0.0, True, str(by_vps["use_vps_sentence"]))
        told["faults"] = fault_rows([fault])
    return replace(result, tables={**result.tables, **told, **_held_out(fit, readings, tables, s)})


def _lever_arm(s: JointSettings) -> Array | None:
    """As measured on the vehicle, sensor axes."""
    return None if s.lever_arm_m is None else np.asarray(axes_of(s).T @ np.asarray(s.lever_arm_m, dtype=float))


def _held_out(fit: JointFit, readings: Readings, tables: Tables, s: JointSettings) -> dict[str, pl.DataFrame]:
    """Gyroscope constants from the first part of the flight alone, with `from_ns`, where the rest begins: `verify`
    predicts that. None where the part determines nothing, or another method gives the gyroscope's."""
    if Sensor.GYROSCOPE not in chosen(s):
        return {}
    split = int(HELD_IN_SHARE * len(readings.t))
    try:
        early = model_selection.first_part(fit, split)
    except (UnusableFlight, EstimationError):
        return {}
    if early is None:
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


def _of_fit(fit: JointFit, sensor: Sensor, s: JointSettings) -> Found:
    """A triad of the fit, judged by the flight's settings."""
    full, bias, covariance, cross_sd = triad_of(fit, sensor)
    codes = judged(
        sensor,
        fit,
        np.diagonal(full),
        covariance,
        polarity=s.polarity[sensor],
        nominal_scale=s.nominal_scale[sensor],
        max_scale_sd=s.gyro_max_scale_sd if sensor == Sensor.GYROSCOPE else s.ellipsoid_max_scale_sd,
        max_residual=s.ellipsoid_max_residual,
    )
    # A held accelerometer tells no zero either.
    held = ReasonCode.HELD_AT_NOMINAL in codes and sensor != Sensor.GYROSCOPE
    return found_of(full, bias, covariance, cross_sd, codes, None if held else priors(s).get(sensor))


def _written(
    triads: Mapping[Sensor, Found],
    fit: JointFit,
    attitude: Array,
    tables: Tables,
    s: JointSettings,
    measured: Mapping[str, Json],
    by_pose: Mapping[Sensor, TriadByPose | FieldcalError],
) -> StageResult:
    """Rows with a status by sensor and axis, the attitude, the covariance, and the numbers that decided. `attitude`
    (n, 4) of the sensor axes, NED; `by_pose`: what a VPS's trajectory gives of each vector triad, or why nothing."""
    rows = constant_rows(triads, Method.JOINT, tables, s)
    if Sensor.GYROSCOPE in triads:
        rows += _slope_rows(fit, tables, s, triads[Sensor.GYROSCOPE].zero_codes)
    told = [name for name, v in triads.items() if None in (*v.codes, *v.zero_codes)]
    rows += beside_rows(
        fit,
        by_pose,
        axes_of(s),
        told,
        gyroscope_unit=s.units[Sensor.GYROSCOPE],
        temperature_degc=mean_temperature(tables),
    )
    codes = refusals(triads)
    first = next((code for _, code in codes), None)
    parts = []
    if codes:
        parts.append(f"Refused by the joint estimate ({', '.join(f'{axis}: {code}' for axis, code in codes)}).")
        parts.append(str(measured["advice"]))
    parts += [f"{name.capitalize()}: {v}" for name, v in by_pose.items() if isinstance(v, FieldcalError)]
    reason = " ".join(part for part in parts if part) or None
    if not triads:
        first, reason = (
            ReasonCode(f"no_{chosen(s)[0]}"),
            "None of the sensors that method joint is chosen for has readings.",
        )
    result = {"calibration": calibration_rows(rows), "covariance": covariance_table(fit.covariance)}
    result["information"] = information_of(
        fit,
        {sensor: found.codes for sensor, found in triads.items()},
        by_pose,
        axes_of(s),
        units={sensor: (UNITS[sensor] or s.field_unit, s.units[sensor]) for sensor in SENSORS},
        temperature_degc=mean_temperature(tables),
    )
    if fit.vps is not None or not any(_of_fit(fit, Sensor.GYROSCOPE, s).codes):
        result["trajectory"] = trajectory_table(attitude, tables, axes_of(s))
    return StageResult(result, status_of(triads), first, reason, measured)


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
