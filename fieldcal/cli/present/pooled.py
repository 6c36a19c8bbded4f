"""What all flights know together, and what to fly next, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fieldcal.cli.present.constants import constant
from fieldcal.cli.present.history import name_of, titled
from fieldcal.cli.present.screen import Screen, table
from fieldcal.schemas.rows import PooledRow
from fieldcal.words.measures import change, measure, with_unit, written
from fieldcal.words.numbers import number
from fieldcal.words.rows import typed

if TYPE_CHECKING:
    import polars as pl

    from fieldcal.trends.pooled.plan import Plan

MOST_SHOWN = 6
"""Constants beside the best manoeuvre, those that it helps most first."""


def print_pooled(screen: Screen, frame: pl.DataFrame) -> None:
    """Rows of `pooled`, a table a unit; then why what is not ok is not."""
    units: dict[tuple[str, str], list[PooledRow]] = {}
    for row in typed(frame.iter_rows(named=True), PooledRow):
        units.setdefault((row["vehicle_id"], row["unit_id"]), []).append(row)
    columns = ["constant", "status", "value at 25 °C", "per °C"]
    for (vehicle, unit), own in units.items():
        screen.print(table(columns, map(_line, own), titled(vehicle, unit, own), drop_silent=True))
        for row in own:
            if row["status"] != "ok":
                screen.print(f"{constant(row['sensor'], row['axis'], row['parameter'])}: {row['reason']}")


def _line(row: PooledRow) -> list[str]:
    slope = change(
        row["slope_per_degc"],
        row["slope_per_degc_sd"],
        row["unit"],
        parameter=row["parameter"],
        of=row["value_at_25degc"],
    )
    return [
        constant(row["sensor"], row["axis"], row["parameter"]),
        row["status"],
        measure(row["value_at_25degc"], row["sd"], row["unit"]),
        slope,
    ]


def print_plan(screen: Screen, found: Plan) -> None:
    """The best manoeuvre with what it would do, and the others."""
    best = found.manoeuvres[0]
    screen.print(f"{name_of(found.vehicle_id, found.unit_id)}: {best.words}.")
    screen.print(f"Constants not known well enough: {best.refused_now} now, {best.refused_after} after it.")
    first = sorted(best.expected, key=lambda e: -(min(e.sd_now, 1e9) / e.sd_after))[:MOST_SHOWN]
    lines = [[e.constant, *(_sd(sd, e.unit) for sd in (e.sd_now, e.sd_after, e.limit))] for e in first]
    screen.print(table(["constant", "sd now", "sd after it", "limit"], lines))
    lines = [[other.words, str(other.refused_after), f"{other.gain:.2f}"] for other in found.manoeuvres[1:]]
    if lines:
        screen.print(table(["or", "not known", "sd smaller by"], lines))


def _sd(sd: float, unit: str) -> str:
    factor, name = written(unit)
    return "not known" if sd == float("inf") else with_unit(number(sd * factor, 2), name)
