"""What is missing: every log of the archive against what the cache and the history hold. Changes nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fieldcal.batch.documents import LogEntry
from fieldcal.batch.jobs import find_jobs, without_copies
from fieldcal.batch.ledgers.flights import Ledger
from fieldcal.batch.ledgers.logs import read_ledger
from fieldcal.batch.ledgers.shared import Shared
from fieldcal.batch.steps import FlightWork
from fieldcal.config.configuration import Configuration
from fieldcal.flight.job import Job
from fieldcal.flight.record import Record
from fieldcal.logs.unread import Unread, find_unread
from fieldcal.warehouse import Warehouse


@dataclass
class Plan:
    """A night before it runs.

    `done`: flights that are as the last night left them, with what is said of them; `unchanged`: others all of whose
    results are there, with their records; `missing`: flights with steps to run, each with why; `copies`: log_uri →
    log_uri of the log it is a copy of; `unread`: what lies beside the logs.
    """

    jobs: list[Job] = field(default_factory=list)
    done: dict[str, LogEntry] = field(default_factory=dict)
    unchanged: dict[str, dict[str, Record]] = field(default_factory=dict)
    missing: dict[str, dict[str, str]] = field(default_factory=dict)
    copies: dict[str, str] = field(default_factory=dict)
    copied: list[Job] = field(default_factory=list)
    unread: list[Unread] = field(default_factory=list)


def make_plan(root: Path, archive: Path, configuration: Configuration, session: Path | None = None) -> Plan:
    """Find the logs and decide for each which steps must run."""
    shared = Shared(root)
    found = find_jobs(archive, configuration, session, read_ledger(root), partial(shared.log, archive))
    kept, copies = without_copies(found, *_known(root, archive))
    unread = find_unread(archive, {job.log_uri for job in found}, session)
    plan = Plan(copies=copies, copied=[job for job in found if job.log_uri in copies], unread=unread)
    seen = Ledger(root, configuration, shared)
    for job in kept:
        plan.jobs.append(job)
        if (entry := seen.entry(job)) is not None:
            plan.done[job.flight_id] = entry
            continue
        work = FlightWork(root, job, configuration.vehicle(job.vehicle_id), configuration.limits)
        pending = work.pending()
        if pending:
            plan.missing[job.flight_id] = pending
        else:
            plan.unchanged[job.flight_id] = work.records
    return plan


def _known(root: Path, archive: Path) -> tuple[dict[str, str], set[str]]:
    """Logs the history knows: flight_id → log_uri, and those of them that are in the archive."""
    rows = Warehouse(root).scan("flight").select("flight_id", "log_uri").sort("log_uri").collect()
    known: dict[str, str] = dict(rows.iter_rows())
    return known, {uri for uri in known.values() if (archive / uri).exists()}
