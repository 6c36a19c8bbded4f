"""Where batches of flights run: in this process, in spawned processes of this machine, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fieldcal.errors import FieldcalError
from flows.jobs import Job

if TYPE_CHECKING:
    from prefect.task_runners import TaskRunner

RUNNERS = ("process", "dask")
LARGEST_BATCH = 40
SMALLEST_BATCH = 4
SHARE_OF_A_WORKER = 4


@dataclass(frozen=True)
class Parallel:
    """How many processes, of which kind; `scheduler` is the address of a Dask scheduler."""

    workers: int = 1
    runner: str = "process"
    scheduler: str | None = None

    def in_this_process(self, n_batches: int) -> bool:
        """Whether other processes would only cost."""
        return self.runner == "process" and (self.workers == 1 or n_batches <= 1)


def batches(jobs: Sequence[Job], workers: int) -> list[list[Job]]:
    """Jobs dealt out in batches, each a quarter of a worker's share of what is left, so that all end together."""
    smallest = min(SMALLEST_BATCH, -(-len(jobs) // workers))
    dealt: list[list[Job]] = []
    start = 0
    while start < len(jobs):
        share = -(-(len(jobs) - start) // (workers * SHARE_OF_A_WORKER))
        size = min(LARGEST_BATCH, max(smallest, share))
        dealt.append(list(jobs[start : start + size]))
        start += size
    return dealt


def task_runner(parallel: Parallel) -> TaskRunner[Any]:
    """The runner that takes the batches.

    Raises
    ------
    FieldcalError
        `wrong_option`, `no_dask` (not installed), `no_scheduler` (none answers at the address).
    """
    if parallel.runner == "process":
        from prefect.task_runners import ProcessPoolTaskRunner

        return ProcessPoolTaskRunner(max_workers=parallel.workers)
    if parallel.runner != "dask":
        raise FieldcalError("wrong_option", f"runner must be one of {', '.join(RUNNERS)}, not {parallel.runner!r}.")
    try:
        from distributed import Client
        from prefect_dask.task_runners import DaskTaskRunner
    except ImportError as error:
        raise FieldcalError("no_dask", 'Dask is not installed: pip install "fieldcal[dask]".') from error
    if parallel.scheduler is None:
        return DaskTaskRunner(cluster_kwargs={"n_workers": parallel.workers, "threads_per_worker": 1})
    try:
        Client(parallel.scheduler, timeout="10s").close()  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        what = f"No Dask scheduler answers at {parallel.scheduler} ({error}). Start it, or mend --scheduler."
        raise FieldcalError("no_scheduler", what) from error
    return DaskTaskRunner(address=parallel.scheduler)
