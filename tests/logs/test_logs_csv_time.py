"""Time text to nanoseconds, against Python's own decimal and datetime."""

from __future__ import annotations

from datetime import datetime
from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldcal.logs.csv.time import NANOSECONDS_OF, looks_iso8601, nanoseconds, sample_numbers, sample_times

NUMBERS = st.builds(
    lambda sign, whole, fraction, point: sign + whole + (("." + fraction) if point else ""),
    st.sampled_from(["", "-", "+"]),
    st.integers(0, 10**9 - 1).map(str),
    st.text("0123456789", max_size=12),
    st.booleans(),
)


@given(st.lists(NUMBERS, min_size=1, max_size=20), st.sampled_from(list(NANOSECONDS_OF)))
def test_decimal_numbers_are_exact(cells: list[str], unit: str) -> None:
    expected = [
        int(Decimal(cell).scaleb(NANOSECONDS_OF[unit]).to_integral_value(rounding=ROUND_HALF_UP)) for cell in cells
    ]
    assert nanoseconds(pl.Series(cells), unit).to_list() == expected


@given(st.decimals(-(10**6), 10**6, allow_nan=False, allow_infinity=False, places=15))
def test_exponents_are_exact(value: Decimal) -> None:
    expected = int(value.scaleb(9).to_integral_value(rounding=ROUND_HALF_UP))
    assert nanoseconds(pl.Series([f"{value:e}"]), "s").to_list() == [expected]


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("1700000000.123456789", "s", 1_700_000_000_123_456_789),
        ("1700000000123.456789", "ms", 1_700_000_000_123_456_789),
        (" 1700000000123456789 ", "ns", 1_700_000_000_123_456_789),
        (".5", "s", 500_000_000),
        ("5.", "s", 5_000_000_000),
        ("9223372035", "s", 9_223_372_035_000_000_000),
        ("9223372037", "s", None),
        ("99999999999999999999", "ns", None),
        ("1e30", "s", None),
        ("9223372036854775807e0", "ns", 2**63 - 1),
        ("9223372036854775808e0", "ns", None),
        ("-9.223372036854775807e9", "s", -(2**63) + 1),
        (".", "s", None),
        ("", "s", None),
        ("1,5", "s", None),
        ("12:00", "s", None),
        ("nan", "s", None),
        ("-", "s", None),
    ],
)
def test_single_cells(text: str, unit: str, expected: int | None) -> None:
    assert nanoseconds(pl.Series([text]), unit).to_list() == [expected]


@given(st.datetimes(datetime(1970, 1, 2), datetime(2200, 1, 1)), st.integers(0, 999), st.sampled_from("T "))
def test_iso8601(moment: datetime, below: int, between: str) -> None:
    text = f"{moment:%Y-%m-%d}{between}{moment:%H:%M:%S}.{moment.microsecond:06d}{below:03d}"
    micro = (moment - datetime(1970, 1, 1)).days * 86400 + moment.hour * 3600 + moment.minute * 60 + moment.second
    expected = (micro * 1_000_000 + moment.microsecond) * 1000 + below
    cells = [text, text + "Z", text + "+00:00"]
    assert all(looks_iso8601(cell) for cell in cells)
    assert nanoseconds(pl.Series(cells), "iso8601").to_list() == [expected] * 3
    assert nanoseconds(pl.Series([text + "+01:30"]), "iso8601").to_list() == [expected - 5400 * 10**9]
    assert nanoseconds(pl.Series([text + "-0130"]), "iso8601").to_list() == [expected + 5400 * 10**9]


def test_what_is_no_date_is_null() -> None:
    cells = ["2024-13-01T00:00:00", "2024-01-01", "yesterday", ""]
    assert nanoseconds(pl.Series(cells), "iso8601").to_list() == [None] * 4


def test_sample_numbers() -> None:
    numbers = sample_numbers(pl.Series(["0", "1028", "3.0", "2.5", "x"]))
    assert numbers.to_list() == [0, 1028, 3, None, None]
    np.testing.assert_array_equal(sample_times(np.array([0, 512, 1024 * 10**6]), 102.4), [0, 5 * 10**9, 10**16])
