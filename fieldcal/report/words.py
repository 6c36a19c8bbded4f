"""Numbers, times and ages as reports write them."""

from __future__ import annotations

from datetime import UTC, datetime

from fieldcal.names import exactness
from fieldcal.words.measures import with_unit, written
from fieldcal.words.numbers import number, with_sd

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PARAMETERS = ("scale", "zero_bias", "bias", "zero")


def logged_unit(text: str | None) -> str:
    """A unit of readings as they are logged."""
    return (text or "").replace("^2", "²")


def measured(value: float | None, of: str | None) -> str:
    """A number of a unit of the tables to three digits, as people write it."""
    factor, name = written(of)
    return with_unit("–" if value is None else number(value * factor, 3), name)


def scientific(value: float | None, sd: float | None = None) -> str:
    """A number with its standard deviation at one power of ten, as the paper's tables have it."""
    if value is None:
        return "–"
    if 1e-3 <= abs(value) < 1e6 or value == 0.0:
        return (with_sd(value, sd) if sd else number(value)).replace("-", "−")
    power = int(f"{value:e}".split("e")[1])
    scaled = with_sd(value / 10.0**power, None if sd is None else sd / 10.0**power)
    tail = f" · 10{str(power).translate(SUPERSCRIPTS)}"
    return (f"({scaled}){tail}" if "±" in scaled else f"{scaled}{tail}").replace("-", "−")


def day(moment: datetime | None) -> str:
    """A date and time of day, UTC (SQL answers come in the session's time zone)."""
    return "undated" if moment is None else moment.astimezone(UTC).strftime("%Y-%m-%d %H:%M")


def age(moment: datetime | None, as_of: datetime | None) -> str:
    """How long before `as_of` a moment was."""
    if moment is None or as_of is None:
        return "unknown"
    days = (as_of - moment).total_seconds() / 86400.0
    if days < 0:
        return f"{-days:.0f} d after"
    return f"{days * 24:.0f} h" if days < 1 else f"{days:.0f} d"


def preferred(methods: set[str]) -> str:
    """The most exact of several estimators."""
    return min(methods, key=lambda method: (exactness(method), method))


def count(n: int, what: str) -> str:
    """A number of things."""
    return f"{n} {what}{'' if n == 1 else 's'}"


NAMES = {"vps": "VPS", "fit": "agreement", "quest": "QUEST", "svd": "SVD", "triad": "TRIAD"}


def plain_name(name: str) -> str:
    """A name of the tables (method, quantity, reference) as people write it."""
    return NAMES.get(name, name.replace("_", " "))
