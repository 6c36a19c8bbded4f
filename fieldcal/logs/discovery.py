"""Which logs an archive holds, and the identity of a log's content."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol

from fieldcal.logs.csv.folder import folder_layout
from fieldcal.logs.interface import LogFile
from fieldcal.logs.rosbag2.parts import bag_files, is_bag_folder

LOG_FORMATS = {
    ".mcap": "mcap",
    ".mcap.zstd": "mcap",
    ".mcap.zst": "mcap",
    ".csv": "csv",
    ".ulg": "ulog",
    ".bin": "dataflash",
    ".bag": "rosbag1",
    ".bag.active": "rosbag1",
    ".db3": "rosbag2",
    ".db3.zstd": "rosbag2",
    ".db3.zst": "rosbag2",
}
"""End of a log's name → its format."""

TABLE_ENDS = (".tsv", ".txt")
"""Ends of names of tables that are read as csv where somebody names them, by a glob with that end or one by one."""

CSV_FOLDER, BAG_FOLDER = "csv", "rosbag2"
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
    """The format that a path's name promises, or None when it is no log.

    A folder with `imu.csv` or a known exporter's files counts as csv, one with those of a ROS 2 bag as rosbag2.
    """
    if path.is_dir():
        if folder_layout(path) is not None:
            return CSV_FOLDER
        return BAG_FOLDER if is_bag_folder(path) else None
    name = path.name.lower()
    if name.endswith(TABLE_ENDS):
        return "csv"
    return next((kind for end, kind in LOG_FORMATS.items() if name.endswith(end)), None)


def log_sha256(path: Path) -> str:
    """sha256 of a log's content, in hexadecimal.

    A file: of its bytes. A folder: of one line "name NUL sha256" for each of its CSV files, or of the files of its bag,
    sorted by name.
    """
    if not path.is_dir():
        return _file_sha256(path)
    digest = hashlib.sha256()
    for part in sorted(folder_parts(path), key=lambda part: part.name):
        digest.update(os.fsencode(part.name) + b"\0" + _file_sha256(part).encode() + b"\n")
    return digest.hexdigest()


def folder_parts(folder: Path) -> list[Path]:
    """The files of a log folder that are its content: CSV files, or those of a ROS 2 bag."""
    if log_format(folder) == BAG_FOLDER:
        return bag_files(folder)
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
    A session's folder that is a ROS 2 bag is the one log of its session. Hidden names are skipped, and so is what is
    neither file nor folder (a pipe would be read for ever) or lies under a name that is no text.
    Links are followed only while they stay inside the archive, those of a folder's files too.
    """
    root = archive.resolve()
    found: dict[str, LogFile] = {}
    for entry in logs_map or ():
        for path in sorted(archive.glob(entry.glob)):
            if not inside(path, root):  # a folder on the way may be a link
                continue
            if path.suffix.lower() in TABLE_ENDS and not entry.glob.lower().endswith(path.suffix.lower()):
                continue
            folders = path.relative_to(archive).parts[:-1] or (path.stem,)
            _add(found, archive, root, path, entry.vehicle or folders[0], entry.session or folders[-1])
    for vehicle in _folders(archive, root):
        for session in _folders(vehicle, root):
            kind = _format_or_none(session)
            if kind is not None and session.relative_to(archive).as_posix() in found:
                continue
            if kind == BAG_FOLDER:  # its files are no flights of their own
                _add(found, archive, root, session, vehicle.name, session.name)
                continue
            for path in entries(session):
                if path.suffix.lower() in TABLE_ENDS:
                    continue
                _add(found, archive, root, path, vehicle.name, session.name)
    return sorted(found.values(), key=lambda log: log.log_uri)


def _add(found: dict[str, LogFile], archive: Path, root: Path, path: Path, vehicle: str, session: str) -> None:
    if not stays_inside(path, root) or not is_stored(path) or not named_in_text(path.relative_to(archive)):
        return
    try:
        kind = log_format(path)
        if kind is not None and path.is_dir() and not all(inside(part, root) for part in folder_parts(path)):
            return
    except OSError:  # a folder that may not be entered: whoever reads it will say so
        kind = CSV_FOLDER
    log_uri = path.relative_to(archive).as_posix()
    if kind is not None and log_uri not in found:
        found[log_uri] = LogFile(path, log_uri, vehicle, session, kind)


def _format_or_none(path: Path) -> str | None:
    try:
        return log_format(path)
    except OSError:  # a folder that may not be entered
        return None


def _folders(folder: Path, root: Path) -> Iterator[Path]:
    return (path for path in entries(folder) if stays_inside(path, root) and path.is_dir())


def entries(folder: Path) -> list[Path]:
    """What a folder holds, sorted; without hidden names, nothing where it may not be entered."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return []


def is_stored(path: Path) -> bool:
    """Whether a path is a file or folder, or may be one that this user may not look at: no pipe, socket or device."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return True
    return stat.S_ISREG(mode) or stat.S_ISDIR(mode)


def named_in_text(path: Path) -> bool:
    """Whether a name is UTF-8, as all that are stored are: others could not come back as they are."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def inside(path: Path, root: Path) -> bool:
    """Whether a path exists and does not lead out of the resolved folder `root`."""
    try:
        return path.resolve(strict=True).is_relative_to(root)
    except (OSError, RuntimeError):
        return False


def stays_inside(path: Path, root: Path) -> bool:
    """The same of a path whose folder is known to be inside: only a link leads out of it."""
    try:
        return inside(path, root) if path.is_symlink() else path.exists()
    except OSError:  # in a folder that may not be entered
        return False


def _file_sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while piece := stream.read(_READ_BYTES):
            digest.update(piece)
    return digest.hexdigest()
