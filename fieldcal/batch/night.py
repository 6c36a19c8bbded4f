"""A night before and after its batches: what it works on, whose outcomes go where, what it says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol, cast

import polars as pl

from fieldcal.batch.closing import Closing
from fieldcal.batch.documents import NightDocument
from fieldcal.batch.ledgers.flights import Ledger
from fieldcal.batch.ledgers.logs import write_ledger
from fieldcal.batch.ledgers.shared import Shared
from fieldcal.batch.outcome import Outcome, summary
from fieldcal.batch.plan import Plan, make_plan
from fieldcal.batch.publish_flights import publish_vehicle, take_out
from fieldcal.batch.sources import know_sources
from fieldcal.config.configuration import Configuration
from fieldcal.config.find import Source, configuration_of, find_source
from fieldcal.flight.job import Job
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.files import remove_abandoned
from fieldcal.warehouse.layout import prepare
from fieldcal.warehouse.remote.handed_over import forget_late


class Watcher(Protocol):
    """Hears of the night's progress."""

    def planned(self, flights: int, missing: int, done: int) -> None: ...
    def done(self, outcome: Outcome) -> None: ...


@dataclass(frozen=True)
class Night:
    """A planned night. `session`: the one folder of the archive that it is about, or None for all."""

    archive: Path
    root: Path
    session: Path | None
    source: Source
    configuration: Configuration
    plan: Plan

    def missing(self) -> list[Job]:
        """Flights with steps to run."""
        return [job for job in self.plan.jobs if job.flight_id in self.plan.missing]

    def has_work(self) -> bool:
        """Whether anything is to be calibrated or published."""
        return bool(self.plan.missing or self.plan.unchanged)

    def unchanged(self) -> Iterator[Outcome]:
        """Outcomes of the flights that had to be looked at and all of whose results are there."""
        for job in self.plan.jobs:
            if job.flight_id in self.plan.unchanged:
                records = self.plan.unchanged[job.flight_id]
                yield Outcome(job, records, cached=tuple(records))

    def remember(self, outcomes: Sequence[Outcome]) -> None:
        """Remember, once it is published, what the next night need not look at."""
        if outcomes or len(self.plan.done) < len(self.plan.jobs):
            ledger = Ledger(self.root, self.configuration)
            ledger.remember(outcomes, self.plan.done)
            Shared(self.root).tell(self.archive, ledger.whole(outcomes))

    def document(self, outcomes: Sequence[Outcome], closing: Closing) -> NightDocument:
        """The JSON of the night, without how long it took."""
        changes = [change.row() for change in closing.changes]
        told: dict[str, object] = dict(
            summary(outcomes, self.plan.done.values(), self.plan.copies, self.plan.copied, self.root)
        )
        unread = [asdict(one) for one in self.plan.unread]
        pages = {"report": str(closing.report), "site": None if closing.site is None else str(closing.site)}
        return cast(NightDocument, {**told, "changes": changes, **pages, "unread": unread})


def plan_night(archive: Path, root: Path, config: Path | None = None, session: Path | None = None) -> Night:
    """Look at the archive, or at one session folder of it, and at what the warehouse holds.

    Raises
    ------
    ConfigurationError, WarehouseError
        What concerns every log.
    """
    source = find_source(config, archive)
    configuration = configuration_of(source)
    prepare(root)
    forget_late(root)
    know_sources(root, keep=True)
    plan = make_plan(root, archive, configuration, session)
    if plan.missing:  # every folder is looked into: too much for a night with nothing to do
        remove_abandoned(root)
    write_ledger(root, [*plan.jobs, *plan.copied])
    return Night(archive, root, session, source, configuration, plan)


@dataclass(frozen=True)
class Publishing:
    """What the publishing of a vehicle needs. `moved`: flights that another vehicle's history has, by vehicle."""

    root: Path
    vehicle_id: str
    configuration: Configuration
    outcomes: Sequence[Outcome]
    moved: Mapping[str, set[str]]

    def publish(self) -> list[str]:
        """Bring the history of the vehicle up to the outcomes; the tables that changed."""
        flights = [(outcome.job, outcome.records) for outcome in self.outcomes]
        changed = publish_vehicle(self.root, self.vehicle_id, flights, self.configuration)
        for former, flight_ids in self.moved.items():
            take_out(self.root, former, flight_ids)
        return list(changed)


def publishings(night: Night, outcomes: Iterable[Outcome]) -> Iterator[Publishing]:
    """One a vehicle, as soon as the last outcome of its flights has come; flights that were published under another
    vehicle leave it."""
    recorded = Warehouse(night.root).scan("flight").select("flight_id", "vehicle_id").collect()
    come = night.plan.missing.keys() | night.plan.unchanged.keys()
    due = Counter(job.vehicle_id for job in night.plan.jobs if job.flight_id in come)
    flown: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        vehicle_id = outcome.job.vehicle_id
        own = flown.setdefault(vehicle_id, [])
        own.append(outcome)
        if len(own) == due[vehicle_id]:
            yield _publishing(night, vehicle_id, flown.pop(vehicle_id), recorded)
    for vehicle_id in sorted(flown):
        yield _publishing(night, vehicle_id, flown[vehicle_id], recorded)


def _publishing(night: Night, vehicle_id: str, flown: Sequence[Outcome], recorded: pl.DataFrame) -> Publishing:
    ids = [outcome.job.flight_id for outcome in flown]
    elsewhere = recorded.filter(pl.col("flight_id").is_in(ids) & (pl.col("vehicle_id") != vehicle_id))
    moved: dict[str, set[str]] = {}
    for flight_id, former in elsewhere.iter_rows():
        moved.setdefault(former, set()).add(flight_id)
    return Publishing(night.root, vehicle_id, night.configuration, flown, moved)
