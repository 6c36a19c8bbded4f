"""The stages: columns ↔ arrays around the numerics, one short function each. `pipeline.PIPELINE` says who reads what.

A stage is `run(tables, settings) -> StageResult`. `tables` holds the inputs that `Stage.reads` names (missing ones are absent), `settings`
only the entries that `Stage.settings` names. No stage knows of files, flows or other stages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl

from fieldcal import attitude as wahba
from fieldcal import ellipsoid, gyro_equation, gyro_output, manoeuvre, sensor, smoothing
from fieldcal.ellipsoid import TriadFit
from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.flight import default_reference_reading
from fieldcal.frames import (
    AXES,
    QUATERNION,
    calibration_rows,
    columns_of,
    constants,
    covariance_of,
    covariance_table,
    matrix,
    seconds,
    triad,
)
from fieldcal.gyro_equation import GyroFit
from fieldcal.propagation import attitude_jacobian, constants_to_gyro
from fieldcal.results import StageResult, triad_rows
from fieldcal.rotation import Array, from_matrix, multiply

Tables = Mapping[str, pl.DataFrame]
Settings = Mapping[str, Any]

ELLIPSOID_METHOD = {
    "robust": "ellipsoid_robust",
    "li": "ellipsoid",
    "li_full": "ellipsoid_full",
    "two_step": "ellipsoid_two_step",
    "tls": "ellipsoid_tls",
}
CALIBRATED_UNIT = {"accelerometer": "m/s^2", "gyroscope": "rad/s"}
# Trust in an attitude halves where the sensed length is off by this share of the field.
TRUST_ACCELERATION, TRUST_FIELD = 0.01, 0.01
# The angle between field and gravity is one number: a median scatter above this says an axis or sign is wrong.
# Judged on the samples that motion and magnets disturb least.
MAX_DIP_SCATTER_DEG = 10.0
TRUSTED_SHARE = 0.2
MAX_MEDIAN_ATTITUDE_ERROR_RAD = 0.35
RUN_IN_STRETCH_S = 15.0


def find_manoeuvre(tables: Tables, s: Settings) -> StageResult:
    """imu → segments: the stretches worth calibrating on, and why."""
    imu = tables["imu"]
    t = seconds(imu["t_ns"], imu["t_ns"][0])
    rate = matrix(imu, triad("gyroscope"))
    rate_or_none = None if np.isnan(rate).any() else rate
    found = manoeuvre.select(
        t,
        rate_or_none,
        window_s=s["manoeuvre_window_s"],
        pad_s=s["manoeuvre_pad_s"],
        rest_s=s["manoeuvre_rest_s"],
        min_s=s["manoeuvre_min_s"],
        max_gap_s=s["manoeuvre_max_gap_s"],
        excited_ratio=s["manoeuvre_excited_ratio"],
    )
    stamps = imu["t_ns"].to_numpy()
    segments = pl.DataFrame(
        {
            "segment": np.arange(len(found.segments), dtype=np.int32),
            "start_ns": np.array([stamps[g.start] for g in found.segments], dtype=np.int64),
            "end_ns": np.array([stamps[g.stop - 1] for g in found.segments], dtype=np.int64),
            "n_samples": np.array([g.stop - g.start for g in found.segments], dtype=np.int64),
            "rate_rms": np.array([g.rate_rms for g in found.segments], dtype=np.float64),
            "used": [g.used for g in found.segments],
            "reason": [g.reason for g in found.segments],
        }
    )
    used_s = float(sum(t[g.stop - 1] - t[g.start] for g in found.segments if g.used))
    measured = {
        "excited_s": found.excited_s,
        "used_s": used_s,
        "log_s": float(t[-1] - t[0]),
        "segments_used": int(sum(g.used for g in found.segments)),
        "rate_level": found.level,
        "rate_threshold": found.threshold,
        "rate_noise": found.noise,
    }
    if found.excited_s < s["manoeuvre_min_s"]:
        return StageResult(
            {"segments": segments.with_columns(used=pl.lit(False))},
            "refused",
            "too_little_motion",
            f"Only {found.excited_s:.1f} s of rotation were found, {s['manoeuvre_min_s']:.0f} s are needed: fly the"
            " manoeuvre (roll, pitch and yaw doublets).",
            measured,
        )
    return StageResult({"segments": segments}, measured=measured)


def smooth(tables: Tables, s: Settings) -> StageResult:
    """imu, magnetometer, segments → samples: readings of the used segments at the IMU's stamps, logged and smoothed."""
    imu, segments = tables["imu"], tables["segments"].filter(pl.col("used"))
    if segments.is_empty():
        return StageResult(status="refused", reason_code="no_manoeuvre", reason="No segment of the log is usable.")
    origin = int(imu["t_ns"][0])
    stamps = imu["t_ns"].to_numpy()
    logged = np.column_stack(
        [matrix(imu, triad("gyroscope") + triad("accelerometer")), _magnetometer_at(tables, stamps)]
    )
    parts: list[dict[str, Any]] = []
    for number, start, end in segments.select("segment", "start_ns", "end_ns").iter_rows():
        rows = slice(int(np.searchsorted(stamps, start)), int(np.searchsorted(stamps, end, side="right")))
        x = logged[rows]
        t = (stamps[rows] - origin) * 1e-9
        smoothed = np.full_like(x, np.nan)
        known = ~np.isnan(x).any(axis=0)
        smoothed[:, known] = smoothing.smooth_samples(
            t, x[:, known], s["smoothing_cutoff_hz"], side_s=s["smoothing_side_s"], ends=s["smoothing_ends"]
        )
        parts.append({"t_ns": stamps[rows], "segment": np.full(len(x), number, dtype=np.int32), "x": x, "s": smoothed})
    joined = {k: np.concatenate([p[k] for p in parts]) for k in ("t_ns", "segment", "x", "s")}
    names = triad("gyroscope") + triad("accelerometer") + triad("magnetometer")
    samples = pl.DataFrame(
        {
            "t_ns": joined["t_ns"],
            "segment": joined["segment"],
            **columns_of(joined["x"], names),
            **columns_of(joined["s"], [f"smoothed_{n}" for n in names]),
        }
    ).with_columns(pl.selectors.float().fill_nan(None))
    return StageResult({"samples": samples}, measured={"n_samples": len(samples)})


def _magnetometer_at(tables: Tables, stamps: np.ndarray, longest_hold_s: float = 1.0) -> Array:
    """Magnetometer at the IMU's stamps, (n, 3), linear between its own; NaN when there is none, or past its ends."""
    magnetometer = tables.get("magnetometer")
    if magnetometer is None or len(magnetometer) < 2:
        return np.full((len(stamps), 3), np.nan)
    own = magnetometer["t_ns"].to_numpy()
    values = matrix(magnetometer, triad("magnetometer"))
    if len(own) == len(stamps) and np.array_equal(own, stamps):
        return values
    origin = stamps[0]
    at, known = (stamps - origin) * 1e-9, (own - origin) * 1e-9
    return np.column_stack([np.interp(at, known, column) for column in values.T])


def _mean_temperature(tables: Tables) -> float | None:
    """Mean logged temperature, °C, over the flight."""
    table = tables.get("temperature")
    return None if table is None or table.is_empty() else float(table["temperature_degc"].mean())  # type: ignore[arg-type]


def _reference(s: Settings, name: str, logged: Array) -> Array:
    configured = s["reference_reading"][name]
    return default_reference_reading(logged, s["units"][name]) if configured is None else np.asarray(configured)


def _used_readings(tables: Tables, name: str) -> Array | None:
    """Unsmoothed readings (n, 3) of the used segments at the sensor's own stamps; None when the log has none."""
    if name == "magnetometer":
        table = tables.get("magnetometer")
        if table is None or table.is_empty():
            return None
        segments = tables["segments"].filter(pl.col("used"))
        t = table["t_ns"].to_numpy()
        inside = np.zeros(len(t), dtype=bool)
        for start, end in segments.select("start_ns", "end_ns").iter_rows():
            inside |= (t >= start) & (t <= end)
        values = matrix(table, triad(name))[inside]
    else:
        values = matrix(tables["samples"], triad(name))
    return None if len(values) == 0 or np.isnan(values).all() else values[np.isfinite(values).all(axis=1)]


def calibrate_magnetometer(tables: Tables, s: Settings) -> StageResult:
    """magnetometer, segments → calibration: hard iron and scale from the length of the local field."""
    strength = float(np.linalg.norm(s["field_ned"]))
    return _ellipsoid_stage(
        "magnetometer", tables, s, strength, s["field_unit"], _used_readings(tables, "magnetometer")
    )


def calibrate_accelerometer(tables: Tables, s: Settings) -> StageResult:
    """samples → calibration: first pass, every sample."""
    return _ellipsoid_stage(
        "accelerometer", tables, s, s["gravity_mps2"], "m/s^2", _used_readings(tables, "accelerometer")
    )


def _ellipsoid_stage(
    name: str, tables: Tables, s: Settings, magnitude: float, unit: str, logged: Array | None
) -> StageResult:
    """Fit, judge, and write rows; a refused fit keeps its numbers."""
    if logged is None:
        return StageResult(status="refused", reason_code=f"no_{name}", reason=f"The log has no {name} readings.")
    method = s["ellipsoid"]
    source = logged if method == "robust" else _smoothed_or(tables, name, logged)
    try:
        fit = ellipsoid.fit_ellipsoid(source, magnitude, method=method, polarity=s["polarity"][name])
    except (UnusableFlight, EstimationError, ValueError) as error:
        return _refused(error, name)
    return _judged(name, fit, tables, s, unit, logged, {})


def _smoothed_or(tables: Tables, name: str, logged: Array) -> Array:
    """Smoothed readings for the algebraic fits (their bias under noise is several per cent on raw counts)."""
    samples = tables.get("samples")
    if samples is None:
        return logged
    smoothed = matrix(samples, triad(name, "smoothed_"))
    return logged if np.isnan(smoothed).any() else smoothed


def _refused(error: Exception, name: str) -> StageResult:
    """A refusal without a result, from whatever the numerics raised."""
    code = getattr(error, "reason_code", "unusable_readings")
    return StageResult(
        status="refused",
        reason_code=code,
        reason=f"{name.capitalize()}: {error}",
        measured=dict(getattr(error, "measured", {})),
    )


def _judged(
    name: str, fit: TriadFit, tables: Tables, s: Settings, unit: str, logged: Array, extra: dict[str, Any]
) -> StageResult:
    """Rows of a triad fit, refused ones included, with the numbers that decided."""
    code = reason = None
    measured = {**fit.measured(), **extra}
    try:
        ellipsoid.require_determined(
            fit,
            max_condition=s["ellipsoid_max_condition"],
            max_scale_sd=s["ellipsoid_max_scale_sd"],
            max_residual=s["ellipsoid_max_residual"],
            nominal_scale=s["nominal_scale"][name],
        )
    except UnusableFlight as refusal:
        code, reason = refusal.reason_code, f"{name.capitalize()}: {refusal}"
        measured |= refusal.measured
    status = "ok" if code is None else "refused"
    rows = triad_rows(
        name,
        ELLIPSOID_METHOD[s["ellipsoid"]],
        fit.scale,
        fit.bias,
        fit.covariance,
        unit=unit,
        logged_unit=s["units"][name],
        reference_reading=_reference(s, name, logged),
        temperature_degc=_mean_temperature(tables),
        status=(status,) * 3,
        reason_code=(code,) * 3,
    )
    result = {"calibration": calibration_rows(rows), "covariance": covariance_table(fit.covariance)}
    return StageResult(result, status, code, reason, measured)


def calibrate_accelerometer_gated(tables: Tables, s: Settings) -> StageResult:
    """samples, first-pass constants and rates → calibration: second pass, lever arm taken out (Eq. 3), quiet samples only.

    The gate (low-passed norm near g, slow rotation) is kept only where enough of the sphere remains and the scales
    become surer for it."""
    first, samples = tables["accelerometer"], tables["samples"]
    known = constants(first, "accelerometer") or logged_constants(s, "accelerometer")
    gyro = constants(tables["gyroscope"], "gyroscope") if "gyroscope" in tables else None
    if known is None or gyro is None:
        return StageResult(
            {
                k: tables[k2]
                for k, k2 in (("calibration", "accelerometer"), ("covariance", "covariance"))
                if k2 in tables
            },
            "ok" if constants(first, "accelerometer") else "refused",
            "first_pass_kept",
            "Without rates there is no second pass: the first one stands.",
        )
    logged, smoothed = matrix(samples, triad("accelerometer")), matrix(samples, triad("accelerometer", "smoothed_"))
    axes = sensor.frd_from_sensor(s["rotation_body_from_sensor"], s["body"])
    rate = sensor.calibrate(matrix(samples, triad("gyroscope", "smoothed_")), *gyro) @ axes.T
    measured: dict[str, Any] = {"lever_arm_applied": s["lever_arm_m"] is not None}
    if s["lever_arm_m"] is not None:
        arm = _lever_arm(samples, rate, s)
        logged, smoothed = (
            sensor.to_centre_of_mass(x, known[0], arm, axes, s["gravity_sign"]) for x in (logged, smoothed)
        )
    norm = np.linalg.norm(sensor.calibrate(smoothed, *known), axis=1)
    quiet = (np.abs(norm / s["gravity_mps2"] - 1.0) < s["gate_norm"]) & (
        np.linalg.norm(rate, axis=1) < s["gate_rate_radps"]
    )
    measured["gate_passed"], measured["gate_share"] = int(quiet.sum()), float(quiet.mean())
    method, polarity = s["ellipsoid"], s["polarity"]["accelerometer"]
    source = logged if method == "robust" else smoothed
    try:
        everything = ellipsoid.fit_ellipsoid(source, s["gravity_mps2"], method=method, polarity=polarity)
    except (UnusableFlight, EstimationError, ValueError) as error:
        everything, refusal = None, error
    gated = _gated_fit(source, quiet, s)
    if gated is not None:
        measured["gate_condition_number"] = gated.condition
    better = gated is not None and (everything is None or _scale_doubt(gated) < _scale_doubt(everything))
    measured["gate_kept"] = better
    chosen = gated if better else everything
    if chosen is None:
        return _refused(refusal, "accelerometer")
    return _judged("accelerometer", chosen, tables, s, "m/s^2", logged, measured)


def _gated_fit(source: Array, quiet: np.ndarray, s: Settings) -> TriadFit | None:
    """Fit of the quiet samples; None where they see too little of the sphere."""
    if quiet.sum() < 100:
        return None
    try:
        fit = ellipsoid.fit_ellipsoid(
            source[quiet], s["gravity_mps2"], method=s["ellipsoid"], polarity=s["polarity"]["accelerometer"]
        )
    except (UnusableFlight, EstimationError):
        return None
    return fit if fit.condition < s["ellipsoid_max_condition"] else None


def _scale_doubt(fit: TriadFit) -> float:
    """Largest claimed relative sd of a scale."""
    return float(np.max(np.sqrt(np.diagonal(fit.covariance)[:3]) / np.abs(fit.scale_diagonal)))


def _lever_arm(samples: pl.DataFrame, rate: Array, s: Settings) -> Array:
    """Acceleration of the sensor about the centre of mass, m/s², body axes, from smoothed rates (Eq. 3)."""
    rate_dot = differentiate_by_segment(samples, rate, s["differentiation_window_s"])
    return sensor.lever_arm_acceleration(rate, rate_dot, s["lever_arm_m"])


def differentiate_by_segment(samples: pl.DataFrame, x: Array, window_s: float) -> Array:
    """Local smoothed derivative of x (n, m) by segment."""
    t_ns, segment = samples["t_ns"].to_numpy(), samples["segment"].to_numpy()
    out = np.empty_like(x)
    starts = np.flatnonzero(np.r_[True, segment[1:] != segment[:-1]])
    for a, b in zip(starts, np.r_[starts[1:], len(segment)], strict=True):
        out[a:b] = smoothing.differentiate_samples((t_ns[a:b] - t_ns[a]) * 1e-9, x[a:b], window_s=window_s)
    return out


def logged_constants(s: Settings, name: str) -> tuple[Array, Array] | None:
    """Scale from the logged unit alone, bias 0: what an SI log says of itself. None for counts."""
    nominal = s["nominal_scale"][name]
    if nominal is None:
        return None
    return np.diag(np.asarray(nominal) * np.asarray(s["polarity"][name], dtype=float)), np.zeros(3)


def estimate_attitude(tables: Tables, s: Settings) -> StageResult:
    """samples and both triads' constants → attitude (Eq. 9), weighted by what the sensed lengths say.

    Where an SI log's ellipsoid is refused its logged values are used, flagged; raw counts stop here."""
    used: dict[str, tuple[Array, Array]] = {}
    fallback = []
    for name in ("magnetometer", "accelerometer"):
        if tables["samples"][f"{name}_x"].null_count() == len(tables["samples"]):
            return StageResult(status="refused", reason_code=f"no_{name}", reason=f"Attitude needs a {name}.")
        own = constants(tables[name], name) if name in tables else None
        if own is None:
            own = logged_constants(s, name)
            fallback.append(name)
        if own is None:
            return StageResult(
                status="refused",
                reason_code=f"{name}_refused",
                reason=f"Attitude needs a calibrated {name}; its fit was refused and raw counts are no vector.",
            )
        used[name] = own
    vectors = body_vectors(tables["samples"], used, s, prefix="smoothed_")
    strength, gravity = float(np.linalg.norm(s["field_ned"])), s["gravity_mps2"]
    field_excess = np.linalg.norm(vectors[:, 0], axis=1) / strength - 1.0
    acceleration_excess = np.linalg.norm(vectors[:, 1], axis=1) / gravity - 1.0
    sigma = np.array([_spread(field_excess), _spread(acceleration_excess)])
    reference = np.array([s["field_ned"], [0.0, 0.0, 1.0]])
    declination = float(np.arctan2(s["field_ned"][1], s["field_ned"][0]))
    fit = wahba.attitudes(vectors, reference, sigma, method=s["attitude"], declination=declination)
    weight = 1.0 / (1.0 + (acceleration_excess / TRUST_ACCELERATION) ** 2 + (field_excess / TRUST_FIELD) ** 2)
    dip = _dip_deg(vectors)[weight >= np.quantile(weight, 1.0 - TRUSTED_SHARE)]
    scatter = float(1.4826 * np.median(np.abs(dip - np.median(dip))))
    expected_dip = float(np.degrees(np.arcsin(np.clip(reference[0, 2] / strength, -1, 1))))
    measured = {
        "logged_values_used": fallback,
        "direction_sd_rad": {"magnetometer": float(sigma[0]), "accelerometer": float(sigma[1])},
        "dip_deg": float(np.median(dip)),
        "dip_expected_deg": expected_dip,
        "dip_scatter_deg": scatter,
        "field": s["field_source"],
        "taste_median": float(np.median(fit.taste)),
    }
    if scatter > MAX_DIP_SCATTER_DEG:
        return StageResult(
            status="refused",
            reason_code="vectors_contradict",
            reason=f"The angle between magnetic field and gravity scatters by {scatter:.1f}° where it should be one number:"
            " a wrong polarity, swapped axes, or a magnet on board.",
            measured=measured,
        )
    table = pl.DataFrame(
        {
            "t_ns": tables["samples"]["t_ns"],
            "segment": tables["samples"]["segment"],
            **columns_of(fit.q, QUATERNION),
            "attitude_sd_rad": fit.sd,
            "taste": fit.taste,
            "acceleration_excess_mps2": acceleration_excess * gravity,
            "field_excess": field_excess,
            "weight": weight,
        }
    )
    code = "logged_values_used" if fallback else None
    reason = f"Logged values stand in for the refused {' and '.join(fallback)}." if fallback else None
    return StageResult({"attitude": table}, "ok", code, reason, measured)


def body_vectors(samples: pl.DataFrame, used: Mapping[str, tuple[Array, Array]], s: Settings, *, prefix: str) -> Array:
    """Calibrated magnetic field and gravity-signed acceleration in body axes, (n, 2, 3)."""
    axes = sensor.frd_from_sensor(s["rotation_body_from_sensor"], s["body"])
    field = sensor.calibrate(matrix(samples, triad("magnetometer", prefix)), *used["magnetometer"]) @ axes.T
    gravity = sensor.calibrate(matrix(samples, triad("accelerometer", prefix)), *used["accelerometer"]) @ axes.T
    return np.stack([field, sensor.GRAVITY_SIGNS[s["gravity_sign"]] * gravity], axis=1)


def _spread(excess: Array) -> float:
    """Robust spread of a relative excess length: the direction noise to expect across it. At least 1e-4 rad."""
    return max(float(1.4826 * np.median(np.abs(excess - np.median(excess)))), 1e-4)


def _dip_deg(vectors: Array) -> Array:
    """Angle of the sensed field below the sensed horizontal, degrees, (n,)."""
    unit = vectors / np.linalg.norm(vectors, axis=2, keepdims=True)
    return np.asarray(np.degrees(np.arcsin(np.clip(np.einsum("ni,ni->n", unit[:, 0], unit[:, 1]), -1.0, 1.0))))


def sensor_attitude(q: Array, s: Settings) -> Array:
    """Attitude of the sensor's own axes (n, 4) from that of the body: gyroscope constants live in sensor axes."""
    axes = sensor.frd_from_sensor(s["rotation_body_from_sensor"], s["body"])
    return multiply(q, from_matrix(axes.T))


def calibrate_gyro_equation(tables: Tables, s: Settings) -> StageResult:
    """samples, attitude → calibration of the gyroscope by equation error (Eq. 10–15)."""
    samples, attitude = tables["samples"], tables["attitude"]
    logged = matrix(samples, triad("gyroscope", "smoothed_"))
    if np.isnan(logged).any():
        return StageResult(status="refused", reason_code="no_gyroscope", reason="The log has no gyroscope readings.")
    q = sensor_attitude(matrix(attitude, QUATERNION), s)
    try:
        fit = gyro_equation.fit_equation_error(
            q,
            differentiate_by_segment(samples, q, s["differentiation_window_s"]),
            logged,
            equations=s["equations"],
            weights=attitude["weight"].to_numpy(),
        )
    except UnusableFlight as error:
        return _refused(error, "gyroscope")
    return _gyro_result("equation_error", fit, fit.covariance, tables, s, {"residual_rms": fit.residual_rms})


def _gyro_result(
    method: str, fit: GyroFit, covariance: Array, tables: Tables, s: Settings, measured: dict[str, Any]
) -> StageResult:
    """Gyroscope rows with a status by axis: sign against polarity, size against nominal, claimed sd."""
    relative = np.sqrt(np.diagonal(covariance)[:3]) / np.abs(fit.scale)
    sign_wrong = np.sign(fit.scale) != np.sign(np.asarray(s["polarity"]["gyroscope"], dtype=float))
    codes: list[str | None] = [None] * 3
    nominal = s["nominal_scale"]["gyroscope"]
    for i in range(3):
        ratio = 1.0 if nominal is None else abs(fit.scale[i]) / abs(nominal[i])
        if not relative[i] <= s["gyro_max_scale_sd"]:
            codes[i] = "scale_uncertain"
        elif sign_wrong[i]:
            codes[i] = "polarity_contradiction"
        elif not 0.5 <= ratio <= 2.0:
            codes[i] = "scale_not_nominal"
    measured = {
        **measured,
        "n_samples": fit.n_samples,
        "iterations": fit.iterations,
        "scale_relative_sd": [float(v) for v in relative],
        "scale_relative_sd_cramer_rao": [
            float(v) for v in np.sqrt(np.diagonal(fit.covariance_white)[:3]) / np.abs(fit.scale)
        ],
    }
    rows = triad_rows(
        "gyroscope",
        method,
        np.diag(fit.scale),
        fit.bias,
        covariance,
        unit="rad/s",
        logged_unit=s["units"]["gyroscope"],
        reference_reading=_reference(s, "gyroscope", matrix(tables["samples"], triad("gyroscope"))),
        temperature_degc=_mean_temperature(tables),
        status=tuple("ok" if c is None else "refused" for c in codes),  # type: ignore[arg-type]
        reason_code=tuple(codes),  # type: ignore[arg-type]
    )
    bad = [f"{axis}: {code}" for axis, code in zip(AXES, codes, strict=True) if code]
    status = "refused" if len(bad) == 3 else "ok"
    reason = GYRO_REASONS.format(axes=", ".join(bad)) if bad else None
    first = next((c for c in codes if c), None)
    result = {"calibration": calibration_rows(rows), "covariance": covariance_table(covariance)}
    return StageResult(result, status, first, reason, measured)


GYRO_REASONS = "Gyroscope axes refused ({axes}): too little rotation about them, or polarity and units that contradict."


def calibrate_gyro_output(tables: Tables, s: Settings) -> StageResult:
    """samples, attitude, equation-error start → calibration by output error, with the triads' own uncertainty propagated."""
    if not s["gyro_output"]:
        return StageResult(status="absent", reason_code="switched_off", reason="Output error is switched off.")
    samples, attitude = tables["samples"], tables["attitude"]
    logged = matrix(samples, triad("gyroscope"))
    t = seconds(samples["t_ns"], samples["t_ns"][0])
    segment, weight = samples["segment"].to_numpy(), attitude["weight"].to_numpy()
    q = sensor_attitude(matrix(attitude, QUATERNION), s)
    start = _start(tables["gyroscope"], t, q, logged, segment, weight, s)
    stretch_s = s["shooting_s"] or _suitable_stretch(start, t, logged, tables)
    options: dict[str, Any] = {
        "segment": segment,
        "weights": weight,
        "initial_attitude": s["initial_attitude"],
        "robust": s["initial_attitude"] == "estimated",
    }
    try:
        if stretch_s > 1.5 * RUN_IN_STRETCH_S and s["initial_attitude"] == "estimated":
            start = gyro_output.fit_output_error(t, q, logged, start, stretch_s=RUN_IN_STRETCH_S, **options)
        fit = gyro_output.fit_output_error(t, q, logged, start, stretch_s=stretch_s, **options)
    except EstimationError as error:
        return _refused(error, "gyroscope")
    median = gyro_output.attitude_error_median(t, q, fit.scale * logged + fit.bias, segment, stretch_s, weight)
    measured = {
        "stretch_s": stretch_s,
        "attitude_error_rms_deg": float(np.degrees(fit.residual_rms)),
        "attitude_error_median_deg": float(np.degrees(median)),
    }
    if median > MAX_MEDIAN_ATTITUDE_ERROR_RAD:
        return StageResult(
            status="refused",
            reason_code="gyro_contradicts_attitude",
            reason=f"The integrated gyroscope misses the attitude by {np.degrees(median):.0f}° (median): wrong polarity, axes"
            " or units of a sensor, or attitudes spoiled by acceleration.",
            measured=measured,
        )
    propagated = constants_to_gyro(t, q, segment, logged, weight, fit, stretch_s, _triad_uncertainty(tables, s))
    measured["propagated_share_of_variance"] = [
        float(v) for v in np.diagonal(propagated)[:3] / np.diagonal(fit.covariance + propagated)[:3]
    ]
    return _gyro_result("output_error", fit, fit.covariance + propagated, tables, s, measured)


def _start(
    equation: pl.DataFrame, t: Array, q: Array, logged: Array, segment: np.ndarray, weight: Array, s: Settings
) -> GyroFit:
    """The nearer of equation error's constants and, for SI logs, the logged values."""
    values = {(p, a): v for p, a, v in equation.select("parameter", "axis", "value").iter_rows()}
    start = GyroFit(
        scale=np.array([values["scale", a] for a in AXES]),
        bias=np.array([values["bias", a] for a in AXES]),
        covariance=np.zeros((6, 6)),
        covariance_white=np.zeros((6, 6)),
        residual_rms=0.0,
        n_samples=len(t),
    )
    own = logged_constants(s, "gyroscope")
    if own is None:
        return start
    nominal = replace(start, scale=np.diagonal(own[0]).copy(), bias=own[1])
    error = [
        gyro_output.attitude_error_median(t, q, c.scale * logged + c.bias, segment, RUN_IN_STRETCH_S, weight)
        for c in (start, nominal)
    ]
    return start if error[0] <= error[1] else nominal


def _suitable_stretch(start: GyroFit, t: Array, logged: Array, tables: Tables) -> float:
    """Stretch length from the gyroscope's sample-to-sample noise and the attitude's own error."""
    difference = np.diff(logged, axis=0)
    noise = 1.4826 * np.median(np.abs(difference - np.median(difference, axis=0)), axis=0) / np.sqrt(2.0)
    excess = tables["attitude"]["acceleration_excess_mps2"].to_numpy(), tables["attitude"]["field_excess"].to_numpy()
    error = max(_spread(excess[0] / 9.81), _spread(excess[1]))
    return gyro_output.suitable_stretch_s(
        float(np.max(noise * np.abs(start.scale))), float(np.median(np.diff(t))), error
    )


def _triad_uncertainty(tables: Tables, s: Settings) -> list[tuple[Array, Array]]:
    """[(directions sensed (n, 3) …)] see `propagation`: one (Jacobian of the attitude, covariance) pair per vector triad."""
    samples, attitude = tables["samples"], tables["attitude"]
    axes = sensor.frd_from_sensor(s["rotation_body_from_sensor"], s["body"])
    used = {n: (constants(tables[n], n) if n in tables else None) or logged_constants(s, n) for n in VECTOR_SENSORS}
    vectors = body_vectors(samples, used, s, prefix="smoothed_")  # type: ignore[arg-type]
    spread = (
        _spread(attitude["field_excess"].to_numpy()),
        _spread(attitude["acceleration_excess_mps2"].to_numpy() / s["gravity_mps2"]),
    )
    sign = {"magnetometer": 1.0, "accelerometer": sensor.GRAVITY_SIGNS[s["gravity_sign"]]}
    pairs = []
    for i, name in enumerate(VECTOR_SENSORS):
        covariance = tables.get(f"{name}_covariance")
        if covariance is None or constants(tables[name], name) is None:
            continue
        logged = matrix(samples, triad(name, "smoothed_"))
        jacobian = attitude_jacobian(vectors, np.array(spread), i, logged, sign[name] * axes)
        pairs.append((np.einsum("ji,njp->nip", axes, jacobian), covariance_of(covariance)))
    return pairs


VECTOR_SENSORS = ("magnetometer", "accelerometer")
