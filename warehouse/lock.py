"""One writer a vehicle: a lock of the operating system, which ends with the process that holds it."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warehouse.errors import WarehouseError, disk
from warehouse.layout import lock_path, prepare

_RETRY_S = 0.02


@contextmanager
def vehicle_lock(root: Path, vehicle_id: str, timeout_s: float = 300.0) -> Iterator[None]:
    """Hold the vehicle's lock during the block.

    Raises
    ------
    WarehouseError
        `busy`: another process held it for `timeout_s`.
    """
    prepare(root)
    path = lock_path(root, vehicle_id)
    with disk(path, "opened"):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        _acquire(descriptor, path, vehicle_id, timeout_s)
        yield
    finally:
        os.close(descriptor)


def _acquire(descriptor: int, path: Path, vehicle_id: str, timeout_s: float) -> None:
    give_up = time.monotonic() + timeout_s
    while not _locked(descriptor, path):
        if time.monotonic() >= give_up:
            raise WarehouseError(
                "busy",
                f"another process has been publishing vehicle {vehicle_id!r} for {timeout_s:g} s ({path}); try later.",
            )
        time.sleep(_RETRY_S)


def _locked(descriptor: int, path: Path) -> bool:
    with disk(path, "locked"):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True
