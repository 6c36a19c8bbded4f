"""By URL: what nights on other machines found whole, so that one with an empty copy has nothing to do either.

An object a vehicle, `night/<vehicle>.json`. It is replaced without asking and may be deleted at any time: what it lacks
is read and calibrated again, with the same results. What it says of a flight holds only while the history has the very
results that it was said of.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TypedDict, cast

import polars as pl

from fieldcal.batch.documents import LogEntry
from fieldcal.batch.jobs import Hashed
from fieldcal.flight.job import Job
from fieldcal.logs import LogFile
from fieldcal.remote.cache import ARCHIVES, called, origin
from fieldcal.remote.objects import Objects
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.layout import encode_id
from fieldcal.warehouse.remote.known import in_threads, objects_of
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal


class Told(TypedDict):
    """A flight, as a night told it. `of`: digest of what its results follow from; `archive`, `stamp`: the URL where
    its log was listed, and as what; `runs`: the executions that its rows come from."""

    of: str
    archive: str
    stamp: list[int]
    sha256: str
    runs: list[str]
    entry: LogEntry


class Shared:
    """What is told of flights at the URL of a warehouse; nothing where it is on this machine.

    Parameters
    ----------
    root : Path
        Data root of the warehouse.
    """

    def __init__(self, root: Path) -> None:
        self._root, self._objects = root, objects_of(root)
        self._told: dict[str, Mapping[str, Told]] = {}
        self._by_place: dict[str, Mapping[tuple[str, str], Told]] = {}
        self._runs: dict[str, Mapping[str, list[str]]] = {}
        self._asking = Lock()

    def log(self, archive: Path, log: LogFile) -> Hashed | None:
        """Stamp and sha256 of a log of an archive by URL, where a night hashed it."""
        if self._objects is None or origin(ARCHIVES, archive) is None:
            return None
        self._of_vehicle(self._objects, log.vehicle_id)
        told = self._by_place[log.vehicle_id].get((called(archive), log.log_uri))
        return None if told is None else (tuple(told["stamp"]), told["sha256"])

    def entry(self, job: Job, of: str) -> LogEntry | None:
        """What to say of a flight of which all is as it was told, its rows in the history too."""
        if self._objects is None:
            return None
        told = self._of_vehicle(self._objects, job.vehicle_id).get(job.flight_id)
        if told is None or told["of"] != of:
            return None
        if job.vehicle_id not in self._runs:
            self._runs[job.vehicle_id] = _runs(self._root, job.vehicle_id)
        return told["entry"] if self._runs[job.vehicle_id].get(job.flight_id) == told["runs"] else None

    def tell(self, archive: Path, flights: Iterable[tuple[Job, str, LogEntry]]) -> None:
        """Tell others of flights that were found whole and are published, with what their results follow from."""
        if self._objects is None:
            return
        where = "" if origin(ARCHIVES, archive) is None else called(archive)
        fresh: dict[str, dict[str, Told]] = {}
        for job, of, entry in flights:
            if job.vehicle_id not in fresh:
                fresh[job.vehicle_id], runs = {}, _runs(self._root, job.vehicle_id)
            fresh[job.vehicle_id][job.flight_id] = {
                "of": of,
                "archive": where,
                "stamp": list(job.stamp),
                "sha256": str(job.sha256),
                "runs": runs.get(job.flight_id, []),
                "entry": entry,
            }
        in_threads(partial(_add, self._objects), list(fresh.items()))

    def _of_vehicle(self, objects: Objects, vehicle_id: str) -> Mapping[str, Told]:
        with self._asking:
            if vehicle_id not in self._told:
                found = self._told[vehicle_id] = _read(objects, vehicle_id)
                places = {(told["archive"], told["entry"]["log_uri"]): told for told in found.values()}
                self._by_place[vehicle_id] = places
            return self._told[vehicle_id]


def _add(objects: Objects, one: tuple[str, Mapping[str, Told]]) -> None:
    vehicle_id, flights = one
    objects.put(_key(vehicle_id), seal({"flights": {**_read(objects, vehicle_id), **flights}}))


def _read(objects: Objects, vehicle_id: str) -> Mapping[str, Told]:
    found = objects.get(_key(vehicle_id))
    try:
        return {} if found is None else cast(Mapping[str, Told], unseal(found[0])["flights"])
    except (BrokenSeal, KeyError):
        return {}


def _runs(root: Path, vehicle_id: str) -> Mapping[str, list[str]]:
    """The executions that each flight's rows come from."""
    rows = Warehouse(root).scan("run", vehicle_id=vehicle_id)
    names = pl.format("{} {} {} {}", "unit_id", "stage", "run_key", "status")
    found = rows.group_by("flight_id").agg(names.fill_null("").sort()).collect()
    return dict(found.iter_rows())


def _key(vehicle_id: str) -> str:
    return f"night/{encode_id(vehicle_id)}.json"
