"""The copy of an archive: every object as a file below one folder, whose content is fetched when it is needed.

Until then the file holds nothing that can be read: it has the object's size, and its time of change tells which version
of the object it stands for (the object's own time, and in the nanoseconds a digest of its tag). Content that is fetched
has the same size and time. So a night knows again, without fetching it, a log that it has seen.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from fieldcal.file_locks import fcntl
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import ARCHIVES, note_copy
from fieldcal.remote.content import here, stand_in, version_ns
from fieldcal.remote.objects import Listed, Objects
from fieldcal.remote.url import RemoteError, checked

READ_AT_ONCE = 1 << 20
"""Bytes of a file that is no log, and is fetched with the listing: settings, the description of a bag."""
AT_ONCE = (".toml", ".yaml")
LONGEST_NAME = 255


def local_archive(url: str) -> Path:
    """Bring the copy of an archive up to what its URL lists; its folder.

    Raises
    ------
    RemoteError
        As `Objects`; `no_archive`: nothing lies there.
    """
    url = checked(url)
    listed = {one.key: one for one in Objects(url).listed() if _can_be_a_file(one.key)}
    folders = {parent.as_posix() for key in listed for parent in PurePosixPath(key).parents}
    listed = {key: one for key, one in listed.items() if key not in folders}
    if not listed:
        raise RemoteError(ReasonCode.NO_ARCHIVE, f"There is no archive at {url}: nothing lies below it.")
    folder = note_copy(ARCHIVES, url)
    folder.mkdir(mode=0o700, exist_ok=True)
    with arranged(folder):
        _remove_others(folder, listed)
        for key, one in listed.items():
            stand_for(folder / key, one.size, version_ns(one))
    for key, one in listed.items():
        if key.endswith(AT_ONCE) and one.size <= READ_AT_ONCE:
            with here(folder / key):
                pass
    return folder


@contextmanager
def arranged(folder: Path) -> Iterator[None]:
    """During the block nobody else puts or removes places of a copy."""
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _can_be_a_file(key: str) -> bool:
    """Whether a key names a place below a folder, as a file there may be called; hidden ones are no logs."""
    names = key.split("/")
    fits = all(name and not name.startswith(".") and len(os.fsencode(name)) <= LONGEST_NAME for name in names)
    return fits and "\0" not in key and str(PurePosixPath(key)) == key


def stand_for(path: Path, size: int, version: int) -> None:
    """Make sure that a file stands for this version of an object (`content.version_ns`), fetched or not."""
    with suppress(OSError):
        told = path.stat()
        if (told.st_size, told.st_mtime_ns) == (size, version):
            return
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    stand_in(path, size, version)


def _remove_others(folder: Path, listed: dict[str, Listed]) -> None:
    """Remove what is listed no longer, so that every key that is has its place: deepest first."""
    for parent, folders, names in os.walk(folder, topdown=False):
        own = Path(parent)
        for name in names:
            file = own / name
            if not name.startswith(".") and file.relative_to(folder).as_posix() not in listed:
                file.unlink(missing_ok=True)
        for name in folders:
            with suppress(OSError):
                (own / name).rmdir()
