"""Synchronise the visual positioning system with the IMU and put it into the IMU's frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import UnusableFlight
from fieldcal.estimation import smoothing
from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.clock_sync.by_field import refine_by_field
from fieldcal.estimation.faults import Fault
from fieldcal.estimation.wahba import rotation_between
from fieldcal.geometry import sensor_model
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import (
    IDENTITY,
    Array,
    body_from_inertial,
    conjugate,
    continuous,
    from_matrix,
    mean_quaternion,
    multiply,
    slerp,
)
from fieldcal.names import Json, Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import logged_constants
from fieldcal.stages.inputs import Tables, is_sound
from fieldcal.stages.results import StageResult, fault_rows
from fieldcal.stages.tables import AXES, QUATERNION, columns_of, constants, matrix, seconds, triad
from fieldcal.stages.vps_poses import AdmittedPoses, admitted_poses, clock_of, far_clock

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import LoggedValues, VpsSyncSettings

BRIDGE_S = 0.1  # IMU results are interpolated to VPS stamps only between samples this close


RATE_COLUMNS = [f"rate_{axis}_radps" for axis in AXES]


SYNC_NUMBERS = ("lag_s", "lag_mid_s", "lag_sd_s", "skew_ppm", "skew_sd_ppm", "peak", "runner_up")


def synchronise_vps(tables: Tables, s: VpsSyncSettings) -> StageResult:
    """imu, vps, gyroscope constants, attitude → sync, vps_aligned: the VPS on the IMU's clock and in its frames."""
    if "vps" not in tables or tables["vps"].is_empty():
        return StageResult(status=Status.ABSENT, reason_code=ReasonCode.NO_VPS, reason="The log has no VPS.")
    imu, vps = tables["imu"], tables["vps"]
    logged = matrix(imu, triad("gyroscope"))
    if np.isnan(logged).any():
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NO_GYROSCOPE, reason="Synchronisation needs a gyroscope."
        )
    gyro = _gyro_constants(tables, s)
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    # As wired at least: a mirrored axis would be taken for a mirrored VPS.
    right_handed = (logged - np.median(logged, axis=0)) * np.asarray(s.polarity[Sensor.GYROSCOPE], dtype=float)
    rate = (right_handed if gyro is None else sensor_model.calibrate(logged, *gyro)) @ axes.T
    origin = int(imu["t_ns"][0])
    t_imu = seconds(imu["t_ns"], origin)
    poses = admitted_poses(vps, origin, float(t_imu[-1]), s)
    measured: dict[str, Json] = {**poses.measured, "gyro_calibrated": gyro is not None}
    t_vps, q_vps = poses.t, poses.q
    try:
        fit = clock_of(poses, t_imu, rate, q_vps, s)
    except UnusableFlight as error:
        row = _sync_row(
            {"status": Status.REFUSED, "peak": error.measured.get("peak"), "runner_up": error.measured.get("runner_up")}
        )
        measured |= {**error.measured, "faults": [f.plain() for f in poses.found]}
        faults = list(poses.found)
        if error.reason_code == ReasonCode.CLOCK_RATES_DIFFER:
            faults.append(Fault(Sensor.GYROSCOPE, "", error.reason_code, 0.0, 0.0, True, str(error)))
        found = {"sync": row, "faults": fault_rows(faults)}
        return StageResult(found, Status.REFUSED, error.reason_code, str(error), measured)
    fit, by_field = _refined(fit, tables, origin, poses)
    told = [*poses.found, *far_clock(poses, fit.lag_mid_s, s.vps_max_lag_s)]
    measured |= {**by_field, "faults": [f.plain() for f in told]}
    row = _sync_row(
        {
            "lag_s": fit.lag_s - poses.base_s,
            "lag_mid_s": fit.lag_mid_s - poses.base_s,
            "lag_sd_s": fit.lag_sd_s,
            "skew_ppm": fit.skew_ppm,
            "skew_sd_ppm": fit.skew_sd_ppm,
            "peak": fit.peak,
            "runner_up": fit.runner_up,
            "status": "ok",
        }
    )
    t_vps = fit.to_imu_clock(t_vps)
    aligned, rotations = _aligned(t_vps, q_vps, t_imu, rate, tables, poses.max_gap_s, calibrated=gyro is not None)
    measured |= rotations | {"peak_width_s": fit.peak_width_s}
    t_ns = np.rint(aligned["t"] * 1e9).astype(np.int64) + origin
    table = pl.DataFrame(
        {"t_ns": t_ns, **columns_of(aligned["q"], QUATERNION), **columns_of(aligned["rate"], RATE_COLUMNS)}
    )
    return StageResult({"sync": row, "vps_aligned": table, "faults": fault_rows(told)}, measured=measured)


def _refined(
    fit: by_rates.SyncFit, tables: Tables, origin: int, poses: AdmittedPoses
) -> tuple[by_rates.SyncFit, dict[str, Json]]:
    """The clock refined by the magnetometer where that has no fault, and the numbers of it."""
    table = tables.get("magnetometer_log")
    if table is None or table.is_empty() or not is_sound(tables, "magnetometer"):
        return fit, {"synchronised_by": "gyroscope"}
    logged = matrix(table, triad("magnetometer"))
    refined, field_clock = refine_by_field(
        seconds(table["t_ns"], origin), logged, poses.t, poses.q, fit, max_gap_s=poses.max_gap_s
    )
    if field_clock is None:
        return fit, {"synchronised_by": "gyroscope"}
    return refined, {
        "synchronised_by": "gyroscope" if refined is fit else "gyroscope and magnetometer",
        # Positive: the magnetometer's readings are older than the gyroscope's.
        "magnetometer_delay_s": field_clock.lag_mid_s - fit.lag_mid_s,
        "magnetometer_delay_sd_s": float(np.hypot(np.sqrt(field_clock.covariance[0, 0]), fit.lag_sd_s)),
    }


def _sync_row(values: dict[str, Json]) -> pl.DataFrame:
    row = dict.fromkeys(SYNC_NUMBERS) | values
    return pl.DataFrame([row], schema={**dict.fromkeys(SYNC_NUMBERS, pl.Float64), "status": pl.String})


def _gyro_constants(tables: Tables, s: LoggedValues) -> tuple[Array, Array] | None:
    """The joint estimate's constants, else output error's, equation error's, the logged unit's, or None."""
    found = constants(tables["joint"], Sensor.GYROSCOPE) if "joint" in tables else None
    if found is not None:
        return found
    for method in (Method.OUTPUT_ERROR, Method.EQUATION_ERROR):
        found = constants(tables["gyroscope"], Sensor.GYROSCOPE, method) if "gyroscope" in tables else None
        if found is not None:
            return found
    return logged_constants(s, Sensor.GYROSCOPE)


def _aligned(
    t_vps: Array, q_vps: Array, t_imu: Array, rate: Array, tables: Tables, max_gap_s: float, *, calibrated: bool
) -> tuple[dict[str, Array], dict[str, Json]]:
    """VPS attitude and rate on a uniform grid at its own rate, IMU clock, both constant rotations applied."""
    # Rates of slow poses are taken on a finer grid: on their own one five of them are a whole manoeuvre.
    every = max(1, int(np.ceil(float(np.median(np.diff(t_vps))) / by_rates.SLOW_POSE_S)))
    interval = float(np.median(np.diff(t_vps))) / every
    rates = by_rates.vps_rates(t_vps, q_vps, interval, max_gap_s=max_gap_s)
    t = rates.t
    inside = rates.valid & (t >= t_imu[0]) & (t <= t_imu[-1])
    between = slerp if every == 1 else by_rates.cubic
    t, q, vps_rate = t[inside], between(t_vps, continuous(q_vps), t[inside]), rates.rate[inside]
    own_rate = smoothing.low_pass(
        np.column_stack([np.interp(t, t_imu, c) for c in rate.T]), by_rates.FINE_CUTOFF_HZ, interval
    )
    body = IDENTITY
    if calibrated:
        smooth = smoothing.low_pass(vps_rate, by_rates.FINE_CUTOFF_HZ, interval)
        # ω_body = R ω_vps: components turn by A(body) = R, the attitude by the same quaternion on the right.
        body = from_matrix(rotation_between(smooth, own_rate))
    q = multiply(q, body)
    vps_rate = sensor_rotation(vps_rate, body)
    world = IDENTITY
    attitude = tables.get("attitude")
    if "trajectory" in tables:
        attitude = tables["trajectory"].with_columns(weight=pl.lit(1.0))
    if attitude is not None:
        origin = int(tables["imu"]["t_ns"][0])
        own_t = seconds(attitude["t_ns"], origin)
        own_q, near = interpolate_attitude(own_t, matrix(attitude, QUATERNION), t)
        trust = np.interp(t, own_t, attitude["weight"].to_numpy())
        if near.any():
            world = mean_quaternion(multiply(own_q[near], conjugate(q[near])), trust[near])
            q = multiply(world, q)
    rotations: dict[str, Json] = {
        "vps_body_rotation_deg": float(np.degrees(2 * np.arccos(np.clip(abs(body[3]), 0, 1)))),
        "vps_world_rotation_deg": float(np.degrees(2 * np.arccos(np.clip(abs(world[3]), 0, 1)))),
    }
    kept = slice(None, None, every)
    return {"t": t[kept], "q": continuous(q)[kept], "rate": vps_rate[kept]}, rotations


def sensor_rotation(vectors: Array, q: Array) -> Array:
    """Components of vectors (n, 3) in axes turned by q (4,): A(q) v."""
    return vectors @ body_from_inertial(q).T


def interpolate_attitude(t: Array, q: Array, at: Array) -> tuple[Array, np.ndarray]:
    """Attitudes at times `at` (m,), and which of them lie between samples no more than 0.1 s apart."""
    return slerp(t, q, at), bridged(t, at)


def bridged(t: Array, at: Array) -> np.ndarray:
    """Which times `at` lie between neighbouring stamps t no more than 0.1 s apart, (m,) bool."""
    i = interval_of(t, at)
    return (t[0] <= at) & (at < t[-1]) & (t[i + 1] - t[i] <= BRIDGE_S)
