"""All steps of flights, one after the other, whoever runs each step. Nothing of Prefect here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from fieldcal.batch.documents import Answer, PlainOutcome
from fieldcal.batch.outcome import Outcome, failed_outcome
from fieldcal.batch.sources import know_sources
from fieldcal.batch.steps import STEPS, FlightWork
from fieldcal.config.configuration import Configuration
from fieldcal.config.find import Source, configuration_of
from fieldcal.errors import unforeseen
from fieldcal.flight.job import Job, PlainJob
from fieldcal.flight.threads import one_thread
from fieldcal.provenance.run_key import code_digest
from fieldcal.reason_codes import ReasonCode
from fieldcal.warehouse.errors import WarehouseError

OTHER_CODE: list[str] = [
    ReasonCode.CODE_CHANGED,
    "fieldcal's own source is not the same in all processes of this night: it was edited or installed anew while the "
    "night ran, or the workers have another version. Nothing is lost; run it again.",
]

Step = Callable[[FlightWork, str], object]
"""Make sure that a step's result is there."""


def one_flight(root: Path, job: Job, settings: Configuration, do: Step = FlightWork.do) -> Outcome:
    """All steps of one flight. Whatever goes wrong costs this flight alone.

    Raises
    ------
    WarehouseError
        What concerns every flight: the warehouse cannot be written.
    """
    work = FlightWork(root, job, settings.vehicle(job.vehicle_id))
    ran: list[str] = []
    cached: list[str] = []
    for step in STEPS:
        if step not in work.steps():
            break
        try:
            do(work, step)
        except WarehouseError:
            raise
        except Exception as error:
            return failed_outcome(job, work.records, step, unforeseen(job.log_uri, error))
        (ran if step in work.why else cached).append(step)
    return Outcome(job, work.records, tuple(ran), tuple(cached), work.why, work.work_s)


def flights(
    root: str,
    source: Source,
    jobs: Sequence[PlainJob],
    code: str,
    do: Step = FlightWork.do,
    tell: Callable[[Outcome], None] | None = None,
) -> Answer:
    """A batch of flights in this process: `outcomes`, plain JSON, and `error`: what concerns every log of the night.

    `code` is the `code_digest` of the process that planned the night; a process with other code does nothing.
    """
    outcomes: list[PlainOutcome] = []
    if code_digest() != code:
        return {"outcomes": outcomes, "error": OTHER_CODE}
    know_sources(Path(root), keep=False)
    settings = configuration_of(source)
    try:
        with one_thread():
            for job in jobs:
                outcome = one_flight(Path(root), Job(**job), settings, do)
                outcomes.append(outcome.plain())
                if tell is not None:
                    tell(outcome)
    except WarehouseError as error:
        return {"outcomes": outcomes, "error": [error.reason_code, error.sentence]}
    return {"outcomes": outcomes, "error": None}


def lost(job: PlainJob, reason: str) -> PlainOutcome:
    """Outcome, as plain JSON, of a flight that took its process down."""
    return failed_outcome(Job(**job), {}, STEPS[0], reason).plain()
