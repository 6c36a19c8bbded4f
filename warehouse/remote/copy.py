"""The local copy of a warehouse by URL: brought up to its heads, a vehicle at a time, under the vehicle's lock."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import WAREHOUSES, note_copy
from fieldcal.remote.objects import Objects, Tag
from fieldcal.remote.url import below, checked
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse import checksums
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import PARTITION, checksum_path, encode_id, prepare
from fieldcal.warehouse.lock import named_lock
from fieldcal.warehouse.remote.heads import HEADS, Head, head_key, name_of, read_head
from fieldcal.warehouse.remote.known import (
    Gone,
    fetched,
    in_threads,
    know_head,
    known,
    known_head,
    known_names,
    objects_of,
)
from fieldcal.warehouse.remote.signals import drop_replaced
from fieldcal.warehouse.sealed import BrokenSeal

_TRIES = 5
"""A head may be replaced, and what it named removed, while it is followed."""


def local_warehouse(url: str) -> Path:
    """The copy of the warehouse at a URL, up to date; a folder that is not there while there is no such warehouse.

    Raises
    ------
    RemoteError, WarehouseError
        The store's refusal, `damaged_file`, or the disk's refusal.
    """
    root = note_copy(WAREHOUSES, checked(url))
    refresh(root)
    return root


def refresh(root: Path) -> bool:
    """Bring the copy up to the heads; whether any was another. A warehouse on this machine is as it is."""
    objects = objects_of(root)
    if objects is None:
        return False
    listed = {name: one.e_tag for one in objects.listed(HEADS) if one.key == head_key(name := name_of(one.key))}
    followed = {name: _tag_if_there(root, name) for name in known_names(root)}
    ahead = {path.name for path in (root / "remote" / "ahead").glob("*")}
    names = {name for name in listed.keys() | followed.keys() if listed.get(name) != followed.get(name)} | ahead
    if names:
        prepare(root)
        in_threads(partial(_follow, root, objects), sorted(names))
    return bool(names)


def _tag_if_there(root: Path, name: str) -> str | None:
    """The tag of the head that the copy follows, while its files are there: any may be removed to be fetched anew."""
    found = known(root, name)
    if found is None:
        return None
    try:
        there = all(_place(root, name, table).stat().st_size == one.size for table, one in found[0].files.items())
    except OSError:
        return None
    return found[1] if there else None


def _place(root: Path, name: str, table: str) -> Path:
    return root / "tables" / table / f"{PARTITION}{name}" / "part.parquet"


def _follow(root: Path, objects: Objects, name: str) -> None:
    with named_lock(root, name):
        take_head(root, objects, name)


def take_head(root: Path, objects: Objects, name: str, vehicle_id: str = "") -> tuple[Head, Tag | None]:
    """Make a vehicle's files in the copy those of its head; whoever calls has the vehicle's lock. The head and its tag.

    What a writer that died had changed in the copy, and no head ever named, is undone by it.
    """
    for attempt in range(_TRIES):
        head, tag = read_head(objects, name, vehicle_id)
        if tag is not None and encode_id(head.vehicle_id) != name:
            told = f"{below(objects.url, head_key(name))} is the head of another vehicle; restore its own."
            raise WarehouseError(ReasonCode.DAMAGED_FILE, told)
        try:
            for table in HISTORY_TABLES:
                _take_table(root, objects, name, head, table)
            drop_replaced(root, objects, known_head(root, name), head)
        except Gone as gone:
            if attempt + 1 < _TRIES and read_head(objects, name)[1] != tag:
                continue
            told = f"{below(objects.url, gone.key)} is not there, though a head names it; restore it (vehicle {name})."
            raise WarehouseError(ReasonCode.DAMAGED_FILE, told) from gone
        know_head(root, name, head, None if tag is None else tag.e_tag)
        end_ahead(root, name)
        return head, tag
    raise AssertionError


def begin_ahead(root: Path, name: str) -> None:
    """Note that the copy's files of a vehicle may be ahead of its head from now on."""
    place = root / "remote" / "ahead" / name
    with disk(place, "written"):
        place.parent.mkdir(parents=True, exist_ok=True)
        place.touch()


def end_ahead(root: Path, name: str) -> None:
    """Note that they are what the head says."""
    (root / "remote" / "ahead" / name).unlink(missing_ok=True)


def _take_table(root: Path, objects: Objects, name: str, head: Head, table: str) -> None:
    path, one = _place(root, name, table), head.files.get(table)
    if one is None:
        with disk(path, "removed"):
            path.unlink(missing_ok=True)
            checksum_path(root, path).unlink(missing_ok=True)
    elif not path.exists() or _recorded(root, path) != [one.sha256]:
        write_bytes(path, fetched(objects, one), partial(checksums.recording, root, path))


def _recorded(root: Path, path: Path) -> list[str | None] | None:
    try:
        return checksums.recorded(root, path)
    except BrokenSeal:
        return None
