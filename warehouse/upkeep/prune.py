"""What of a warehouse may go, and what is lost with it; listing changes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property, partial
from pathlib import Path

import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse import checksums
from fieldcal.warehouse.errors import disk
from fieldcal.warehouse.layout import checksum_path, encode_id, history_path, signal_files
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.remote.share import share
from fieldcal.warehouse.remote.turn import in_turn
from fieldcal.warehouse.signals import signal_ids


@dataclass(frozen=True)
class Removable:
    """Files of a kind.

    Attributes
    ----------
    what : str
        In a few words.
    lost : str
        What is lost, and how it would come back.
    files : tuple of Path
    vehicle_id : str, optional
        Whose history is among them.
    """

    what: str
    lost: str
    files: tuple[Path, ...]
    vehicle_id: str | None = None

    @cached_property
    def size_bytes(self) -> int:
        """Of all files together."""
        return sum(path.stat().st_size for path in self.files if path.exists())


def former_results(root: Path) -> Removable:
    """Executions of stages that no row of the history comes from: of settings, code or logs of before."""
    named = set(Warehouse(root).scan("run").select("run_key").drop_nulls().unique().collect()["run_key"].to_list())
    former = [folder for folder in executions(root) if folder.name not in named]
    return Removable(
        "results of stages by former settings, code or logs",
        "nothing that the history has; a setting that is changed back runs its stages again",
        tuple(path for folder in former for path in files_below(folder)),
    )


def all_results(root: Path) -> Removable:
    """The whole cache of stages."""
    return Removable(
        "results of all stages",
        "nothing that the history has; the next night runs all stages of all logs again",
        tuple(files_below(root / "stages")),
    )


def signals_before(root: Path, moment: datetime) -> Removable:
    """Readings of flights that started before a moment."""
    flights = Warehouse(root).scan("flight").filter(pl.col("started_at") < moment).select("flight_id").collect()
    old = set(flights["flight_id"].to_list())
    return Removable(
        f"readings of {len(old)} flights before {moment:%Y-%m-%d}",
        "their Parquet readings and curves on their pages; their logs are read again where a stage has to run again",
        tuple(path for path in all_signals(root) if signal_ids(path)[1] in old),
    )


def of_vehicle(root: Path, vehicle_id: str) -> Removable:
    """All that is kept of a vehicle.

    Raises
    ------
    FieldcalError
        `not_found`: nothing is.
    """
    flights = Warehouse(root).scan("flight", vehicle_id=vehicle_id).select("flight_id").collect()["flight_id"].to_list()
    tables = [path for table in HISTORY_TABLES if (path := history_path(root, table, vehicle_id)).exists()]
    signals = [path for path in all_signals(root) if signal_ids(path)[0] == vehicle_id]
    if not tables and not signals:
        raise FieldcalError(ReasonCode.NOT_FOUND, f"Nothing of a vehicle {vehicle_id!r} is in {root}.")
    own = {encode_id(flight_id) for flight_id in flights}
    stages = [path for folder in executions(root) if folder.parent.name in own for path in files_below(folder)]
    return Removable(
        f"all of vehicle {vehicle_id}: {len(flights)} flights",
        "its history, decisions and exports for good; its flights come back if a night finds their logs",
        (*tables, *signals, *stages),
        vehicle_id,
    )


def remove(root: Path, one: Removable) -> None:
    """Remove the files, their recorded sha256 and folders that are empty then; what is gone already is passed over.

    Interrupted, it leaves whole files only, and a warehouse that `verify` calls whole.
    """
    if one.vehicle_id is None:
        _remove(root, one)
    else:
        in_turn(root, one.vehicle_id, partial(_remove, root, one))
        share(root)


def _remove(root: Path, one: Removable) -> None:
    for path in one.files:
        beside = checksum_path(root, path)
        if beside.exists() and (allowed := checksums.recorded(root, path)):
            checksums.record(root, path, [*dict.fromkeys([*allowed, None])])
        with disk(path, "removed"):
            path.unlink(missing_ok=True)
            beside.unlink(missing_ok=True)
        _remove_empty(path.parent, root)
        _remove_empty(beside.parent, root)


def executions(root: Path) -> Iterator[Path]:
    """Folders of the cache of stages, one an execution."""
    yield from (folder for folder in sorted((root / "stages").glob("*/*/*")) if folder.is_dir())


def all_signals(root: Path) -> Iterator[Path]:
    """Of every table, further units' too."""
    tables = sorted(path.name for path in (root / "signals").glob("*") if path.is_dir())
    yield from (path for table in tables for path in signal_files(root, table))


def files_below(folder: Path) -> Iterator[Path]:
    """The record of an execution first: without it the rest counts for nothing."""
    yield from sorted((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.name != "run.json")


def _remove_empty(folder: Path, root: Path) -> None:
    while folder != root and folder.is_relative_to(root):
        with suppress(OSError):
            folder.rmdir()
        if folder.exists():
            return
        folder = folder.parent
