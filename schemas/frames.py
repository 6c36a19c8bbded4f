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


@cache
def _schema(table: str, stage: bool) -> pl.Schema:
    # `Schema.empty_table` of Arrow would load pandas where it is installed.
    empty = pl.from_arrow(pa.Table.from_batches([], arrow_schema(table, stage=stage)))
    assert isinstance(empty, pl.DataFrame)
    return empty.schema
