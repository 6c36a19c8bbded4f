"""A number, and a number with its standard deviation, to the digits that it earns."""

from __future__ import annotations

from datetime import datetime
from math import floor, log10


def cell(value: object) -> str:
    """A value in a table."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, datetime):
        return value.strftime("%Y-%m-%d %H:%M:%S")
    return str(value)


def number(value: float | None, digits: int = 5) -> str:
    """A number with so many significant digits."""
    return "–" if value is None else f"{value:.{digits}g}"


def with_sd(value: float | None, sd: float | None) -> str:
    """A value and its standard deviation, to the digits that the latter leaves."""
    if value is None:
        return "–"
    if sd is None or not sd > 0:
        return number(value)
    places = 1 - floor(log10(sd))
    places = 0 if -3 <= places < 0 else places
    if 0 <= places <= 9:
        return f"{value:.{places}f} ± {sd:.{places}f}"
    return f"{number(value)} ± {number(sd, 2)}"
