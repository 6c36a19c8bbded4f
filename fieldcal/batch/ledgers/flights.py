"""What the last night found whole: flights whose results need not be looked at again.

Of each flight it is remembered what its results follow from, which files they are with their size, times and inode, and
what the night says of it. Where all of that is as it was, and the history of its vehicle too, the flight is done:
a thousand flights cost some tenths of a second. What changes a byte without changing its file's times is for
`fieldcal verify` to find. A file a vehicle, `night/seen/<vehicle>.json`, which may be deleted at any time: a night
never has those of a whole fleet at hand.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypedDict, cast

from fieldcal.batch.documents import LogEntry
from fieldcal.batch.ledgers.shared import Shared
from fieldcal.batch.limits import why_ended
from fieldcal.batch.outcome import Outcome
from fieldcal.batch.sources import sources
from fieldcal.config.configuration import Configuration
from fieldcal.flight.job import Job, PlainJob
from fieldcal.flight.record import Record
from fieldcal.flight.versions import versions
from fieldcal.provenance.run_key import library_versions
from fieldcal.schemas import FLIGHT_TABLES
from fieldcal.stages.pipeline import INGEST
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import checksum_path, encode_id, history_path, signal_path, stage_folder
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal
from fieldcal.warehouse.stage_store import RECORD


class Seen(TypedDict):
    """A flight. `of`: digest of what its results follow from; `files`: below the data root; `as_they_were`: digest of
    their stamps; `entry`: its place in the JSON of a night that has nothing to do for it."""

    of: str
    files: list[str]
    as_they_were: str
    entry: LogEntry


class Ledger:
    """What is remembered, asked about one flight after the other."""

    def __init__(self, root: Path, configuration: Configuration, shared: Shared | None = None) -> None:
        self._root, self._configuration, self._shared = root, configuration, shared
        self._read: tuple[str | None, Mapping[str, Seen], str | None] = None, {}, None
        self._common = _common(configuration)
        self._vehicles: dict[str, str] = {}
        self._same_history: dict[str, bool] = {}

    def entry(self, job: Job) -> LogEntry | None:
        """What to say of a flight of which everything is as it was; None of any other."""
        known = self._of_flights(job.vehicle_id)[0].get(job.flight_id)
        if known is not None and self._is_as_it_was(job, known):
            return known["entry"]
        return None if self._shared is None else self._shared.entry(job, self._of_content(job))

    def whole(self, outcomes: Iterable[Outcome]) -> Iterator[tuple[Job, str, LogEntry]]:
        """Of flights all of whose results were kept: what they follow from, and what to say of them."""
        for outcome in outcomes:
            if (seen := self._seen(outcome)) is not None:
                yield outcome.job, self._of_content(outcome.job), seen["entry"]

    def remember(self, outcomes: Iterable[Outcome], done: Mapping[str, LogEntry]) -> None:
        """Remember a night's flights: the outcomes, all of whose results were kept, and those that were `done`."""
        by_vehicle: dict[str, tuple[list[str], list[Outcome]]] = {}
        for flight_id, entry in done.items():
            by_vehicle.setdefault(entry["vehicle_id"], ([], []))[0].append(flight_id)
        for outcome in outcomes:
            by_vehicle.setdefault(outcome.job.vehicle_id, ([], []))[1].append(outcome)
        for vehicle_id, (as_before, others) in by_vehicle.items():
            known, of_history = self._of_flights(vehicle_id)
            flights = {flight_id: known[flight_id] for flight_id in as_before if flight_id in known}
            seen = {outcome.job.flight_id: self._seen(outcome) for outcome in others}
            flights |= {flight_id: one for flight_id, one in seen.items() if one is not None}
            history = _history(self._root, vehicle_id)
            if flights != known or history != of_history:
                sealed = seal({"flights": flights, "history": history})
                write_bytes(_place(self._root, vehicle_id), sealed, durable=False)
        (self._root / "night" / "seen.json").unlink(missing_ok=True)  # of an older release, for the whole fleet
        self._read = None, {}, None

    def as_they_were(self, flights: Mapping[str, str]) -> dict[str, str]:
        """Those of the flights (flight_id → vehicle_id) whose results are as they were when they were remembered."""
        by_vehicle = sorted(flights.items(), key=lambda flight: flight[1])
        known = {one: self._of_flights(vehicle_id)[0].get(one) for one, vehicle_id in by_vehicle}
        return {
            one: flights[one]
            for one, seen in known.items()
            if seen is not None and _stamps(self._root, seen["files"]) == seen["as_they_were"]
        }

    def let_go(self, flights: Mapping[str, str]) -> None:
        """Remember flights (flight_id → vehicle_id) whose results were removed since as they are now: there is nothing
        to do for them."""
        for vehicle_id in sorted(set(flights.values())):
            known, history = self._of_flights(vehicle_id)
            own = {one: known[one] for one, whose in flights.items() if whose == vehicle_id}
            of_now = {one: {**seen, "as_they_were": _stamps(self._root, seen["files"])} for one, seen in own.items()}
            sealed = seal({"flights": {**known, **of_now}, "history": history})
            write_bytes(_place(self._root, vehicle_id), sealed, durable=False)
        self._read = None, {}, None

    def _of_flights(self, vehicle_id: str) -> tuple[Mapping[str, Seen], str | None]:
        """A vehicle's flights, and the digest of its history; those of the last vehicle asked about are at hand."""
        if self._read[0] != vehicle_id:
            try:
                found = unseal(_place(self._root, vehicle_id).read_bytes())
                own = cast(Mapping[str, Seen], found["flights"]), str(found["history"])
                self._read = vehicle_id, *own
            except (OSError, BrokenSeal, KeyError):
                self._read = vehicle_id, {}, None
        return self._read[1], self._read[2]

    def _seen(self, outcome: Outcome) -> Seen | None:
        job, records = outcome.job, outcome.records
        vehicle = self._configuration.vehicle(job.vehicle_id)
        if any(record.get("unkept") or record["run_key"] is None for record in records.values()):
            return None
        if why_ended(self._root, job, vehicle, self._configuration.limits):
            return None
        files = sorted(_files(self._root, job, records))
        entry: LogEntry = {**outcome.entry(), "stages_run": 0, "stages_cached": len(records), "ran": {}}
        of = self._of(job.plain())
        return {"of": of, "files": files, "as_they_were": _stamps(self._root, files), "entry": entry}

    def _of(self, job: PlainJob) -> str:
        """Digest of what a flight's results, and what is said of it, follow from."""
        vehicle_id = job["vehicle_id"]
        if (vehicle := self._vehicles.get(vehicle_id)) is None:
            vehicle = self._vehicles[vehicle_id] = self._configuration.vehicle(vehicle_id).model_dump_json()
        return _digest([job, vehicle, self._common])

    def _is_as_it_was(self, job: Job, known: Seen) -> bool:
        if known["of"] != self._of(job.plain()):
            return False
        return self._history_is_same(job.vehicle_id) and _stamps(self._root, known["files"]) == known["as_they_were"]

    def _of_content(self, job: Job) -> str:
        """What its results follow from wherever its log lies."""
        return self._of({**job.plain(), "path": "", "stamp": []})

    def _history_is_same(self, vehicle_id: str) -> bool:
        if vehicle_id not in self._same_history:
            known = self._of_flights(vehicle_id)[1]
            self._same_history[vehicle_id] = known is not None and known == _history(self._root, vehicle_id)
        return self._same_history[vehicle_id]


def _common(configuration: Configuration) -> str:
    """Digest of what every flight's results follow from."""
    return _digest([dict(sources()), versions(), library_versions(), configuration.limits.model_dump_json()])


def _digest(parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _files(root: Path, job: Job, records: Mapping[str, Record]) -> Iterable[str]:
    for step, record in records.items():
        folder = stage_folder(root, step, job.flight_id, str(record["run_key"]))
        yield str((folder / RECORD).relative_to(root))
        for output in record["outputs"].values():
            if "file" in output:
                yield str((folder / output["file"]).relative_to(root))
    for table in records[INGEST]["signals"]:
        path = signal_path(root, table, job.vehicle_id, job.flight_id)
        yield from (str(one.relative_to(root)) for one in (path, checksum_path(root, path)))


def _stamps(root: Path, files: Sequence[str]) -> str:
    """Digest of the files' sizes, times and inodes; one that is absent is none."""
    digest, folder = hashlib.sha256(), os.fspath(root)
    for file in files:
        try:
            stat = os.stat(os.path.join(folder, file))  # fifty of a flight: path objects took longer than the system
        except OSError:
            digest.update(f"{file}\\0".encode("utf-8", "surrogateescape"))
            continue
        stamp = (stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino)
        digest.update(f"{file}\\0{stamp}\\0".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _history(root: Path, vehicle_id: str) -> str:
    """Digest of what is recorded of a vehicle's history, and of its files' stamps."""
    paths = [history_path(root, table, vehicle_id) for table in FLIGHT_TABLES]
    files = [path for path in paths for path in (path, checksum_path(root, path))]
    return _stamps(root, [str(path.relative_to(root)) for path in files])


def _place(root: Path, vehicle_id: str) -> Path:
    return root / "night" / "seen" / f"{encode_id(vehicle_id)}.json"
