"""Selection of the segments to calibrate on, and their readings at the IMU's stamps, smoothed."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fieldcal.estimation import motion_selection, smoothing
from fieldcal.estimation.segments import run_bounds
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import Array
from fieldcal.names import Json, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import columns_of, matrix, seconds, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import ManoeuvreSettings, SmoothingSettings

TURNED_DEG = "turned_deg"
"""Among what stage `manoeuvre` measured: `turned_within` about each axis, degrees."""
LEAST_TURNED_DEG = 1.0
"""A vehicle that turned by less within 10 s about every axis lay still; a manoeuvre in rad/s that is taken for °/s
turns by more, and is told by its unit."""
SHORTEST_STRETCH = 10
MAGNETOMETER_GAP_S = 0.1
MAGNETOMETER_GAP_INTERVALS = 5.0
"""Longest gap that a magnetometer is interpolated over: so many of its intervals, or MAGNETOMETER_GAP_S if longer."""


class _Stretch(NamedTuple):
    """Samples without a gap: stamps and number of the segment (n,), readings logged and smoothed (n, 9)."""

    t_ns: NDArray[np.int64]
    segment: NDArray[np.int32]
    logged: Array
    smoothed: Array


def find_manoeuvre(tables: Tables, s: ManoeuvreSettings) -> StageResult:
    """imu → segments: the stretches worth calibrating on, and why."""
    imu = tables["imu"]
    t = seconds(imu["t_ns"], imu["t_ns"][0])
    rate = matrix(imu, triad("gyroscope"))
    rate_or_none = None if np.isnan(rate).any() else rate
    found = motion_selection.select(
        t,
        rate_or_none,
        window_s=s.manoeuvre_window_s,
        pad_s=s.manoeuvre_pad_s,
        rest_s=s.manoeuvre_rest_s,
        min_s=s.manoeuvre_min_s,
        max_gap_s=s.manoeuvre_max_gap_s,
        excited_ratio=s.manoeuvre_excited_ratio,
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
    measured: dict[str, Json] = {
        "excited_s": found.excited_s,
        "used_s": used_s,
        "log_s": float(t[-1] - t[0]),
        "segments_used": int(sum(g.used for g in found.segments)),
        "rate_level": found.level,
        "rate_threshold": found.threshold,
        "rate_noise": found.noise,
    }
    unit, still = s.nominal_scale[Sensor.GYROSCOPE], False
    if rate_or_none is not None and unit is not None:
        turned = motion_selection.turned_within(t, rate * np.asarray(unit), max_gap_s=s.manoeuvre_max_gap_s)
        measured[TURNED_DEG] = [float(angle) for angle in np.rad2deg(turned)]
        still = bool(np.max(np.rad2deg(turned)) < LEAST_TURNED_DEG)
    too_short = found.excited_s < s.manoeuvre_min_s
    if too_short or still:
        wanting = (
            f"Only {found.excited_s:.1f} s of rotation were found, {s.manoeuvre_min_s:.0f} s are needed"
            if too_short
            else "It lay still, but for vibration"
        )
        return StageResult(
            {"segments": segments.with_columns(used=pl.lit(False))},
            Status.REFUSED,
            ReasonCode.TOO_LITTLE_MOTION,
            f"{wanting}: fly the manoeuvre (roll, pitch and yaw doublets).",
            measured,
        )
    return StageResult({"segments": segments}, measured=measured)


def smooth(tables: Tables, s: SmoothingSettings) -> StageResult:
    """imu, magnetometer, segments → samples: readings of the used segments at the IMU's stamps, logged and smoothed."""
    imu, segments = tables["imu"], tables["segments"].filter(pl.col("used"))
    if segments.is_empty():
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NO_MANOEUVRE, reason="No segment of the log is usable."
        )
    origin = int(imu["t_ns"][0])
    stamps = imu["t_ns"].to_numpy()
    logged = np.column_stack(
        [matrix(imu, triad("gyroscope") + triad("accelerometer")), _magnetometer_at(tables, stamps)]
    )
    parts: list[_Stretch] = []
    for number, rows in _whole_stretches(segments, stamps, logged):
        x = logged[rows]
        t = (stamps[rows] - origin) * 1e-9
        smoothed = np.full_like(x, np.nan)
        valid = ~np.isnan(x).any(axis=0)
        smoothed[:, valid] = smoothing.smooth_samples(
            t, x[:, valid], s.smoothing_cutoff_hz, side_s=s.smoothing_side_s, ends=s.smoothing_ends
        )
        parts.append(_Stretch(stamps[rows], np.full(len(x), number, dtype=np.int32), x, smoothed))
    if not parts:
        return StageResult(
            status=Status.REFUSED,
            reason_code=ReasonCode.NO_MANOEUVRE,
            reason="The magnetometer has gaps throughout.",
        )
    t_ns, segment, x, smoothed = (np.concatenate(pieces) for pieces in zip(*parts, strict=True))
    names = triad("gyroscope") + triad("accelerometer") + triad("magnetometer")
    samples = pl.DataFrame(
        {
            "t_ns": t_ns,
            "segment": segment,
            **columns_of(x, names),
            **columns_of(smoothed, [f"smoothed_{n}" for n in names]),
        }
    ).with_columns(pl.selectors.float().fill_nan(None))
    return StageResult({"samples": samples}, measured={"n_samples": len(samples)})


def _whole_stretches(segments: pl.DataFrame, stamps: np.ndarray, logged: Array) -> list[tuple[int, slice]]:
    """Number and rows of each used segment; one with gaps in the magnetometer is split at them."""
    found: list[tuple[int, slice]] = []
    silent = np.asarray(np.isnan(logged[:, 6:]).any(axis=1))
    extra = int(segments["segment"].max()) + 1  # type: ignore[arg-type]
    for number, start, end in segments.select("segment", "start_ns", "end_ns").iter_rows():
        first, last = int(np.searchsorted(stamps, start)), int(np.searchsorted(stamps, end, side="right"))
        quiet = silent[first:last]
        if silent.all() or not quiet.any():
            found.append((number, slice(first, last)))
            continue
        for a, b in ((first + start, first + stop) for start, stop in run_bounds(quiet)):
            if not silent[a] and b - a >= SHORTEST_STRETCH:
                found.append((number if not found or found[-1][0] != number else extra, slice(a, b)))
                extra += 1
    return found


def _magnetometer_at(tables: Tables, stamps: np.ndarray) -> Array:
    """Magnetometer at the IMU's stamps, (n, 3), linear between its readings, held past its ends for as long as
    the longest gap that is interpolated over; NaN in longer gaps and where there is none."""
    magnetometer = tables.get("magnetometer")
    if magnetometer is None or len(magnetometer) < 2:
        return np.full((len(stamps), 3), np.nan)
    stamps_ns = magnetometer["t_ns"].to_numpy()
    values = matrix(magnetometer, triad("magnetometer"))
    if len(stamps_ns) == len(stamps) and np.array_equal(stamps_ns, stamps):
        return values
    origin = stamps[0]
    at, stamps_s = (stamps - origin) * 1e-9, (stamps_ns - origin) * 1e-9
    result = np.column_stack([np.interp(at, stamps_s, column) for column in values.T])
    longest = max(MAGNETOMETER_GAP_S, MAGNETOMETER_GAP_INTERVALS * float(np.median(np.diff(stamps_s))))
    i = interval_of(stamps_s, at, on_stamp="ends")
    between = (stamps_s[0] <= at) & (at <= stamps_s[-1])
    in_gap = between & (stamps_s[i + 1] - stamps_s[i] > longest)
    beyond = np.maximum(stamps_s[0] - at, at - stamps_s[-1]) > longest
    result[(in_gap & ~np.isin(stamps, stamps_ns)) | beyond] = np.nan
    return result
