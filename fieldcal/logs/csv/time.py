"""Time as text to integer nanoseconds, without a floating-point number in between."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation

import numpy as np
import polars as pl
from numpy.typing import NDArray

NANOSECONDS_OF = {"s": 9, "ms": 6, "100us": 5, "us": 3, "ns": 0}
"""Time unit -> decimal digits down to the nanosecond. "100us" are ticks of 10 kHz, which presets alone name."""

_DECIMAL = r"^([+-]?)(\d*)(?:\.(\d*))?$"
_ISO = r"^(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d+))?\s*(Z|z|[+-]\d\d:?\d\d)?$"
_TIME_OF_DAY = r"^(\d{1,2}):([0-5]\d):([0-5]\d)(?:[.,](\d+))?$"
_CLOCK_PARTS = ((1, "hours"), (2, "minutes"), (3, "seconds"))
_LARGEST = 2**63 - 1
_LONGEST_TIME = 100
"""Characters of a time with an exponent: the exact value takes the square of their number."""


def looks_iso8601(text: str) -> bool:
    """Whether a cell is a date and time of day."""
    return bool(pl.select(pl.lit(text.strip()).str.contains(_ISO)).item())


def looks_time_of_day(text: str) -> bool:
    """Whether a cell is a time of day, HH:MM:SS with or without a fraction."""
    return bool(pl.select(pl.lit(text.strip()).str.contains(_TIME_OF_DAY)).item())


def nanoseconds(cells: pl.Series, unit: str) -> pl.Series:
    """Int64 nanoseconds of time cells in `unit` ("s", "ms", "us", "ns", "iso8601", "time_of_day": HH:MM:SS.fff since
    midnight); null where a cell is no time.

    Digits below the nanosecond are rounded half up in size. ISO 8601 without an offset is taken for UTC.
    """
    stripped = cells.str.strip_chars()
    if unit == "time_of_day":
        return _from_time_of_day(stripped)
    return _from_iso(stripped) if unit == "iso8601" else _from_decimal(stripped, NANOSECONDS_OF[unit])


def sample_times(samples: NDArray[np.int64], rate_hz: float) -> NDArray[np.int64]:
    """Nanoseconds of sample numbers at a rate."""
    times: NDArray[np.int64] = np.rint(samples * (1e9 / rate_hz)).astype(np.int64)
    return times


def sample_numbers(cells: pl.Series) -> pl.Series:
    """Int64 sample numbers; null where a cell is none."""
    numbers = cells.str.strip_chars().cast(pl.Float64, strict=False)
    whole = numbers.is_finite() & (numbers == numbers.round(0)) & (numbers.abs() < 2**53)
    return numbers.set(~whole.fill_null(False), None).cast(pl.Int64)


def _from_decimal(cells: pl.Series, digits: int) -> pl.Series:
    parts = cells.to_frame("cell").select(
        pl.col("cell").str.extract(_DECIMAL, 1).alias("sign"),
        pl.col("cell").str.extract(_DECIMAL, 2).alias("whole"),
        pl.col("cell").str.extract(_DECIMAL, 3).fill_null("").alias("fraction"),
        pl.col("cell"),
    )
    limit = _LARGEST // 10**digits - 1
    fraction = pl.col("fraction").str.pad_end(digits + 1, "0")
    whole = pl.when(pl.col("whole") == "").then(pl.lit("0")).otherwise(pl.col("whole")).cast(pl.Int64, strict=False)
    below = fraction.str.slice(0, digits).cast(pl.Int64, strict=False) if digits else pl.lit(0, pl.Int64)
    size = whole * 10**digits + below + (fraction.str.slice(digits, 1) >= "5").cast(pl.Int64)
    usable = (whole <= limit) & ((pl.col("whole") != "") | (pl.col("fraction") != ""))
    signed = pl.when(pl.col("sign") == "-").then(-size).otherwise(size)
    result = parts.select(pl.when(usable).then(signed).otherwise(None).alias("t_ns"))["t_ns"]
    exponents = parts.select(
        (pl.col("cell").str.len_bytes() <= _LONGEST_TIME)
        .and_(pl.col("cell").str.contains(r"^[+-]?(\d+\.?\d*|\.\d+)[eE][+-]?\d{1,3}$"))
        .fill_null(False)
    ).to_series()
    places = exponents.arg_true()
    if len(places):
        values = [_exact(text, digits) for text in cells.gather(places).to_list()]
        result = result.scatter(places, pl.Series(values, dtype=pl.Int64))
    return result


def _exact(text: str, digits: int) -> int | None:
    try:
        value = int((Decimal(text).scaleb(digits)).to_integral_value(rounding="ROUND_HALF_UP"))
    except (InvalidOperation, OverflowError):
        return None
    return value if abs(value) <= _LARGEST else None


def _from_iso(cells: pl.Series) -> pl.Series:
    parts = cells.to_frame("cell").select(
        (pl.col("cell").str.extract(_ISO, 1) + "T" + pl.col("cell").str.extract(_ISO, 2))
        .str.to_datetime("%Y-%m-%dT%H:%M:%S", time_unit="us", strict=False)
        .dt.epoch("s")
        .alias("seconds"),
        pl.col("cell").str.extract(_ISO, 3).fill_null("").str.pad_end(10, "0").alias("fraction"),
        pl.col("cell").str.extract(_ISO, 4).fill_null("Z").str.replace(":", "").alias("zone"),
    )
    zone_hours = pl.col("zone").str.slice(1, 2).cast(pl.Int64, strict=False).fill_null(0)
    zone_minutes = pl.col("zone").str.slice(3, 2).cast(pl.Int64, strict=False).fill_null(0)
    east_s = (zone_hours * 3600 + zone_minutes * 60) * pl.when(pl.col("zone").str.starts_with("-")).then(-1).otherwise(
        1
    )
    below = pl.col("fraction").str.slice(0, 9).cast(pl.Int64) + (pl.col("fraction").str.slice(9, 1) >= "5").cast(
        pl.Int64
    )
    seconds = pl.col("seconds") - east_s
    usable = seconds.abs() < _LARGEST // 10**9
    return parts.select(pl.when(usable).then(seconds * 10**9 + below).otherwise(None).alias("t_ns"))["t_ns"]


def _from_time_of_day(cells: pl.Series) -> pl.Series:
    parts = cells.to_frame("cell").select(
        *(pl.col("cell").str.extract(_TIME_OF_DAY, n).cast(pl.Int64).alias(name) for n, name in _CLOCK_PARTS),
        pl.col("cell").str.extract(_TIME_OF_DAY, 4).fill_null("").str.pad_end(10, "0").alias("fraction"),
    )
    seconds = pl.col("hours") * 3600 + pl.col("minutes") * 60 + pl.col("seconds")
    below = pl.col("fraction").str.slice(0, 9).cast(pl.Int64) + (pl.col("fraction").str.slice(9, 1) >= "5").cast(
        pl.Int64
    )
    return parts.select(pl.when(pl.col("hours") < 24).then(seconds * 10**9 + below).alias("t_ns"))["t_ns"]
