"""One SELECT over the history in DuckDB, locked down: no files, no network, no settings, bounded in memory and time.

The engine works in a process of its own (`engine`), which waits for further questions of this one. It keeps the
limits as far as it counts; what it does not (plans of many thousand parts, single huge values) meets the end of its
address space or, by the clock, of the process.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import NoReturn, TypeAlias, TypedDict

import polars as pl
import pyarrow as pa

from fieldcal import schemas
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.schemas.frames import frame
from fieldcal.schemas.migrations import fillings
from fieldcal.warehouse.checksums import assure
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.layout import history_files, vehicle_of
from fieldcal.warehouse.store import by_absent_columns
from fieldcal.warehouse.views import VIEWS, view_text

_ABOUT_ALL = ("show", "describe", "summarize", "information_schema", "duckdb_", "pg_", "pragma_")
_ENGINE = Path(__file__).with_name("engine.py")
_EPOCH_DAY = date(1970, 1, 1).toordinal()
_GRACE_S = 1.0
"""Time for the engine to stop by itself."""


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
    limits: dict[str, float] = {"timeout_s": timeout_s, "memory_mb": memory_mb, "max_result_mb": max_result_mb}
    asked = {"query": query, "parameters": _plain(parameters), **limits}
    engine = _engine()
    try:
        answer = engine.asked({**asked, **_made(root, query, _named(query, texts))}, timeout_s)
        if isinstance(answer, _Failed) and answer.kind == "catalog":
            # A name that was not recognised in the text, or a mistake, best explained by all.
            answer = engine.asked({**asked, **_made(root, query, texts)}, timeout_s)
    except BaseException:
        engine.end()
        raise
    if engine.lives():
        _idle.append(engine)
    if isinstance(answer, _Failed):
        _refuse(answer, limits)
    return _shown(answer)


def _named(query: str, texts: Mapping[str, str]) -> dict[str, str]:
    """The views that a query may need: those whose name is in its text, and what these need. Making them costs most."""
    if any(word in query.lower() for word in _ABOUT_ALL):
        return dict(texts)
    named: dict[str, str] = {}
    for view in reversed(VIEWS):
        if view in query.lower() or any(view in text for text in named.values()):
            named[view] = texts[view]
    return dict(reversed(named.items()))


def _made(root: Path, query: str, views: Mapping[str, str]) -> dict[str, object]:
    """Statements that make the tables and views that a query may name, and the files that it may open."""
    needed = "".join([query.lower(), *views.values()]) if len(views) < len(VIEWS) else "".join(HISTORY_TABLES)
    paths = {table: history_files(root, table) for table in HISTORY_TABLES if table in needed}
    assure(root, [path for own in paths.values() for path in own])
    tables = [_table_view(table, own) if own else empty_table(table) for table, own in paths.items()]
    return {"made": [*tables, *views.values()], "paths": _listed([path for own in paths.values() for path in own])}


def _table_view(table: str, paths: Sequence[Path]) -> str:
    """A view over a table's files; also where columns are younger than a file."""
    forms = by_absent_columns(paths, table)
    return f"CREATE VIEW {table} AS {' UNION ALL '.join(_select(table, own, absent) for absent, own in forms.items())}"


def empty_table(table: str) -> str:
    """The statement that makes a table of the history without rows."""
    columns = ", ".join(f'"{field.name}" {_sql_type(field)}' for field in schemas.arrow_schema(table))
    return f"CREATE TABLE {table} ({columns})"


def _sql_type(field: pa.Field) -> str:
    """DuckDB's type of a column of a table."""
    import duckdb

    (kind,) = duckdb.from_arrow(pa.Table.from_batches([], pa.schema([field]))).types
    return str(kind)


def _select(table: str, paths: Sequence[Path], absent: Collection[str]) -> str:
    """Rows of files of one form. Where folders tell the vehicles exactly, a query for one vehicle opens one file.

    Columns are qualified: inside a macro a bare name would be the macro's parameter.
    """
    keys = {path.parent.name.partition("=")[0] for path in paths}
    by_folder = len(keys) == 1 and all(vehicle_of(path) for path in paths)
    how, columns = "hive_partitioning = false", {name: f'f."{name}"' for name in schemas.TABLES[table].column_names}
    if by_folder:
        (key,) = keys
        how = f"hive_partitioning = true, hive_types = {{'{key}': 'VARCHAR'}}"
        columns["vehicle_id"] = f'f."{key}" AS "vehicle_id"'
    columns |= {name: _younger(table, name) for name in columns if name in absent}
    return f"SELECT {', '.join(columns.values())} FROM read_parquet({_listed(paths)}, {how}) AS f"


def _younger(table: str, name: str) -> str:
    """What rows of an older version have in a column that they lack (`schemas.check`)."""
    has = fillings(table).get(name)
    if isinstance(has, str):
        return f'f."{has}" AS "{name}"'
    value = "NULL" if has is None else str(has)
    return f'CAST({value} AS {_sql_type(schemas.arrow_schema(table).field(name))}) AS "{name}"'


def _listed(paths: Sequence[Path]) -> str:
    """Absolute paths as a SQL list; a quote in one is doubled."""
    quoted = ("'" + str(path.absolute()).replace("'", "''") + "'" for path in paths)
    return f"[{', '.join(quoted)}]"


def _plain(parameters: Sequence[SqlValue] | None) -> list[list[object]] | None:
    """Parameters as JSON, each with its kind."""
    if parameters is None:
        return None
    return [
        [type(value).__name__, value.isoformat() if isinstance(value, date) else value]  # a datetime is a date too
        for value in parameters
    ]


@dataclass(frozen=True)
class _Failed:
    """What kind of failure, and DuckDB's own words."""

    kind: str
    words: str


class _Engine:
    """A process of `engine`."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._process = subprocess.Popen(
            [sys.executable, "-I", str(_ENGINE)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # where it dies it says so to nobody
        )

    def lives(self) -> bool:
        return self._process.poll() is None

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()

    def asked(self, question: Mapping[str, object], timeout_s: float) -> pa.Table | _Failed:
        """The answer, within the time and a little more."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        late = threading.Event()

        def stop() -> None:
            late.set()
            self._process.kill()

        timer = threading.Timer(timeout_s + _GRACE_S, stop)
        timer.daemon = True
        timer.start()
        try:
            self._process.stdin.write(json.dumps(question).encode() + b"\n")
            self._process.stdin.flush()
            error = json.loads(self._process.stdout.readline())["error"]
            if error is not None:
                return _Failed(*error)
            with pa.ipc.open_stream(self._process.stdout) as stream:
                return stream.read_all()
        except (OSError, ValueError):  # it ended in the middle, ArrowInvalid among them
            self.end()
            return _Failed("timeout" if late.is_set() else "memory", "")
        finally:
            timer.cancel()


_idle: list[_Engine] = []
"""Engines that wait: starting one takes a fifth of a second."""


def _engine() -> _Engine:
    """One that waits, else a new one. Those that died meanwhile, or are another process's, are passed over."""
    while _idle:
        engine = _idle.pop()
        if engine.owner == os.getpid() and engine.lives():
            return engine
    return _Engine()


@atexit.register
def _end_engines() -> None:
    while _idle:
        engine = _idle.pop()
        if engine.owner == os.getpid():
            engine.end()


def _shown(answer: pa.Table) -> pl.DataFrame:
    listed = ", ".join(f"{field.name[:40]} ({field.type})" for field in answer.schema)
    try:
        shown = frame(answer)
    except pl.exceptions.DuplicateError as error:
        what = f"Two columns of the answer have one name, among {listed}: name them with AS."
        raise WarehouseError(ReasonCode.SQL_WRONG, what) from error
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, pa.ArrowException, TypeError, ValueError) as error:
        what = f"The answer has a column of a type that cannot be shown, among {listed}: CAST it to VARCHAR."
        raise WarehouseError(ReasonCode.SQL_WRONG, what) from error
    for column in shown:
        if isinstance(column.dtype, pl.Date | pl.Datetime) and not _in_calendar(column):
            what = f"{column.name} holds times beyond the years 1 to 9999, which cannot be shown: CAST it to VARCHAR."
            raise WarehouseError(ReasonCode.SQL_WRONG, what)
    return shown


def _in_calendar(column: pl.Series) -> bool:
    """Whether all times of a column are such as Python knows."""
    days = column.cast(pl.Datetime("ms")).to_physical() if isinstance(column.dtype, pl.Datetime) else None
    whole = column.to_physical() if days is None else days // 86_400_000
    return bool(whole.is_between(date.min.toordinal() - _EPOCH_DAY, date.max.toordinal() - _EPOCH_DAY).all())


def _refuse(failed: _Failed, limits: Mapping[str, float]) -> NoReturn:
    """DuckDB's errors as ours."""
    sentences = {
        "not one": (
            ReasonCode.SQL_REFUSED,
            f"Only a single SELECT is answered here; this is {failed.words}. The tables are read-only.",
        ),
        "reach": (
            ReasonCode.SQL_REFUSED,
            "Files and extensions are out of reach of SQL here: it reads the warehouse's tables only.",
        ),
        "timeout": (ReasonCode.SQL_TIMEOUT, f"The query took longer than {limits['timeout_s']:g} s and was stopped."),
        "memory": (
            ReasonCode.SQL_TOO_LARGE,
            f"The query needs more than {limits['memory_mb']:g} MB; narrow it, for instance by vehicle_id.",
        ),
        "too large": (
            ReasonCode.SQL_TOO_LARGE,
            f"The result is larger than {limits['max_result_mb']:g} MB; aggregate it or add a LIMIT.",
        ),
    }
    wrong = (ReasonCode.SQL_WRONG, f"The query cannot be answered: {failed.words}")
    raise WarehouseError(*sentences.get(failed.kind, wrong))
