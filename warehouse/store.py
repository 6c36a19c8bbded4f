"""Parquet: the only place that writes or reads it.

Every file carries its table's schema (unit and meaning of every column) and a checksum for every page; reading verifies
both. Time stamps are delta-encoded, texts by dictionary, readings and what stages make of them by byte-stream split
(the numbers of the history, of which many are alike, by dictionary); pages are compressed with zstd. Equal data give
equal bytes.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self, TypeAlias

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from fieldcal import schemas
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import SchemaMismatch
from fieldcal.schemas.arrow import VERSION_KEY
from fieldcal.schemas.frames import frame
from fieldcal.schemas.migrations import fillings, name_today
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.files import AroundRename, AtomicFile, write_bytes

Data: TypeAlias = pl.DataFrame | pa.Table | pa.RecordBatch | Mapping[str, np.ndarray]

_ROWS_PER_GROUP = 131_072
_THREADS_FROM_BYTES = 4 << 20
"""Below, threads gain nothing, and a process that ends just after pyarrow started them may be aborted."""


class TableWriter:
    """Write a table in batches; it appears at `path` when the block ends without an error, else nothing does.

    Parameters
    ----------
    table : str
        Table whose columns the batches have (in any order).
    path : Path
        Final place.
    stage : bool
        The table as a stage writes it.
    units, metadata : mapping, optional
        Real units of logged columns, and facts for the file's metadata (`schemas.arrow_schema`).
    around_rename : callable, optional
        Given the sha256: a context within which the file gets its final name.
    durable : bool
        False: not forced to disk (`fieldcal.warehouse.files.AtomicFile`).

    Attributes
    ----------
    sha256 : str
        sha256 of the file, once the block has ended.
    n_rows : int
        Rows written so far.
    """

    def __init__(
        self,
        table: str,
        path: Path,
        *,
        stage: bool = False,
        units: Mapping[str, str] | None = None,
        metadata: Mapping[str, str] | None = None,
        around_rename: AroundRename | None = None,
        durable: bool = True,
    ) -> None:
        self.table = table
        self.path = path
        self.sha256 = ""
        self.n_rows = 0
        self._stage = stage
        self._schema = schemas.arrow_schema(table, stage=stage, units=units, metadata=metadata)
        self._file = AtomicFile(path, around_rename, durable=durable)
        try:
            readings = stage or schemas.TABLES[schemas.signal_kind(table)].kind != "history"
            self._parquet = pq.ParquetWriter(self._file, self._schema, **_options(self._schema, readings=readings))
        except BaseException:
            self._file.close()
            raise
        self._waiting: list[pa.Table] = []
        self._n_waiting = 0

    def write(self, data: Data) -> None:
        """Append rows. Few rows at a time are fine: they are gathered into row groups of one size.

        Raises
        ------
        SchemaMismatch
            Columns are missing, additional or of the wrong type, or a column of the key holds nulls.
        """
        rows = schemas.conform(_arrow(data), self.table, self._schema, stage=self._stage)
        self._waiting.append(rows)
        self._n_waiting += rows.num_rows
        self.n_rows += rows.num_rows
        if self._n_waiting >= _ROWS_PER_GROUP:
            self._flush(everything=False)

    def _flush(self, *, everything: bool) -> None:
        rows = pa.concat_tables(self._waiting) if self._waiting else pa.Table.from_batches([], self._schema)
        whole = rows.num_rows if everything else rows.num_rows - rows.num_rows % _ROWS_PER_GROUP
        if whole:
            self._parquet.write_table(rows.slice(0, whole).combine_chunks(), row_group_size=_ROWS_PER_GROUP)
        self._waiting = [rows.slice(whole)]
        self._n_waiting = rows.num_rows - whole

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._flush(everything=True)
                self._parquet.close()
                self.sha256 = self._file.commit()
            else:
                with suppress(Exception):
                    self._parquet.close()
        finally:
            self._file.close()


def write_table(
    data: Data,
    table: str,
    path: Path,
    *,
    stage: bool = False,
    units: Mapping[str, str] | None = None,
    metadata: Mapping[str, str] | None = None,
    around_rename: AroundRename | None = None,
    durable: bool = True,
) -> str:
    """Write a whole table, atomically; the sha256 of the file. Parameters as in `TableWriter`."""
    writer = TableWriter(
        table, path, stage=stage, units=units, metadata=metadata, around_rename=around_rename, durable=durable
    )
    with writer:
        writer.write(data)
    return writer.sha256


def write_frame(rows: pl.DataFrame, path: Path, metadata: Mapping[str, str]) -> None:
    """Write a frame that is no table of the warehouse's, with facts in the file's metadata, atomically."""
    write_bytes(path, frame_bytes(rows, metadata))


def frame_bytes(rows: pl.DataFrame, metadata: Mapping[str, str]) -> bytes:
    """The bytes `write_frame` would write."""
    data = rows.to_arrow().replace_schema_metadata(dict(metadata))
    buffer = io.BytesIO()
    with pq.ParquetWriter(buffer, data.schema, **_options(data.schema)) as parquet:
        parquet.write_table(data.combine_chunks())
    return buffer.getvalue()


def table_bytes(data: Data, table: str) -> bytes:
    """The bytes `write_table` would write."""
    rows = conform(data, table)
    buffer = io.BytesIO()
    with pq.ParquetWriter(buffer, rows.schema, **_options(rows.schema)) as parquet:
        parquet.write_table(rows.combine_chunks(), row_group_size=_ROWS_PER_GROUP)
    return buffer.getvalue()


def read_table(path: Path, table: str, *, stage: bool = False) -> pl.DataFrame:
    """Read a table, verifying page checksums and schema. Columns that an older version did not have: `schemas.check`.

    Raises
    ------
    WarehouseError
        `damaged_file`, `schema_mismatch`, or the disk's refusal.
    """
    return frame(read_arrow(path, table, stage=stage))


def read_arrow(source: Path | bytes, table: str, *, stage: bool = False, name: str = "") -> pa.Table:
    """The same as an Arrow table, metadata kept; `source` may be the bytes of a file, called `name` in messages."""
    shown = name or str(source if isinstance(source, Path) else "the file")
    if isinstance(source, Path):
        with disk(source, "read"):
            source = source.read_bytes()
    with _opened(source, shown) as file:
        absent = schemas.check(file.schema_arrow, table, stage=stage)
        names = [name for name in _names(table, stage) if name not in absent]
        rows = file.read(columns=names, use_threads=len(source) >= _THREADS_FROM_BYTES)
        rows.validate(full=True)
        return _completed(rows, absent, table, stage)


def read_older(source: bytes, table: str, name: str) -> tuple[int, pa.Table]:
    """Version of a file of the history, which is called `name` in messages, and its rows as today's version has them.

    Columns have the names of today (`migrations.CHANGES`) and, where nothing is lost by it, the types.

    Raises
    ------
    WarehouseError
        `damaged_file`, `schema_mismatch`.
    """
    with _opened(source, name) as file:
        known = schemas.TABLES[table].version
        version = int((file.schema_arrow.metadata or {}).get(VERSION_KEY.encode(), known))
        rows = file.read(use_threads=len(source) >= _THREADS_FROM_BYTES)
        rows.validate(full=True)
        names = [name_today(table, version, column) for column in rows.column_names]
        rows = rows.rename_columns(names).replace_schema_metadata(file.schema_arrow.metadata)
        wanted = schemas.arrow_schema(table)
        for i, field in enumerate(rows.schema):
            if field.name in wanted.names and field.type != (kind := wanted.field(field.name).type):
                with suppress(pa.ArrowException):  # what cannot be converted is refused below
                    rows = rows.set_column(i, field.with_type(kind), rows.column(i).cast(kind))
        absent = schemas.check(rows.schema, table)
        if lost := set(names) - set(wanted.names):
            raise SchemaMismatch(f"an upgrade of {table} would lose what the columns {', '.join(sorted(lost))} hold")
        return version, schemas.conform(_completed(rows, absent, table, stage=False), table)


@contextmanager
def _opened(source: bytes, shown: str) -> Iterator[pq.ParquetFile]:
    """A Parquet file, each page checked as it is read; what goes wrong in the block as errors of the warehouse."""
    try:
        with pq.ParquetFile(pa.BufferReader(source), page_checksum_verification=True) as file:
            yield file
    except SchemaMismatch as error:
        raise WarehouseError(ReasonCode.SCHEMA_MISMATCH, f"{shown}: {error}.") from error
    except (pa.ArrowException, pl.exceptions.PanicException, OSError, ValueError) as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        raise WarehouseError(
            ReasonCode.DAMAGED_FILE, f"{shown} is damaged ({first_line}); `fieldcal verify` lists what else is."
        ) from error


def by_absent_columns(paths: Iterable[Path], table: str) -> dict[tuple[str, ...], list[Path]]:
    """Files of a table by the columns that they lack because an older version wrote them: none, as a rule.

    Raises
    ------
    WarehouseError
        `schema_mismatch`: one of another version that cannot be read as this one.
    """
    known = str(schemas.TABLES[table].version)
    found: dict[tuple[str, ...], list[Path]] = {}
    for path in paths:
        absent: tuple[str, ...] = ()
        try:
            if pl.read_parquet_metadata(path).get(VERSION_KEY, known) != known:
                absent = schemas.check(pq.read_schema(path), table)
        except SchemaMismatch as error:
            raise WarehouseError(ReasonCode.SCHEMA_MISMATCH, f"{path}: {error}.") from error
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, pa.ArrowException, OSError, ValueError):
            pass  # damaged: whoever reads its rows says so
        found.setdefault(absent, []).append(path)
    return found


def read_facts(path: Path) -> dict[str, str]:
    """Facts in a file's metadata: table, version, and what its writer added."""
    with disk(path, "read"), path.open("rb") as file:
        metadata = pq.read_schema(file).metadata or {}
    return {key.decode(): value.decode() for key, value in metadata.items()}


def conform(data: Data, table: str, *, stage: bool = False) -> pa.Table:
    """`schemas.conform` of any form of data."""
    return schemas.conform(_arrow(data), table, stage=stage)


def _arrow(data: Data) -> pa.Table:
    if isinstance(data, pl.DataFrame):
        return data.to_arrow()
    if isinstance(data, pa.RecordBatch):
        return pa.Table.from_batches([data])
    if isinstance(data, pa.Table):
        return data
    return pa.table({name: pa.array(np.ascontiguousarray(column)) for name, column in data.items()})


def _completed(rows: pa.Table, absent: Collection[str], table: str, stage: bool) -> pa.Table:
    """The rows with the columns that they lack (`schemas.check`), in the table's order."""
    schema = schemas.arrow_schema(table, stage=stage)
    filled = fillings(table)
    for name in absent:
        has = filled.get(name)
        kind = schema.field(name).type
        values = rows[has] if isinstance(has, str) else pa.repeat(pa.scalar(has, kind), rows.num_rows)
        rows = rows.append_column(schema.field(name), values)
    return rows.select(schema.names)


def _names(table: str, stage: bool) -> tuple[str, ...]:
    return tuple(column.name for column in schemas.table_columns(table, stage=stage))


def _options(schema: pa.Schema, *, readings: bool = False) -> dict[str, object]:
    """How a table is written; `readings`: a signal's or a stage's, in which hardly a number is like another."""
    stamps = [field.name for field in schema if field.name.endswith("_ns")]
    split = [field.name for field in schema if readings and pa.types.is_floating(field.type)]
    return {
        "version": "2.6",
        "compression": "zstd",
        "compression_level": 1 if readings else 3,
        "use_dictionary": [field.name for field in schema if field.name not in (*stamps, *split)],
        "column_encoding": dict.fromkeys(stamps, "DELTA_BINARY_PACKED") | dict.fromkeys(split, "BYTE_STREAM_SPLIT"),
        "write_page_checksum": True,
        "write_statistics": True,
        "dictionary_pagesize_limit": 4 << 20,
    }
