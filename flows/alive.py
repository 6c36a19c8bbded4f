"""Which flow runs are really running: each holds a lock of the operating system, which ends with its process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldcal.file_locks import fcntl

FOLDER = "prefect/running"


@contextmanager
def alive(root: Path) -> Iterator[None]:
    """Within the block the flow run that this process is in counts as running, for as long as the process lives."""
    from prefect.runtime import flow_run

    run_id = flow_run.get_id()
    if run_id is None:
        yield
        return
    folder = root / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / run_id
    unnamed = folder / f".{run_id}"
    descriptor = os.open(unnamed, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        unnamed.rename(path)  # a run is never seen without its lock
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def dead(root: Path) -> list[Path]:
    """Marks, named by flow run id, of runs whose process died before they ended."""
    folder = root / FOLDER
    marks = sorted(folder.iterdir()) if folder.is_dir() else []
    return [mark for mark in marks if not mark.name.startswith(".") and mark.exists() and not is_held(mark)]


def is_held(path: Path) -> bool:
    """Whether a process holds the lock of this file, alone; one that cannot be opened counts as free."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # two who look do not take each other for the holder
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False
