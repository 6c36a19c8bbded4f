"""Rows as plain JSON, for tables too small to be worth a file, and the digest of any table's rows in their order."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import polars as pl

from fieldcal.names import Json
from fieldcal.schemas.frames import empty_frame


def as_json(rows: pl.DataFrame) -> dict[str, Sequence[Json]]:
    """Column → values. Floats come back to the bit; what is not finite is a text, which JSON has no number for."""
    return {column.name: [_plain(value) for value in column.to_list()] for column in rows}


def from_json(columns: Mapping[str, Sequence[Json]], table: str) -> pl.DataFrame:
    """Rows of a stage's table from `as_json`."""
    schema = empty_frame(table, stage=True).schema
    return pl.DataFrame({name: _values(columns[name], kind) for name, kind in schema.items()}, schema=schema)


def digest(rows: pl.DataFrame) -> str:
    """sha256 of names, nulls and values, row by row: equal for equal rows in equal order, in every process."""
    found = hashlib.sha256()
    for column in rows:
        found.update(f"{column.name}\0{column.dtype}\0{len(column)}\0".encode())
        for part in column_bytes(column):
            found.update(part)
    return found.hexdigest()


def column_bytes(column: pl.Series) -> Iterator[bytes | memoryview]:
    """Nulls and values of a column as bytes, the same on every machine."""
    whole = column.null_count() == 0
    yield np.zeros(len(column), dtype=bool).data if whole else column.is_null().to_numpy().tobytes()
    if column.dtype == pl.List:
        yield np.ascontiguousarray(column.list.len().fill_null(0).to_numpy(), dtype="<i8").data
        yield from column_bytes(column.drop_nulls().explode())
        return
    if column.dtype == pl.String:
        texts = [text.encode() for text in (column if whole else column.fill_null(""))]
        yield np.array([len(text) for text in texts], dtype="<i8").tobytes()
        yield b"".join(texts)
        return
    kind, number = ("<f8", column) if column.dtype == pl.Float64 else ("<i8", column.cast(pl.Int64))
    yield np.ascontiguousarray((number if whole else number.fill_null(0)).to_numpy(), dtype=kind).data


def _plain(value: Json) -> Json:
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value


def _values(values: Sequence[Json], kind: pl.DataType) -> Sequence[Json]:
    return [float(value) if isinstance(value, str) else value for value in values] if kind.is_float() else values
