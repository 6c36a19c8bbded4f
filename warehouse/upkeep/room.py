"""A warehouse held to a size: of the flights that flew longest ago goes what can be made again from their logs."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fieldcal.warehouse.layout import checksum_path, encode_id
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.upkeep.prune import Removable, all_signals, executions, files_below

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
    size = sum(map(_size, _below(root)))
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
        if own := of_flight.get(encode_id(flight_id)):
            going += own
            left -= sum(_size(path) + _size(checksum_path(root, path)) for path in own)
            whose[flight_id] = vehicle_id
    what = "readings and results of stages" if readings else "results of stages"
    removable = Removable(
        f"{what} of the {len(whose)} flights that flew longest ago",
        "nothing that the history has; their logs are read again where a stage has to run again",
        tuple(going),
    )
    return Excess(removable, whose, size, left)


def _by_flight(root: Path, readings: bool) -> dict[str, list[Path]]:
    """Name of a flight's folder → its files, an execution's record before what it lists."""
    found: dict[str, list[Path]] = defaultdict(list)
    for folder in executions(root):
        found[folder.parent.name] += files_below(folder)
    for path in all_signals(root) if readings else ():
        found[path.stem].append(path)
    return found


def _below(folder: Path) -> Iterator[Path]:
    yield from (Path(place) / name for place, _, names in os.walk(folder) for name in names)


def _size(path: Path) -> int:
    try:
        return path.lstat().st_size
    except OSError:
        return 0
