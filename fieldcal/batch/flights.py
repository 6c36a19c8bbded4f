"""All steps of flights, whoever runs them: a batch goes through a step together, so that who watches over steps has one
thing to do for all. Nothing of Prefect here."""

from __future__ import annotations

import time
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


class Walk:
    """A flight on its way through its steps. Whatever goes wrong costs this flight alone.

    Parameters
    ----------
    root : Path
        Data root of the warehouse.
    job : Job
        The log.
    settings : Configuration
    watched : bool
        If it takes more than the limits, this process is ended, and whoever started it goes on from there.

    Attributes
    ----------
    step : str or None
        The step that comes next; None when there is none.
    records, why : mapping
        What each step left behind, and why those had to run that did.
    """

    def __init__(self, root: Path, job: Job, settings: Configuration, *, watched: bool = False) -> None:
        self.job = job
        self.records: dict[str, Record] = {}
        self.why: dict[str, str] = {}
        self.step: str | None = None
        self._root, self._watched, self._limits = root, watched, settings.limits
        self._vehicle = settings.vehicle(job.vehicle_id)
        self._spent = {"seconds": 0.0, "cpu_seconds": 0.0}
        self._work_s = 0.0
        self._failed: Outcome | None = None
        self._steps = self._all_steps(FlightWork(root, job, self._vehicle, self._limits))
        self._go_on()

    def take(self, step: str) -> None:
        """Make sure that the result of a step is there, if it is the next.

        Raises
        ------
        WarehouseError
            What concerns every flight: the warehouse cannot be written.
        """
        if step != self.step:
            return
        work, began, cpu_began, before_s = self._work, time.monotonic(), time.process_time(), self._work.work_s
        over = WATCH.over(self._root, self.job, self._vehicle, self._limits, self._spent)
        with over if self._watched else nullcontext(_unwatched) as begins:
            begins(step)
            try:
                work.do(step)
            except WarehouseError:
                raise
            except Exception as error:
                why = unforeseen(self.job.log_uri, error)
                self._failed = failed_outcome(self.job, self.records | work.records, step, why)
                self.step = None
                return
        self._spent["seconds"] += time.monotonic() - began
        self._spent["cpu_seconds"] += time.process_time() - cpu_began
        self._work_s += work.work_s - before_s
        self.records |= work.records
        self.why |= work.why
        self._go_on()

    def outcome(self) -> Outcome:
        """What became of it, once no step is left."""
        if self._failed is not None:
            return self._failed
        ran, cached = (tuple(step for step in self.records if (step in self.why) == new) for new in (True, False))
        return Outcome(self.job, self.records, ran, cached, self.why, self._work_s)

    def _go_on(self) -> None:
        work, self.step = next(self._steps, (None, None))
        if work is not None:
            self._work = work

    @staticmethod
    def _all_steps(work: FlightWork) -> Iterator[tuple[FlightWork, str]]:
        """Every step with the work that it is of; the next is asked for when one is done."""
        yield work, INGEST
        yield from ((work, step) for step in work.steps())
        for other in work.further():
            yield from ((other, step) for step in other.steps())


Round = Callable[[str, Sequence[Walk]], object]
"""Have flights take a step."""


def take(step: str, walks: Sequence[Walk]) -> None:
    """Have flights take a step, one after the other."""
    for walk in walks:
        walk.take(step)


def together(walks: Sequence[Walk], do: Round = take) -> None:
    """All steps of flights, each step of all that have it next at a time."""
    while going := [walk for walk in walks if walk.step is not None]:
        for step in dict.fromkeys(walk.step for walk in going):
            if step is not None:
                do(step, [walk for walk in going if walk.step == step])


def one_flight(root: Path, job: Job, settings: Configuration) -> Outcome:
    """All steps of one flight.

    Raises
    ------
    WarehouseError
        What concerns every flight.
    """
    walk = Walk(root, job, settings)
    together([walk])
    return walk.outcome()


def _unwatched(step: str) -> None:
    pass


def flights(
    root: str,
    source: Source,
    jobs: Sequence[PlainJob],
    code: str,
    do: Round = take,
    *,
    watched: bool = False,
) -> Answer:
    """A batch of flights in this process: `outcomes`, plain JSON, and `error`: what concerns every log of the night.

    `code` is the `code_digest` of the process that planned the night; a process with other code does nothing.
    `watched`: a log that takes more than its limits ends this process.
    """
    if code_digest() != code:
        return {"outcomes": [], "error": OTHER_CODE}
    know_sources(Path(root), keep=False)
    settings = configuration_of(source)
    walks = [Walk(Path(root), Job(**job), settings, watched=watched) for job in jobs]
    try:
        with one_thread():
            together(walks, do)
    except WarehouseError as error:
        return {"outcomes": [], "error": [error.reason_code, error.sentence]}
    return {"outcomes": [walk.outcome().plain() for walk in walks], "error": None}


def lost(job: PlainJob, reason: str) -> PlainOutcome:
    """Outcome, as plain JSON, of a flight that took its process down."""
    return failed_outcome(Job(**job), {}, INGEST, reason).plain()
