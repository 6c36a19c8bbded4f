"""The table drift in words and curves: what a row's regression says at a time and temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import polars as pl

from fieldcal.rotation import Array
from flows.report.words import count, day, scientific, with_unit

STATUSES = ("step", "outlier", "drifting", "insufficient", "stable")
"""Worst first."""

REFERENCE_DEGC = 25.0
DAY_S = 86400.0


def worst_status(drift: pl.DataFrame | None) -> str | None:
    """Worst status of the rows; None where there are none."""
    if drift is None or drift.is_empty():
        return None
    there = set(drift["status"].to_list())
    return next((status for status in STATUSES if status in there), min(map(str, there)))


def change_sentence(row: Mapping[str, Any], siblings: Sequence[float]) -> str:
    """What is not steady about a drift row, in words; `siblings` are the values of the fleet's other IMUs at 25 °C."""
    if row["status"] == "step" and row["change_at"] is not None:
        return f"step at the flight of {day(row['change_at'])}"
    if row["status"] == "outlier":
        own = with_unit(scientific(row["value_at_25degc"], row["sd"]), row["unit"])
        median = with_unit(scientific(float(np.median(siblings))), row["unit"]) if siblings else "unknown"
        return f"{own} at 25 °C; median of {count(len(siblings), 'sibling')}: {median}"
    slopes = [
        f"{with_unit(scientific(row[name], row[f'{name}_sd']), row['unit'])} per {per}"
        for name, per in (("slope_per_day", "day"), ("slope_per_degc", "°C"))
        if row[name] is not None
    ]
    return "; ".join(slopes) or "no slope"


def predicted(row: Mapping[str, Any], degc: Array | float, days: Array | float) -> tuple[Array, Array]:
    """Value and standard deviation of a drift row's regression at a temperature and so many days after its reference.

    The table keeps no covariances between value and slopes: the three variances are added.
    """
    warmer = np.asarray(degc, dtype=float) - REFERENCE_DEGC
    later = np.asarray(days, dtype=float)
    value = row["value_at_25degc"] + (row["slope_per_degc"] or 0.0) * warmer + (row["slope_per_day"] or 0.0) * later
    variance = (
        (row["sd"] or 0.0) ** 2
        + ((row["slope_per_degc_sd"] or 0.0) * warmer) ** 2
        + ((row["slope_per_day_sd"] or 0.0) * later) ** 2
    )
    return np.asarray(value), np.sqrt(variance)


def days_after(moments: list[datetime | None], reference: datetime) -> Array:
    """Days from `reference`, (n,); NaN where the time is unknown."""
    return np.array([np.nan if m is None else (m - reference).total_seconds() / DAY_S for m in moments])


def fly_with_sentence(row: Mapping[str, Any]) -> str:
    """Where a constant to fly with comes from."""
    if row["source"] == "flight":
        at = row["temperature_degc"]
        return f"flight of {day(row['started_at'])}" + ("" if at is None else f", {at:.0f} °C")
    return "history" if row["source"] == "drift" else str(row["source"])
