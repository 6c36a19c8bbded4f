"""What a table is as a polars frame."""

from __future__ import annotations

from functools import cache

import polars as pl
import pyarrow as pa

from fieldcal.schemas.arrow import arrow_schema
from fieldcal.schemas.tables import table_key


def fits(rows: pl.DataFrame, table: str, *, stage: bool = False) -> bool:
    """Whether rows have exactly the columns and types of `table`, in its order, and nothing missing in its key: whether
    `conform` would give them back as they are."""
    if rows.schema != _schema(table, stage):
        return False
    return not any(rows.get_column(name).null_count() for name in table_key(table, stage=stage))


def frame(rows: pa.Table) -> pl.DataFrame:
    """An Arrow table as a polars frame; metadata, which polars has no place for, is left behind."""
    result = pl.from_arrow(pa.Table.from_arrays(rows.columns, names=rows.column_names))
    if not isinstance(result, pl.DataFrame):
        raise TypeError("a table is needed, not a column")
    return result


def empty_frame(table: str, *, stage: bool = False) -> pl.DataFrame:
    """A table without rows, its columns typed."""
    # `Schema.empty_table` would load pandas where it is installed: a third of a second at every start.
    return frame(pa.Table.from_batches([], arrow_schema(table, stage=stage)))


@cache
def _schema(table: str, stage: bool) -> pl.Schema:
    return empty_frame(table, stage=stage).schema
