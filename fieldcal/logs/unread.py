"""What lies in an archive and is not read, with the reason: nobody should learn of a lost flight by its absence."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

from fieldcal.logs.discovery import LOG_FORMATS, entries, is_stored, named_in_text, stays_inside

BESIDE_LOGS = (
    "readme*",
    "license*",
    "fieldcal.toml",
    "*.truth.json",
    "*.truth.parquet",
    "sha256sums*",
    "*.db3-wal",
    "*.db3-shm",
    "*.db3-journal",
    "desktop.ini",
    "thumbs.db",
)
"""Names (in lower case) of what nobody takes for a log."""

SESSION = 2
"""Depth of a session's content below the archive."""

UNKNOWN = "no known kind of log"
UNKNOWN_FOLDER = "a folder that is no log"
OUTSIDE = "a link that leads out of the archive or nowhere"
NO_TEXT = "its name is not UTF-8: rename it"
NOT_STORED = "a pipe, socket or device"
MISPLACED = "in no folder of a session, nor named in archive.logs"


@dataclass(frozen=True)
class Unread:
    """A file or folder that is not read. `path`: relative to the archive, with forward slashes."""

    path: str
    why: str


def find_unread(archive: Path, log_uris: Collection[str], session: Path | None = None) -> list[Unread]:
    """What of an archive, or of one session folder of it, is no log; sorted by place.

    Parameters
    ----------
    archive, session : Path
        Root of the archive; the session's folder or None.
    log_uris : collection of str
        The logs that `find_logs` found.
    """
    root = archive.resolve()
    holding = {str(folder) for uri in log_uris for folder in PurePosixPath(uri).parents}
    found = []
    for path, depth in _walk(archive, root, set(log_uris), holding):
        uri = os.fsencode(path.relative_to(archive).as_posix()).decode("utf-8", "backslashreplace")
        if session is not None and not path.parent.resolve().is_relative_to(session.resolve()):
            continue
        if uri in log_uris or any(fnmatch(path.name.lower(), pattern) for pattern in BESIDE_LOGS):
            continue
        if uri in holding and path.is_dir():
            continue
        why = _reason(path, root, depth)
        if why:
            found.append(Unread(uri, why))
    return sorted(found, key=lambda unread: unread.path)


def told(unread: Collection[Unread], most: int = 5) -> str:
    """One line: how many, the first by name with their reasons."""
    listed = ", ".join(f"{one.path} ({one.why})" for one in list(unread)[:most])
    more = f", and {len(unread) - most} more" if len(unread) > most else ""
    what = "file or folder is" if len(unread) == 1 else "files or folders are"
    return f"{len(unread)} {what} not read: {listed}{more}"


def _walk(archive: Path, root: Path, log_uris: Collection[str], holding: Collection[str]) -> Iterator[tuple[Path, int]]:
    """Everything in the archive's folders as deep as a session's content, with its depth: 2 in a session; deeper in
    folders that hold logs."""
    level, depth = [archive], 0
    while level:
        content = [path for folder in level for path in entries(folder)]
        yield from ((path, depth) for path in content if depth >= SESSION or not path.is_dir() or not _named(path))
        level = [
            path
            for path in content
            if stays_inside(path, root)
            and path.is_dir()
            and _named(path)
            and (uri := path.relative_to(archive).as_posix()) not in log_uris
            and (depth < SESSION or uri in holding)
        ]
        depth += 1


def _named(path: Path) -> bool:
    return named_in_text(Path(path.name))


def _reason(path: Path, root: Path, depth: int) -> str | None:
    if not stays_inside(path, root):
        return OUTSIDE
    if not _named(path):
        return NO_TEXT
    if not is_stored(path):
        return NOT_STORED
    if path.is_dir():
        return UNKNOWN_FOLDER if entries(path) else None
    return MISPLACED if depth != SESSION and path.name.lower().endswith(tuple(LOG_FORMATS)) else UNKNOWN
