"""Bring the files of the history to today's version: one after the other, each of them whole or as it was.

Signals have had one version since the first night; stages, reports and what a night remembers are made anew.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from functools import partial
from pathlib import Path
from typing import Literal, TypedDict

import pyarrow as pa

from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import HISTORY_TABLES, TABLES
from fieldcal.warehouse import checksums
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.files import remove_abandoned, sync_folder, write_bytes
from fieldcal.warehouse.layout import (
    FORMER_PARTITION,
    PARTITION,
    checksum_path,
    history_files,
    under,
    vehicle_of,
)
from fieldcal.warehouse.questions import existing
from fieldcal.warehouse.remote.share import share
from fieldcal.warehouse.remote.turn import in_turn
from fieldcal.warehouse.store import read_older, table_bytes


class FileUpgrade(TypedDict):
    """What became of a file that was not of today's version, or could not be read."""

    table: str
    vehicle_id: str
    path: str
    status: Literal["upgraded", "due", "left"]
    from_version: int | None
    to_version: int
    rows: int
    reason: str | None


class Upgrade(TypedDict):
    """What `upgrade` did."""

    ok: bool
    files: int
    upgraded: list[FileUpgrade]


def upgrade(root: Path, *, dry_run: bool = False, timeout_s: float = 300.0) -> Upgrade:
    """Rewrite every file of the history that an older version wrote as today's version, in today's place, with all its
    rows and values.

    Each file is replaced under its vehicle's lock, its sha256 recorded; killed at any moment, this leaves every file
    whole in one version or the other, and the next run does the rest. What cannot be read is left alone.

    Parameters
    ----------
    dry_run : bool
        Change nothing; status "due" says what would be upgraded.
    timeout_s : float
        How long to wait for another process that publishes a vehicle.

    Returns
    -------
    dict
        `ok` (nothing was left), `files` (how many were looked at), `upgraded`: those of another version or place,
        or that cannot be read, with status "upgraded", "due" or "left" and the reason; paths relative to `root`.

    Raises
    ------
    WarehouseError
        `no_warehouse`, `busy`, or the disk's refusal.
    """
    existing(root)
    if not dry_run:
        remove_abandoned(root)
    files = [(table, path) for table in HISTORY_TABLES for path in history_files(root, table)]
    found = [_upgraded(root, table, path, dry_run, timeout_s) for table, path in files]
    if not dry_run:
        _remove_former_records(root)
        share(root)
    told = [outcome for outcome in found if outcome is not None]
    return {"ok": all(outcome["status"] != "left" for outcome in told), "files": len(files), "upgraded": told}


def _rename(root: Path, former: Path, path: Path) -> None:
    """Give a file's folder today's name. What was recorded of the file is there under both names for a moment."""
    records = checksum_path(root, former).parent
    with disk(former, "renamed"):
        if records.is_dir():
            shutil.copytree(records, checksum_path(root, path).parent, dirs_exist_ok=True)
        os.replace(former.parent, path.parent)
        sync_folder(path.parent.parent)


def _remove_former_records(root: Path) -> None:
    """Records of files that have moved: also of those after whose move an upgrade was killed."""
    for records in (root / "checksums" / "tables").glob(f"*/{FORMER_PARTITION}*"):
        if not (root / records.relative_to(root / "checksums")).exists():
            shutil.rmtree(records, ignore_errors=True)


def _upgraded(root: Path, table: str, path: Path, dry_run: bool, timeout_s: float) -> FileUpgrade | None:
    """What became of one file; None where it is of today's version."""
    known, place = TABLES[table].version, under(PARTITION, path)
    outcome: FileUpgrade = {
        "table": table,
        "vehicle_id": vehicle_of(path) or path.parent.name,
        "path": str(place.relative_to(root)),
        "status": "due" if dry_run else "upgraded",
        "from_version": None,
        "to_version": known,
        "rows": 0,
        "reason": None,
    }
    try:
        version, rows = _read(root, table, path)
        moves = path != place
        if version == known and not moves:
            return None
        ids = rows["vehicle_id"].unique().to_pylist()
        outcome["vehicle_id"] = vehicle_id = ids[0] if ids else outcome["vehicle_id"]
        outcome["from_version"], outcome["rows"] = version, rows.num_rows
        if not dry_run:
            in_turn(root, vehicle_id, partial(_bring, root, table, path, place), timeout_s=timeout_s)
    except WarehouseError as error:
        if error.reason_code not in (ReasonCode.DAMAGED_FILE, ReasonCode.SCHEMA_MISMATCH):
            raise
        outcome["status"], outcome["reason"] = "left", error.sentence
    return outcome


def _bring(root: Path, table: str, path: Path, place: Path) -> None:
    """Write a file as today's version, in today's place."""
    version, rows = _read(root, table, path)  # a night may have published meanwhile
    if version != TABLES[table].version:
        write_bytes(path, table_bytes(rows, table), partial(checksums.recording, root, path))
    if path != place:
        _rename(root, path, place)


def _read(root: Path, table: str, path: Path) -> tuple[int, pa.Table]:
    """Version and rows of a file, refused when it is not what was written."""
    with disk(path, "read"):
        data = path.read_bytes()
    if problem := checksums.problem(root, path, hashlib.sha256(data).hexdigest()):
        raise WarehouseError(
            ReasonCode.DAMAGED_FILE, f"{path} is damaged ({problem}); `fieldcal verify` lists what else is."
        )
    return read_older(data, table, str(path))
