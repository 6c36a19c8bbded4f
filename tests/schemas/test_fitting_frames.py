"""Rows that fit are exactly those that `conform` gives back as they are."""

from __future__ import annotations

import polars as pl
import pytest

from fieldcal.schemas import STAGE_TABLES, fits
from fieldcal.schemas.frames import empty_frame, frame
from fieldcal.warehouse.store import conform

NOTES = pl.DataFrame(
    {"row": [0, 1], "column": [0, 1], "value": [1.0, None]},
    schema={"row": pl.Int32, "column": pl.Int32, "value": pl.Float64},
)


@pytest.mark.parametrize("table", sorted(STAGE_TABLES))
def test_what_is_read_back_fits(table: str) -> None:
    assert fits(empty_frame(table, stage=True), table, stage=True)


def test_rows_that_fit_are_given_back_as_they_are() -> None:
    assert fits(NOTES, "covariance", stage=True)
    assert frame(conform(NOTES, "covariance", stage=True)).equals(NOTES)


@pytest.mark.parametrize(
    "other",
    [
        NOTES.drop("value"),
        NOTES.with_columns(more=1),
        NOTES.select("column", "row", "value"),
        NOTES.cast({"row": pl.Int64}),
        NOTES.with_columns(row=pl.lit(None, pl.Int32)),
    ],
    ids=["lacks a column", "has one more", "in another order", "another width", "nothing in its key"],
)
def test_rows_that_differ_do_not_fit(other: pl.DataFrame) -> None:
    assert not fits(other, "covariance", stage=True)
