"""What another machine computed, by way of the store: readings as objects that a head will name, all else in one pack.

Readings are most of the bytes. They go where they stay, and the machine that publishes them is told their names; it
need not have them. A pack has what the stages left behind, and is put into that machine's own cache of stages, as if
they had run there. Packs lie under `handed-over/` and go when they were taken, or with other garbage.
"""

from __future__ import annotations

import re
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, TypedDict, cast
from uuid import uuid4
from zipfile import ZipFile

from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.objects import Objects
from fieldcal.remote.url import RemoteError, below
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.files import file_sha256, write_bytes
from fieldcal.warehouse.layout import SIGNAL_PARTITION, checksum_path, encode_id
from fieldcal.warehouse.remote.heads import GRACE, HANDED_OVER, PLACE, Kept
from fieldcal.warehouse.remote.known import fetched, in_threads
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

_MEMBER = re.compile(r"stages(/[A-Za-z0-9%~_-][A-Za-z0-9%~._-]*){4}")
_FORGOTTEN_AFTER_S = GRACE.total_seconds() / 2
"""Objects that no head names yet may go when they are as old as `GRACE`."""


class HandedOver(TypedDict):
    """`pack`: what the stages left behind, as `Kept`; `readings`: "<vehicle>/<flight>" by their names in paths → place
    "<table>/<flight>" → object, as `Kept`."""

    pack: list[str | int]
    readings: dict[str, dict[str, list[str | int]]]


def hand_over(objects: Objects, root: Path) -> HandedOver:
    """Upload all that a root of its own holds of flights.

    Raises
    ------
    RemoteError, WarehouseError
        The store's refusal, or the disk's.
    """
    readings: dict[str, dict[str, list[str | int]]] = {}
    uploads: list[tuple[str, Path]] = []
    for path in sorted((root / "signals").glob(f"*/{SIGNAL_PARTITION}*/*.parquet")):
        one = Kept.new(file_sha256(path), path.stat().st_size)
        flight = f"{path.parent.name.removeprefix(SIGNAL_PARTITION)}/{path.stem}"
        readings.setdefault(flight, {})[f"{path.parent.parent.name}/{path.stem}"] = [one.key, one.sha256, one.size]
        uploads.append((one.key, path))
    place = root / "handed-over.zip"
    with disk(place, "written"), ZipFile(place, "w") as pack:
        for path in sorted((root / "stages").glob("*/*/*/*")):
            if not path.name.startswith("."):
                pack.write(path, path.relative_to(root))
    key, sha256 = f"{HANDED_OVER}/{uuid4().hex}.zip", file_sha256(place)
    in_threads(lambda one: objects.put(*one), [*uploads, (key, place)])
    return {"pack": [key, sha256, place.stat().st_size], "readings": readings}


def take_over(objects: Objects, root: Path, handed: HandedOver) -> None:
    """Have results that were handed over in the copy, as if they had been made here; readings by their names alone.

    Raises
    ------
    Gone
        The pack is not there (any more).
    RemoteError, WarehouseError
        `damaged_file`, or the store's refusal, or the disk's.
    """
    pack = Kept(*cast(Any, handed["pack"]))
    with ZipFile(BytesIO(fetched(objects, pack))) as found:
        names = found.namelist()
        if wrong := [name for name in names if not _MEMBER.fullmatch(name)]:
            told = f"{below(objects.url, pack.key)} holds {wrong[0]}, which no stage leaves behind."
            raise WarehouseError(ReasonCode.DAMAGED_FILE, told)
        for flight, objects_of_it in handed["readings"].items():
            _expect(root, flight, objects_of_it)
        for name in sorted(names, key=lambda name: name.endswith(".json")):  # a record says that the rest is there
            write_bytes(root / name, found.read(name), durable=False)
    with suppress(RemoteError):  # whoever may not delete leaves it to those who prune
        objects.delete([pack.key])


def _expect(root: Path, flight: str, readings: Mapping[str, Sequence[str | int]]) -> None:
    """Note which objects the readings of a flight are, in place of those that the copy may have of an earlier try."""
    if not all(PLACE.fullmatch(place) for place in readings):
        raise WarehouseError(ReasonCode.DAMAGED_FILE, f"readings of {flight} were handed over under wrong names.")
    vehicle, _, name = flight.partition("/")
    for path in (root / "signals").glob(f"*/{SIGNAL_PARTITION}{vehicle}/{name}.parquet"):
        one = readings.get(f"{path.parent.parent.name}/{name}")
        if one is None or file_sha256(path) != one[1]:
            with disk(path, "removed"):
                path.unlink(missing_ok=True)
                checksum_path(root, path).unlink(missing_ok=True)
    write_bytes(_note(root, vehicle, name), seal({"readings": dict(readings)}), durable=False)


def expected(root: Path, vehicle_id: str, flight_id: str) -> Mapping[str, Kept]:
    """Readings of a flight that were handed over and are not published yet: place → object."""
    try:
        found = unseal(_note(root, encode_id(vehicle_id), encode_id(flight_id)).read_bytes())["readings"]
    except (OSError, BrokenSeal, KeyError):
        return {}
    return {place: Kept(*one) for place, one in cast(Mapping[str, Any], found).items()}


def published(root: Path, vehicle_id: str, flights: Collection[str]) -> None:
    """A head names the readings of these flights now."""
    for flight in flights:
        _note(root, encode_id(vehicle_id), encode_id(flight)).unlink(missing_ok=True)


def forget_late(root: Path) -> None:
    """Let flights whose readings were handed over, and not published for days, count as not calibrated: what is named
    by no head may be gone."""
    for note in _notes(root):
        with suppress(OSError):
            if time.time() - note.stat().st_mtime > _FORGOTTEN_AFTER_S:
                for record in (root / "stages" / "ingest" / note.stem).glob("*/run.json"):
                    record.unlink(missing_ok=True)
                note.unlink(missing_ok=True)


def _notes(root: Path) -> Iterator[Path]:
    yield from (root / "remote" / HANDED_OVER).glob("*/*.json")


def _note(root: Path, vehicle: str, flight: str) -> Path:
    return root / "remote" / HANDED_OVER / vehicle / f"{flight}.json"
