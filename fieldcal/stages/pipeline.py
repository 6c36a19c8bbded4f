"""The pipeline: the stages in order, the tables that each reads and writes, and the settings that it takes.

Tables are named `stage.table`; the log's own are `ingest.imu`, `ingest.magnetometer`, … . `run_flight` walks it in
memory; the night walks the same tuple through its cache.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import polars as pl

from fieldcal.config.flight_settings import FlightSettings
from fieldcal.config.stage_settings import (
    AccelerometerSettings,
    AttitudeSettings,
    ChoiceSettings,
    CompositionSettings,
    GatedAccelerometerSettings,
    GyroEquationPass2Settings,
    GyroEquationSettings,
    GyroOutputSettings,
    JointSettings,
    MagnetometerSettings,
    ManoeuvreSettings,
    MomentsSettings,
    S,
    SanitySettings,
    SmoothingSettings,
    VectorsSettings,
    VerifySettings,
    VpsSyncSettings,
    WarmUpSettings,
)
from fieldcal.names import VECTOR_SENSORS, Sensor
from fieldcal.stages import (
    attitude,
    choice,
    comparison,
    composition,
    gyroscope,
    preparation,
    sanity,
    vector_triads,
    vps,
)
from fieldcal.stages.beside import moments, warm_up
from fieldcal.stages.inputs import Tables
from fieldcal.stages.joint import estimate
from fieldcal.stages.results import StageResult
from fieldcal.stages.stage import Stage, run_stage


def _stage(
    name: str,
    function: Callable[[Tables, S], StageResult],
    takes: type[S],
    reads: Mapping[str, str],
    needs: tuple[str, ...],
    writes: tuple[str, ...],
    trusts: tuple[Sensor, ...] = (),
    hands_on: tuple[str, ...] = (),
) -> Stage:
    """A stage whose function takes the settings that it is given."""
    return Stage(name, function, takes, reads, needs, writes, trusts, hands_on)


INGEST = "ingest"

FAULTS = {"faults": "sanity.faults"}
SAMPLES = {"samples": "smoothing.samples"}
TRIAD = {**SAMPLES, "temperature": "ingest.temperature", **FAULTS}
MAGNETOMETER = {"magnetometer": "magnetometer.calibration"}
COVARIANCES = {
    "magnetometer_covariance": "magnetometer.covariance",
    "accelerometer_covariance": "accelerometer_pass2.covariance",
}

PIPELINE: tuple[Stage, ...] = (
    _stage(
        "sanity",
        sanity.check_sensors,
        SanitySettings,
        {"imu": "ingest.imu", "magnetometer": "ingest.magnetometer"},
        (),
        ("faults",),
    ),
    _stage(
        "manoeuvre",
        preparation.find_manoeuvre,
        ManoeuvreSettings,
        {"imu": "ingest.imu"},
        ("imu",),
        ("segments",),
    ),
    _stage(
        "smoothing",
        preparation.smooth,
        SmoothingSettings,
        {"imu": "ingest.imu", "magnetometer": "ingest.magnetometer", "segments": "manoeuvre.segments"},
        ("imu", "segments"),
        ("samples",),
        hands_on=("samples",),
    ),
    _stage(
        "magnetometer",
        vector_triads.calibrate_magnetometer,
        MagnetometerSettings,
        {**TRIAD, "magnetometer": "ingest.magnetometer", "segments": "manoeuvre.segments"},
        ("samples", "segments"),
        ("calibration", "covariance"),
        (Sensor.MAGNETOMETER,),
    ),
    _stage(
        "accelerometer",
        vector_triads.calibrate_accelerometer,
        AccelerometerSettings,
        TRIAD,
        ("samples",),
        ("calibration", "covariance"),
        (Sensor.ACCELEROMETER,),
    ),
    _stage(
        "attitude",
        attitude.estimate_attitude,
        AttitudeSettings,
        {**SAMPLES, **FAULTS, **MAGNETOMETER, "accelerometer": "accelerometer.calibration"},
        ("samples",),
        ("attitude", "faults"),
        VECTOR_SENSORS,
        hands_on=("attitude",),
    ),
    _stage(
        "gyro_equation",
        gyroscope.calibrate_gyro_equation,
        GyroEquationSettings,
        {**TRIAD, "attitude": "attitude.attitude"},
        ("samples", "attitude"),
        ("calibration", "covariance"),
        (Sensor.GYROSCOPE,),
    ),
    # Second pass, with rates: the lever arm is corrected (Eq. 3), samples are gated.
    _stage(
        "accelerometer_pass2",
        vector_triads.calibrate_accelerometer_gated,
        GatedAccelerometerSettings,
        {
            **TRIAD,
            "accelerometer": "accelerometer.calibration",
            "gyroscope": "gyro_equation.calibration",
        },
        ("samples",),
        ("calibration", "covariance"),
        (Sensor.ACCELEROMETER,),
    ),
    _stage(
        "attitude_pass2",
        attitude.estimate_attitude,
        AttitudeSettings,
        {**SAMPLES, **FAULTS, **MAGNETOMETER, "accelerometer": "accelerometer_pass2.calibration"},
        ("samples",),
        ("attitude", "faults"),
        VECTOR_SENSORS,
        hands_on=("attitude",),
    ),
    _stage(
        "vectors",
        vector_triads.judge_vectors,
        VectorsSettings,
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
    ),
    _stage(
        "gyro_equation_pass2",
        gyroscope.calibrate_gyro_equation_pass2,
        GyroEquationPass2Settings,
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
        (Sensor.GYROSCOPE,),
    ),
    _stage(
        "gyro_output",
        gyroscope.calibrate_gyro_output,
        GyroOutputSettings,
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
        (Sensor.GYROSCOPE,),
    ),
    _stage(
        "warm_up",
        warm_up.find_warm_up,
        WarmUpSettings,
        {
            "imu": "ingest.imu",
            "temperature": "ingest.temperature",
            "accelerometer": "accelerometer_pass2.calibration",
            **FAULTS,
        },
        ("imu",),
        ("calibration",),
        (Sensor.GYROSCOPE,),
    ),
    _stage(
        "moments",
        moments.collect_moments,
        MomentsSettings,
        {
            **TRIAD,
            **MAGNETOMETER,
            "accelerometer": "accelerometer_pass2.calibration",
            "magnetometer_log": "ingest.magnetometer",
            "segments": "manoeuvre.segments",
            "attitude": "attitude_pass2.attitude",
        },
        ("samples", "segments"),
        ("moments",),
    ),
    _stage(
        "joint",
        estimate.estimate_jointly,
        JointSettings,
        {
            **TRIAD,
            "imu": "ingest.imu",
            "vps": "ingest.vps",
            "gnss_velocity": "ingest.gnss_velocity",
            "magnetometer_log": "ingest.magnetometer",
            "magnetometer": "magnetometer.calibration",
            "accelerometer": "accelerometer_pass2.calibration",
            "gyroscope": "gyro_output.calibration",
            "motor_faults": "vectors.faults",
        },
        (),
        ("calibration", "covariance", "trajectory", "held_out", "faults", "information"),
    ),
    _stage(
        "vps_sync",
        vps.synchronise_vps,
        VpsSyncSettings,
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
        ("sync", "vps_aligned", "faults"),
        (Sensor.GYROSCOPE,),
        hands_on=("vps_aligned",),
    ),
    _stage(
        "verify",
        comparison.verify_fit,
        VerifySettings,
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
    ),
    _stage(
        "choice",
        choice.choose,
        ChoiceSettings,
        {
            **SAMPLES,
            "vectors": "vectors.calibration",
            "gyroscope": "gyro_output.calibration",  # equation error's rows too
            "joint": "joint.calibration",
            "joint_faults": "joint.faults",
            "motor_faults": "vectors.faults",
            "vps_aligned": "vps_sync.vps_aligned",
            "vps_faults": "vps_sync.faults",
            "fit": "verify.fit",
        },
        (),
        ("calibration",),
    ),
    _stage(
        "composition",
        composition.compose,
        CompositionSettings,
        {
            "calibration": "choice.calibration",
            "warm_up": "warm_up.calibration",
            "information": "joint.information",
        },
        (),
        ("calibration", "information"),
    ),
)

# The stages' tables that each published table is made of.
PUBLISHED: dict[str, tuple[str, ...]] = {
    "calibration": ("composition.calibration",),
    "fit": ("verify.fit",),
    "sync": ("vps_sync.sync",),
    "moments": ("moments.moments",),
    "information": ("composition.information",),
}


def run_flight(signals: Mapping[str, pl.DataFrame], settings: FlightSettings) -> dict[str, StageResult]:
    """All stages of one flight, in memory: signal table name → frame in, stage name → result out."""
    tables = {f"ingest.{name}": frame for name, frame in signals.items()}
    results: dict[str, StageResult] = {}
    for stage in PIPELINE:
        result = run_stage(stage, tables, settings)
        results[stage.name] = result
        tables |= {f"{stage.name}.{name}": frame for name, frame in result.tables.items()}
    return results
