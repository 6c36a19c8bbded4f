"""A log and what it is: where it lies, whose it is, which content it has."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


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
    stamp: tuple[int, ...] = ()
    problem: str | None = None

    def plain(self) -> dict[str, Any]:
        """Plain JSON; `Job(**plain)` is the job again."""
        return {**asdict(self), "stamp": list(self.stamp)}


def file_stamp(path: Path) -> tuple[int, ...]:
    """Size, times of change and inode of a log's files: differs when somebody wrote to it."""
    stats = [file.stat() for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    return tuple(value for stat in stats for value in (stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino))
