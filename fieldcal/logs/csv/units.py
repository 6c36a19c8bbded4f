"""Units as CSV files write them: in a units row, in brackets in the header, as a suffix of a column's name."""

from __future__ import annotations

import re

_COUNTS = {"lsb": "counts", "counts": "counts", "count": "counts", "raw": "counts", "adc": "counts"}
SENSOR_TOKENS: dict[str, dict[str, str]] = {
    "gyroscope": _COUNTS
    | dict.fromkeys(("rad/s", "rads", "radps", "rad_s", "rad_per_s", "rad/sec"), "rad/s")
    | dict.fromkeys(("deg/s", "degs", "dps", "degps", "deg_s", "deg_per_s", "deg/sec"), "deg/s"),
    "accelerometer": _COUNTS
    | dict.fromkeys(("m/s^2", "m/s2", "m/s**2", "m/s/s", "mps2", "ms2", "m_s2", "m_per_s2", "mpss"), "m/s^2")
    | dict.fromkeys(("g", "gs", "g0"), "g"),
    "magnetometer": _COUNTS
    | dict.fromkeys(("t", "tesla", "teslas"), "T")
    | dict.fromkeys(("ut", "microtesla", "microteslas"), "uT")
    | dict.fromkeys(("g", "gauss"), "G")
    | dict.fromkeys(("1", "norm", "au", "a.u."), "norm"),
}
"""Sensor -> lower-case token -> unit."""

TIME_TOKENS = (
    dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s")
    | dict.fromkeys(("ms", "millisecond", "milliseconds", "msec"), "ms")
    | dict.fromkeys(("us", "microsecond", "microseconds", "usec"), "us")
    | dict.fromkeys(("ns", "nanosecond", "nanoseconds", "nsec"), "ns")
    | {"iso8601": "iso8601"}
)
_OTHER_TOKENS = {
    "",
    "-",
    "1",
    "m",
    "mm",
    "cm",
    "c",
    "degc",
    "celsius",
    "k",
    "v",
    "mv",
    "a",
    "ma",
    "pa",
    "hpa",
    "hz",
    "%",
}
_OTHER_TOKENS |= {"deg", "rad", "m/s", "mg", "mt", "nt", "mgauss", "mdps", "mrad/s", "none", "unitless", "quat", "n/a"}
_BRACKETS = re.compile(r"[(\[{]([^()\[\]{}]*)[)\]}]\s*$")


def token(text: str) -> str:
    """A unit in one spelling: lower case, no brackets, ASCII."""
    plain = text.strip().strip("()[]{}").strip().lower()
    for old, new in (("µ", "u"), ("μ", "u"), ("°", "deg"), ("²", "^2"), ("⁻¹", "^-1"), (" ", "")):
        plain = plain.replace(old, new)
    return plain


def is_units_row(cells: list[str]) -> bool:
    """Whether a row under the header consists of units."""
    known = _OTHER_TOKENS | TIME_TOKENS.keys() | {name for tokens in SENSOR_TOKENS.values() for name in tokens}
    tokens = [token(cell) for cell in cells]
    return all(name in known for name in tokens) and any(name not in ("", "-", "1") for name in tokens)


def sensor_unit(sensor: str, column: str, row_cell: str | None) -> str | None:
    """Unit of a sensor's column, from the units row, else from its name; None when neither says.

    A unit that is understood but not one that fieldcal calibrates in (milli-g, ...) is given as it is written.
    """
    known = SENSOR_TOKENS[sensor]
    for text in (row_cell, _bracketed(column)):
        if text is not None and token(text) not in ("", "-"):
            return known.get(token(text), text.strip())
    return _by_suffix(column, known)


def time_unit(column: str, row_cell: str | None) -> str | None:
    """Unit of a time column, from the units row, else from its name; None when neither says."""
    for text in (row_cell, _bracketed(column)):
        if text is not None and token(text) in TIME_TOKENS:
            return TIME_TOKENS[token(text)]
    return _by_suffix(column, TIME_TOKENS)


def _bracketed(column: str) -> str | None:
    match = _BRACKETS.search(column)
    return match[1] if match else None


def _by_suffix(column: str, known: dict[str, str]) -> str | None:
    lowered = column.strip().lower()
    for name, unit in known.items():
        if len(name) < len(lowered) - 1 and lowered.endswith("_" + name):
            return unit
    return None
