"""The paper's curves of a flight, recomputed from its samples, its attitude and its constants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from fieldcal.estimation.gyroscope.equation_error import predicted_quaternion_rate
from fieldcal.estimation.gyroscope.output_error import propagate_stretches, start_stretches
from fieldcal.estimation.segments import begins_run, run_bounds
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array, conjugate, continuous, multiply, to_rotation_vector
from fieldcal.names import Method, Sensor, Status, exactness
from fieldcal.report.flight_data import FigureSettings
from fieldcal.stages.attitude import sensor_attitude
from fieldcal.stages.inputs import differentiate_by_segment
from fieldcal.stages.tables import QUATERNION, constants, matrix, seconds, triad
from fieldcal.stages.vps import RATE_COLUMNS, interpolate_attitude

GYRO_METHODS = (Method.EQUATION_ERROR, Method.OUTPUT_ERROR, Method.JOINT, Method.VELOCITY)


@dataclass(frozen=True)
class Curves:
    """Arrays of one flight, time in seconds from its first sample; what could not be had is None or absent.

    t : (n,); segment : (n,); q : (n, 4) attitude NED to body; q_sensor : the same to sensor axes
    rate : method → (n, 3) calibrated smoothed rates in sensor axes, rad/s; body_rate : in body axes
    q_dot, q_dot_model : (n, 4) data and model of Eq. 10; propagated : (n, 4) integrated gyroscope, sensor axes
    t_vps : (m,); q_vps : (m, 4); vps_rate : (m, 3); near : (m,) VPS stamps between neighbouring samples
    attitude_error_deg : (k, 3) rotation from VPS to the estimate at t_vps[near], body axes
    """

    t: Array
    segment: np.ndarray
    q: Array
    q_sensor: Array
    rate: Mapping[Method, Array]
    body_rate: Mapping[Method, Array]
    q_dot: Array | None
    q_dot_model: Array | None
    propagated: Array | None
    t_vps: Array | None
    q_vps: Array | None
    vps_rate: Array | None
    near: np.ndarray | None
    attitude_error_deg: Array | None


def curves(
    samples: pl.DataFrame,
    attitude: pl.DataFrame,
    calibration: pl.DataFrame,
    vps: pl.DataFrame | None,
    settings: FigureSettings,
) -> Curves:
    """What Figures 7–10 show: smoothed readings, the constants of each method, the VPS where there is one."""
    origin = int(samples["t_ns"][0])
    t = seconds(samples["t_ns"], origin)
    segment = samples["segment"].to_numpy()
    q = continuous(matrix(attitude, QUATERNION))
    q_sensor = continuous(sensor_attitude(q, settings))
    axes = sensor_model.frd_from_sensor(settings.rotation_body_from_sensor, settings.body)
    logged = matrix(samples, triad("gyroscope", "smoothed_"))
    found = {m: constants(calibration, Sensor.GYROSCOPE, m, refused_too=True) for m in GYRO_METHODS}
    rate = {m: sensor_model.calibrate(logged, *own) for m, own in found.items() if own is not None and finite(own)}
    q_dot = model = propagated = None
    if Method.EQUATION_ERROR in rate:
        q_dot = differentiate_by_segment(samples, q_sensor, settings.differentiation_window_s)
        model = predicted_quaternion_rate(q_sensor, rate[Method.EQUATION_ERROR])
    if Method.OUTPUT_ERROR in rate:
        relative = propagate_stretches(t, rate[Method.OUTPUT_ERROR], segment)
        weight = attitude["weight"].to_numpy()
        fixed = settings.initial_attitude == "fixed"
        propagated = _same_side(start_stretches(relative, q_sensor, segment, weight, fixed=fixed), q_sensor)
    t_vps = q_vps = vps_rate = near = error = None
    if vps is not None and not vps.is_empty():
        t_vps = seconds(vps["t_ns"], origin)
        q_vps, vps_rate = continuous(matrix(vps, QUATERNION)), matrix(vps, RATE_COLUMNS)
        own, near = interpolate_attitude(t, q, t_vps)
        if near.any():
            q_vps = q_vps if np.sum(q_vps[near][0] * own[near][0]) >= 0 else -q_vps
            error = np.degrees(to_rotation_vector(multiply(conjugate(q_vps[near]), own[near])))
    return Curves(
        t,
        segment,
        q,
        q_sensor,
        rate,
        {m: r @ axes.T for m, r in rate.items()},
        q_dot,
        model,
        propagated,
        t_vps,
        q_vps,
        vps_rate,
        near,
        error,
    )


def finite(own: tuple[Array, Array]) -> bool:
    """Whether constants are numbers: a refused fit may have none."""
    return all(bool(np.isfinite(part).all()) for part in own)


def counting(calibration: pl.DataFrame, sensor: Sensor) -> pl.DataFrame:
    """A sensor's rows by the method that counts: of those with a scale published the most exact, else of all."""
    rows = list(calibration.select("sensor", "parameter", "method", "status").iter_rows())
    scales = [(method, status) for own, parameter, method, status in rows if (own, parameter) == (sensor, "scale")]
    published = [method for method, status in scales if status == Status.OK]
    methods = published or [method for method, _ in scales]
    if not methods:
        return calibration.clear()
    best = min(methods, key=exactness)
    return calibration[[i for i, (own, _, method, _) in enumerate(rows) if (own, method) == (sensor, best)]]


def lengths(samples: pl.DataFrame, calibration: pl.DataFrame, name: Sensor) -> Array | None:
    """Calibrated vectors (n, 3) of the magnetometer or accelerometer, unsmoothed, sensor axes; None without a fit."""
    rows = counting(calibration, name).filter(pl.col("value").is_not_null())
    if rows.is_empty() or set(rows["parameter"].to_list()) < {"scale", "bias"}:
        return None
    own = constants(rows, name, refused_too=True)
    logged = matrix(samples, triad(name))
    if own is None or not finite(own) or np.isnan(logged).all():
        return None
    return sensor_model.calibrate(logged[np.isfinite(logged).all(axis=1)], *own)


def covered_cells(vectors: Array, columns: int = 24, rows: int = 12) -> Array:
    """Samples in each of (rows, columns) cells of equal solid angle: equal steps of azimuth about the third axis, and
    of the sine of elevation above the plane of the first two."""
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    azimuth = np.arctan2(unit[:, 1], unit[:, 0])
    counted, _, _ = np.histogram2d(unit[:, 2], azimuth, bins=(rows, columns), range=((-1, 1), (-np.pi, np.pi)))
    return np.asarray(counted)


def amplitude_spectrum(t: Array, x: Array, segment: np.ndarray) -> tuple[Array, Array] | None:
    """One-sided amplitude spectral density (per √Hz) of x (n, m), root of the sum over channels, by Welch's method on
    the longest stretch without a gap; None where that is under 2 s."""
    from scipy.signal import welch

    begins = begins_run(segment)
    begins[1:] |= np.diff(t) > 0.1
    a, b = max(run_bounds(np.cumsum(begins)), key=lambda bounds: bounds[1] - bounds[0])
    if b - a < 16 or t[b - 1] - t[a] < 2.0:
        return None
    rate = 1.0 / float(np.median(np.diff(t[a:b])))
    f, density = welch(x[a:b], fs=rate, nperseg=min(b - a, round(8.0 * rate)), axis=0, detrend="constant")
    return f[1:], np.sqrt(density.sum(axis=1))[1:]


def _same_side(q: Array, reference: Array) -> Array:
    """q (n, 4) with each sign nearest to the reference's."""
    return np.where(np.sum(q * reference, axis=1, keepdims=True) < 0, -q, q)
