"""Pages of vehicles and of their flights drawn: one vehicle after the other here, or shared among processes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import Self

from fieldcal.flight.processes import one_of_many
from fieldcal.report.fitness import Fitness
from fieldcal.report.links import Links
from fieldcal.site.ledger import Files, Ledger, Written, flight_digest, flights_digest
from fieldcal.site.snapshot import Snapshot
from fieldcal.site.vehicle_pages import flight_files, vehicle_files

FLIGHTS_WORTH_A_PROCESS = 60
"""Fewer are drawn in less time than a process takes to start."""


@dataclass(frozen=True)
class Due:
    """A vehicle some of whose pages show something else than the history. Without `fitness` only its flights' are
    drawn, which show nothing of the fleet; else `of` is the digest of what all are made from now."""

    vehicle_id: str
    flights: tuple[str, ...]
    fitness: Fitness | None = None
    of: str = ""


class Drawing:
    """Draws pages, with processes where there are flights enough for two of them at least; they end with the block.

    Parameters
    ----------
    root : Path
        Data root.
    workers : int
        How many processes at most.
    """

    def __init__(self, root: Path, workers: int) -> None:
        self._root, self._workers = root, workers
        self._pool: ProcessPoolExecutor | None = None
        self._ahead: list[Future[None]] = []

    def begin(self, due: Sequence[Due], links: Links, code: str) -> None:
        """Have processes draw, if they are worth it, and come back at once; the next `draw` waits for them."""
        self._ahead = self._given(due, links, code)

    def draw(self, snapshot: Snapshot, due: Sequence[Due], links: Links, code: str) -> None:
        """Write what changed of these vehicles, and remember it in their ledgers.

        Processes share whole vehicles. Where one is killed, for want of memory say, what is left is drawn here.
        """
        try:
            _await(self._ahead)
            given = self._given(due, links, code)
            _await(given)
            if given:
                return
        except BrokenProcessPool:
            self._end()
        _draw_each(snapshot, due, links, code)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def _end(self) -> None:
        self._ahead = []
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def _given(self, due: Sequence[Due], links: Links, code: str) -> list[Future[None]]:
        number = min(self._workers, sum(len(one.flights) for one in due) // FLIGHTS_WORTH_A_PROCESS)
        shares = _shares(due, number)
        if len(shares) < 2:
            return []
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self._workers, get_context("spawn"), one_of_many)
        return [self._pool.submit(_draw_alone, self._root, share, links, code) for share in shares]


def _await(drawn: Sequence[Future[None]]) -> None:
    for one in drawn:
        one.result()


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
    """Its flights' pages, then the vehicle's, where what they show, or the code that makes them, is another."""
    ledger = Ledger.of_vehicle(snapshot.root, due.vehicle_id)
    drawn_of = flights_digest(snapshot.root, due.vehicle_id, due.flights, code)
    seen: dict[str, tuple[str, Files]] = {}
    for flight_id in due.flights:
        files = ledger.of_flights.get(flight_id, {})
        there, digest = written.has(files), ledger.flights.get(flight_id, "")
        if not there or ledger.drawn_of != drawn_of:
            former, digest = digest, flight_digest(snapshot, due.vehicle_id, flight_id, code)
            if not there or digest != former:
                files = written.put(flight_files(snapshot, due.vehicle_id, flight_id, links), files)
        seen[flight_id] = (digest, files)
    of, own = ledger.of, ledger.files
    if due.fitness is not None:
        of, own = due.of, written.put(vehicle_files(snapshot, due.fitness, links), own)
    ledger.remember(of, own, drawn_of, seen)
