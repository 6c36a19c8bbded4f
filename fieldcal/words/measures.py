"""How a value is written for people, said once: its unit, and as many digits as its standard deviation earns.

Tables of the history keep SI; people think of a gyroscope in °/s, of an accelerometer in mg, of a magnetometer in µT,
of what a scale does in ppm."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import polars as pl

from fieldcal.config.flight_settings import STANDARD_GRAVITY_MPS2
from fieldcal.words.numbers import with_sd

_MILLI, _MICRO = 1e3, 1e6
_DEGREES = 180.0 / np.pi
ABOVE = {
    "rad/s": (_DEGREES, "°/s"),
    "deg/s": (1.0, "°/s"),
    "rad": (_DEGREES, "°"),
    "deg": (1.0, "°"),
    "m/s^2": (_MILLI / STANDARD_GRAVITY_MPS2, "mg"),
    "T": (_MICRO, "µT"),
    "G": (100.0, "µT"),
    "uT": (1.0, "µT"),
    "s": (_MILLI, "ms"),
    "m": (_MILLI, "mm"),
    "1": (1.0, ""),
}
"""Unit of the tables → factor and unit that people write."""
BELOW = {"m/s^2": (STANDARD_GRAVITY_MPS2, "g"), "counts": (1.0, "count"), "degC": (1.0, "°C")}
"""The same below a stroke."""
_ATOM = re.compile(r"rad/s|deg/s|m/s\^2|[^/]+")
PER_CENT_FROM = 1e4
"""So many ppm are told in per cent."""


def written(unit: str | None) -> tuple[float, str]:
    """(factor, unit): what a number in a unit of the tables is multiplied by, and the unit that it is then written in.

    Examples
    --------
    >>> written("m/s^2")[1], written("(rad/s/counts)/degC")[1], written("norm")
    ('mg', '°/s/count/°C', (1.0, 'norm'))
    """
    first, *below = _ATOM.findall(
        (unit or "1").replace("²", "^2").replace(" per ", "/").replace("(", "").replace(")", "")
    )
    factor, name = ABOVE.get(first, (1.0, first))
    if (first, below[:1]) == ("norm", ["counts"]):
        factor, name = _MICRO, "ppm"  # of the field
    for one in below:
        own, own_name = BELOW.get(one, (1.0, one))
        factor, name = factor * own, f"{name}/{own_name}" if name else f"1/{own_name}"
    return factor, name


def rows_written(rows: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    """Rows whose `columns` are in their column `unit`, in the units that people write.

    Examples
    --------
    >>> rows_written(pl.DataFrame({"value": [0.5, None], "unit": ["rad/s", "m/s^2"]}), ["value"]).rows()
    [(28.64788975654116, '°/s'), (None, 'mg')]
    """
    if rows.is_empty():
        return rows
    known = {one: written(one) for one in rows["unit"].unique()}
    factor = pl.col("unit").replace_strict({one: own[0] for one, own in known.items()}, return_dtype=pl.Float64)
    name = pl.col("unit").replace_strict({one: own[1] for one, own in known.items()}, return_dtype=pl.String)
    return rows.with_columns(*(pl.col(column) * factor for column in columns), unit=name)


def measure(value: float | None, sd: float | None, unit: str | None) -> str:
    """A value ± its standard deviation as people write it.

    Examples
    --------
    >>> measure(0.0123456, 0.00041, "rad/s"), measure(1.00234, 4e-4, "1"), measure(-0.0492, 0.012, "m/s^2")
    ('0.707 ± 0.023 °/s', '1.00234 ± 0.00040', '-5.0 ± 1.2 mg')
    >>> measure(1.6027e-4, 1.4e-7, "norm/counts"), measure(None, None, "rad/s")
    ('160.27 ± 0.14 ppm/count', '–')
    """
    factor, name = written(unit)
    if value is None:
        return "–"
    return with_unit(with_sd(value * factor, None if sd is None else sd * factor), name)


def share(value: float | None, sd: float | None, of: float | None) -> str:
    """A change of a scale as a share of it, in ppm or per cent.

    Examples
    --------
    >>> share(2.1e-8, 0.5e-8, 1.6e-4), share(0.02, 0.004, 1.0)
    ('131 ± 31 ppm', '2.00 ± 0.40 %')
    """
    if value is None or not of:
        return "–"
    ppm = _MICRO / abs(of)
    large = max(abs(value), sd or 0.0) * ppm >= PER_CENT_FROM
    factor, name = (ppm / PER_CENT_FROM, "%") if large else (ppm, "ppm")
    return f"{with_sd(value * factor, None if sd is None else sd * factor)} {name}"


def change(value: float | None, sd: float | None, unit: str | None, *, parameter: str, of: float | None) -> str:
    """What a parameter changes by: a scale by a share of it, everything else in its unit."""
    return share(value, sd, of) if parameter == "scale" else measure(value, sd, unit)


def with_unit(text: str, name: str) -> str:
    """A number's text and its unit."""
    return text if text == "–" or not name else f"{text}{name}" if name == "°" else f"{text} {name}"
