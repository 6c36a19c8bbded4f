"""A data root for the time of a batch, in this machine's caches; those of processes that died are removed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from fieldcal.file_locks import fcntl
from fieldcal.remote.cache import cache_root

FOLDER = "batches"


@contextmanager
def own_root() -> Iterator[Path]:
    """A folder that nobody else uses, gone after the block. It is locked as long as its process lives."""
    folder = cache_root() / FOLDER
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _remove_dead(folder)
    root = folder / uuid4().hex
    unnamed = folder / f".{root.name}"
    unnamed.mkdir(mode=0o700)
    descriptor = os.open(unnamed, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        unnamed.rename(root)  # never seen without its lock
        yield root
    finally:
        shutil.rmtree(root, ignore_errors=True)
        os.close(descriptor)


def _remove_dead(folder: Path) -> None:
    for root in folder.glob("[!.]*"):
        try:
            descriptor = os.open(root, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:  # its batch ended meanwhile
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(root, ignore_errors=True)
        except OSError:  # its process lives
            pass
        finally:
            os.close(descriptor)
