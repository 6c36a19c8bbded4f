"""What a night has to look at: the logs, what they are, which are copies, and whose settings apply."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from fieldcal.config.configuration import Configuration
from fieldcal.flight.job import Job, file_stamp
from fieldcal.logs import LogFile, find_logs, flight_id, log_sha256
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import ARCHIVES, origin
from fieldcal.remote.content import here
from fieldcal.remote.url import RemoteError

AT_ONCE = 8
Hashed = tuple[tuple[int, ...], str]
"""The stamp of a log's files when they were hashed, and its sha256."""
Ledger = Mapping[str, Hashed]
"""By the path of a log."""


def find_jobs(
    archive: Path,
    configuration: Configuration,
    session: Path | None = None,
    ledger: Ledger | None = None,
    elsewhere: Callable[[LogFile], Hashed | None] | None = None,
) -> list[Job]:
    """All logs of an archive, or of one session folder of it, in the order of their place.

    Each is hashed, unless the `ledger`, or whoever has seen it `elsewhere`, knows it as it is.
    """
    logs: Iterable[LogFile] = find_logs(archive, configuration.logs)
    if session is not None:
        inside = session.resolve()
        logs = (log for log in logs if log.path.resolve().is_relative_to(inside))
    job = partial(_job, ledger=ledger or {}, elsewhere=elsewhere)
    if origin(ARCHIVES, archive) is None:
        return [job(log) for log in logs]
    with ThreadPoolExecutor(AT_ONCE) as threads:  # each that is new is fetched
        return list(threads.map(job, logs))


def _job(log: LogFile, ledger: Ledger, elsewhere: Callable[[LogFile], Hashed | None] | None) -> Job:
    known = (str(log.path), log.log_uri, log.vehicle_id, log.session_id, log.log_format)
    try:
        stamp = file_stamp(log.path)
        remembered = ledger.get(str(log.path)) or (elsewhere(log) if elsewhere else None)
        if remembered and remembered[0] == stamp:
            sha256 = remembered[1]
        else:
            with here(log.path):
                sha256 = log_sha256(log.path)
    except RemoteError as error:
        if error.reason_code != ReasonCode.CHANGED_WHILE_READ:
            raise
        return Job(*known, None, _stand_in(log), problem=error.sentence)
    except OSError as error:
        why = f"{log.log_uri} cannot be read ({error.strerror}). Check its permissions."
        return Job(*known, None, _stand_in(log), problem=why)
    return Job(*known, sha256, flight_id(sha256), stamp)


def _stand_in(log: LogFile) -> str:
    return flight_id(hashlib.sha256(f"unreadable\0{log.log_uri}".encode()).hexdigest())


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
