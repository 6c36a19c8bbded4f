"""The tables on disk, read by engines that know nothing of fieldcal: every table, rows and ids as written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import duckdb
import pandas as pd
import polars as pl
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from history_rows import START, lead, rows

from fieldcal import schemas
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import append, publish

IDS = ("sim-1", "7", "007", "Möwe/2", "1e3", "2026-01-01")
"""Some of which an engine takes for numbers or dates where they stand in a folder's name."""
READERS: dict[str, Callable[[Path], list[str]]] = {
    "pandas": lambda folder: pd.read_parquet(folder)["vehicle_id"].tolist(),
    "pandas, of a file": lambda folder: [
        str(value) for path in folder.rglob("*.parquet") for value in pd.read_parquet(path)["vehicle_id"]
    ],
    "pyarrow": lambda folder: pq.read_table(folder)["vehicle_id"].to_pylist(),
    "pyarrow dataset": lambda folder: ds.dataset(folder, partitioning="hive").to_table()["vehicle_id"].to_pylist(),
    "polars": lambda folder: pl.read_parquet(folder / "**/*.parquet")["vehicle_id"].to_list(),
    "polars, hive": lambda folder: pl.scan_parquet(folder, hive_partitioning=True).collect()["vehicle_id"].to_list(),
    "duckdb": lambda folder: _by_duckdb(f"read_parquet('{folder}/**/*.parquet')"),
    "duckdb, hive": lambda folder: _by_duckdb(f"read_parquet('{folder}/**/*.parquet', hive_partitioning = true)"),
}


def _by_duckdb(source: str) -> list[str]:
    found: list[tuple[Any, ...]] = duckdb.sql(f"SELECT vehicle_id FROM {source}").fetchall()
    return [row[0] for row in found]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("elsewhere")
    for vehicle_id in IDS:
        first = lead(vehicle_id, f"flight of {vehicle_id}", 1)
        tables = {table: rows(table, keyed(table, first)) for table in HISTORY_TABLES}
        publish(folder, vehicle_id, tables, [first["flight_id"]])
        for table in ("decision", "export"):
            append(folder, vehicle_id, table, tables[table])
    return folder


def keyed(table: str, first: dict[str, Any]) -> dict[str, Any]:
    """A row that has something in every column of a key."""
    texts = {c.name: "x" for c in schemas.table_columns(table) if c.type == pa.string()}
    stamps = {c.name: START for c in schemas.table_columns(table) if pa.types.is_timestamp(c.type)}
    numbers = {c.name: 0 for c in schemas.table_columns(table) if pa.types.is_integer(c.type)}
    return {**texts, **stamps, **numbers, **first}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("table", HISTORY_TABLES)
def test_every_table_is_read_as_it_stands(table: str, reader: str, root: Path) -> None:
    written = Warehouse(root).scan(table).collect()
    found = READERS[reader](root / "tables" / table)
    assert sorted(found) == sorted(written["vehicle_id"].to_list())
    assert set(found) == set(IDS)
