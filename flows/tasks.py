"""The night's work as Prefect tasks: a step of a flight, a batch of flights, the publishing of a vehicle.

A step whose result is in the warehouse, whole, ends in the state `Cached` with its run_key as cache key: the warehouse
is the only cache, so Prefect keeps no results of its own (a result record of Prefect's chooses its own deserialiser).
Where Prefect's server is lost, the work goes on without it.
"""

from __future__ import annotations

from typing import TypeVar, cast

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, StateDetails
from prefect.states import Completed
from prefect.utilities.annotations import quote

from fieldcal.batch.documents import Answer
from fieldcal.batch.flights import flights
from fieldcal.batch.night import Publishing
from fieldcal.batch.steps import FlightWork
from fieldcal.config.find import Source
from fieldcal.flight.job import PlainJob
from fieldcal.warehouse.errors import WarehouseError

T = TypeVar("T")


def unseen(value: T) -> T:
    """A parameter of a task that Prefect does not walk through; the task gets it as it is."""
    return cast(T, quote(value))


@task(name="step", task_run_name="{step} {log_uri}", cache_policy=NO_CACHE, persist_result=False)
def run_step(work: FlightWork, step: str, log_uri: str) -> State[dict[str, str | None]]:
    """One step of a flight, from the cache or run; the state says which."""
    work.do(step)
    run_key = work.records[step]["run_key"]
    reference = {"stage": step, "flight_id": work.job.flight_id, "run_key": run_key}
    details = StateDetails(cache_key=run_key)
    if step in work.why:
        return Completed(message=f"Run: {work.why[step]}.", data=reference, state_details=details)
    return Completed(name="Cached", message="The result is there and whole.", data=reference, state_details=details)


@task(name="batch", task_run_name="batch {number}", cache_policy=NO_CACHE, persist_result=False)
def run_batch(number: int, root: str, source: Source, jobs: list[PlainJob], code: str) -> Answer:
    """A batch of flights, every step a task (`fieldcal.batch.flights.flights`), in a process that can be spared."""
    return flights(root, source, jobs, code, do=step_as_task, watched=True)


@task(name="publish", task_run_name="publish {vehicle_id}", cache_policy=NO_CACHE, persist_result=False)
def run_publish(vehicle_id: str, work: Publishing) -> list[str]:
    """Bring the history of one vehicle up to the night's outcomes; the tables that changed."""
    return work.publish()


def step_as_task(work: FlightWork, step: str) -> None:
    """One step as a Prefect task; where Prefect itself fails, without it."""
    try:
        run_step(unseen(work), step, work.job.log_uri)
    except WarehouseError:
        raise
    except Exception:
        if step not in work.records:
            work.do(step)


def publish_as_task(publishing: Publishing) -> None:
    """The publishing of a vehicle as a Prefect task; where Prefect itself fails, without it."""
    try:
        run_publish(publishing.vehicle_id, unseen(publishing))
    except WarehouseError:
        raise
    except Exception:
        publishing.publish()  # what was published already stays as it is
