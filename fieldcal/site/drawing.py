"""Pages of vehicles and of their flights drawn: one vehicle after the other here, or shared among processes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from fieldcal.flight.processes import end_with_parent
from fieldcal.report.fitness import Fitness
from fieldcal.report.links import Links
from fieldcal.site.ledger import Ledger, Written, flight_digest
from fieldcal.site.snapshot import Snapshot
from fieldcal.site.vehicle_pages import flight_files, vehicle_files

FLIGHTS_WORTH_A_PROCESS = 60
"""Fewer are drawn in less time than a process takes to start."""


@dataclass(frozen=True)
class Due:
    """A vehicle whose pages show something else than the history: `of`, the digest of what they are made from now."""

    fitness: Fitness
    flights: tuple[str, ...]
    of: str


def draw(snapshot: Snapshot, due: Sequence[Due], links: Links, code: str, workers: int) -> None:
    """Write what changed of these vehicles, and remember it in their ledgers.

    Processes share whole vehicles. Where one is killed, for want of memory say, what is left is drawn here.
    """
    shares = _shares(due, min(workers, sum(len(one.flights) for one in due) // FLIGHTS_WORTH_A_PROCESS))
    if len(shares) > 1:
        try:
            with ProcessPoolExecutor(len(shares), get_context("spawn"), end_with_parent) as pool:
                for drawn in [pool.submit(_draw_alone, snapshot.root, share, links, code) for share in shares]:
                    drawn.result()
            return
        except BrokenProcessPool:
            pass
    _draw_each(snapshot, due, links, code)


def _shares(due: Sequence[Due], number: int) -> list[list[Due]]:
    """Vehicles dealt out, the one with the most flights first, each to who has the fewest."""
    shares: list[list[Due]] = [[] for _ in range(max(1, number))]
    for one in sorted(due, key=lambda own: -len(own.flights)):
        min(shares, key=lambda share: sum(1 + len(own.flights) for own in share)).append(one)
    return [share for share in shares if share]


def _draw_alone(root: Path, share: Sequence[Due], links: Links, code: str) -> None:
    _draw_each(Snapshot(root), share, links, code)


def _draw_each(snapshot: Snapshot, due: Sequence[Due], links: Links, code: str) -> None:
    written = Written(links.folder)
    for one in due:
        _draw(snapshot, one, links, written, code)


def _draw(snapshot: Snapshot, due: Due, links: Links, written: Written, code: str) -> None:
    """The vehicle's pages and its flights', where what they show, or the code that makes them, is another."""
    vehicle_id = due.fitness.vehicle_id
    ledger = Ledger.of_vehicle(snapshot.root, vehicle_id)
    seen = {}
    for flight_id in due.flights:
        digest = flight_digest(snapshot, vehicle_id, flight_id, code)
        files = ledger.of_flights.get(flight_id, {})
        if ledger.flights.get(flight_id) != digest or not written.has(files):
            files = written.put(flight_files(snapshot, vehicle_id, flight_id, links), files)
        seen[flight_id] = (digest, files)
    ledger.remember(due.of, written.put(vehicle_files(snapshot, due.fitness, links), ledger.files), seen)
