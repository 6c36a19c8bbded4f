"""Units as CSV files write them: in a units row, in brackets in the header, as a suffix of a column's name."""

from __future__ import annotations

import re

_COUNTS = {"lsb": "counts", "counts": "counts", "count": "counts", "raw": "counts", "adc": "counts"}
SENSOR_TOKENS: dict[str, dict[str, str]] = {
    "gyroscope": _COUNTS
    | dict.fromkeys(("rad/s", "rads", "radps", "rad_s", "rad_per_s", "rad/sec", "rads^-1", "rads-1"), "rad/s")
    | dict.fromkeys(("deg/s", "degs", "dps", "degps", "deg_s", "deg_per_s", "deg/sec", "degs^-1", "degs-1"), "deg/s"),
    "accelerometer": _COUNTS
    | dict.fromkeys(
        ("m/s^2", "m/s2", "m/s**2", "m/s/s", "mps2", "ms2", "m_s2", "m_per_s2", "mpss", "ms^-2", "ms-2"), "m/s^2"
    )
    | dict.fromkeys(("g", "gs", "g0"), "g"),
    "magnetometer": _COUNTS
    | dict.fromkeys(("t", "tesla", "teslas"), "T")
    | dict.fromkeys(("ut", "microtesla", "microteslas"), "uT")
    | dict.fromkeys(("g", "ga", "gauss"), "G")
    | dict.fromkeys(("1", "norm", "au", "a.u."), "norm"),
}
"""Sensor -> lower-case token -> unit."""

PREFIXED_TOKENS: dict[str, dict[str, tuple[str, float]]] = {
    "gyroscope": dict.fromkeys(("mrad/s", "mradps", "mrads^-1"), ("rad/s", 1e-3))
    | dict.fromkeys(("mdps", "mdeg/s", "mdegs^-1"), ("deg/s", 1e-3)),
    "accelerometer": dict.fromkeys(("mg", "milli-g", "millig"), ("g", 1e-3))
    | dict.fromkeys(("mm/s^2", "mm/s2", "mms^-2"), ("m/s^2", 1e-3)),
    "magnetometer": dict.fromkeys(("mt", "millitesla"), ("T", 1e-3))
    | dict.fromkeys(("nt", "nanotesla"), ("uT", 1e-3))
    | dict.fromkeys(("mgauss", "mga", "milligauss"), ("G", 1e-3)),
}
"""Sensor -> lower-case token of a unit that readings are converted from -> unit, and factor to it."""

TEMPERATURE_TOKENS = (
    dict.fromkeys(("c", "degc", "celsius"), "degC")
    | dict.fromkeys(("k", "kelvin"), "K")
    | dict.fromkeys(("f", "degf", "fahrenheit"), "degF")
)
TO_DEGC = {"degC": (1.0, 0.0), "K": (1.0, -273.15), "degF": (5.0 / 9.0, -160.0 / 9.0)}
"""Unit of temperature -> factor and offset to degrees Celsius."""
ANGLE_TOKENS = dict.fromkeys(("deg", "degs", "degree", "degrees"), "deg") | dict.fromkeys(("rad", "radian"), "rad")

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
_OTHER_TOKENS |= TEMPERATURE_TOKENS.keys() | {name for tokens in PREFIXED_TOKENS.values() for name in tokens}
_SPELLINGS = (
    *(("µ", "u"), ("μ", "u"), ("°", "deg"), ("⁻¹", "^-1"), ("⁻²", "^-2"), ("²", "^2")),
    *(("·", ""), ("⋅", ""), (" ", "")),
)
_INDEX = re.compile(r"\s*[(\[{](\d+|[xyz])[)\]}]$")
_BRACKETS = re.compile(r"[(\[{]([^()\[\]{}]*)[)\]}]\s*$")


def token(text: str) -> str:
    """A unit in one spelling: lower case, no brackets, ASCII."""
    plain = text.strip().strip("()[]{}").strip().lower()
    for old, new in _SPELLINGS:
        plain = plain.replace(old, new)
    return plain


def is_units_row(cells: list[str]) -> bool:
    """Whether a row under the header consists of units."""
    known = _OTHER_TOKENS | TIME_TOKENS.keys() | {name for tokens in SENSOR_TOKENS.values() for name in tokens}
    tokens = [token(cell) for cell in cells]
    return all(name in known for name in tokens) and any(name not in ("", "-", "1") for name in tokens)


def sensor_unit(sensor: str, column: str, row_cell: str | None) -> str | None:
    """Unit of a sensor's column, from the units row, else from its name; None when neither says.

    A unit that is understood but not one that fieldcal calibrates in (milli-g, ...) is given as it is written. What is
    no unit says nothing: the 0 of `gyro[0]` is an index, the x of `gyro(x)` an axis.
    """
    known = SENSOR_TOKENS[sensor]
    if row_cell is not None and token(row_cell) not in ("", "-"):
        return known.get(token(row_cell), row_cell.strip())
    bracketed = _bracketed(column)
    if bracketed is not None and _is_unit(token(bracketed)):
        return known.get(token(bracketed), bracketed.strip())
    return _by_suffix(column, known | {name: name for name in PREFIXED_TOKENS[sensor]})


def without_unit(column: str) -> str:
    """A column's name without a unit in brackets behind it: `gx [rad/s]` is gx, `gyro[0]` stays."""
    bracketed = _bracketed(column)
    return column if bracketed is None or not _is_unit(token(bracketed)) else _BRACKETS.sub("", column).rstrip()


def prefixed_unit(sensor: str, unit: str) -> tuple[str, float] | None:
    """Unit that readings in a unit with a prefix ("mg") are converted to, and the factor; None: it is none of these."""
    return PREFIXED_TOKENS[sensor].get(token(unit))


def time_unit(column: str, row_cell: str | None) -> str | None:
    """Unit of a time column, from the units row, else from its name; None when neither says."""
    return _unit_among(TIME_TOKENS, column, row_cell)


def temperature_unit(column: str, row_cell: str | None) -> str:
    """Unit of a temperature ("degC", "K", "degF"), from the units row, else from its name, else degrees Celsius."""
    return _unit_among(TEMPERATURE_TOKENS, column, row_cell) or "degC"


def angle_unit(column: str, row_cell: str | None) -> str | None:
    """Unit of an angle ("deg", "rad"), from the units row, else from its name; None when neither says."""
    return _unit_among(ANGLE_TOKENS, column, row_cell)


def _unit_among(known: dict[str, str], column: str, row_cell: str | None) -> str | None:
    for text in (row_cell, _bracketed(column)):
        if text is not None and token(text) in known:
            return known[token(text)]
    return _by_suffix(column, known)


def _is_unit(name: str) -> bool:
    """Whether a token is the unit of anything. Digits are an index."""
    sensors = any(name in tokens for tokens in SENSOR_TOKENS.values())
    return not name.isdigit() and name not in ("", "-") and (sensors or name in _OTHER_TOKENS or name in TIME_TOKENS)


def _bracketed(column: str) -> str | None:
    match = _BRACKETS.search(column)
    return match[1] if match else None


def _by_suffix(column: str, known: dict[str, str]) -> str | None:
    lowered = _INDEX.sub("", column.strip().lower())
    for name, unit in known.items():
        if len(name) < len(lowered) - 1 and lowered.endswith("_" + name):
            return unit
    return None
