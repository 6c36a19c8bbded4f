"""The night, and one session, as Prefect flows: plan → batches of flights (each step a task) → publish each vehicle.

What travels between tasks are small plain-JSON records. A step whose result is in the warehouse, whole, ends in the
state `Cached` with its run_key as cache key: the warehouse is the only cache, so Prefect keeps no results of its own (a
result record of Prefect's chooses its own deserialiser). Where Prefect's server is lost, the work goes on without it.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, StateDetails
from prefect.settings import PREFECT_API_URL, temporary_settings
from prefect.states import Completed

from fieldcal.batch.closing import close_night
from fieldcal.batch.flights import flights, lost, one_step
from fieldcal.batch.log_ledger import write_ledger
from fieldcal.batch.outcome import Outcome, summary
from fieldcal.batch.plan import Plan, make_plan
from fieldcal.batch.publish_flights import publish_vehicle, withdraw
from fieldcal.batch.source_ledger import know_sources
from fieldcal.batch.steps import FlightWork, Record
from fieldcal.config.configuration import Configuration
from fieldcal.config.find import Source, configuration_of, find_source
from fieldcal.flight.job import Job
from fieldcal.flows.alive import alive
from fieldcal.flows.artifact import keep_artifact, tell_prefect
from fieldcal.flows.pool import hand_over, pool_answers
from fieldcal.flows.processes import process_answers, processes_begun, spawned
from fieldcal.flows.runners import Answers, Parallel, batches, dask_answers
from fieldcal.flows.watching import Watcher, tell_done, tell_plan, watch
from fieldcal.stages.run_key import code_digest
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.files import remove_abandoned
from fieldcal.warehouse.layout import prepare
from fieldcal.words.talk import say


@dataclass(frozen=True)
class Publishing:
    """What the publishing of a vehicle needs. `moved`: flights that another vehicle's history has, by vehicle."""

    root: Path
    settings: Configuration
    outcomes: list[Outcome]
    moved: dict[str, set[str]]


# Prefect walks through the parameters of a task: large things are handed over here, by name, within this process.
_at_work: dict[str, FlightWork] = {}
_to_publish: dict[str, Publishing] = {}
_planned: dict[tuple[Path, Path, str | None, Path | None], tuple[Source, Configuration, Plan]] = {}


@task(name="step", task_run_name="{step} {log_uri}", cache_policy=NO_CACHE, persist_result=False)
def run_step(flight_id: str, step: str, log_uri: str) -> State[Any]:
    """One step of a flight that is at work in this process, which keeps its record; the state says what was done."""
    work = _at_work[flight_id]
    record, ran = one_step(work, step)
    reference = {"stage": step, "flight_id": flight_id, "run_key": record["run_key"]}
    details = StateDetails(cache_key=record["run_key"])
    if ran:
        return Completed(message=f"Run: {work.why.get(step)}.", data=reference, state_details=details)
    return Completed(name="Cached", message="The result is there and whole.", data=reference, state_details=details)


@task(name="batch", task_run_name="batch {number}", cache_policy=NO_CACHE, persist_result=False)
def run_batch(number: int, root: str, source: Source, jobs: list[dict[str, Any]], code: str) -> dict[str, Any]:
    """A batch of flights, every step a task (`fieldcal.batch.flights.flights`)."""
    return flights(root, source, jobs, code, _as_task, tell_done)


@flow(name="batch", persist_result=False, validate_parameters=False)
def batch(number: int, root: str, source: Source, jobs: list[dict[str, Any]], code: str, handed_over: str) -> None:
    """A batch in a flow run of its own, in a work pool; its answer is handed over as a file of the warehouse."""
    with alive(Path(root)):
        hand_over(Path(root), handed_over, run_batch(number, root, source, jobs, code))


@task(name="publish", task_run_name="publish {vehicle_id}", cache_policy=NO_CACHE, persist_result=False)
def run_publish(vehicle_id: str) -> list[str]:
    """Bring the history of one vehicle up to the night's outcomes; the tables that changed."""
    work = _to_publish[vehicle_id]
    own = [(outcome.job, outcome.records) for outcome in work.outcomes]
    changed = publish_vehicle(work.root, vehicle_id, own, work.settings)
    for former, flight_ids in work.moved.items():
        withdraw(work.root, former, flight_ids)
    return list(changed)


@flow(name="nightly", persist_result=False, validate_parameters=False)
def nightly(
    archive: str,
    warehouse: str,
    config: str | None = None,
    workers: int = 1,
    runner: str = "process",
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Calibrate every log of `archive` that is new or changed, and publish.

    Parameters
    ----------
    archive, warehouse, config
        Folder of logs, data root, `fieldcal.toml` if not the archive's own.
    workers, runner, scheduler
        Where the batches of flights run (`fieldcal.flows.runners.task_runner`); results do not depend on it.

    Returns
    -------
    dict
        The JSON of the night (`fieldcal.batch.outcome.summary`).

    Raises
    ------
    ConfigurationError, WarehouseError
        What concerns every log.
    """
    return _night(Path(archive), Path(warehouse), config, None, Parallel(workers, runner, scheduler))


@flow(name="session", persist_result=False, validate_parameters=False)
def session(
    folder: str,
    warehouse: str,
    config: str | None = None,
    workers: int = 1,
    runner: str = "process",
    scheduler: str | None = None,
) -> dict[str, Any]:
    """The same for the one session folder `<archive>/<vehicle>/<session>`."""
    own = Path(folder)
    return _night(own.parent.parent, Path(warehouse), config, own, Parallel(workers, runner, scheduler))


def run_nightly(api_url: str, watcher: Watcher | None = None, **parameters: Any) -> dict[str, Any]:
    """Run one of the flows in this process against the server at `api_url`; `watcher` hears of every flight.

    `parameters` are those of `session` when they name a `folder`, else those of `nightly`.
    """
    watch(watcher)
    chosen: Any = session if "folder" in parameters else nightly
    with temporary_settings({PREFECT_API_URL: api_url}):
        result: dict[str, Any] = chosen(**parameters)
    return result


@contextmanager
def prepared(
    root_of_logs: Path, root: Path, config: str | None, only: Path | None, parallel: Parallel
) -> Iterator[None]:
    """Plan the night that this process is about to run, and start its processes, while the server starts.

    The flow takes both from here.
    """
    source, settings, plan = _plan(root_of_logs, root, config, only)
    _planned[(root_of_logs, root, config, only)] = source, settings, plan
    n_batches = len(batches(_missing(plan), parallel.workers))
    elsewhere = parallel.runner == "process" and not parallel.in_this_process(n_batches)
    with processes_begun(parallel.workers) if elsewhere else nullcontext():
        yield


def _plan(root_of_logs: Path, root: Path, config: str | None, only: Path | None) -> tuple[Source, Configuration, Plan]:
    source = find_source(Path(config) if config else None, root_of_logs)
    settings = configuration_of(source)
    prepare(root)
    remove_abandoned(root)
    know_sources(root, keep=True)
    plan = make_plan(root, root_of_logs, settings, only)
    write_ledger(root, [*plan.jobs, *plan.copied])
    return source, settings, plan


def _night(root_of_logs: Path, root: Path, config: str | None, only: Path | None, parallel: Parallel) -> dict[str, Any]:
    ahead = _planned.pop((root_of_logs, root, config, only), None)
    source, settings, plan = ahead or _plan(root_of_logs, root, config, only)
    with alive(root):
        tell_plan(len(plan.jobs), len(plan.missing))
        outcomes = [*_from_cache(plan), *_calibrate(root, plan, source, parallel)]
        _publish(root, settings, outcomes)
        closing = close_night(root, settings.alerts)
        told = [change.row() for change in closing.changes]
        result = {**summary(outcomes, plan.copies, plan.copied, root), "changes": told, "report": str(closing.report)}
        keep_artifact(result, root)
        tell_prefect(closing.changes)
        return result


def _as_task(work: FlightWork, step: str) -> tuple[Record, bool]:
    """One step as a Prefect task; where Prefect itself fails, without it."""
    _at_work[work.job.flight_id] = work
    try:
        state = run_step(work.job.flight_id, step, work.job.log_uri, return_state=True)
        if step in work.records:
            return work.records[step], state.name != "Cached"
        state.result()
        return one_step(work, step)
    except WarehouseError:
        raise
    except Exception:
        return one_step(work, step)
    finally:
        del _at_work[work.job.flight_id]


def _from_cache(plan: Plan) -> Iterator[Outcome]:
    for job in plan.jobs:
        if job.flight_id in plan.unchanged:
            records = plan.unchanged[job.flight_id]
            outcome = Outcome(job, records, cached=tuple(records))
            tell_done(outcome)
            yield outcome


def _calibrate(root: Path, plan: Plan, source: Source, parallel: Parallel) -> Iterator[Outcome]:
    """Outcomes of the flights with something missing, batch by batch."""
    code = code_digest()
    inputs: list[dict[str, Any]] = [
        {"number": n, "root": str(root), "source": source, "jobs": [job.plain() for job in jobs], "code": code}
        for n, jobs in enumerate(batches(_missing(plan), parallel.workers))
    ]
    if parallel.in_this_process(len(inputs)):
        for given in inputs:
            yield from _outcomes(run_batch(**given))
        return
    for given, answer in _answers(parallel, inputs):
        if isinstance(answer, Exception):
            say(f"Batch {given['number']} was lost ({type(answer).__name__}: {answer}); its logs follow one by one.")
            answer = _one_by_one(given)
        for outcome in _outcomes(answer):
            tell_done(outcome)
            yield outcome


def _answers(parallel: Parallel, inputs: list[dict[str, Any]]) -> Answers:
    if parallel.runner == "pool":
        return pool_answers(inputs)
    if parallel.runner == "dask":
        return dask_answers(parallel, run_batch, inputs)
    return process_answers(parallel.workers, inputs)


def _missing(plan: Plan) -> list[Job]:
    return [job for job in plan.jobs if job.flight_id in plan.missing]


def _outcomes(answer: dict[str, Any]) -> Iterator[Outcome]:
    yield from (Outcome.of(plain) for plain in answer["outcomes"])
    if answer["error"] is not None:
        raise WarehouseError(*answer["error"])


def _one_by_one(given: dict[str, Any]) -> dict[str, Any]:
    """The flights of a batch whose process died, each in a process of its own: only the guilty one is lost."""
    outcomes: list[dict[str, Any]] = []
    for job in given["jobs"]:
        with spawned(1) as alone:
            try:
                answer = alone.submit(flights, given["root"], given["source"], [job], given["code"]).result()
            except BrokenProcessPool:
                why = f"The process that calibrated {job['log_uri']} was killed, twice (out of memory?)."
                outcomes.append(lost(job, why))
                continue
        outcomes += answer["outcomes"]
        if answer["error"] is not None:
            return {"outcomes": outcomes, "error": answer["error"]}
    return {"outcomes": outcomes, "error": None}


def _publish(root: Path, settings: Configuration, outcomes: list[Outcome]) -> None:
    """One vehicle after the other; flights that were published under another vehicle leave it."""
    recorded = Warehouse(root).scan("flight").select("flight_id", "vehicle_id").collect()
    for vehicle_id in sorted({outcome.job.vehicle_id for outcome in outcomes}):
        own = [outcome for outcome in outcomes if outcome.job.vehicle_id == vehicle_id]
        ids = [outcome.job.flight_id for outcome in own]
        elsewhere = recorded.filter(pl.col("flight_id").is_in(ids) & (pl.col("vehicle_id") != vehicle_id))
        moved: dict[str, set[str]] = {}
        for flight_id, former in elsewhere.iter_rows():
            moved.setdefault(former, set()).add(flight_id)
        _to_publish[vehicle_id] = Publishing(root, settings, own, moved)
        run_publish(vehicle_id)
        del _to_publish[vehicle_id]
