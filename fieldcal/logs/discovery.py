"""Which logs an archive holds, and the identity of a log's content."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol

from fieldcal.logs.interface import LogFile

LOG_FORMATS = {".mcap": "mcap", ".csv": "csv", ".ulg": "ulog", ".bin": "dataflash"}
FOLDER_FORMAT = "csv"
_READ_BYTES = 1 << 20


class LogsEntry(Protocol):
    """A glob relative to the archive, and the vehicle and session of what it matches (`configuration.LogsMap`)."""

    @property
    def glob(self) -> str: ...
    @property
    def vehicle(self) -> str | None: ...
    @property
    def session(self) -> str | None: ...


def log_format(path: Path) -> str | None:
    """The format that a path's name promises (a folder with `imu.csv` counts as csv), or None when it is no log."""
    if path.is_dir():
        return FOLDER_FORMAT if (path / "imu.csv").is_file() else None
    return LOG_FORMATS.get(path.suffix.lower())


def log_sha256(path: Path) -> str:
    """sha256 of a log's content, in hexadecimal.

    A file: of its bytes. A folder: of one line "name NUL sha256" for each of its CSV files, sorted by name.
    """
    if not path.is_dir():
        return _file_sha256(path)
    digest = hashlib.sha256()
    for part in sorted(folder_parts(path), key=lambda part: part.name):
        digest.update(os.fsencode(part.name) + b"\0" + _file_sha256(part).encode() + b"\n")
    return digest.hexdigest()


def folder_parts(folder: Path) -> list[Path]:
    """The CSV files of a log folder."""
    return [part for part in folder.iterdir() if part.suffix.lower() == ".csv" and part.is_file()]


def flight_id(sha: str) -> str:
    """The flight a content hash names: its first 16 hexadecimal digits."""
    return sha[:16]


def find_logs(archive: Path, logs_map: Iterable[LogsEntry] | None = None) -> list[LogFile]:
    """All logs of an archive, sorted by their place in it.

    Parameters
    ----------
    archive : Path
        Root of the archive: `ARCHIVE/<vehicle_id>/<session_id>/<log>`.
    logs_map : iterable of LogsEntry, optional
        For archives of another shape (`Configuration.logs`). A log matched here takes vehicle and session from the
        first entry that matches; where an entry leaves one open, from the outermost and the innermost folder that the
        log lies in, or from its own name when it lies in none.

    Notes
    -----
    Hidden names are skipped. Links are followed only while they stay inside the archive, those of a folder's files too.
    """
    root = archive.resolve()
    found: dict[str, LogFile] = {}
    for entry in logs_map or ():
        for path in sorted(archive.glob(entry.glob)):
            folders = path.relative_to(archive).parts[:-1] or (path.stem,)
            _add(found, archive, root, path, entry.vehicle or folders[0], entry.session or folders[-1])
    for vehicle in _folders(archive, root):
        for session in _folders(vehicle, root):
            if log_format(session) is not None and session.relative_to(archive).as_posix() in found:
                continue
            for path in _entries(session):
                _add(found, archive, root, path, vehicle.name, session.name)
    return sorted(found.values(), key=lambda log: log.log_uri)


def _add(found: dict[str, LogFile], archive: Path, root: Path, path: Path, vehicle: str, session: str) -> None:
    if not _inside(path, root):
        return
    try:
        kind = log_format(path)
        if kind is not None and path.is_dir() and not all(_inside(part, root) for part in folder_parts(path)):
            return
    except OSError:  # a folder that may not be entered: whoever reads it will say so
        kind = FOLDER_FORMAT
    log_uri = path.relative_to(archive).as_posix()
    if kind is not None and log_uri not in found:
        found[log_uri] = LogFile(path, log_uri, vehicle, session, kind)


def _folders(folder: Path, root: Path) -> Iterator[Path]:
    return (path for path in _entries(folder) if _inside(path, root) and path.is_dir())


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return []


def _inside(path: Path, root: Path) -> bool:
    try:
        return path.resolve(strict=True).is_relative_to(root)
    except (OSError, RuntimeError):
        return False


def _file_sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while piece := stream.read(_READ_BYTES):
            digest.update(piece)
    return digest.hexdigest()
