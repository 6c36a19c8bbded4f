"""A warehouse held to a size: of the flights that flew longest ago goes what can be made again from their logs."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fieldcal.warehouse.layout import checksum_path, encode_id
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.upkeep.prune import Removable

SPARE = 0.05
"""Of the limit: so much more is removed, so that not every night has to."""


@dataclass(frozen=True)
class Excess:
    """What a warehouse has beyond a limit.

    Attributes
    ----------
    removable : Removable
        Readings and results of stages, of whole flights.
    flights : dict
        flight_id → vehicle_id of these.
    size_bytes, left_bytes : int
        Of the warehouse before and after it is removed.
    """

    removable: Removable
    flights: Mapping[str, str]
    size_bytes: int
    left_bytes: int


def excess(root: Path, limit_bytes: float, *, readings: bool = True) -> Excess | None:
    """What has to go so that all below `root` is within the limit again; None where it is within.

    Everything of as many flights as fit stays, the latest. History, pages and what others put there stay anyway.

    Parameters
    ----------
    readings
        Whether readings may go beside results of stages.
    """
    size = sum(size for _, size in _files(root))
    if size <= limit_bytes:
        return None
    ids = ("vehicle_id", "flight_id")
    flights = Warehouse(root).scan("flight").sort("started_at", *ids, nulls_last=False).select(*ids).collect()
    of_flight = _by_flight(root, readings)
    going: list[Path] = []
    whose: dict[str, str] = {}
    left = size
    for vehicle_id, flight_id in flights.iter_rows():
        if left <= limit_bytes * (1.0 - SPARE):
            break
        if own := of_flight.get((encode_id(vehicle_id), encode_id(flight_id))):
            going += [path for path, _ in own]
            left -= sum(size for _, size in own)
            whose[flight_id] = vehicle_id
    what = "readings and results of stages" if readings else "results of stages"
    removable = Removable(
        f"{what} of the {len(whose)} flights that flew longest ago",
        "nothing that the history has; their logs are read again where a stage has to run again",
        tuple(going),
    )
    return Excess(removable, whose, size, left)


def _by_flight(root: Path, readings: bool) -> dict[tuple[str, str], list[tuple[Path, int]]]:
    """Names of a vehicle's and a flight's folder → files with sizes, an execution's record before what it lists."""
    found: dict[str, list[tuple[Path, int]]] = defaultdict(list)
    for path, size in _files(root / "stages"):
        found[path.relative_to(root / "stages").parts[1]].append((path, size))
    by_flight: dict[tuple[str, str], list[tuple[Path, int]]] = defaultdict(list)
    vehicles: dict[str, str] = {}
    rows = Warehouse(root).scan("flight").select("vehicle_id", "flight_id").collect()
    for vehicle_id, flight_id in rows.iter_rows():
        vehicles[encode_id(flight_id)] = encode_id(vehicle_id)
    for flight, files in found.items():
        if flight in vehicles:
            own = sorted(files, key=lambda file: file[0].name != "run.json")
            by_flight[vehicles[flight], flight] += own
    for path, size in _files(root / "signals") if readings else ():
        beside = checksum_path(root, path)
        by_flight[path.parent.name.partition("=")[2], path.stem].append((path, size + _size(beside)))
    return by_flight


def _files(folder: Path) -> Iterator[tuple[Path, int]]:
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place) / name
            yield path, _size(path)


def _size(path: Path) -> int:
    try:
        return path.lstat().st_size
    except OSError:
        return 0
