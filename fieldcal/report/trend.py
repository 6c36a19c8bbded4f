"""The table drift in words and curves: what a row's regression says at a time and temperature."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.names import GRAVEST_FIRST, DriftStatus
from fieldcal.report.history import LatestCalibration
from fieldcal.report.words import count, day, scientific
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.schemas.rows import DriftRow
from fieldcal.words.measures import with_unit, written

TREND_VALUES = (
    *("value_at_25degc", "sd", "slope_per_degc", "slope_per_degc_sd", "slope_per_day", "slope_per_day_sd"),
    *("session_sd", "change_size", "change_size_sd"),
    *("curve_per_degc2", "curve_per_degc2_sd", "curve_per_degc3", "curve_per_degc3_sd"),
)
"""Columns of `drift` that go with its unit."""
DAY_S = 86400.0


def worst_status(drift: pl.DataFrame | None) -> str | None:
    """Worst status of the rows; None where there are none. `insufficient` says nothing: only where nothing else is."""
    if drift is None or drift.is_empty():
        return None
    there = set(drift["status"].to_list())
    return next((status for status in GRAVEST_FIRST if status in there), min(map(str, there)))


def change_sentence(row: DriftRow, siblings: Sequence[float]) -> str:
    """What is not steady about a drift row: its own sentence, and what the siblings, in the row's unit, show of an
    outlier."""
    told = str(row["reason"] or "")
    if row["status"] == DriftStatus.OUTLIER and siblings:
        median = with_unit(*_written(float(np.median(siblings)), None, row["unit"]))
        told = f"{told} Median of {count(len(siblings), 'sibling')} at {REFERENCE_DEGC:g} °C: {median}.".strip()
    if told:
        return told
    if row["change_at"] is not None:
        return f"Step at the flight of {day(row['change_at'])}."
    slope, unit = _written(row["slope_per_day"], row["slope_per_day_sd"], row["unit"])
    return "–" if slope == "–" else f"{with_unit(slope, unit)} per day."


def _written(value: float | None, sd: float | None, unit: str) -> tuple[str, str]:
    factor, name = written(unit)
    scaled = (None if one is None else one * factor for one in (value, sd))
    return scientific(*scaled), name


def warmed(row: DriftRow, degc: Array | float) -> Array:
    """What a drift row's regression adds to the value at 25 °C at another temperature."""
    d = np.asarray(degc, dtype=float) - REFERENCE_DEGC
    first, second, third = (r or 0.0 for r in (row["slope_per_degc"], row["curve_per_degc2"], row["curve_per_degc3"]))
    return np.asarray(first * d + second * d**2 + third * d**3)


def predicted(row: DriftRow, degc: Array | float, days: Array | float) -> tuple[Array, Array]:
    """Value and standard deviation of a drift row's regression at a temperature, so many days after its moment.

    The value at 25 °C and the slope on temperature are correlated; they are independent at `best_known_degc`, B:
    var(T) = sd² + s²[(T − B)² − (25 °C − B)²], s the slope's sd. So are the value and the slope in time at
    `best_known_at`. Where one is not known the variances are added. Away from 25 °C and from the moment `as_of` at
    once, the covariance of the two slopes is missing: ask along one of them. A bend's sd is left out.
    """
    degc, later = np.asarray(degc, dtype=float), np.asarray(days, dtype=float)
    level, slope_sd = row["value_at_25degc"], row["slope_per_degc_sd"] or 0.0
    assert level is not None, "a drift row without a value predicts nothing"
    best = REFERENCE_DEGC if row["best_known_degc"] is None else row["best_known_degc"]
    value = level + warmed(row, degc) + (row["slope_per_day"] or 0.0) * later
    at_temperature = (row["sd"] or 0.0) ** 2 + slope_sd**2 * ((degc - best) ** 2 - (REFERENCE_DEGC - best) ** 2)
    best_at, as_of = row["best_known_at"], row["as_of"]
    best_day = 0.0 if best_at is None or as_of is None else days_after([best_at], as_of)[0]
    in_time = (row["slope_per_day_sd"] or 0.0) ** 2 * ((later - best_day) ** 2 - best_day**2)
    return np.asarray(value), np.sqrt(np.maximum(at_temperature + in_time, 0.0))


def days_after(moments: Sequence[datetime | None], reference: datetime) -> Array:
    """Days from `reference`, (n,); NaN where the time is unknown."""
    return np.array([np.nan if m is None else (m - reference).total_seconds() / DAY_S for m in moments])


def fly_with_sentence(row: LatestCalibration) -> str:
    """Where a constant to fly with comes from: a row of `latest_calibration`."""
    if row["source"] != "flight":
        return str(row["why"])
    at = "" if row["temperature_degc"] is None else f", {row['temperature_degc']:.0f} °C"
    return f"Flight of {day(row['started_at'])}{at}. {row['why']}"
