"""The typed dictionaries of the history's rows say what its tables are."""

from __future__ import annotations

from datetime import datetime
from types import NoneType, UnionType
from typing import Any, get_args, get_type_hints

import pyarrow as pa
import pytest

from fieldcal.schemas import HISTORY_TABLES, rows, table_columns, table_key

TYPES = {
    pa.string(): str,
    pa.float64(): float,
    pa.int64(): int,
    pa.bool_(): bool,
    pa.list_(pa.float64()): list[float],
    pa.list_(pa.string()): list[str],
    pa.timestamp("us", tz="UTC"): datetime,
}


def alternatives(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if isinstance(hint, UnionType) else (hint,)


def test_every_table_of_the_history_has_its_row() -> None:
    assert tuple(rows.ROWS) == HISTORY_TABLES


@pytest.mark.parametrize("table", rows.ROWS)
def test_a_row_has_the_columns_and_types_of_its_table(table: str) -> None:
    hints = get_type_hints(rows.ROWS[table])
    found = {name: next(t for t in alternatives(hint) if t is not NoneType) for name, hint in hints.items()}
    assert found == {column.name: TYPES[column.type] for column in table_columns(table)}
    assert rows.ROWS[table].__optional_keys__ == frozenset()


@pytest.mark.parametrize("table", rows.ROWS)
def test_none_stands_where_a_column_may_be_null_and_nowhere_in_a_key(table: str) -> None:
    hints: dict[str, Any] = get_type_hints(rows.ROWS[table])
    optional = {name for name, hint in hints.items() if NoneType in get_args(hint)}
    assert {column.name for column in table_columns(table) if "null" in column.meaning} <= optional
    assert not optional & set(table_key(table))
    assert rows.may_be_null(table) == optional


@pytest.mark.parametrize(
    ("unfolded", "folded", "nested"),
    [
        (rows.UnfoldedFlight, rows.FlightRow, {"findings"}),
        (rows.UnfoldedRun, rows.RunRow, {"measured", "versions"}),
    ],
)
def test_an_unfolded_row_differs_in_its_json_alone(unfolded: type, folded: type, nested: set[str]) -> None:
    first, second = unfolded.__annotations__, folded.__annotations__
    assert set(first) == set(second)
    assert {name for name in first if first[name] != second[name]} == nested
