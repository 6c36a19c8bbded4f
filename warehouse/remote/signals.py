"""Readings by URL: uploaded with the rows of their flight, listed in one object a vehicle, fetched when asked for."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

from fieldcal.remote.objects import Objects
from fieldcal.warehouse import checksums
from fieldcal.warehouse.errors import disk
from fieldcal.warehouse.files import file_sha256, write_bytes
from fieldcal.warehouse.layout import SIGNAL_PARTITION, checksum_path, encode_id
from fieldcal.warehouse.remote.handed_over import expected
from fieldcal.warehouse.remote.heads import PLACE, Head, Kept
from fieldcal.warehouse.remote.known import fetched, in_threads, known_head, known_names, objects_of
from fieldcal.warehouse.sealed import seal, unseal

Listing = Mapping[str, Kept]
"""Place of a file, "<table>/<flight>" (`PLACE`), → its object."""


def with_own_signals(
    root: Path, objects: Objects, before: Head, flights: Collection[str]
) -> tuple[Kept | None, list[tuple[str, bytes | Path]]]:
    """The list of a vehicle's readings with those that flights have in the copy, or that other machines have uploaded
    already, and what is to be uploaded for it."""
    name = encode_id(before.vehicle_id)
    former = listed(root, objects, before)
    listing = dict(former)
    fresh: list[tuple[str, bytes | Path]] = []
    for flight in sorted(flights):
        for place, one in expected(root, before.vehicle_id, flight).items():
            if place not in listing or listing[place].sha256 != one.sha256:
                listing[place] = one
        for path in sorted((root / "signals").glob(f"*/{SIGNAL_PARTITION}{name}/{encode_id(flight)}.parquet")):
            place, sha256 = f"{path.parent.parent.name}/{path.stem}", checksums.assured(root, path)
            if place not in listing or listing[place].sha256 != sha256:
                listing[place] = Kept.new(sha256, path.stat().st_size)
                fresh.append((listing[place].key, path))
    if listing == former:
        return before.signals, []
    data = seal({place: [one.key, one.sha256, one.size] for place, one in listing.items()})
    list_itself = Kept.new(hashlib.sha256(data).hexdigest(), len(data))
    write_bytes(_list_here(root, before), data, durable=False)
    return list_itself, [*fresh, (list_itself.key, data)]


def listed(root: Path, objects: Objects, head: Head | None) -> Listing:
    """What readings a vehicle has, by its head."""
    if head is None or head.signals is None:
        return {}
    data = _read_here(root, head)
    if data is None:
        data = fetched(objects, head.signals)
        write_bytes(_list_here(root, head), data, durable=False)
    return _decoded(data)


def _decoded(data: bytes) -> Listing:
    listing = {where: Kept(*one) for where, one in cast(Mapping[str, Any], unseal(data)).items()}
    return {where: one for where, one in listing.items() if PLACE.fullmatch(where)}


def fetch_signals(root: Path, table: str, vehicle_id: str | None = None, flight_id: str | None = None) -> None:
    """Have readings in the copy: of one vehicle and flight, or of all. A warehouse on this machine has what it has."""
    objects = objects_of(root)
    if objects is None:
        return
    names = [encode_id(vehicle_id)] if vehicle_id is not None else known_names(root)
    wanted = list(_absent(root, objects, names, table, None if flight_id is None else encode_id(flight_id)))
    in_threads(partial(_fetch, root, objects), wanted)


def _absent(
    root: Path, objects: Objects, names: list[str], table: str, flight_id: str | None
) -> Iterator[tuple[Path, Kept]]:
    for name in names:
        for place, one in listed(root, objects, known_head(root, name)).items():
            kind, _, flight = place.partition("/")
            path = _path(root, name, place)
            if kind == table and flight_id in (None, flight) and not path.exists():
                yield path, one


def _fetch(root: Path, objects: Objects, wanted: tuple[Path, Kept]) -> None:
    path, one = wanted
    write_bytes(path, fetched(objects, one), partial(checksums.recording, root, path, dispensable=True))


def drop_replaced(root: Path, objects: Objects, before: Head | None, head: Head) -> None:
    """Remove readings from the copy that others have replaced; whoever asks for them fetches theirs."""
    former = None if before is None or before.signals == head.signals else _read_here(root, before)
    if before is None or former is None:
        return
    now = listed(root, objects, head)
    for place, one in _decoded(former).items():
        path = _path(root, encode_id(before.vehicle_id), place)
        if (place not in now or now[place].sha256 != one.sha256) and path.exists() and file_sha256(path) == one.sha256:
            with disk(path, "removed"):
                path.unlink(missing_ok=True)
                checksum_path(root, path).unlink(missing_ok=True)


def _read_here(root: Path, head: Head) -> bytes | None:
    """The list that a head names, where the copy has it."""
    try:
        data = _list_here(root, head).read_bytes()
    except OSError:
        return None
    same = head.signals is not None and hashlib.sha256(data).hexdigest() == head.signals.sha256
    return data if same else None


def _list_here(root: Path, head: Head) -> Path:
    return root / "remote" / "signals" / f"{encode_id(head.vehicle_id)}.json"


def _path(root: Path, name: str, place: str) -> Path:
    table, _, flight = place.partition("/")
    return root / "signals" / table / f"{SIGNAL_PARTITION}{name}" / f"{flight}.parquet"
