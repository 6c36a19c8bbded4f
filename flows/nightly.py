"""The night, and one session, as Prefect flows: plan → batches of flights (each step a task) → publish each vehicle,
as soon as all its flights are through."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, cast

from prefect import Flow, State, flow
from prefect.states import Failed

from fieldcal.batch.documents import Answer, Batch, NightDocument, PlainOutcome
from fieldcal.batch.elsewhere.work import is_far, work
from fieldcal.batch.ending import end_night
from fieldcal.batch.flights import lost
from fieldcal.batch.night import Night, Watcher, plan_night, publishings
from fieldcal.batch.outcome import Outcome
from fieldcal.batch.telling import telling
from fieldcal.config.find import Source
from fieldcal.flight.job import PlainJob
from fieldcal.flows.alive import alive
from fieldcal.flows.artifact import keep_artifact, tell_prefect
from fieldcal.flows.cluster.answers import taken_in
from fieldcal.flows.cluster.dask import far_dask_answers
from fieldcal.flows.farewell import tell_while_heard
from fieldcal.flows.pool import beating, far_pool_answers, hand_over, pool_answers
from fieldcal.flows.processes import Processes, process_answers
from fieldcal.flows.runners import Answers, Parallel, batches, dask_answers
from fieldcal.flows.tasks import publish_as_task, run_batch, stage_as_task
from fieldcal.names import Status
from fieldcal.provenance.run_key import code_digest
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.places import archive_at, session_at
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.words.printable import printable
from fieldcal.words.talk import say

PlainValue = str | list[int] | None
"""In a `PlainJob`; that itself Prefect, which shows its server the parameters of flows, cannot describe."""


@flow(name="nightly", persist_result=False, validate_parameters=False)
def nightly(
    archive: str,
    warehouse: str,
    config: str | None = None,
    workers: int = 1,
    runner: str = "process",
    scheduler: str | None = None,
) -> NightDocument:
    """Calibrate every log of `archive` that is new or changed, and publish.

    Parameters
    ----------
    archive, warehouse, config
        Folder of logs and data root, or their URLs; `fieldcal.toml` if not the archive's own.
    workers, runner, scheduler
        Where the batches of flights run (`fieldcal.flows.runners.Parallel`); results do not depend on it.

    Returns
    -------
    dict
        The JSON of the night (`fieldcal.batch.night.Night.document`).

    Raises
    ------
    ConfigurationError, WarehouseError
        What concerns every log.
    """
    night = plan_night(archive_at(archive), Warehouse(warehouse).root, Path(config) if config else None)
    return carry_out(night, Parallel(workers, runner, scheduler))


@flow(name="session", persist_result=False, validate_parameters=False)
def session(
    folder: str,
    warehouse: str,
    config: str | None = None,
    workers: int = 1,
    runner: str = "process",
    scheduler: str | None = None,
) -> NightDocument:
    """The same for the one session folder `<archive>/<vehicle>/<session>`."""
    archive, place = session_at(folder)
    night = plan_night(archive, Warehouse(warehouse).root, Path(config) if config else None, place)
    return carry_out(night, Parallel(workers, runner, scheduler))


@flow(name="batch", persist_result=False, validate_parameters=False)
def batch(
    number: int,
    root: str,
    source: Source,
    jobs: list[dict[str, PlainValue]],
    code: str,
    handed_over: str,
    logs: dict[str, Any] | None = None,
    made_by: dict[str, str] | None = None,
) -> None:
    """A batch in a flow run of its own, in a work pool; its answer is handed over through the warehouse. With `logs` it
    is a `FarBatch`."""
    given: Batch = {"number": number, "root": root, "source": source, "jobs": cast(list[PlainJob], jobs), "code": code}
    with beating(root, handed_over):
        if logs is not None and made_by is not None:
            far_answer = work({**given, "logs": logs, "made_by": made_by}, partial(stage_as_task, number=number))
            hand_over(root, handed_over, far_answer)
        else:
            with alive(Path(root)):
                hand_over(root, handed_over, run_batch(**given))


def flow_of(
    night: Night,
    parallel: Parallel,
    watcher: Watcher | None,
    processes: Processes | None,
    keep: Callable[[NightDocument], None],
) -> Flow[..., None]:
    """The flow of a night that was planned already, while the server started; `processes` wait for its batches.

    `keep` gets the result: the flow itself fails if Prefect cannot tell its server that it has ended, and of what a
    flow returns Prefect visits every value, of every log.
    """

    name = "nightly" if night.session is None else "session"
    about = printable(f"{(night.session or night.archive).resolve().name}, {datetime.now():%Y-%m-%d %H:%M}")

    @flow(name=name, flow_run_name=lambda: about, persist_result=False, validate_parameters=False)
    def planned(folder: str, warehouse: str, workers: int, runner: str) -> None:
        result = carry_out(night, parallel, watcher, processes)
        keep(result)
        return cast(None, failed_stages(result))

    return planned


def carry_out(
    night: Night,
    parallel: Parallel,
    watcher: Watcher | None = None,
    processes: Processes | None = None,
) -> NightDocument:
    """Run what the plan says, within a flow run; the JSON of the night. People are told what is new in it, or that it
    failed."""
    tell_while_heard()
    with alive(night.root), telling(night) as tell:
        if watcher is not None:
            watcher.planned(len(night.plan.jobs), len(night.plan.missing), len(night.plan.done))
        outcomes: list[Outcome] = []

        def coming() -> Iterator[Outcome]:
            for outcome in chain(night.unchanged(), _calibrate(night, parallel, processes)):
                outcomes.append(outcome)
                if watcher is not None:
                    watcher.done(outcome)
                yield outcome

        for publishing in publishings(night, coming()):
            publish_as_task(publishing)
        result, closing = end_night(night, outcomes, parallel.here())
        keep_artifact(result, night.root)
        tell_prefect(closing.changes)
        tell(result)
        return result


def told_apart(result: NightDocument) -> NightDocument:
    """What a flow returns of its night: where stages failed a state that Prefect shows red, with what failed."""
    return cast(NightDocument, failed_stages(result) or result)


def failed_stages(result: NightDocument) -> State[Any] | None:
    """The state of a night in which stages failed; None where none did."""
    failed = [log for log in result["logs"] if any(own["status"] == Status.FAILED for own in log["refusals"])]
    if not failed:
        return None
    first = f"{failed[0]['log_uri']}: {failed[0]['reason']}"
    more = f" … and {len(failed) - 1} more" if len(failed) > 1 else ""
    told = f"Stages of {len(failed)} of {len(result['logs'])} logs failed; the rest is published. {first}{more}"
    return Failed(message=printable(told))


def _calibrate(night: Night, parallel: Parallel, processes: Processes | None) -> Iterator[Outcome]:
    """Outcomes of the flights with something missing, batch by batch."""
    root, code = str(night.root), code_digest()
    inputs: list[Batch] = [
        {"number": n, "root": root, "source": night.source, "jobs": [job.plain() for job in jobs], "code": code}
        for n, jobs in enumerate(batches(night.missing(), parallel.workers))
    ]
    for given, answer in _answers(night, parallel, inputs, processes):
        if isinstance(answer, Exception):
            say(f"Batch {given['number']} was lost ({type(answer).__name__}: {answer}); its logs follow one by one.")
            answer = _one_by_one(given)
        yield from _outcomes(answer)


def _answers(night: Night, parallel: Parallel, inputs: list[Batch], processes: Processes | None) -> Answers:
    if parallel.elsewhere and is_far(night.archive, night.root):
        by_scheduler = parallel.scheduler if parallel.runner == "dask" else None
        return taken_in(far_pool_answers(inputs) if by_scheduler is None else far_dask_answers(by_scheduler, inputs))
    if parallel.runner == "pool":
        return pool_answers(inputs)
    if parallel.runner == "dask":
        return dask_answers(parallel, run_batch, inputs)
    return process_answers(parallel.spawned(len(inputs)), inputs, processes)


def _outcomes(answer: Answer) -> Iterator[Outcome]:
    yield from (Outcome.of(plain) for plain in answer["outcomes"])
    if answer["error"] is not None:
        reason_code, sentence = answer["error"]
        raise WarehouseError(ReasonCode(reason_code), sentence)


def _one_by_one(given: Batch) -> Answer:
    """The flights of a batch whose process died, each a batch of its own: only the guilty one is lost."""
    outcomes: list[PlainOutcome] = []
    for single, answer in process_answers(1, [{**given, "jobs": [job]} for job in given["jobs"]]):
        if isinstance(answer, Exception):
            (job,) = single["jobs"]
            why = f"The process that calibrated {job['log_uri']} was killed, twice (out of memory?)."
            outcomes.append(lost(job, why))
            continue
        outcomes += answer["outcomes"]
        if answer["error"] is not None:
            return {"outcomes": outcomes, "error": answer["error"]}
    return {"outcomes": outcomes, "error": None}
