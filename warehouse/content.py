"""What `tables/` say, as one hash: independent of row order, file layout, compression and of how results came to be."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import polars as pl

from fieldcal import schemas
from fieldcal.warehouse.layout import history_files, vehicle_name
from fieldcal.warehouse.rows_as_json import column_bytes
from fieldcal.warehouse.store import read_table

_JSON_COLUMNS = ("measured", "findings")


def content_sha256(root: Path) -> str:
    """sha256 over the history tables; equal for equal results, by equal decisions. What was exported is no result.

    Left out are the columns that say how a result was made (`run_key`, `versions`), or who decided when. JSON counts by
    its content, not by its spelling.
    """
    digest = hashlib.sha256()
    for table in sorted(set(schemas.HISTORY_TABLES) - {"export"}):
        folders: dict[Path, list[Path]] = {}
        for path in history_files(root, table):
            folders.setdefault(path.parent, []).append(path)
        for folder in folders:
            rows = pl.concat([read_table(path, table) for path in folders[folder]])
            if rows.height:
                digest.update(f"{table}\0vehicle_id={vehicle_name(folders[folder][0])}\0{rows.height}\0".encode())
                digest.update(rows_sha256(rows, table))
    return digest.hexdigest()


def rows_sha256(rows: pl.DataFrame, table: str) -> bytes:
    """Digest of a table's rows as a set."""
    columns = [column.name for column in schemas.table_columns(table) if not column.provenance]
    texts = [name for name in columns if name in _JSON_COLUMNS]
    shown = rows.select(columns).with_columns(
        pl.col(pl.Float64).fill_nan(None) + 0.0,
        *(pl.col(name).map_elements(_canonical_json, return_dtype=pl.String) for name in texts),
    )
    ordered = shown.sort(columns, nulls_last=False)
    digest = hashlib.sha256()
    for name in columns:
        digest.update(name.encode())
        for part in column_bytes(ordered[name]):
            digest.update(part)
    return digest.digest()


def _canonical_json(text: str) -> str:
    try:
        return json.dumps(json.loads(text), sort_keys=True, ensure_ascii=False)
    except ValueError:
        return text
