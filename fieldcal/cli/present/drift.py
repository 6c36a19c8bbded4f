"""Trends on the terminal: a table a unit, then in sentences what is not steady."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fieldcal.cli.present.constants import constant, telling
from fieldcal.cli.present.history import titled
from fieldcal.cli.present.screen import Screen, table
from fieldcal.names import exactness
from fieldcal.schemas.rows import DriftRow
from fieldcal.trends.reasons import MONTH_D, status_words
from fieldcal.words.measures import change, measure
from fieldcal.words.rows import typed

if TYPE_CHECKING:
    import polars as pl

COLUMNS = ("constant", "status", "value at 25 °C", "in 30 days")


def print_drift(screen: Screen, frame: pl.DataFrame, following: Mapping[str, str] | None) -> None:
    """Rows of `drift` that tell most; how many others there are is said. `following`: when to calibrate each vehicle
    again; None without limits."""
    rows = typed(frame.iter_rows(named=True), DriftRow)
    shown = telling(rows)
    units: dict[tuple[str, str], list[DriftRow]] = {}
    for row in shown:
        units.setdefault((row["vehicle_id"], row["unit_id"]), []).append(row)
    for (vehicle, unit), own in units.items():
        best = {
            place: min(exactness(row["method"]) for row in own if _place(row) == place) for place in map(_place, own)
        }
        lines = [_line(row, exactness(row["method"]) == best[_place(row)]) for row in own]
        screen.print(table(COLUMNS, lines, titled(vehicle, unit, own), drop_silent=True))
        for reason, names in _reasons(own).items():
            screen.print(f"{names[0]}{f' (and {len(names) - 1} more)' if len(names) > 1 else ''}: {reason}")
    for vehicle, told in (following or {}).items():
        screen.print(f"{vehicle}: {told}")
    if following is None and rows:
        screen.print("When to calibrate again: nights tell it by [limits] of fieldcal.toml, which has none.")
    if hidden := len(rows) - len(shown):
        screen.print(f"Not shown: {hidden} steady rows: other methods, bias, zero, agreement (--wide).")


def _line(row: DriftRow, is_best: bool) -> list[str]:
    name = constant(row["sensor"], row["axis"], row["parameter"])
    slope, sd = row["slope_per_day"], row["slope_per_day_sd"]
    moved = change(
        None if slope is None else MONTH_D * slope,
        None if sd is None else MONTH_D * sd,
        row["unit"],
        parameter=row["parameter"],
        of=row["value_at_25degc"],
    )
    return [
        name if is_best else f"{name} ({row['method'].replace('_', ' ')})",
        status_words(row),
        measure(row["value_at_25degc"], row["sd"], row["unit"]),
        moved,
    ]


def _place(row: DriftRow) -> tuple[str, ...]:
    return row["sensor"], row["parameter"], row["axis"]


def _reasons(rows: list[DriftRow]) -> dict[str, list[str]]:
    """Each sentence once, and of which constants."""
    told: dict[str, list[str]] = {}
    for row in rows:
        if row["reason"]:
            told.setdefault(row["reason"], []).append(constant(row["sensor"], row["axis"], row["parameter"]))
    return told
