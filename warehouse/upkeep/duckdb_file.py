"""The history as one DuckDB file: its tables with units and meanings as comments, and its views."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.questions import existing
from fieldcal.warehouse.reference import Relation, relations
from fieldcal.warehouse.sql import empty_table
from fieldcal.warehouse.views import VIEWS, view_text

if TYPE_CHECKING:
    import duckdb


class Written(TypedDict):
    """What a file holds: rows by table, and the names of the views."""

    path: str
    tables: dict[str, int]
    views: list[str]


def write_duckdb(root: Path, path: Path, *, replace: bool = False) -> Written:
    """Copy the history into a DuckDB file; it appears whole or not at all.

    Parameters
    ----------
    root : Path
        Data root.
    path : Path
        The file to write.
    replace : bool
        Replace a file that is there.

    Raises
    ------
    WarehouseError
        `no_warehouse`, `damaged_file`; `wrong_option`: there is a file already; or the disk's refusal.
    """
    import duckdb

    warehouse: Warehouse = existing(root)
    if path.exists() and not replace:
        raise WarehouseError(ReasonCode.WRONG_OPTION, f"{path} is there already; --replace writes it anew.")
    known, rows = relations(), {}
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with disk(path, "written"):
            beside.unlink(missing_ok=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            beside.touch()
            beside.unlink()
        try:
            with duckdb.connect(str(beside)) as file:
                for table in HISTORY_TABLES:
                    own = warehouse.scan(table).collect().to_arrow()
                    file.execute(empty_table(table))
                    file.register("own", own)
                    file.execute(f"INSERT INTO {table} BY NAME SELECT * FROM own")
                    file.unregister("own")
                    rows[table] = own.num_rows
                    _comment(file, known[table])
                for view in VIEWS:
                    file.execute(view_text(view))
        except duckdb.Error as error:
            told = str(error).splitlines()[0]
            raise WarehouseError(ReasonCode.DISK_ERROR, f"{path} cannot be written: {told}.") from error
        with disk(path, "written"):
            beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
        beside.with_name(f"{beside.name}.wal").unlink(missing_ok=True)
    return {"path": str(path), "tables": rows, "views": list(VIEWS)}


def _comment(file: duckdb.DuckDBPyConnection, table: Relation) -> None:
    file.execute(f"COMMENT ON TABLE {table.name} IS {_quoted(table.meaning)}")
    for column in table.columns:
        unit = f"[{column.unit}] " if column.unit else ""
        file.execute(f'COMMENT ON COLUMN {table.name}."{column.name}" IS {_quoted(unit + column.meaning)}')


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
