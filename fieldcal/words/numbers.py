"""A number, and a number with its standard deviation, to the digits that it earns."""

from __future__ import annotations

from datetime import datetime
from math import floor, log10

SMALL, LARGE = 1e-3, 1e7
"""Below the one, and from the other on, a power of ten is told beside the number."""


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
    """A value and its standard deviation, to the two digits of the latter that say something.

    Examples
    --------
    >>> with_sd(38480.3, 108.0), with_sd(0.70735, 0.0231), with_sd(1.43238e-4, 7.3e-8)
    ('38480 ± 110', '0.707 ± 0.023', '(1.43238 ± 0.00073)e-4')
    """
    if value is None:
        return "–"
    if sd is None or not 0 < sd < float("inf"):
        return number(value)
    largest = max(abs(value), sd)
    power = floor(log10(largest)) if largest < SMALL or largest >= LARGE else 0
    value, sd = value / 10.0**power, sd / 10.0**power
    places = 1 - floor(log10(sd))
    rounded = round(value, places) + 0.0  # no minus before nothing
    text = f"{rounded:.{max(places, 0)}f} ± {round(sd, places):.{max(places, 0)}f}"
    return f"({text})e{power}" if power else text
