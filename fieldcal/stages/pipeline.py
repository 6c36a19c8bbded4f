"""The whole data path, as one tuple: who reads what, who writes what, and which settings matter.

Tables are named `stage.table`; the log's own are `ingest.imu`, `ingest.magnetometer`, … . `run_flight` walks it in
memory; the night walks the same tuple through its cache.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import polars as pl

from fieldcal.schemas import SchemaMismatch, conform
from fieldcal.stages import attitude, comparison, gyroscope, joint, preparation, sanity, vector_triads, vps, warm_up
from fieldcal.stages.results import StageResult, fatal_fault

Run = Callable[[Mapping[str, pl.DataFrame], Mapping[str, Any]], StageResult]


@dataclass(frozen=True)
class Stage:
    """One stage: `reads` maps the function's own names to `stage.table`, `needs` are those it cannot do without,
    `trusts` the sensors that must be free of fatal faults."""

    name: str
    function: Run
    reads: Mapping[str, str]
    needs: tuple[str, ...]
    writes: tuple[str, ...]
    settings: tuple[str, ...]
    trusts: tuple[str, ...] = ()


INGEST = "ingest"

ELLIPSOID = (
    "ellipsoid",
    "ellipsoid_max_condition",
    "ellipsoid_max_scale_sd",
    "ellipsoid_max_residual",
    "polarity",
    "units",
    "nominal_scale",
    "reference_reading",
)
AXES = ("rotation_body_from_sensor", "body")
SMOOTHING = ("smoothing_cutoff_hz", "smoothing_ends", "smoothing_side_s")
VECTORS = ("field_ned", "gravity_mps2", "gravity_sign", "nominal_scale", "polarity", "units", *AXES)
GYRO = ("gyro_max_scale_sd", "nominal_scale", "polarity", "units", "reference_reading", *AXES)
EQUATION = ("equations", "differentiation_window_s", "smoothing_cutoff_hz", "smoothing_side_s")
VPS = ("world", "vps_max_lag_s", "vps_min_peak", "vps_max_gap_s")
FAULTS = {"faults": "sanity.faults"}
SAMPLES = {"samples": "smoothing.samples"}
TRIAD = {**SAMPLES, "temperature": "ingest.temperature", **FAULTS}
MAGNETOMETER = {"magnetometer": "magnetometer.calibration"}
COVARIANCES = {
    "magnetometer_covariance": "magnetometer.covariance",
    "accelerometer_covariance": "accelerometer_pass2.covariance",
}

PIPELINE: tuple[Stage, ...] = (
    Stage(
        "sanity",
        sanity.check_sensors,
        {"imu": "ingest.imu", "magnetometer": "ingest.magnetometer"},
        (),
        ("faults",),
        ("units", "nominal_scale", "field_ned", "field_unit", "gravity_mps2"),
    ),
    Stage(
        "manoeuvre",
        preparation.find_manoeuvre,
        {"imu": "ingest.imu"},
        ("imu",),
        ("segments",),
        (
            "manoeuvre_window_s",
            "manoeuvre_pad_s",
            "manoeuvre_rest_s",
            "manoeuvre_min_s",
            "manoeuvre_max_gap_s",
            "manoeuvre_excited_ratio",
        ),
    ),
    Stage(
        "smoothing",
        preparation.smooth,
        {"imu": "ingest.imu", "magnetometer": "ingest.magnetometer", "segments": "manoeuvre.segments"},
        ("imu", "segments"),
        ("samples",),
        SMOOTHING,
    ),
    Stage(
        "magnetometer",
        vector_triads.calibrate_magnetometer,
        {**TRIAD, "magnetometer": "ingest.magnetometer", "segments": "manoeuvre.segments"},
        ("samples", "segments"),
        ("calibration", "covariance"),
        (*ELLIPSOID, "field_ned", "field_unit"),
        ("magnetometer",),
    ),
    Stage(
        "accelerometer",
        vector_triads.calibrate_accelerometer,
        TRIAD,
        ("samples",),
        ("calibration", "covariance"),
        (*ELLIPSOID, "gravity_mps2"),
        ("accelerometer",),
    ),
    Stage(
        "attitude",
        attitude.estimate_attitude,
        {**SAMPLES, **FAULTS, **MAGNETOMETER, "accelerometer": "accelerometer.calibration"},
        ("samples",),
        ("attitude", "faults"),
        (*VECTORS, "attitude", "field_source"),
        attitude.VECTOR_SENSORS,
    ),
    Stage(
        "gyro_equation",
        gyroscope.calibrate_gyro_equation,
        {**TRIAD, "attitude": "attitude.attitude"},
        ("samples", "attitude"),
        ("calibration", "covariance"),
        (*GYRO, *EQUATION),
        ("gyroscope",),
    ),
    # Second pass, now with rates: lever arm (Eq. 3) and sample gate.
    Stage(
        "accelerometer_pass2",
        vector_triads.calibrate_accelerometer_gated,
        {
            **TRIAD,
            "accelerometer": "accelerometer.calibration",
            "gyroscope": "gyro_equation.calibration",
        },
        ("samples",),
        ("calibration", "covariance"),
        (
            *ELLIPSOID,
            *AXES,
            "gravity_mps2",
            "gravity_sign",
            "lever_arm_m",
            "gate_norm",
            "gate_rate_radps",
            "differentiation_window_s",
        ),
        ("accelerometer",),
    ),
    Stage(
        "attitude_pass2",
        attitude.estimate_attitude,
        {**SAMPLES, **FAULTS, **MAGNETOMETER, "accelerometer": "accelerometer_pass2.calibration"},
        ("samples",),
        ("attitude", "faults"),
        (*VECTORS, "attitude", "field_source"),
        attitude.VECTOR_SENSORS,
    ),
    Stage(
        "vectors",
        vector_triads.judge_vectors,
        {
            "magnetometer": "magnetometer.calibration",
            "accelerometer": "accelerometer_pass2.calibration",
            "faults": "attitude_pass2.faults",
            "readings": "ingest.magnetometer",
            "segments": "manoeuvre.segments",
            "power": "ingest.power",
            "sanity": "sanity.faults",
        },
        (),
        ("calibration", "faults"),
        ("field_ned", "field_unit", "polarity"),
    ),
    Stage(
        "gyro_equation_pass2",
        gyroscope.calibrate_gyro_equation,
        {
            **TRIAD,
            **MAGNETOMETER,
            "accelerometer": "accelerometer_pass2.calibration",
            **COVARIANCES,
            "attitude": "attitude_pass2.attitude",
            "attitude_faults": "vectors.faults",
        },
        ("samples", "attitude"),
        ("calibration", "covariance"),
        (*GYRO, *VECTORS, *EQUATION),
        ("gyroscope",),
    ),
    Stage(
        "gyro_output",
        gyroscope.calibrate_gyro_output,
        {
            **TRIAD,
            **MAGNETOMETER,
            "accelerometer": "accelerometer_pass2.calibration",
            **COVARIANCES,
            "attitude": "attitude_pass2.attitude",
            "gyroscope": "gyro_equation_pass2.calibration",
        },
        ("samples", "attitude", "gyroscope"),
        ("calibration", "covariance"),
        (*GYRO, *VECTORS, "gyro_output", "initial_attitude", "shooting_s"),
        ("gyroscope",),
    ),
    Stage(
        "warm_up",
        warm_up.find_warm_up,
        {
            "imu": "ingest.imu",
            "temperature": "ingest.temperature",
            "accelerometer": "accelerometer_pass2.calibration",
            **FAULTS,
        },
        ("imu",),
        ("calibration",),
        ("units", "manoeuvre_max_gap_s"),
        ("gyroscope",),
    ),
    Stage(
        "joint",
        joint.estimate_jointly,
        {
            **TRIAD,
            "imu": "ingest.imu",
            "vps": "ingest.vps",
            "magnetometer_log": "ingest.magnetometer",
            "magnetometer": "magnetometer.calibration",
            "accelerometer": "accelerometer_pass2.calibration",
            "gyroscope": "gyro_output.calibration",
            "motor_faults": "vectors.faults",
        },
        (),
        ("calibration", "covariance", "trajectory", "held_out"),
        (
            *AXES,
            "method",
            "polarity",
            "units",
            "nominal_scale",
            "reference_reading",
            "field_ned",
            "field_unit",
            "gravity_mps2",
            "gravity_sign",
            "lever_arm_m",
            "ellipsoid_max_scale_sd",
            "ellipsoid_max_residual",
            "gyro_max_scale_sd",
            "use_vps",
            *VPS,
        ),
    ),
    Stage(
        "vps_sync",
        vps.synchronise_vps,
        {
            "imu": "ingest.imu",
            "vps": "ingest.vps",
            "magnetometer_log": "ingest.magnetometer",
            "attitude": "attitude_pass2.attitude",
            "gyroscope": "gyro_output.calibration",
            "joint": "joint.calibration",
            "trajectory": "joint.trajectory",
            "motor_faults": "vectors.faults",
            **FAULTS,
        },
        ("imu",),
        ("sync", "vps_aligned"),
        (*AXES, "polarity", "nominal_scale", *VPS),
        ("gyroscope",),
    ),
    Stage(
        "verify",
        comparison.verify_fit,
        {
            **SAMPLES,
            "magnetometer": "magnetometer.calibration",
            "accelerometer": "accelerometer_pass2.calibration",
            "attitude": "attitude_pass2.attitude",
            "gyroscope": "gyro_output.calibration",
            "vps_aligned": "vps_sync.vps_aligned",
            "joint": "joint.calibration",
            "trajectory": "joint.trajectory",
            "held_out": "joint.held_out",
        },
        ("samples",),
        ("fit",),
        (*VECTORS, *SMOOTHING, "attitude", "differentiation_window_s", "initial_attitude"),
    ),
)

# Which stage's table is the flight's word, for each published table.
PUBLISHED: dict[str, tuple[str, ...]] = {
    "calibration": (
        "vectors.calibration",
        "gyro_output.calibration",  # equation error's rows too
        "joint.calibration",
        "warm_up.calibration",
    ),
    "fit": ("verify.fit",),
    "sync": ("vps_sync.sync",),
}


def run_stage(stage: Stage, tables: Mapping[str, pl.DataFrame], settings: Mapping[str, Any]) -> StageResult:
    """Run one stage on `stage.table` tables; missing needs end as a refusal that names them."""
    inputs = {own: tables[name] for own, name in stage.reads.items() if name in tables}
    result = refused_beforehand(stage, inputs)
    if result is None:
        result = stage.function(inputs, {name: settings[name] for name in stage.settings})
        _check_written(stage, result)
    return result


def refused_beforehand(stage: Stage, inputs: Mapping[str, pl.DataFrame]) -> StageResult | None:
    """The refusal of a stage that is not to run on these inputs: a sensor is faulty, or something needed is missing."""
    # An attitude is as good as the vectors that it came from.
    for faults, sensors in (("faults", stage.trusts), ("attitude_faults", attitude.VECTOR_SENSORS)):
        fault = fatal_fault(inputs[faults], sensors) if faults in inputs else None
        if fault is not None:
            return StageResult(
                status="refused",
                reason_code=str(fault["reason_code"]),
                reason=str(fault["reason"]),
                measured={"number": fault["number"], "limit": fault["limit"]},
            )
    for need in stage.needs:
        if need not in inputs:
            source = stage.reads[need].split(".")[0]
            return StageResult(
                status="refused",
                reason_code=f"no_{need}",
                reason=f"{stage.name} needs {stage.reads[need]}, which {source} could not give.",
            )
    return None


def _check_written(stage: Stage, result: StageResult) -> None:
    """Raise `SchemaMismatch` unless what a stage wrote is what it declares, by the tables' schemas."""
    if undeclared := sorted(set(result.tables) - set(stage.writes)):
        raise SchemaMismatch(f"stage {stage.name} wrote {', '.join(undeclared)}, which it does not declare")
    for name, frame in result.tables.items():
        conform(frame.to_arrow(), name, stage=True)


def run_flight(signals: Mapping[str, pl.DataFrame], settings: Mapping[str, Any]) -> dict[str, StageResult]:
    """All stages of one flight, in memory: signal table name → frame in, stage name → result out."""
    tables = {f"ingest.{name}": frame for name, frame in signals.items()}
    results: dict[str, StageResult] = {}
    for stage in PIPELINE:
        result = run_stage(stage, tables, settings)
        results[stage.name] = result
        tables |= {f"{stage.name}.{name}": frame for name, frame in result.tables.items()}
    return results
