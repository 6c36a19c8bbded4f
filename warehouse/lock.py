"""One writer a vehicle, and one for the fleet: locks of the operating system, which end with their process."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldcal.file_locks import fcntl
from fieldcal.reason_codes import ReasonCode
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.layout import LOCK, lock_path, prepare

_RETRY_S = 0.02


@contextmanager
def vehicle_lock(root: Path, vehicle_id: str, timeout_s: float = 300.0) -> Iterator[None]:
    """Hold the vehicle's lock during the block.

    Raises
    ------
    WarehouseError
        `busy`: another process held it for `timeout_s`.
    """
    with _lock(root, lock_path(root, vehicle_id), f"publishing vehicle {vehicle_id!r}", timeout_s):
        yield


@contextmanager
def named_lock(root: Path, name: str, timeout_s: float = 300.0) -> Iterator[None]:
    """The same lock, of a vehicle by its name in paths."""
    with _lock(root, root / f"{LOCK}{name}", f"publishing vehicle {name!r}", timeout_s):
        yield


@contextmanager
def fleet_lock(root: Path, timeout_s: float = 3600.0) -> Iterator[None]:
    """Hold the lock of what concerns the whole fleet, its trends, during the block; raises as `vehicle_lock`."""
    with _lock(root, root / ".fleet-lock", "working on the fleet's trends", timeout_s):
        yield


@contextmanager
def _lock(root: Path, path: Path, doing: str, timeout_s: float) -> Iterator[None]:
    prepare(root)
    with disk(path, "opened"):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        give_up = time.monotonic() + timeout_s
        while not _locked(descriptor, path):
            if time.monotonic() >= give_up:
                what = f"another process has been {doing} for {timeout_s:g} s ({path}); try later."
                raise WarehouseError(ReasonCode.BUSY, what)
            time.sleep(_RETRY_S)
        yield
    finally:
        os.close(descriptor)


def _locked(descriptor: int, path: Path) -> bool:
    with disk(path, "locked"):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True
