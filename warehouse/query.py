"""Ask the warehouse: lazily in polars, or in SQL that can only read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import polars as pl

from fieldcal.remote.url import is_url
from fieldcal.schemas import HISTORY_TABLES, SIGNAL_TABLES, TABLES, signal_kind
from fieldcal.schemas.frames import empty_frame
from fieldcal.schemas.migrations import fillings
from fieldcal.warehouse.checksums import assure
from fieldcal.warehouse.layout import encode_id, history_files, history_path, signal_files, signal_path, vehicle_name
from fieldcal.warehouse.remote.signals import fetch_signals
from fieldcal.warehouse.signals import signal_ids
from fieldcal.warehouse.store import by_absent_columns
from fieldcal.warehouse.views import AT, VIEWS

if TYPE_CHECKING:
    from fieldcal.warehouse.sql import Limits, SqlValue

DEFAULT_ROOT = "fieldcal-data"


class Warehouse:
    """The data below a root.

    Parameters
    ----------
    root : Path or str, optional
        Data root, or its URL (s3://, gs://, az://), of which a local copy is brought up to date; else
        `FIELDCAL_WAREHOUSE`, else `./fieldcal-data`.
    """

    def __init__(self, root: Path | str | None = None) -> None:
        place = root or os.environ.get("FIELDCAL_WAREHOUSE") or DEFAULT_ROOT
        if is_url(place):
            from fieldcal.warehouse.remote.copy import local_warehouse  # what reads a store, which few need

            place = local_warehouse(str(place))
        self.root = Path(place)

    def scan(self, table: str, *, vehicle_id: str | None = None, flight_id: str | None = None) -> pl.LazyFrame:
        """A table or a view as a lazy frame; a table typed and empty when there is nothing yet.

        Signals come with `vehicle_id` and `flight_id` in front; name a flight unless all of them are meant.
        `vehicle_id` and `flight_id` narrow what is read. Of further units on board: "imu.1", "magnetometer.1", ….
        Every byte of the files is held against its recorded sha256 before the frame is returned.

        Raises
        ------
        WarehouseError
            `damaged_file`, `schema_mismatch`; of a view as `sql`.
        ValueError
            There is no such table or view.
        """
        if table in VIEWS and table not in AT:
            return self._view(table, vehicle_id, flight_id)
        if signal_kind(table) in SIGNAL_TABLES:
            return self._signals(table, vehicle_id, flight_id)
        if table not in HISTORY_TABLES:
            there = ", ".join([*HISTORY_TABLES, *SIGNAL_TABLES, *(view for view in VIEWS if view not in AT)])
            raise ValueError(f"there is no table {table!r} to ask; there are {there}")
        if vehicle_id is None:
            files = history_files(self.root, table)
        else:
            files = [path for path in [history_path(self.root, table, vehicle_id)] if path.exists()]
        assure(self.root, files)
        frame = _scan(files, table)
        return frame if flight_id is None else frame.filter(pl.col("flight_id") == flight_id)

    def sql(self, query: str, parameters: Sequence[SqlValue] | None = None, **limits: Unpack[Limits]) -> pl.DataFrame:
        """Answer one SELECT over the history tables and views; limits as in `fieldcal.warehouse.sql.run_sql`.

        Raises
        ------
        WarehouseError
            `sql_refused`, `sql_wrong`, `sql_timeout`, `sql_too_large`.
        """
        from fieldcal.warehouse.sql import run_sql  # DuckDB, which only questions in SQL need

        return run_sql(self.root, query, parameters, **limits)

    def _view(self, view: str, vehicle_id: str | None, flight_id: str | None) -> pl.LazyFrame:
        rows = self.sql(f"FROM {view}").lazy()
        for name, value in (("vehicle_id", vehicle_id), ("flight_id", flight_id)):
            rows = rows if value is None else rows.filter(pl.col(name) == value)
        return rows

    def _signals(self, table: str, vehicle_id: str | None, flight_id: str | None) -> pl.LazyFrame:
        fetch_signals(self.root, table, vehicle_id, flight_id)
        if vehicle_id is not None and flight_id is not None:
            files = [path for path in [signal_path(self.root, table, vehicle_id, flight_id)] if path.exists()]
        else:
            files = signal_files(self.root, table)
        if vehicle_id is not None:
            files = [path for path in files if vehicle_name(path) == encode_id(vehicle_id)]
        if flight_id is not None:
            files = [path for path in files if path.stem == encode_id(flight_id)]
        assure(self.root, files)
        kind = signal_kind(table)
        return pl.concat([_with_ids(path, kind) for path in files] or [_ids(empty_frame(kind).lazy(), "", "")])


def _scan(files: Sequence[Path], table: str) -> pl.LazyFrame:
    """Rows of a table's files, also where columns are younger than a file (`schemas.check`)."""
    columns, forms = TABLES[table].column_names, by_absent_columns(files, table)
    known = {name: has for name, has in fillings(table).items() if has is not None}
    younger = {name: pl.col(has) if isinstance(has, str) else pl.lit(has) for name, has in known.items()}
    parts = [
        pl.scan_parquet(paths, hive_partitioning=False, glob=False)
        .with_columns(**{name: value for name, value in younger.items() if name in absent})
        .select(n for n in columns if n not in absent or n in younger)
        for absent, paths in forms.items()
    ]
    return parts[0] if list(forms) == [()] else pl.concat([empty_frame(table).lazy(), *parts], how="diagonal")


def _with_ids(path: Path, table: str) -> pl.LazyFrame:
    vehicle_id, flight_id = signal_ids(path)
    return _ids(_scan([path], table), vehicle_id, flight_id)


def _ids(frame: pl.LazyFrame, vehicle_id: str, flight_id: str) -> pl.LazyFrame:
    return frame.select(pl.lit(flight_id).alias("flight_id"), pl.lit(vehicle_id).alias("vehicle_id"), pl.all())
