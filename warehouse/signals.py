"""Readings as logged: one file a flight and table, written once at ingest."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import polars as pl

from fieldcal.schemas import signal_kind
from fieldcal.warehouse import checksums
from fieldcal.warehouse.layout import decode_id, prepare, signal_path, vehicle_of
from fieldcal.warehouse.remote.signals import fetch_signals
from fieldcal.warehouse.store import TableWriter, read_facts, read_table


def signal_writer(
    root: Path,
    table: str,
    vehicle_id: str,
    flight_id: str,
    *,
    units: Mapping[str, str] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> TableWriter:
    """Writer of one signal of a flight ("imu", of a further unit "imu.1"); its sha256 is recorded, the exact ids are in
    the file's metadata."""
    prepare(root)
    path = signal_path(root, table, vehicle_id, flight_id)
    facts = {**(metadata or {}), "fieldcal.vehicle_id": vehicle_id, "fieldcal.flight_id": flight_id}
    kind = signal_kind(table)
    return TableWriter(kind, path, units=units, metadata=facts, around_rename=partial(checksums.recording, root, path))


def has_signal(root: Path, table: str, vehicle_id: str, flight_id: str) -> bool:
    """Whether readings of a flight are kept; by URL they are fetched for it."""
    path = signal_path(root, table, vehicle_id, flight_id)
    if not path.exists():
        fetch_signals(root, table, vehicle_id, flight_id)
    return path.exists()


def read_signal(root: Path, table: str, vehicle_id: str, flight_id: str) -> pl.DataFrame:
    """Readings of one flight, held against their recorded sha256."""
    path = signal_path(root, table, vehicle_id, flight_id)
    has_signal(root, table, vehicle_id, flight_id)
    checksums.assure(root, [path])
    return read_table(path, signal_kind(table))


def signal_ids(path: Path) -> tuple[str, str]:
    """Vehicle and flight of a signal file: from its name, or from its metadata where the name is shortened."""
    vehicle_id, flight_id = vehicle_of(path), decode_id(path.stem)
    if vehicle_id is None or flight_id is None:
        facts = read_facts(path)
        return facts["fieldcal.vehicle_id"], facts["fieldcal.flight_id"]
    return vehicle_id, flight_id
