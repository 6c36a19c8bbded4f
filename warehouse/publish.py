"""Publish into the history: one file a vehicle and table, replaced whole, atomically, and only when it changes.

Nights replace flights and trends; decisions and exports are only ever added. What was decided holds for rows that are
published later too.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path

import polars as pl

from fieldcal import schemas
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import FLEET_TABLES, FLIGHT_TABLES, HISTORY_TABLES, SchemaMismatch
from fieldcal.schemas.columns import SEQUENCE, STARTED_AT
from fieldcal.schemas.frames import empty_frame, frame
from fieldcal.warehouse import checksums
from fieldcal.warehouse.decisions.withdrawn import DECIDED, as_decided, decisions
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import history_path
from fieldcal.warehouse.remote.turn import in_turn
from fieldcal.warehouse.store import conform, read_arrow, read_table, table_bytes

_ORDER = (*(name for name in FLIGHT_TABLES if name != "flight"), *FLEET_TABLES, "flight")


def publish(
    root: Path,
    vehicle_id: str,
    rows: Mapping[str, pl.DataFrame],
    flights: Collection[str],
    *,
    timeout_s: float = 300.0,
) -> tuple[str, ...]:
    """Replace all rows of `flights` in the vehicle's history by `rows`; rows of other flights stay.

    A table that is not in `rows` loses its rows of these flights too. `drift` and `pooled` have no flights: when given,
    each replaces the vehicle's. `flight` is written last: a flight that it lists as just published is so in every other
    table.

    Parameters
    ----------
    rows : mapping
        History tables with all their columns, lead included; NaN becomes null.
    flights : collection
        Flight ids replaced; every row given belongs to one of them.
    timeout_s : float
        How long to wait for another process that publishes this vehicle.

    Returns
    -------
    tuple
        The tables whose file changed.

    Raises
    ------
    WarehouseError
        `damaged_file` (what is there cannot be trusted: nothing is overwritten), `busy`, or the disk's refusal.
    SchemaMismatch
        Rows are not of their table, of another vehicle or flight, or two have the same key.
    """
    prepared = {table: _prepared(table, new, vehicle_id) for table, new in rows.items()}
    for table in prepared.keys() & FLIGHT_TABLES:
        _only(table, "flight", prepared[table]["flight_id"], set(flights))

    def replace() -> tuple[str, ...]:
        changed = []
        for table in _ORDER:
            new = prepared.get(table)
            if (table in FLEET_TABLES and new is None) or (new is None and not flights):
                continue
            if _replace(root, table, vehicle_id, empty_frame(table) if new is None else new, flights):
                changed.append(table)
        return tuple(changed)

    return in_turn(root, vehicle_id, replace, flights=flights, timeout_s=timeout_s)


def append(root: Path, vehicle_id: str, table: str, rows: pl.DataFrame, *, timeout_s: float = 300.0) -> None:
    """Add rows to a vehicle's `decision` or `export`; raises as `publish`."""
    new = _prepared(table, rows, vehicle_id)
    in_turn(root, vehicle_id, lambda: _replace(root, table, vehicle_id, new, ()), timeout_s=timeout_s)


def settle(root: Path, vehicle_id: str, *, timeout_s: float = 300.0) -> tuple[str, ...]:
    """Bring the statuses of a vehicle's rows up to what is decided; the tables that changed. Raises as `publish`."""

    def follow() -> tuple[str, ...]:
        return tuple(table for table in DECIDED if _replace(root, table, vehicle_id, empty_frame(table), ()))

    return in_turn(root, vehicle_id, follow, timeout_s=timeout_s)


def read_history(root: Path, table: str, vehicle_id: str) -> pl.DataFrame:
    """A vehicle's history as it is; no rows when there is none."""
    path = history_path(root, table, vehicle_id)
    checksums.assure(root, [path])
    return read_table(path, table) if path.exists() else empty_frame(table)


def _prepared(table: str, rows: pl.DataFrame, vehicle_id: str) -> pl.DataFrame:
    if table not in HISTORY_TABLES:
        raise SchemaMismatch(f"{table} is no table of the history; those are {', '.join(HISTORY_TABLES)}")
    result = frame(conform(rows, table))
    _only(table, "vehicle", result["vehicle_id"], {vehicle_id})
    return result.with_columns(pl.col(pl.Float64).fill_nan(None))


def _only(table: str, what: str, found: pl.Series, allowed: Collection[str]) -> None:
    if others := set(found.to_list()) - set(allowed):
        raise SchemaMismatch(f"{table}: rows of {what} {min(map(str, others))!r} are not of what is published here")


def _replace(root: Path, table: str, vehicle_id: str, new: pl.DataFrame, flights: Collection[str]) -> bool:
    path = history_path(root, table, vehicle_id)
    before, there = _existing(root, path, table)
    kept = there.clear() if table in FLEET_TABLES else there
    if table in FLIGHT_TABLES and flights:
        kept = there.filter(~pl.col("flight_id").is_in(list(flights)))
    if before is None and not new.height:
        return False
    rows = pl.concat([kept, new])
    if table in DECIDED:
        rows = as_decided(table, rows, decisions(root))
    after = table_bytes(_sorted(table, rows), table)
    if after == before:
        return False
    write_bytes(path, after, partial(checksums.recording, root, path))
    return True


def _existing(root: Path, path: Path, table: str) -> tuple[bytes | None, pl.DataFrame]:
    """Bytes and rows of what is there, refused when it is not what was written."""
    if not path.exists():
        return None, empty_frame(table)
    with disk(path, "read"):
        data = path.read_bytes()
    if problem := checksums.problem(root, path, hashlib.sha256(data).hexdigest()):
        told = f"{path} is damaged ({problem}), and nothing is published over it. {checksums.remedy(root, path)}"
        raise WarehouseError(ReasonCode.DAMAGED_FILE, told)
    return data, frame(read_arrow(data, table, name=str(path)))


def _sorted(table: str, rows: pl.DataFrame) -> pl.DataFrame:
    """Rows in the order of flights in time, then of their key, which must be theirs alone."""
    key = list(schemas.table_key(table))
    if (double := rows.select(key).is_duplicated()).any():
        first = rows.filter(double).select(key).row(0)
        raise SchemaMismatch(f"{table}: more than one row with {', '.join(key)} = {', '.join(map(str, first))}")
    order = [STARTED_AT.name, SEQUENCE.name, *key] if table in FLIGHT_TABLES else key
    return rows.sort(order, nulls_last=False)
