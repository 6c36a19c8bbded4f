"""A change of one vehicle's files, alone: under its lock, and by URL as if nobody else had written meanwhile."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import TypeVar

from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.objects import Objects, Tag
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse import checksums
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.layout import encode_id, history_path
from fieldcal.warehouse.lock import vehicle_lock
from fieldcal.warehouse.remote.copy import begin_ahead, end_ahead, take_head
from fieldcal.warehouse.remote.handed_over import published
from fieldcal.warehouse.remote.heads import Head, Kept, head_key, read_head
from fieldcal.warehouse.remote.known import in_threads, know_head, objects_of
from fieldcal.warehouse.remote.signals import with_own_signals
from fieldcal.warehouse.sealed import seal

T = TypeVar("T")
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.05, 2.0


def in_turn(
    root: Path, vehicle_id: str, change: Callable[[], T], *, flights: Collection[str] = (), timeout_s: float = 300.0
) -> T:
    """Carry out a change of a vehicle's files below `root`; what it returned.

    By URL: on the latest files, uploaded under names of their own, then named by the vehicle's head if that is still
    the one that was followed; else all over again on the files of whoever was faster. So `change` may be called
    repeatedly, each time on files as published. Killed at any moment, it leaves what was there, or the whole change.

    Parameters
    ----------
    flights : collection of str
        Flights whose readings belong to the change.

    Raises
    ------
    RemoteError, WarehouseError
        `busy`: another process on this machine, or others by URL again and again, wrote for `timeout_s`.
    """
    with vehicle_lock(root, vehicle_id, timeout_s):
        objects = objects_of(root)
        if objects is None:
            return change()
        name, give_up, wait_s = encode_id(vehicle_id), time.monotonic() + timeout_s, _FIRST_WAIT_S
        while time.monotonic() < give_up:
            before, tag = take_head(root, objects, name, vehicle_id)
            begin_ahead(root, name)
            result = change()
            if _committed(root, objects, before, tag, flights):
                end_ahead(root, name)
                published(root, vehicle_id, flights)
                return result
            time.sleep(random.uniform(0.0, wait_s))
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
    told = f"others have been publishing vehicle {vehicle_id!r} at {objects.url} for {timeout_s:g} s; try later."
    raise WarehouseError(ReasonCode.BUSY, told)


def _committed(root: Path, objects: Objects, before: Head, tag: Tag | None, flights: Collection[str]) -> bool:
    """Have the head name the files as they are in the copy; False where another was faster."""
    name, vehicle_id = encode_id(before.vehicle_id), before.vehicle_id
    files: dict[str, Kept] = {}
    fresh: list[tuple[str, bytes | Path]] = []
    for table in HISTORY_TABLES:
        path = history_path(root, table, vehicle_id)
        if not path.exists():
            continue
        sha256, was = checksums.assured(root, path), before.files.get(table)
        if was is not None and was.sha256 == sha256:
            files[table] = was
        else:
            files[table] = Kept.new(sha256, path.stat().st_size)
            fresh.append((files[table].key, path))
    signals, own = with_own_signals(root, objects, before, flights) if files else (None, [])
    if files == before.files and signals == before.signals:
        return True
    in_threads(partial(_put, objects), [*fresh, *own])
    head = before.next(files, signals)
    e_tag = objects.swap(head_key(name), seal(head.plain()), tag)
    if e_tag is None:  # refused, or won by a try whose answer was lost
        now, its_tag = read_head(objects, name)
        if now.written != head.written or its_tag is None:
            return False
        e_tag = its_tag.e_tag
    know_head(root, name, head, e_tag)
    return True


def _put(objects: Objects, one: tuple[str, bytes | Path]) -> None:
    objects.put(*one)
