"""A log and what it is: where it lies, whose it is, which content it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

from fieldcal.remote.content import version_stamp

STAMPS = 4
"""Numbers that tell a file from what it was: size first."""


class PlainJob(TypedDict):
    """A `Job` as plain JSON."""

    path: str
    log_uri: str
    vehicle_id: str
    session_id: str
    log_format: str
    sha256: str | None
    flight_id: str
    stamp: list[int]
    problem: str | None


@dataclass(frozen=True)
class Job:
    """One log of the night, plain values only. `problem`: why its content could not even be hashed."""

    path: str
    log_uri: str
    vehicle_id: str
    session_id: str
    log_format: str
    sha256: str | None
    flight_id: str
    stamp: Sequence[int] = ()
    problem: str | None = None

    @property
    def size_bytes(self) -> int:
        """Of the log, as its stamp tells."""
        return sum(self.stamp[::STAMPS])

    def plain(self) -> PlainJob:
        """Plain JSON; `Job(**plain)` is the job again."""
        return {
            "path": self.path,
            "log_uri": self.log_uri,
            "vehicle_id": self.vehicle_id,
            "session_id": self.session_id,
            "log_format": self.log_format,
            "sha256": self.sha256,
            "flight_id": self.flight_id,
            "stamp": list(self.stamp),
            "problem": self.problem,
        }


def file_stamp(path: Path) -> tuple[int, ...]:
    """Size, times of change and inode of a log's files, or the versions of those that an archive by URL lists: differs
    when somebody wrote to it."""
    return tuple(value for file in (sorted(path.iterdir()) if path.is_dir() else [path]) for value in _stamp(file))


def _stamp(file: Path) -> tuple[int, ...]:
    if (version := version_stamp(file)) is not None:
        return version
    stat = file.stat()
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino
