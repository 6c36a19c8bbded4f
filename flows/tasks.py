"""The night's work as Prefect tasks: a stage of a batch of flights, the batch, the publishing of a vehicle.

A stage whose results are in the warehouse, whole, ends in the state `Cached`; its cache key is the digest of its
flights' run keys: the warehouse is the only cache, so Prefect keeps no results of its own (a result record of Prefect's
chooses its own deserialiser). A task costs ten milliseconds, most of a flight's cheaper stages: so one is for many.
Where Prefect's server is lost, the work goes on without it.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from typing import TypeVar, cast

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, StateDetails
from prefect.states import Completed
from prefect.utilities.annotations import quote

from fieldcal.batch.documents import Answer
from fieldcal.batch.flights import Walk, flights, take
from fieldcal.batch.night import Publishing
from fieldcal.config.find import Source
from fieldcal.flight.job import PlainJob
from fieldcal.warehouse.errors import WarehouseError

T = TypeVar("T")


def unseen(value: T) -> T:
    """A parameter of a task that Prefect does not walk through; the task gets it as it is."""
    return cast(T, quote(value))


@task(name="stage", task_run_name="{step}, {n} logs of batch {number}", cache_policy=NO_CACHE, persist_result=False)
def run_stage(walks: Sequence[Walk], step: str, number: int, n: int) -> State[list[dict[str, str | None]]]:
    """One step of a batch's flights, each from the cache or run; the state says which, and what they are."""
    take(step, walks)
    done = [walk for walk in walks if step in walk.records]
    found = [
        {"flight_id": walk.job.flight_id, "run_key": walk.records[step]["run_key"], "why": walk.why.get(step)}
        for walk in done
    ]
    ran = Counter(walk.why[step] for walk in done if step in walk.why)
    details = StateDetails(cache_key=digest_of([str(one["run_key"]) for one in found]))
    if not ran and len(done) == n:
        return Completed(name="Cached", message="Results are there and whole.", data=found, state_details=details)
    told = [f"{count} run: {why}" for why, count in ran.most_common()]
    told += [f"{n_cached} there and whole"] if (n_cached := len(done) - ran.total()) else []
    told += [f"{n - len(done)} failed"] if len(done) < n else []
    return Completed(message=f"{'; '.join(told)}.", data=found, state_details=details)


@task(name="batch", task_run_name="batch {number}", cache_policy=NO_CACHE, persist_result=False)
def run_batch(number: int, root: str, source: Source, jobs: list[PlainJob], code: str) -> Answer:
    """A batch of flights, every step a task (`fieldcal.batch.flights.flights`), in a process that can be spared."""

    def as_task(step: str, walks: Sequence[Walk]) -> None:
        stage_as_task(step, walks, number)

    return flights(root, source, jobs, code, do=as_task, watched=True)


@task(name="publish", task_run_name="publish {vehicle_id}", cache_policy=NO_CACHE, persist_result=False)
def run_publish(vehicle_id: str, work: Publishing) -> list[str]:
    """Bring the history of one vehicle up to the night's outcomes; the tables that changed."""
    return work.publish()


def stage_as_task(step: str, walks: Sequence[Walk], number: int) -> None:
    """One step of a batch's flights as a Prefect task; where Prefect itself fails, without it."""
    try:
        run_stage(unseen(walks), step, number, len(walks))
    except WarehouseError:
        raise
    except Exception:
        take(step, walks)  # those that took it already stay as they are


def digest_of(keys: Sequence[str]) -> str:
    """One digest of flights' run keys."""
    return hashlib.sha256("\0".join(keys).encode()).hexdigest()


def publish_as_task(publishing: Publishing) -> None:
    """The publishing of a vehicle as a Prefect task; where Prefect itself fails, without it."""
    try:
        run_publish(publishing.vehicle_id, unseen(publishing))
    except WarehouseError:
        raise
    except Exception:
        publishing.publish()  # what was published already stays as it is
