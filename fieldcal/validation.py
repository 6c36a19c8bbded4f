"""The stages that compare: VPS synchronisation and the TICs of everything against everything the paper prints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import polars as pl

from fieldcal import attitude as wahba
from fieldcal import sensor, smoothing, sync
from fieldcal.errors import UnusableFlight
from fieldcal.frames import AXES, QUATERNION, columns_of, constants, matrix, seconds, triad
from fieldcal.gyro_equation import predicted_quaternion_rate
from fieldcal.gyro_output import propagate_stretches, start_stretches
from fieldcal.manoeuvre import contiguous
from fieldcal.metrics import Fit, theil, theil_attitude
from fieldcal.results import StageResult
from fieldcal.rotation import (
    Array,
    body_from_inertial,
    conjugate,
    continuous,
    from_matrix,
    mean_quaternion,
    multiply,
    normalise,
    slerp,
)
from fieldcal.stages import VECTOR_SENSORS, body_vectors, differentiate_by_segment, logged_constants, sensor_attitude

Tables = Mapping[str, pl.DataFrame]
Settings = Mapping[str, Any]

NED_ENU = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])  # rotation of ENU components to NED
FLU_FRD = np.array([1.0, 0.0, 0.0, 0.0])
BRIDGE_S = 0.1  # IMU results are interpolated to VPS stamps only between samples this close
RATE_COLUMNS = [f"rate_{axis}_radps" for axis in AXES]


def synchronise_vps(tables: Tables, s: Settings) -> StageResult:
    """imu, vps, gyroscope constants, attitude → sync, vps_aligned: the VPS on the IMU's clock and in its frames."""
    if "vps" not in tables or tables["vps"].is_empty():
        return StageResult(status="absent", reason_code="no_vps", reason="The log has no VPS.")
    imu, vps = tables["imu"], tables["vps"]
    logged = matrix(imu, triad("gyroscope"))
    if np.isnan(logged).any():
        return StageResult(status="refused", reason_code="no_gyroscope", reason="Synchronisation needs a gyroscope.")
    gyro = _gyro_constants(tables, s)
    axes = sensor.frd_from_sensor(s["rotation_body_from_sensor"], s["body"])
    rate = (logged - np.median(logged, axis=0) if gyro is None else sensor.calibrate(logged, *gyro)) @ axes.T
    origin = int(imu["t_ns"][0])
    t_imu = seconds(imu["t_ns"], origin)
    # Clocks of different epochs: their starts are laid together first, as integers.
    base_ns = int(vps["t_ns"][0]) - origin
    if abs(base_ns) * 1e-9 <= s["vps_max_lag_s"] + t_imu[-1]:
        base_ns = 0
    t_vps = seconds(vps["t_ns"], origin + base_ns)
    q_vps = vps_attitude(matrix(vps, QUATERNION), s)
    keep = sync.mask_outliers(t_vps, q_vps)
    measured: dict[str, Any] = {
        "vps_samples": len(keep),
        "vps_masked": int((~keep).sum()),
        "gyro_calibrated": gyro is not None,
    }
    t_vps, q_vps = t_vps[keep], q_vps[keep]
    try:
        fit = sync.synchronise(
            t_imu,
            rate,
            t_vps,
            q_vps,
            max_lag_s=s["vps_max_lag_s"],
            min_peak=s["vps_min_peak"],
            max_gap_s=s["vps_max_gap_s"],
        )
    except UnusableFlight as error:
        row = _sync_row(
            {"status": "refused", "peak": error.measured.get("peak"), "runner_up": error.measured.get("runner_up")}
        )
        return StageResult({"sync": row}, "refused", error.reason_code, str(error), {**measured, **error.measured})
    row = _sync_row(
        {
            "lag_s": fit.lag_s - base_ns * 1e-9,
            "lag_mid_s": fit.lag_mid_s - base_ns * 1e-9,
            "lag_sd_s": fit.lag_sd_s,
            "skew_ppm": fit.skew_ppm,
            "skew_sd_ppm": fit.skew_sd_ppm,
            "peak": fit.peak,
            "runner_up": fit.runner_up,
            "status": "ok",
        }
    )
    t_vps = fit.to_imu_clock(t_vps)
    aligned, rotations = _aligned(t_vps, q_vps, t_imu, rate, tables, s, calibrated=gyro is not None)
    measured |= rotations | {"peak_width_s": fit.peak_width_s}
    t_ns = np.rint(aligned["t"] * 1e9).astype(np.int64) + origin
    table = pl.DataFrame(
        {"t_ns": t_ns, **columns_of(aligned["q"], QUATERNION), **columns_of(aligned["rate"], RATE_COLUMNS)}
    )
    return StageResult({"sync": row, "vps_aligned": table}, measured=measured)


SYNC_NUMBERS = ("lag_s", "lag_mid_s", "lag_sd_s", "skew_ppm", "skew_sd_ppm", "peak", "runner_up")


def _sync_row(values: dict[str, Any]) -> pl.DataFrame:
    row = dict.fromkeys(SYNC_NUMBERS) | values
    return pl.DataFrame([row], schema={**dict.fromkeys(SYNC_NUMBERS, pl.Float64), "status": pl.String})


def _gyro_constants(tables: Tables, s: Settings) -> tuple[Array, Array] | None:
    """Output error's constants, else equation error's, else what the logged unit says, else None."""
    for name, method in (("gyro_output", "output_error"), ("gyro_equation", "equation_error")):
        if name in tables:
            own = constants(tables[name], "gyroscope", method)
            if own is not None:
                return own
    return logged_constants(s, "gyroscope")


def vps_attitude(q: Array, s: Settings) -> Array:
    """Logged VPS attitudes, body to world, in the paper's NED and FRD; unit length, continuous."""
    with np.errstate(invalid="ignore", divide="ignore"):
        q = normalise(q)
    if s["world"] == "enu":
        q = multiply(NED_ENU, q)
    if s["body"] == "flu":
        q = multiply(q, FLU_FRD)
    return q


def _aligned(
    t_vps: Array, q_vps: Array, t_imu: Array, rate: Array, tables: Tables, s: Settings, *, calibrated: bool
) -> tuple[dict[str, Array], dict[str, Any]]:
    """VPS attitude and rate on a uniform grid at its own rate, IMU clock, both constant rotations put in."""
    interval = float(np.median(np.diff(t_vps)))
    rates = sync.vps_rates(t_vps, q_vps, interval, max_gap_s=s["vps_max_gap_s"])
    t = rates.t
    inside = rates.valid & (t >= t_imu[0]) & (t <= t_imu[-1])
    t, q, vps_rate = t[inside], slerp(t_vps, continuous(q_vps), t[inside]), rates.rate[inside]
    own_rate = smoothing.low_pass(
        np.column_stack([np.interp(t, t_imu, c) for c in rate.T]), sync.FINE_CUTOFF_HZ, interval
    )
    body = np.array([0.0, 0.0, 0.0, 1.0])
    if calibrated:
        smooth = smoothing.low_pass(vps_rate, sync.FINE_CUTOFF_HZ, interval)
        # Vectors turn by R: ω_body = R ω_vps, and the attitude by the matching quaternion on the right.
        body = conjugate(from_matrix(sync.rotation_between(smooth, own_rate)))
        body = body if body[3] >= 0 else -body
    q = multiply(q, body)
    vps_rate = sensor_rotation(vps_rate, body)
    world = np.array([0.0, 0.0, 0.0, 1.0])
    if "attitude" in tables:
        origin = int(tables["imu"]["t_ns"][0])
        own_t = seconds(tables["attitude"]["t_ns"], origin)
        own_q, near = interpolate_attitude(own_t, matrix(tables["attitude"], QUATERNION), t)
        trust = np.interp(t, own_t, tables["attitude"]["weight"].to_numpy())
        if near.any():
            world = mean_quaternion(multiply(own_q[near], conjugate(q[near])), trust[near])
            q = multiply(world, q)
    rotations = {
        "vps_body_rotation_deg": float(np.degrees(2 * np.arccos(np.clip(abs(body[3]), 0, 1)))),
        "vps_world_rotation_deg": float(np.degrees(2 * np.arccos(np.clip(abs(world[3]), 0, 1)))),
    }
    return {"t": t, "q": continuous(q), "rate": vps_rate}, rotations


def sensor_rotation(vectors: Array, q: Array) -> Array:
    """Components of vectors (n, 3) in axes turned by q (4,): A(q) v."""
    return vectors @ body_from_inertial(q).T


def interpolate_attitude(t: Array, q: Array, at: Array) -> tuple[Array, np.ndarray]:
    """Attitudes at times `at` (m,), and which of them lie between samples no more than 0.1 s apart."""
    return slerp(t, q, at), bridged(t, at)


def bridged(t: Array, at: Array) -> np.ndarray:
    """Which times `at` lie between neighbouring stamps t no more than 0.1 s apart, (m,) bool."""
    i = np.searchsorted(t, at, side="right") - 1
    ok = (i >= 0) & (i < len(t) - 1)
    i = np.clip(i, 0, len(t) - 2)
    return ok & (t[i + 1] - t[i] <= BRIDGE_S)


def verify_fit(tables: Tables, s: Settings) -> StageResult:
    """Everything estimated → fit: the paper's five TICs and one more, raw and smoothed, with physical units."""
    samples, attitude = tables["samples"], tables["attitude"]
    t = seconds(samples["t_ns"], int(samples["t_ns"][0]))
    segment = samples["segment"].to_numpy()
    smoothed_q = matrix(attitude, QUATERNION)
    sides = {"raw": _raw_attitude(tables, s), "smoothed": smoothed_q}
    gyros = {
        method: constants(tables[name], "gyroscope", method)
        for name, method in (("gyro_equation", "equation_error"), ("gyro_output", "output_error"))
        if name in tables
    }
    vps = tables.get("vps_aligned")
    vps_t = None if vps is None else seconds(vps["t_ns"], int(samples["t_ns"][0]))
    axes = sensor.frd_from_sensor(s["rotation_body_from_sensor"], s["body"])
    rows: list[dict[str, Any]] = []

    def add(quantity: str, method: str, reference: str, signal: str, fit: Fit, unit: str) -> None:
        rows.append(_fit_row(quantity, method, reference, signal, fit, unit))

    name = s["attitude"]
    for signal, q in sides.items():
        q = continuous(q)
        rate_logged = matrix(samples, triad("gyroscope", "" if signal == "raw" else "smoothed_"))
        if vps is not None and vps_t is not None:
            own, near = interpolate_attitude(t, q, vps_t)
            if near.any():
                vps_q = matrix(vps, QUATERNION)
                add("attitude", name, "vps", signal, theil_attitude(vps_q[near], own[near]), "deg")
        q_sensor = continuous(sensor_attitude(q, s))
        for method, own_constants in gyros.items():
            if own_constants is None:
                continue
            rate = sensor.calibrate(rate_logged, *own_constants)
            if method == "equation_error":
                q_dot = differentiate_by_segment(samples, q_sensor, s["differentiation_window_s"])
                add(
                    "quaternion_rate",
                    method,
                    name,
                    signal,
                    theil(q_dot, predicted_quaternion_rate(q_sensor, rate)),
                    "1/s",
                )
            else:
                relative = propagate_stretches(t, rate, segment)
                weight = attitude["weight"].to_numpy()
                model = start_stretches(relative, q_sensor, segment, weight, fixed=s["initial_attitude"] == "fixed")
                add("attitude_propagated", method, name, signal, theil_attitude(q_sensor, model), "deg")
                if vps is not None and vps_t is not None:
                    _propagated_against_vps(add, signal, t, relative, segment, vps, vps_t, s)
            if vps is not None and vps_t is not None:
                near = bridged(t, vps_t)
                if near.any():
                    body = np.column_stack([np.interp(vps_t, t, c) for c in (rate @ axes.T).T])
                    vps_rate = matrix(vps, RATE_COLUMNS)
                    if signal == "smoothed":
                        vps_rate = _smoothed_blocks(vps_t, vps_rate, s)
                    add("body_rate", method, "vps", signal, theil(vps_rate[near], body[near]), "rad/s")
    if not rows:
        return StageResult(status="absent", reason_code="nothing_to_compare", reason="No reference to compare with.")
    return StageResult({"fit": pl.DataFrame(rows, schema=FIT_SCHEMA)}, measured={"comparisons": len(rows)})


FIT_SCHEMA = {
    "quantity": pl.String,
    "method": pl.String,
    "reference": pl.String,
    "signal": pl.String,
    "sample": pl.String,
    "tic": pl.Float64,
    "tic_bias": pl.Float64,
    "tic_variance": pl.Float64,
    "tic_covariance": pl.Float64,
    "rms": pl.Float64,
    "rms_unit": pl.String,
    "n_samples": pl.Int64,
}


def _fit_row(quantity: str, method: str, reference: str, signal: str, fit: Fit, unit: str) -> dict[str, Any]:
    parts = [v if np.isfinite(v) else None for v in (fit.bias, fit.variance, fit.covariance)]
    return dict(
        zip(
            FIT_SCHEMA,
            (quantity, method, reference, signal, "all", float(fit.tic), *parts, fit.rms, unit, fit.n_samples),
            strict=True,
        )
    )


def _raw_attitude(tables: Tables, s: Settings) -> Array:
    """Attitude from unsmoothed readings with the same constants and weights as the attitude stage."""
    used = {n: (constants(tables[n], n) if n in tables else None) or logged_constants(s, n) for n in VECTOR_SENSORS}
    known = {n: c for n, c in used.items() if c is not None}
    vectors = body_vectors(tables["samples"], known, s, prefix="")
    lengths = np.linalg.norm(vectors, axis=2) / np.array([np.linalg.norm(s["field_ned"]), s["gravity_mps2"]])
    sigma = np.maximum(1.4826 * np.median(np.abs(lengths - np.median(lengths, axis=0)), axis=0), 1e-4)
    reference = np.array([s["field_ned"], [0.0, 0.0, 1.0]])
    declination = float(np.arctan2(s["field_ned"][1], s["field_ned"][0]))
    return wahba.attitudes(vectors, reference, sigma, method=s["attitude"], declination=declination).q


def _propagated_against_vps(
    add: Callable[..., None],
    signal: str,
    t: Array,
    relative: Array,
    segment: np.ndarray,
    vps: pl.DataFrame,
    vps_t: Array,
    s: Settings,
) -> None:
    """Open-loop drift: the gyroscope integrated over each segment from its best start, against the VPS."""
    to_sensor = sensor_attitude(matrix(vps, QUATERNION), s)
    near = bridged(t, vps_t)
    index = np.clip(np.searchsorted(t, vps_t), 0, len(t) - 1)
    own, reference, part = slerp(t, relative, vps_t)[near], to_sensor[near], segment[index][near]
    if len(own) < 10:
        return
    model = start_stretches(own, reference, part, np.ones(len(own)), fixed=False)
    add("attitude_propagated", "output_error", "vps", signal, theil_attitude(continuous(reference), model), "deg")


def _smoothed_blocks(t: Array, x: Array, s: Settings) -> Array:
    """Low-pass by contiguous block of the VPS's own grid."""
    out = np.empty_like(x)
    for a, b in contiguous(t, BRIDGE_S):
        out[a:b] = smoothing.smooth_samples(
            t[a:b], x[a:b], s["smoothing_cutoff_hz"], side_s=s["smoothing_side_s"], ends=s["smoothing_ends"]
        )
    return out
