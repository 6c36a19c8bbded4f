"""One SELECT over the history in DuckDB, locked down: no files, no network, no settings, bounded in memory and time.

The engine may open the history's own files, named one by one, for reading; everything else external is switched off and
the configuration locked before the query is looked at.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date, datetime
from pathlib import Path
from typing import TypeAlias, TypedDict

import duckdb
import polars as pl
import pyarrow as pa

from fieldcal import schemas
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.schemas.columns import IS_PRIMARY, UNIT_ID
from fieldcal.schemas.rows import UNIT_OF_OLDER_ROWS
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.layout import history_files, vehicle_of
from fieldcal.warehouse.store import by_absent_columns, frame
from fieldcal.warehouse.views import view_text

# In the order in which they are made: later ones may need earlier ones.
VIEWS = ("latest_calibration", "history", "drift_by_temperature", "worst_tic", "refusals", "calibration_at")

_READING = frozenset({"SELECT", "EXPLAIN"})
_ABOUT_ALL = ("show", "describe", "summarize", "information_schema", "duckdb_", "pg_", "pragma_")
_ROWS_PER_BATCH = 65_536
_CONFIG: dict[str, str | bool | int | float | list[str]] = {
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "allow_community_extensions": False,
    "python_enable_replacements": False,
    "temp_directory": "",
}


SqlValue: TypeAlias = str | bool | int | float | date | datetime | None
"""What may stand for a `?` of a query."""


class Limits(TypedDict, total=False):
    """Limits of `run_sql`."""

    timeout_s: float
    memory_mb: int
    max_result_mb: int


def run_sql(
    root: Path,
    query: str,
    parameters: Sequence[SqlValue] | None = None,
    *,
    timeout_s: float = 60.0,
    memory_mb: int = 1024,
    max_result_mb: int = 512,
) -> pl.DataFrame:
    """Answer one reading statement; `parameters` fill its `?` marks.

    Parameters
    ----------
    timeout_s : float
        The query is interrupted after this time.
    memory_mb, max_result_mb : int
        Memory the engine may use, and size the result may have.

    Raises
    ------
    WarehouseError
        `sql_refused` (not one SELECT, or it reaches outside), `sql_wrong` (syntax, unknown names, wrong types),
        `sql_timeout`, `sql_too_large`.
    """
    texts = {view: view_text(view) for view in VIEWS}
    with _sentences(timeout_s, memory_mb):
        try:
            return _answer(root, query, parameters, _named(query, texts), timeout_s, memory_mb, max_result_mb)
        except (
            duckdb.CatalogException
        ):  # a name that was not recognised in the text, or a mistake, best explained by all
            return _answer(root, query, parameters, texts, timeout_s, memory_mb, max_result_mb)


def _named(query: str, texts: Mapping[str, str]) -> dict[str, str]:
    """The views that a query may need: those whose name is in its text, and what these need. Making them costs most."""
    if any(word in query.lower() for word in _ABOUT_ALL):
        return dict(texts)
    named: dict[str, str] = {}
    for view in reversed(VIEWS):
        if view in query.lower() or any(view in text for text in named.values()):
            named[view] = texts[view]
    return dict(reversed(named.items()))


def _answer(
    root: Path,
    query: str,
    parameters: Sequence[SqlValue] | None,
    views: Mapping[str, str],
    timeout_s: float,
    memory_mb: int,
    max_result_mb: int,
) -> pl.DataFrame:
    needed = "".join([query.lower(), *views.values()]) if len(views) < len(VIEWS) else "".join(HISTORY_TABLES)
    with duckdb.connect(":memory:", config={**_CONFIG, "memory_limit": f"{memory_mb}MB"}) as connection:
        paths = {table: history_files(root, table) for table in HISTORY_TABLES if table in needed}
        for table, own in paths.items():
            if own:
                connection.execute(_table_view(table, own))
            else:
                connection.register(table, schemas.arrow_schema(table).empty_table())
        for text in views.values():
            connection.execute(text)
        connection.execute("SET TimeZone = 'UTC'")
        connection.execute(f"SET allowed_paths = {_listed([path for own in paths.values() for path in own])}")
        connection.execute("SET enable_external_access = false")
        connection.execute("SET lock_configuration = true")
        with _time_limit(connection, timeout_s):
            statement = _one_reading_statement(connection, query)
            return _result(connection.sql(statement, params=parameters), max_result_mb)


def _table_view(table: str, paths: Sequence[Path]) -> str:
    """A view over a table's files; also where columns are younger than a file."""
    forms = by_absent_columns(paths, table)
    return f"CREATE VIEW {table} AS {' UNION ALL '.join(_select(table, own, absent) for absent, own in forms.items())}"


def _select(table: str, paths: Sequence[Path], absent: Collection[str]) -> str:
    """Rows of files of one form. Where folders tell the vehicles exactly, a query for one vehicle opens one file.

    Columns are qualified: inside a macro a bare name would be the macro's parameter.
    """
    by_folder = all(vehicle_of(path) for path in paths)
    how = (
        "hive_partitioning = true, hive_types = {'vehicle_id': 'VARCHAR'}" if by_folder else "hive_partitioning = false"
    )
    names = schemas.TABLES[table].column_names
    columns = ", ".join(_younger(table, name) if name in absent else f'f."{name}"' for name in names)
    return f"SELECT {columns} FROM read_parquet({_listed(paths)}, {how}) AS f"


def _younger(table: str, name: str) -> str:
    """What rows of an older version have in a column that they lack (`schemas.check`)."""
    if name == UNIT_ID.name:
        return f'f."{UNIT_OF_OLDER_ROWS}" AS "{name}"'
    if name == IS_PRIMARY.name:
        return f'TRUE AS "{name}"'
    column = schemas.arrow_schema(table).field(name)
    (kind,) = duckdb.from_arrow(pa.schema([column]).empty_table()).types
    return f'CAST(NULL AS {kind}) AS "{name}"'


def _listed(paths: Sequence[Path]) -> str:
    """Absolute paths as a SQL list; a quote in one is doubled."""
    quoted = ("'" + str(path.absolute()).replace("'", "''") + "'" for path in paths)
    return f"[{', '.join(quoted)}]"


def _one_reading_statement(connection: duckdb.DuckDBPyConnection, query: str) -> duckdb.Statement:
    statements = connection.extract_statements(query)
    kinds = [statement.type.name for statement in statements]
    if len(kinds) == 1 and kinds[0] in _READING:
        return statements[0]
    what = "nothing" if not kinds else ", ".join(kinds)
    raise WarehouseError(
        ReasonCode.SQL_REFUSED, f"Only a single SELECT is answered here; this is {what}. The tables are read-only."
    )


def _result(answer: duckdb.DuckDBPyRelation, max_result_mb: int) -> pl.DataFrame:
    reader: pa.RecordBatchReader = answer.to_arrow_reader(_ROWS_PER_BATCH)
    batches: list[pa.RecordBatch] = []
    size = 0
    for batch in reader:
        size += batch.nbytes
        if size > max_result_mb << 20:
            raise WarehouseError(
                ReasonCode.SQL_TOO_LARGE, f"The result is larger than {max_result_mb} MB; aggregate it or add a LIMIT."
            )
        batches.append(batch)
    return frame(pa.Table.from_batches(batches, schema=reader.schema))


@contextmanager
def _time_limit(connection: duckdb.DuckDBPyConnection, timeout_s: float) -> Iterator[None]:
    timer = threading.Timer(timeout_s, connection.interrupt)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def _sentences(timeout_s: float, memory_mb: int) -> Iterator[None]:
    """DuckDB's errors as ours."""
    try:
        yield
    except duckdb.InterruptException as error:
        raise WarehouseError(
            ReasonCode.SQL_TIMEOUT, f"The query took longer than {timeout_s:g} s and was stopped."
        ) from error
    except duckdb.OutOfMemoryException as error:
        raise WarehouseError(
            ReasonCode.SQL_TOO_LARGE,
            f"The query needs more than {memory_mb} MB; narrow it, for instance by vehicle_id.",
        ) from error
    except duckdb.PermissionException as error:
        raise WarehouseError(
            ReasonCode.SQL_REFUSED,
            "Files and extensions are out of reach of SQL here: it reads the warehouse's tables only.",
        ) from error
    except duckdb.Error as error:
        raise WarehouseError(ReasonCode.SQL_WRONG, f"The query cannot be answered: {str(error).strip()}") from error
