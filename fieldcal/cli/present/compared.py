"""What a vehicle flies with beside what is estimated, on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from fieldcal.cli.present.constants import constant
from fieldcal.cli.present.screen import Screen, table
from fieldcal.exports.autopilots.comparison import COLUMNS, NONE, Compared, lines
from fieldcal.words.measures import measure
from fieldcal.words.numbers import number

NARROW = ("constant", "flies with", "estimate", "which is", "matters")


def print_compared(screen: Screen, rows: Sequence[Compared], vehicle: str) -> None:
    """A constant a line; wide: with the autopilot's parameter, in its own units."""
    title = f"{vehicle}: what it flies with, and what is estimated"
    if screen.is_wide:
        screen.print(table(COLUMNS, lines(rows), title))
        return
    screen.print(table(NARROW, map(_line, rows), title))
    names = [
        f"{row.name} ({constant(row.sensor, row.axis, row.parameter)})" for row in rows if row.matters and row.name
    ]
    if names:
        screen.print(f"To change: {', '.join(names)}: fieldcal export {vehicle}.")


def _line(row: Compared) -> list[str]:
    known = isfinite(row.estimate)
    sd = row.sd if isfinite(row.sd) else None
    return [
        constant(row.sensor, row.axis, row.parameter),
        measure(row.flies_with, None, row.unit),
        measure(row.estimate, sd, row.unit) if known else NONE,
        NONE if row.effect is None else f"{number(row.effect, 3)} {row.effect_unit}",
        ("yes" if row.matters else "no") if known else NONE,
    ]
