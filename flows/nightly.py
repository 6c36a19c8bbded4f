"""The night as a Prefect flow: plan → batches of flights (each step a task) → publish, one vehicle at a time.

What travels between tasks are small plain-JSON records. A step whose result is in the warehouse, whole, ends in the
state `Cached` with its run_key as cache key: the warehouse is the only cache, so Prefect keeps no results of its own (a
result record of Prefect's chooses its own deserialiser). Where Prefect's server is lost, the work goes on without it.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import polars as pl
from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import StateDetails
from prefect.settings import PREFECT_API_URL, temporary_settings
from prefect.states import Completed
from prefect.task_runners import ProcessPoolTaskRunner, TaskRunner

from fieldcal.configuration import Configuration
from flows.flights import flights, lost, one_step
from flows.history import publish_vehicle, withdraw
from flows.jobs import Job, Source, configuration_of, find_source
from flows.outcome import Outcome, summary
from flows.plan import Plan, make_plan
from flows.show import say
from flows.steps import FlightWork, Record
from flows.watching import Watcher, tell_done, tell_plan, watch
from warehouse import Warehouse
from warehouse.errors import WarehouseError

LARGEST_BATCH = 40
BATCHES_PER_WORKER = 4
Batch = tuple[int, str, Source, list[dict[str, Any]]]


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


@task(name="step", task_run_name="{step} {log_uri}", cache_policy=NO_CACHE, persist_result=False)
def run_step(flight_id: str, step: str, log_uri: str) -> Any:
    """One step of a flight that is at work in this process: its record, and whether it ran."""
    record, ran = one_step(_at_work[flight_id], step)
    if ran:
        return record, True
    details = StateDetails(cache_key=record["run_key"])
    return Completed(
        name="Cached", message="The result is there and whole.", data=(record, False), state_details=details
    )


@task(name="batch", task_run_name="batch {number}", cache_policy=NO_CACHE, persist_result=False)
def run_batch(number: int, root: str, source: Source, jobs: list[dict[str, Any]]) -> dict[str, Any]:
    """A batch of flights, every step a task (`flows.flights.flights`)."""
    return flights(root, source, jobs, _as_task, tell_done)


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
    archive: str, warehouse: str, config: str | None = None, session: str | None = None, workers: int = 1
) -> dict[str, Any]:
    """Calibrate every log of `archive` (or of the one folder `session` of it) that is new or changed, and publish.

    Returns the JSON of the night (`flows.outcome.summary`).

    Raises
    ------
    ConfigurationError, WarehouseError
        What concerns every log.
    """
    root, place = Path(warehouse), Path(archive)
    source = find_source(Path(config) if config else None, place)
    settings = configuration_of(source)
    plan = make_plan(root, place, settings, Path(session) if session else None)
    tell_plan(len(plan.jobs), len(plan.missing))
    outcomes = [*_from_cache(plan), *_calibrate(root, plan, source, workers)]
    _publish(root, settings, outcomes)
    return summary(outcomes, plan.copies, plan.copied, root)


def run_nightly(api_url: str, watcher: Watcher | None = None, **parameters: Any) -> dict[str, Any]:
    """Run the flow in this process against the server at `api_url`; `watcher` hears of every flight as it is done."""
    workers = parameters.get("workers", 1)
    runner: TaskRunner[Any] = ProcessPoolTaskRunner(max_workers=workers)
    watch(watcher)
    night = nightly if workers == 1 else nightly.with_options(task_runner=runner)
    with temporary_settings({PREFECT_API_URL: api_url}):
        result: dict[str, Any] = night(**parameters)
    return result


def batches(jobs: list[Job], workers: int) -> list[list[Job]]:
    """Jobs dealt out in batches: several for every worker, none too large."""
    size = max(1, min(LARGEST_BATCH, -(-len(jobs) // (workers * BATCHES_PER_WORKER))))
    return [jobs[i : i + size] for i in range(0, len(jobs), size)]


def _as_task(work: FlightWork, step: str) -> tuple[Record, bool]:
    _at_work[work.job.flight_id] = work
    try:
        record, ran = run_step(work.job.flight_id, step, work.job.log_uri, return_state=True).result()
        return record, ran
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


def _calibrate(root: Path, plan: Plan, source: Source, workers: int) -> Iterator[Outcome]:
    """Outcomes of the flights with something missing, batch by batch."""
    missing = [job for job in plan.jobs if job.flight_id in plan.missing]
    inputs: list[Batch] = [
        (number, str(root), source, [job.plain() for job in jobs])
        for number, jobs in enumerate(batches(missing, workers) if missing else [])
    ]
    if workers == 1 or len(inputs) == 1:
        for batch in inputs:
            yield from _outcomes(run_batch(*batch))
        return
    futures = [run_batch.submit(*batch) for batch in inputs]
    for batch, future in zip(inputs, futures, strict=True):
        try:
            answer = future.result()
        except Exception as error:
            say(f"Batch {batch[0]} was lost ({type(error).__name__}: {error}); its logs follow one by one.")
            answer = _one_by_one(batch)
        for outcome in _outcomes(answer):
            tell_done(outcome)
            yield outcome


def _outcomes(answer: dict[str, Any]) -> Iterator[Outcome]:
    yield from (Outcome.of(plain) for plain in answer["outcomes"])
    if answer["error"] is not None:
        raise WarehouseError(*answer["error"])


def _one_by_one(batch: Batch) -> dict[str, Any]:
    """The flights of a batch whose process died, each in a process of its own: only the guilty one is lost."""
    _, root, source, jobs = batch
    outcomes: list[dict[str, Any]] = []
    for job in jobs:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
            try:
                answer = alone.submit(flights, root, source, [job]).result()
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
