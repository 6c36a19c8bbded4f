"""All steps of flights, one after the other, whoever runs each step. Nothing of Prefect here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

from fieldcal.batch.documents import Answer, PlainOutcome
from fieldcal.batch.limits import WATCH
from fieldcal.batch.outcome import Outcome, failed_outcome
from fieldcal.batch.sources import know_sources
from fieldcal.batch.steps import FlightWork
from fieldcal.config.configuration import Configuration
from fieldcal.config.find import Source, configuration_of
from fieldcal.errors import unforeseen
from fieldcal.flight.job import Job, PlainJob
from fieldcal.flight.record import Record
from fieldcal.flight.threads import one_thread
from fieldcal.provenance.run_key import code_digest
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.pipeline import INGEST
from fieldcal.warehouse.errors import WarehouseError

OTHER_CODE: list[str] = [
    ReasonCode.CODE_CHANGED,
    "fieldcal's own source is not the same in all processes of this night: it was edited or installed anew while the "
    "night ran, or the workers have another version. Nothing is lost; run it again.",
]

Step = Callable[[FlightWork, str], object]
"""Make sure that a step's result is there."""


def one_flight(
    root: Path, job: Job, settings: Configuration, do: Step = FlightWork.do, *, watched: bool = False
) -> Outcome:
    """All steps of one flight. Whatever goes wrong costs this flight alone.

    `watched`: if it takes more than the limits, this process is ended, and whoever started it goes on from there.

    Raises
    ------
    WarehouseError
        What concerns every flight: the warehouse cannot be written.
    """
    records: dict[str, Record] = {}
    why: dict[str, str] = {}
    work_s = 0.0
    vehicle, limits = settings.vehicle(job.vehicle_id), settings.limits
    with WATCH.over(root, job, vehicle, limits) if watched else nullcontext(_unwatched) as begins:
        for work, step in _steps(FlightWork(root, job, vehicle, limits)):
            before_s = work.work_s
            begins(step)
            try:
                do(work, step)
            except WarehouseError:
                raise
            except Exception as error:
                return failed_outcome(job, records | work.records, step, unforeseen(job.log_uri, error))
            records, why, work_s = records | work.records, why | work.why, work_s + work.work_s - before_s
    ran, cached = (tuple(step for step in records if (step in why) == new) for new in (True, False))
    return Outcome(job, records, ran, cached, why, work_s)


def _unwatched(step: str) -> None:
    pass


def _steps(work: FlightWork) -> Iterator[tuple[FlightWork, str]]:
    """Every step of a flight with the work that it is of; the next is asked for when one is done."""
    yield work, INGEST
    yield from ((work, step) for step in work.steps())
    for other in work.further():
        yield from ((other, step) for step in other.steps())


def flights(
    root: str,
    source: Source,
    jobs: Sequence[PlainJob],
    code: str,
    do: Step = FlightWork.do,
    *,
    watched: bool = False,
) -> Answer:
    """A batch of flights in this process: `outcomes`, plain JSON, and `error`: what concerns every log of the night.

    `code` is the `code_digest` of the process that planned the night; a process with other code does nothing.
    `watched`: a log that takes more than its limits ends this process.
    """
    outcomes: list[PlainOutcome] = []
    if code_digest() != code:
        return {"outcomes": outcomes, "error": OTHER_CODE}
    know_sources(Path(root), keep=False)
    settings = configuration_of(source)
    try:
        with one_thread():
            for job in jobs:
                outcome = one_flight(Path(root), Job(**job), settings, do, watched=watched)
                outcomes.append(outcome.plain())
    except WarehouseError as error:
        return {"outcomes": outcomes, "error": [error.reason_code, error.sentence]}
    return {"outcomes": outcomes, "error": None}


def lost(job: PlainJob, reason: str) -> PlainOutcome:
    """Outcome, as plain JSON, of a flight that took its process down."""
    return failed_outcome(Job(**job), {}, INGEST, reason).plain()
