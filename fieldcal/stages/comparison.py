"""Agreement of estimates with their references: the paper's Theil inequality coefficients, and rms errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.estimation import smoothing, wahba
from fieldcal.estimation.gyroscope.equation_error import predicted_quaternion_rate
from fieldcal.estimation.gyroscope.output_error import propagate_stretches, shooting_segments, start_stretches
from fieldcal.estimation.motion_selection import contiguous
from fieldcal.estimation.theil import Fit, theil, theil_attitude
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array, continuous, slerp
from fieldcal.names import Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import body_vectors, known_vectors, reference_vectors, sensor_attitude
from fieldcal.stages.inputs import Tables, differentiate_by_segment, spread_of
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import QUATERNION, constants, matrix, seconds, triad
from fieldcal.stages.vps import BRIDGE_S, RATE_COLUMNS, bridged, interpolate_attitude

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import Axes, SmoothingSettings, VerifySettings

HELD_OUT_STRETCH_S = 10.0

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


def verify_fit(tables: Tables, s: VerifySettings) -> StageResult:
    """All estimates → fit: the paper's five TICs and one more, raw and smoothed, and rms errors in physical units."""
    samples, attitude = tables["samples"], tables.get("attitude")
    t = seconds(samples["t_ns"], int(samples["t_ns"][0]))
    segment = samples["segment"].to_numpy()
    sides = {}
    if attitude is not None:
        sides = {"raw": _raw_attitude(tables, s), "smoothed": matrix(attitude, QUATERNION)}
    gyros = {
        method: constants(tables["gyroscope"], Sensor.GYROSCOPE, method, refused_too=True)
        for method in (Method.EQUATION_ERROR, Method.OUTPUT_ERROR)
        if "gyroscope" in tables
    }
    vps = tables.get("vps_aligned")
    vps_t = None if vps is None else seconds(vps["t_ns"], int(samples["t_ns"][0]))
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    rows: list[dict[str, str | float | None]] = []

    def add(quantity: str, method: str, reference: str, signal: str, fit: Fit, unit: str, sample: str = "all") -> None:
        rows.append(_fit_row(quantity, method, reference, signal, sample, fit, unit))

    name = s.attitude
    for signal, q in sides.items():
        q = continuous(q)
        rate_logged = matrix(samples, triad("gyroscope", "" if signal == "raw" else "smoothed_"))
        if vps is not None and vps_t is not None:
            imu_q, near = interpolate_attitude(t, q, vps_t)
            if near.any():
                vps_q = matrix(vps, QUATERNION)
                add("attitude", name, "vps", signal, theil_attitude(vps_q[near], imu_q[near]), "deg")
        q_sensor = continuous(sensor_attitude(q, s))
        for method, own_constants in gyros.items():
            if own_constants is None:
                continue
            rate = sensor_model.calibrate(rate_logged, *own_constants)
            if method == Method.EQUATION_ERROR:
                q_dot = differentiate_by_segment(samples, q_sensor, s.differentiation_window_s)
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
                weight = np.ones(len(t)) if attitude is None else attitude["weight"].to_numpy()
                model = start_stretches(relative, q_sensor, segment, weight, fixed=s.initial_attitude == "fixed")
                add("attitude_propagated", method, name, signal, theil_attitude(q_sensor, model), "deg")
                if vps is not None and vps_t is not None:
                    _propagated_against_vps(add, method, signal, t, relative, segment, vps, vps_t, s)
            if vps is not None and vps_t is not None:
                _rates_against_vps(add, method, signal, t, rate @ axes.T, vps, vps_t, s)
    joint = constants(tables["joint"], Sensor.GYROSCOPE) if "joint" in tables else None
    if joint is not None and vps is not None and vps_t is not None:
        q = matrix(tables["trajectory"], QUATERNION)
        imu_q, near = interpolate_attitude(t, continuous(q), vps_t)
        if near.any():
            add(
                "attitude",
                "joint",
                "vps",
                "smoothed",
                theil_attitude(matrix(vps, QUATERNION)[near], imu_q[near]),
                "deg",
            )
        for signal, prefix in (("raw", ""), ("smoothed", "smoothed_")):
            rate = sensor_model.calibrate(matrix(samples, triad("gyroscope", prefix)), *joint)
            relative = propagate_stretches(t, rate, segment)
            _propagated_against_vps(add, "joint", signal, t, relative, segment, vps, vps_t, s)
            _rates_against_vps(add, "joint", signal, t, rate @ axes.T, vps, vps_t, s)
    if "held_out" in tables:
        _held_out(add, tables, t, segment, vps, vps_t, s)
    if not rows:
        return StageResult(
            status=Status.ABSENT, reason_code=ReasonCode.NOTHING_TO_COMPARE, reason="No reference to compare with."
        )
    return StageResult({"fit": pl.DataFrame(rows, schema=FIT_SCHEMA)}, measured={"comparisons": len(rows)})


def _fit_row(
    quantity: str, method: str, reference: str, signal: str, sample: str, fit: Fit, unit: str
) -> dict[str, str | float | None]:
    parts = [v if np.isfinite(v) else None for v in (fit.bias, fit.variance, fit.covariance)]
    return dict(
        zip(
            FIT_SCHEMA,
            (quantity, method, reference, signal, sample, float(fit.tic), *parts, fit.rms, unit, fit.n_samples),
            strict=True,
        )
    )


def _raw_attitude(tables: Tables, s: VerifySettings) -> Array:
    """Attitude from unsmoothed readings with the same constants and weights as the attitude stage."""
    vectors = body_vectors(tables["samples"], known_vectors(tables, s), s, prefix="")
    lengths = np.linalg.norm(vectors, axis=2) / np.array([np.linalg.norm(s.field_ned), s.gravity_mps2])
    sigma = np.array([spread_of(lengths[:, 0]), spread_of(lengths[:, 1])])
    reference, declination = reference_vectors(vectors, s)
    return wahba.attitudes(vectors, reference, sigma, method=s.attitude, declination=declination).q


def _held_out(
    add: Callable[..., None],
    tables: Tables,
    t: Array,
    segment: np.ndarray,
    vps: pl.DataFrame | None,
    vps_t: Array | None,
    s: Axes,
) -> None:
    """Constants of the first part of the flight predict the rest: attitude over stretches, and body rates, against the
    VPS, else against the joint attitude of the whole flight."""
    constants_then = constants(tables["held_out"], Sensor.GYROSCOPE)
    if constants_then is None:
        return
    late = tables["samples"]["t_ns"].to_numpy() >= tables["held_out"]["from_ns"][0]
    t, segment = t[late], segment[late]
    rate = sensor_model.calibrate(matrix(tables["samples"], triad("gyroscope"))[late], *constants_then)
    if vps is not None and vps_t is not None:
        name, reference_t, q = "vps", vps_t, matrix(vps, QUATERNION)
        rates = matrix(vps, RATE_COLUMNS)
    elif "trajectory" in tables:
        name, reference_t, q = "joint", t, matrix(tables["trajectory"], QUATERNION)[late]
        rates = None
    else:
        return
    stretch = shooting_segments(t, segment, HELD_OUT_STRETCH_S)
    near = bridged(t, reference_t) & (reference_t >= t[0])
    if near.sum() < 10:
        return
    imu_q = slerp(t, propagate_stretches(t, rate, stretch), reference_t)[near]
    part = stretch[np.clip(np.searchsorted(t, reference_t, side="right") - 1, 0, len(t) - 1)][near]
    to_sensor = sensor_attitude(q, s)[near]
    model = start_stretches(imu_q, to_sensor, part, np.ones(len(imu_q)), fixed=False)
    fit = theil_attitude(continuous(to_sensor), model)
    add("attitude_propagated", "joint", name, "raw", fit, "deg", "held_out")
    if rates is not None:
        axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
        body = np.column_stack([np.interp(reference_t[near], t, c) for c in (rate @ axes.T).T])
        add("body_rate", "joint", name, "raw", theil(rates[near], body), "rad/s", "held_out")


def _rates_against_vps(
    add: Callable[..., None],
    method: str,
    signal: str,
    t: Array,
    rate: Array,
    vps: pl.DataFrame,
    vps_t: Array,
    s: SmoothingSettings,
) -> None:
    """Body rates (n, 3), rad/s, against those of the VPS."""
    near = bridged(t, vps_t)
    if not near.any():
        return
    body = np.column_stack([np.interp(vps_t, t, c) for c in rate.T])
    vps_rate = matrix(vps, RATE_COLUMNS)
    if signal == "smoothed":
        vps_rate = _smoothed_blocks(vps_t, vps_rate, s)
    add("body_rate", method, "vps", signal, theil(vps_rate[near], body[near]), "rad/s")


def _propagated_against_vps(
    add: Callable[..., None],
    method: str,
    signal: str,
    t: Array,
    relative: Array,
    segment: np.ndarray,
    vps: pl.DataFrame,
    vps_t: Array,
    s: Axes,
) -> None:
    """Attitude integrated from the gyroscope over each segment, its initial attitude fitted, against the VPS."""
    to_sensor = sensor_attitude(matrix(vps, QUATERNION), s)
    near = bridged(t, vps_t)
    index = np.clip(np.searchsorted(t, vps_t), 0, len(t) - 1)
    imu_q, reference, part = slerp(t, relative, vps_t)[near], to_sensor[near], segment[index][near]
    if len(imu_q) < 10:
        return
    model = start_stretches(imu_q, reference, part, np.ones(len(imu_q)), fixed=False)
    add("attitude_propagated", method, "vps", signal, theil_attitude(continuous(reference), model), "deg")


def _smoothed_blocks(t: Array, x: Array, s: SmoothingSettings) -> Array:
    """Low-pass of each contiguous stretch of the VPS's uniform grid."""
    out = np.empty_like(x)
    for a, b in contiguous(t, BRIDGE_S):
        out[a:b] = smoothing.smooth_samples(
            t[a:b], x[a:b], s.smoothing_cutoff_hz, side_s=s.smoothing_side_s, ends=s.smoothing_ends
        )
    return out
