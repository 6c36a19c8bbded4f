"""Where batches of flights run: in spawned processes of this machine, on Dask, or in a work pool; never in this one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Protocol

from fieldcal.batch.documents import Answer, Batch
from fieldcal.errors import FieldcalError
from fieldcal.flight.job import Job
from fieldcal.reason_codes import ReasonCode

if TYPE_CHECKING:
    from distributed import Client
    from prefect import Task
    from prefect_dask.task_runners import DaskTaskRunner

RUNNERS = ("process", "dask", "pool")
LARGEST_BATCH = 10
LARGEST_BATCH_BYTES = 64 << 20
"""Of logs: what their flights are between two stages is held in memory together, some two to five times as much."""
SMALLEST_BATCH = 2
SHARE_OF_A_WORKER = 4


@dataclass(frozen=True)
class Parallel:
    """How many processes, of which kind; `scheduler` is the address of a Dask scheduler.

    "pool": the deployment `batch/fieldcal` of `prefect.yaml`. Its workers, and those of a scheduler, see the same
    archive and warehouse as the night: the same folders, or by URL.

    Raises
    ------
    FieldcalError
        `wrong_option`.
    """

    workers: int = 1
    runner: str = "process"
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.runner not in RUNNERS:
            raise FieldcalError(
                ReasonCode.WRONG_OPTION, f"runner must be one of {', '.join(RUNNERS)}, not {self.runner!r}."
            )

    @property
    def elsewhere(self) -> bool:
        """Whether the workers may be on other machines."""
        return self.runner == "pool" or (self.runner == "dask" and self.scheduler is not None)

    def here(self) -> int:
        """How many processes of this machine the night may keep busy."""
        return self.workers if self.runner == "process" else 1

    def spawned(self, n_batches: int) -> int:
        """How many processes of this machine so many batches keep busy; one too, for a log may have its own ended."""
        return min(self.workers, n_batches) if self.runner == "process" else 0


def batches(jobs: Sequence[Job], workers: int) -> list[list[Job]]:
    """Jobs dealt out in batches, each a quarter of a worker's share of what is left, so that all end together, and no
    more bytes than a process is to hold."""
    smallest = min(SMALLEST_BATCH, -(-len(jobs) // workers))
    dealt: list[list[Job]] = []
    start = 0
    while start < len(jobs):
        share = -(-(len(jobs) - start) // (workers * SHARE_OF_A_WORKER))
        size = min(LARGEST_BATCH, max(smallest, share))
        held = list(accumulate(job.size_bytes for job in jobs[start : start + size]))
        size = max(1, sum(so_far <= LARGEST_BATCH_BYTES for so_far in held))
        dealt.append(list(jobs[start : start + size]))
        start += size
    return dealt


Answers = Iterator[tuple[Batch, Answer | Exception]]
"""Each input with what came back, in the order in which they end."""


def dask_answers(parallel: Parallel, task: Task[..., Answer], inputs: Sequence[Batch]) -> Answers:
    """Run `task` on a Dask cluster: the one of the scheduler, or one of this machine.

    Raises
    ------
    FieldcalError
        `no_dask`, `no_scheduler`.
    """
    from prefect.futures import as_completed

    with _dask(parallel) as runner:
        waiting = {runner.submit(task, dict(given)): given for given in inputs}
        for future in as_completed(list(waiting)):
            yield waiting[future], answer_of(future)


class Finished(Protocol):
    """A future, Python's or Prefect's."""

    def result(self) -> Answer: ...


def answer_of(future: Finished) -> Answer | Exception:
    """What a finished batch came back with."""
    try:
        return future.result()
    except Exception as error:
        return error


def _dask(parallel: Parallel) -> DaskTaskRunner:
    try:
        from prefect_dask.task_runners import DaskTaskRunner
    except ImportError as error:
        raise FieldcalError(ReasonCode.NO_DASK, 'Dask is not installed: pip install "fieldcal[dask]".') from error
    if parallel.scheduler is None:
        # Whoever reaches a scheduler has its workers run what he likes: with keys of its own only this process does.
        closed = {"security": True, "dashboard_address": None}
        return DaskTaskRunner(cluster_kwargs={"n_workers": parallel.workers, "threads_per_worker": 1, **closed})
    scheduler_client(parallel.scheduler).close()  # type: ignore[no-untyped-call]
    return DaskTaskRunner(address=parallel.scheduler)


def scheduler_client(address: str) -> Client:
    """A connection to a Dask scheduler.

    Raises
    ------
    FieldcalError
        `no_dask`, `no_scheduler`.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise FieldcalError(ReasonCode.NO_DASK, 'Dask is not installed: pip install "fieldcal[dask]".') from error
    try:
        return Client(address, timeout="10s", set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        what = f"No Dask scheduler answers at {address} ({error}). Start it, or mend --scheduler."
        raise FieldcalError(ReasonCode.NO_SCHEDULER, what) from error
