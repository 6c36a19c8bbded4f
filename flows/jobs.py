"""What a night has to look at: the logs, what they are, which are copies, and whose settings apply."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from fieldcal.configuration import Configuration, Vehicle, load, parse
from fieldcal.errors import ConfigurationError
from fieldcal.logs import LogFile, find_logs, flight_id, log_sha256

CONFIG_NAME = "fieldcal.toml"


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


Source = dict[str, str | None]
"""Path and text of a configuration file, as plain JSON: what was read once holds for the whole night."""


def find_source(config: Path | None, archive: Path | None) -> Source:
    """The configuration named, else the archive's own at its root, else none (the defaults).

    Raises
    ------
    ConfigurationError
        The file is wrong, or the named one is not there.
    """
    path = config
    if path is None and archive is not None and (archive / CONFIG_NAME).is_file():
        path = archive / CONFIG_NAME
    if path is None:
        return {"path": None, "text": ""}
    if not path.is_file():
        raise ConfigurationError("config_not_readable", f"{path}: there is no such file.")
    load(path)
    return {"path": str(path), "text": path.read_bytes().decode("utf-8-sig")}


def configuration_of(source: Source) -> Configuration:
    """The configuration from its source."""
    return parse(source["text"] or "", Path(source["path"]) if source["path"] else None)


Ledger = Mapping[str, tuple[tuple[int, ...], str]]
"""Path of a log → the stamp of its files when they were hashed, sha256."""


def find_jobs(
    archive: Path, configuration: Configuration, session: Path | None = None, ledger: Ledger | None = None
) -> list[Job]:
    """All logs of an archive, or of one session folder of it, in the order of their place.

    Each is hashed, unless the `ledger` knows it as it is.
    """
    logs: Iterable[LogFile] = find_logs(archive, configuration.logs)
    if session is not None:
        inside = session.resolve()
        logs = (log for log in logs if log.path.resolve().is_relative_to(inside))
    return [_job(log, ledger or {}) for log in logs]


def file_stamp(path: Path) -> tuple[int, ...]:
    """Size, times of change and inode of a log's files: differs when somebody wrote to it."""
    stats = [file.stat() for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    return tuple(value for stat in stats for value in (stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino))


def _job(log: LogFile, ledger: Ledger) -> Job:
    known = (str(log.path), log.log_uri, log.vehicle_id, log.session_id, log.log_format)
    try:
        stamp = file_stamp(log.path)
        remembered = ledger.get(str(log.path))
        sha256 = remembered[1] if remembered and remembered[0] == stamp else log_sha256(log.path)
    except OSError as error:
        stand_in = flight_id(hashlib.sha256(f"unreadable\0{log.log_uri}".encode()).hexdigest())
        why = f"{log.log_uri} cannot be read ({error.strerror}). Check its permissions."
        return Job(*known, None, stand_in, problem=why)
    return Job(*known, sha256, flight_id(sha256), stamp)


def without_copies(jobs: list[Job], known: dict[str, str], present: set[str]) -> tuple[list[Job], dict[str, str]]:
    """Jobs to look at, and for each copy (by log_uri) the log_uri of the log it is a copy of.

    The first is the one the history knows (`known`: flight_id → log_uri), while it is still `present` in the archive;
    else the one whose place sorts first.
    """
    first: dict[str, str] = {}
    for job in jobs:
        recorded = known.get(job.flight_id)
        first.setdefault(job.flight_id, recorded if recorded in present else job.log_uri)
    kept = [job for job in jobs if first[job.flight_id] == job.log_uri]
    return kept, {job.log_uri: first[job.flight_id] for job in jobs if first[job.flight_id] != job.log_uri}


def with_parameters(vehicle: Vehicle, profile: str | None, changes: Mapping[str, str]) -> Vehicle:
    """A vehicle with a profile's presets and single parameters (name → text) laid over its own.

    Raises
    ------
    ConfigurationError
        An unknown name (the nearest known one is told) or a value that is not allowed.
    """
    lines = ["[defaults]"]
    if profile is not None:
        lines.append(f"profile = {json.dumps(profile)}")
    lines.append("[defaults.parameters]")
    lines += [f"{json.dumps(name)} = {_toml_value(text)}" for name, text in changes.items()]
    given = parse("\n".join(lines), Path("command line")).vehicle(vehicle.vehicle_id)
    over = {name: given.parameters[name] for name in changes}
    base = dict(vehicle.parameters)
    if profile is not None:
        base |= {name: value for name, value in given.parameters.items() if name not in changes}
    return replace(vehicle, profile=profile or vehicle.profile, parameters={**base, **over})


def _toml_value(text: str) -> str:
    """Text of a parameter as TOML: numbers and true/false as they are, the rest quoted."""
    if text in ("true", "false"):
        return text
    try:
        float(text)
    except ValueError:
        return json.dumps(text)
    return text
