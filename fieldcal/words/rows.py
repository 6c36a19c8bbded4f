"""Rows of a table as objects."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, TypeVar, cast

if TYPE_CHECKING:
    import polars as pl

NESTED = ("measured", "versions", "findings")

Row = TypeVar("Row")
"""A typed dictionary of `schemas.rows`, or one like it."""


def typed(rows: Iterable[Mapping[str, object]], kind: type[Row]) -> list[Row]:
    """The same rows to the type check, as those of a table (`schemas.rows`): polars gives what its schema says."""
    return cast(list[Row], list(rows))


def rows_of(frame: pl.DataFrame) -> list[dict[str, object]]:
    """Rows as objects; what is not a finite number is null."""
    return [{name: _finite(value) for name, value in row.items()} for row in frame.iter_rows(named=True)]


def unfolded(row: Mapping[str, object]) -> dict[str, object]:
    """A row whose JSON texts (`measured`, `versions`, `findings`) are objects."""
    return {k: json.loads(v) if k in NESTED and isinstance(v, str) else v for k, v in row.items()}


def _finite(value: object) -> object:
    return None if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))) else value
