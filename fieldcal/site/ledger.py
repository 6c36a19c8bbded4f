"""What of the site is written already, and from what: only what changed is made again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from fieldcal.names import Json
from fieldcal.report.fitness import Fitness
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.site.downloads import CONSTANTS
from fieldcal.site.pages import DATA
from fieldcal.site.snapshot import Snapshot
from fieldcal.warehouse.errors import disk
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import SITE, checksum_path, encode_id, history_path
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

FOLDERS = ("", DATA, CONSTANTS)
OF_FLIGHT = ("flight", "calibration", "fit", "sync", "run", "decision")
Files = Mapping[str, tuple[str, int]]
"""Names below the site → sha256 and size."""


class Ledger:
    """Of one vehicle: digests of what its pages were made from, and which files they are. `drawn_of` is the one of all
    its flights' pages together."""

    def __init__(self, root: Path, vehicle_id: str) -> None:
        self.root, self.vehicle_id = root, vehicle_id
        self.of = ""
        self.drawn_of = ""
        self.files: Files = {}
        self.flights: Mapping[str, str] = {}
        self.of_flights: Mapping[str, Files] = {}
        self._path = _path(root, vehicle_id)

    @staticmethod
    def all_of(root: Path) -> dict[str, Ledger]:
        """By vehicle; those that are damaged are left out, so that their pages are made anew."""
        found = (_read(root, path) for path in sorted(folder(root).glob("*.json")))
        return {ledger.vehicle_id: ledger for ledger in found if ledger is not None}

    @staticmethod
    def of_vehicle(root: Path, vehicle_id: str) -> Ledger:
        """As it was written last; an empty one where there is none, or a damaged one."""
        return _read(root, _path(root, vehicle_id)) or Ledger(root, vehicle_id)

    def _fill(self, told: Mapping[str, Json]) -> None:
        flights = cast(Mapping[str, tuple[str, Mapping[str, list[str | int]]]], told["flights"])
        self.files = _files(cast(Mapping[str, list[str | int]], told["files"]))
        self.flights = {flight_id: own[0] for flight_id, own in flights.items()}
        self.of_flights = {flight_id: _files(own[1]) for flight_id, own in flights.items()}
        self.of, self.drawn_of = str(told["of"]), str(told["drawn_of"])

    def remember(self, of: str, files: Files, drawn_of: str, flights: Mapping[str, tuple[str, Files]]) -> None:
        """Remember, once all is written."""
        told = {"vehicle_id": self.vehicle_id, "of": of, "files": files, "drawn_of": drawn_of, "flights": flights}
        write_bytes(self._path, seal(told), durable=False)
        self._fill(cast(Mapping[str, Json], json.loads(json.dumps(told))))

    def forget(self) -> None:
        """Its vehicle is gone."""
        with disk(self._path, "removed"):
            self._path.unlink(missing_ok=True)


class Written:
    """The files of the site: what is there, what stays."""

    def __init__(self, site: Path) -> None:
        self._site = site
        self._sizes = {name: size for part in FOLDERS for name, size in _there(site, part)}
        self._stay: set[str] = set()

    def has(self, files: Files) -> bool:
        """Whether files were written and are there, each with its size."""
        return bool(files) and all(self._sizes.get(name) == size for name, (_, size) in files.items())

    def put(self, files: Mapping[str, bytes], known: Files) -> Files:
        """Write those that are not `known` to be there with this content."""
        told = {}
        for name, content in files.items():
            told[name] = (hashlib.sha256(content).hexdigest(), len(content))
            if known.get(name) != told[name] or self._sizes.get(name) != len(content):
                self._write(name, content)
        return told

    def compare(self, files: Mapping[str, bytes]) -> None:
        """Write those whose content is not there; they stay."""
        for name, content in files.items():
            path = self._site / name
            if not path.is_file() or path.read_bytes() != content:
                self._write(name, content)
        self._stay.update(files)

    def keep(self, ledger: Ledger) -> None:
        """What a ledger lists stays."""
        for files in (ledger.files, *ledger.of_flights.values()):
            self._stay.update(files)

    def remove_others(self) -> None:
        """Remove files of vehicles and flights that are gone."""
        for name in self._sizes.keys() - self._stay:
            with disk(self._site / name, "removed"):
                (self._site / name).unlink(missing_ok=True)

    def _write(self, name: str, content: bytes) -> None:
        write_bytes(self._site / name, content, durable=False)
        self._sizes[name] = len(content)


def folder(root: Path) -> Path:
    """Where nights remember what of the site they wrote."""
    return root / "night" / SITE


def _path(root: Path, vehicle_id: str) -> Path:
    return folder(root) / f"{encode_id(vehicle_id)}.json"


def _read(root: Path, path: Path) -> Ledger | None:
    try:
        told = unseal(path.read_bytes())
        ledger = Ledger(root, str(told["vehicle_id"]))
        ledger._fill(told)
    except (OSError, BrokenSeal, KeyError, TypeError, ValueError):
        return None
    return ledger


def vehicle_digest(snapshot: Snapshot, one: Fitness, code: str) -> str:
    """Digest of all that a vehicle's pages, its flights' too, show: by the records of what its history holds, and of
    that of others that carried its units."""
    told = [code, one.standing, *one.reasons, *(note.sentence for note in one.notes), one.next]
    for vehicle_id in snapshot.sharing_units(one.vehicle_id):
        told += [_record(snapshot.root, table, vehicle_id) for table in HISTORY_TABLES]
    return _joined(told)


def flights_digest(root: Path, vehicle_id: str, flights: Sequence[str], code: str) -> str:
    """Digest of all that the pages of these flights of a vehicle show, by the records of its history."""
    return _joined([code, vehicle_id, *flights, *(_record(root, table, vehicle_id) for table in OF_FLIGHT)])


def flight_digest(snapshot: Snapshot, vehicle_id: str, flight_id: str, code: str) -> str:
    """Digest of all that a flight's page shows."""
    rows = (snapshot.scan(table, vehicle_id=vehicle_id, flight_id=flight_id).collect() for table in OF_FLIGHT)
    return _joined([code, vehicle_id, *(f"{of.columns}{of.rows()}" for of in rows)])


def _record(root: Path, table: str, vehicle_id: str) -> str:
    record = checksum_path(root, history_path(root, table, vehicle_id))
    return f"{table} {record.read_bytes().hex() if record.exists() else None}"


def _joined(texts: list[str]) -> str:
    return hashlib.sha256("\0".join(texts).encode("utf-8", "surrogatepass")).hexdigest()


def _files(told: Mapping[str, list[str | int]]) -> Files:
    return {name: (str(sha256), int(size)) for name, (sha256, size) in told.items()}


def _there(site: Path, part: str) -> list[tuple[str, int]]:
    """Files in a folder of the site: names below the site, and sizes."""
    place = site / part
    if not place.is_dir():
        return []
    with disk(place, "read"), os.scandir(place) as entries:
        found = [(entry.name, entry.stat().st_size) for entry in entries if entry.is_file(follow_symlinks=False)]
    return [(f"{part}/{name}" if part else name, size) for name, size in found if not name.startswith(".")]
