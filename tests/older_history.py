"""Tables as an older release left them: an earlier version, without some of today's columns, recorded as its own."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from fieldcal.schemas import TABLES
from fieldcal.schemas.arrow import VERSION_KEY
from fieldcal.warehouse import checksums
from fieldcal.warehouse.files import write_bytes


def rewrite(root: Path, path: Path, rows: pa.Table, version: int) -> None:
    """Replace a file of the warehouse by `rows` of this version, its checksum recorded."""
    metadata = {**(rows.schema.metadata or {}), VERSION_KEY.encode(): str(version).encode()}
    sink = pa.BufferOutputStream()
    pq.write_table(rows.replace_schema_metadata(metadata), sink)
    write_bytes(path, sink.getvalue().to_pybytes(), partial(checksums.recording, root, path))


def age(root: Path, path: Path, table: str, without: Collection[str]) -> None:
    """Make a file one version older, from before the columns `without` were added."""
    rewrite(root, path, pq.read_table(path, partitioning=None).drop_columns(list(without)), TABLES[table].version - 1)
