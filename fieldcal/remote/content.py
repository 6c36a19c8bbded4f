"""Content of logs in copies of archives: fetched once, kept while it is in use, and as long as there is room."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from fieldcal.file_locks import fcntl
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import ARCHIVES, FOLDER, cache_root, most_bytes, origin
from fieldcal.remote.objects import Listed, Objects
from fieldcal.remote.url import RemoteError, below

HOLDER, CONTENT = 0o200, 0o600
"""Modes of a file in a copy of an archive: by them it is told whether the content is there."""
SECOND_NS = 1_000_000_000
FETCHED = "fetched"
"""Folder of notes, one for each file whose content is there."""


@contextmanager
def here(log: Path) -> Iterator[None]:
    """Have the content of a log, a file or a folder of files, at its place during the block; of a log that lies in no
    copy of an archive nothing is done.

    Raises
    ------
    RemoteError
        As `Objects`; `changed_while_read`: the object is another than was listed.
    """
    copy = origin(ARCHIVES, log)
    with ExitStack() as held:
        if copy is not None:
            for file in sorted(log.iterdir()) if log.is_dir() else [log]:
                if file.is_file() and not file.name.startswith("."):
                    held.enter_context(_in_use(file, *copy))
        yield


@contextmanager
def _in_use(file: Path, folder: Path, url: str) -> Iterator[None]:
    """Keep a file's content from being removed during the block. Whoever fetches or removes it has the file's lock
    alone, and puts another file in its place."""
    while True:
        descriptor = os.open(file, os.O_WRONLY | os.O_CLOEXEC)
        try:
            told = os.fstat(descriptor)
            there = bool(told.st_mode & 0o400)
            fcntl.flock(descriptor, fcntl.LOCK_SH if there else fcntl.LOCK_EX)
            if not file.exists() or file.stat().st_ino != told.st_ino:
                continue
            if there:
                os.utime(file, ns=(time.time_ns(), told.st_mtime_ns))
                yield
                if not file.exists() or file.stat().st_ino != told.st_ino:
                    raise _changed(url, file.relative_to(folder).as_posix())
                return
            _fetch(file, folder, url, told)
        finally:
            os.close(descriptor)


def version_stamp(file: Path) -> tuple[int, ...] | None:
    """What tells the version of a file in a copy of an archive, its content fetched or not; None of any other file."""
    if origin(ARCHIVES, file) is None:
        return None
    told = file.stat()
    return told.st_size, told.st_mtime_ns, told.st_mtime_ns, 0


def version_ns(one: Listed) -> int:
    """The time of change that stands for a version of an object."""
    digest = hashlib.sha256(f"{one.e_tag}\0{one.size}".encode()).digest()
    return int(one.modified.timestamp()) * SECOND_NS + int.from_bytes(digest[:8], "big") % SECOND_NS


def _fetch(file: Path, folder: Path, url: str, told: os.stat_result) -> None:
    key = file.relative_to(folder).as_posix()
    beside = file.with_name(f".{uuid4().hex}")
    try:
        found = Objects(url).fetch(key, beside)
        if found is None or (found[0].size, version_ns(found[0])) != (told.st_size, told.st_mtime_ns):
            raise _changed(url, key)
        if beside.stat().st_size != told.st_size:
            raise RemoteError(ReasonCode.STORE_ERROR, f"{below(url, key)} came shorter than it is; run it again.")
        os.chmod(beside, CONTENT)
        os.utime(beside, ns=(time.time_ns(), told.st_mtime_ns))
        _note(file)
        beside.replace(file)
    except OSError as error:
        why = f"{error.strerror or error}: free some space, or set {FOLDER} to another place"
        raise RemoteError(ReasonCode.DISK_ERROR, f"{file} cannot be written ({why}).") from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
    _make_room(file)


def _changed(url: str, key: str) -> RemoteError:
    told = f"{below(url, key)} was replaced or removed after it was listed; the next night takes it as it is then."
    return RemoteError(ReasonCode.CHANGED_WHILE_READ, told)


def _note(file: Path) -> None:
    notes = cache_root() / FETCHED
    notes.mkdir(mode=0o700, parents=True, exist_ok=True)
    (notes / hashlib.sha256(os.fsencode(file)).hexdigest()[:32]).write_bytes(os.fsencode(file))


def _make_room(newest: Path) -> None:
    """Remove content that nobody uses, what was used longest ago first, until the rest is small enough."""
    kept = []
    for note in (cache_root() / FETCHED).iterdir():
        with suppress(OSError):
            file = Path(os.fsdecode(note.read_bytes()))
            told = file.stat()
            if told.st_mode & 0o400:
                kept.append((told.st_atime_ns, told.st_size, file, note))
    held = sum(size for _, size, _, _ in kept)
    for _, size, file, note in sorted(kept):
        if held <= most_bytes():
            return
        if file != newest and _removed(file):
            note.unlink(missing_ok=True)
            held -= size


def _removed(file: Path) -> bool:
    """Put a file without content in a file's place, unless it is in use."""
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        told = os.fstat(descriptor)
        if file.stat().st_ino != told.st_ino:
            return False
        stand_in(file, told.st_size, told.st_mtime_ns)
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)


def stand_in(path: Path, size: int, version: int) -> None:
    """Put a file without content in a place, or in another's: of this size and time of change."""
    beside = path.with_name(f".{uuid4().hex}")
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, HOLDER)
    os.truncate(descriptor, size)
    os.close(descriptor)
    os.utime(beside, ns=(0, version))
    beside.replace(path)
