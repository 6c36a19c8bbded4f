"""Rows of a table as objects."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import polars as pl

NESTED = ("measured", "versions", "findings")

Row = Mapping[str, Any]
"""A row of a table, column → value: what polars gives is of the column's type."""


def rows_of(frame: pl.DataFrame) -> list[Row]:
    """Rows as objects; what is not a finite number is null."""
    return [{name: _finite(value) for name, value in row.items()} for row in frame.iter_rows(named=True)]


def unfolded(row: Row) -> dict[str, Any]:
    """A row whose JSON texts (`measured`, `versions`, `findings`) are objects."""
    return {k: json.loads(v) if k in NESTED and isinstance(v, str) else v for k, v in row.items()}


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))) else value
