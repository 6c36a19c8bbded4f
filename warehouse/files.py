"""Files that are whole or not there: temporary file in the same folder, fsync, rename, fsync of the folder."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import Self, TypeAlias
from uuid import uuid4

from fieldcal.file_locks import fcntl
from fieldcal.warehouse.errors import disk

TEMPORARY = ".tmp"
_ABANDONED_AFTER_S = 60.0

AroundRename: TypeAlias = Callable[[str], AbstractContextManager[None]]


class AtomicFile:
    """A file being written beside its final place; `commit` puts it there, leaving the block without it leaves nothing.

    While it is being written it is locked, so that `remove_abandoned` can tell it from one whose writer died.

    Parameters
    ----------
    path : Path
        Final place.
    around_rename : callable, optional
        Given the sha256 of what was written, safe on disk by then: a context within which it gets its final name.
    durable : bool
        False: still whole or absent when a process dies, but after a power cut the file may be torn; for what is
        checked before it is used and can be made again.
    """

    def __init__(self, path: Path, around_rename: AroundRename | None = None, *, durable: bool = True) -> None:
        self.path = path
        self.sha256 = ""
        self.size = 0
        self.closed = False
        self._durable = durable
        self._around_rename = around_rename or _nothing
        self._digest = hashlib.sha256()
        self._temporary = path.with_name(f".{uuid4().hex}{TEMPORARY}")
        with disk(path, "written"):
            make_folder(path.parent, durable=durable)
            self._descriptor = os.open(self._temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX)

    def write(self, data: bytes | memoryview) -> int:
        """Append bytes."""
        if self.closed:
            raise ValueError(f"{self.path} is no longer being written")
        view = memoryview(data).cast("B")
        self._digest.update(view)
        with disk(self.path, "written"):
            rest = view
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        self.size += len(view)
        return len(view)

    def tell(self) -> int:
        """Bytes written so far."""
        return self.size

    def flush(self) -> None:
        """Part of the file interface; `commit` is what makes it durable."""

    def commit(self) -> str:
        """Put the file in its final place; its sha256."""
        self.sha256 = self._digest.hexdigest()
        with disk(self.path, "written"):
            if self._durable:
                os.fsync(self._descriptor)
            with self._around_rename(self.sha256):
                os.replace(self._temporary, self.path)
                if self._durable:
                    sync_folder(self.path.parent)
        self.close()
        return self.sha256

    def close(self) -> None:
        """Release the file; without a `commit` before, nothing of it stays."""
        if not self.closed:
            self.closed = True
            self._temporary.unlink(missing_ok=True)
            os.close(self._descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _nothing(sha256: str) -> AbstractContextManager[None]:
    return nullcontext()


def write_bytes(path: Path, data: bytes, around_rename: AroundRename | None = None, *, durable: bool = True) -> str:
    """Write a whole file, atomically and durably; its sha256. Parameters as in `AtomicFile`."""
    with AtomicFile(path, around_rename, durable=durable) as file:
        file.write(data)
        return file.commit()


def make_folder(folder: Path, *, durable: bool = True) -> None:
    """Make a folder and those above it, each (if `durable`) safe on disk."""
    if folder.is_dir():
        return
    make_folder(folder.parent, durable=durable)
    folder.mkdir(exist_ok=True)
    if durable:
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder safe on disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def file_sha256(path: Path) -> str:
    """sha256 of a file's bytes."""
    with disk(path, "read"), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_abandoned(root: Path) -> int:
    """Remove the temporary files that killed processes left below `root`; how many there were."""
    removed = 0
    for folder, _, names in os.walk(root):
        for name in names:
            if name.startswith(".") and name.endswith(TEMPORARY):
                removed += _remove_if_abandoned(Path(folder, name))
    return removed


def _remove_if_abandoned(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_WRONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if time.time() - os.fstat(descriptor).st_mtime < _ABANDONED_AFTER_S:
            return False
        path.unlink(missing_ok=True)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True
