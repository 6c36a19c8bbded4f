"""Batches in spawned processes of this machine, within the night's flow run.

A module of its own, because Prefect may load `nightly` under another name, which other processes would not find. Each
process tells Prefect's server of its tasks itself: through this one every event would be sent twice.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Self

from fieldcal.batch.documents import Answer, Batch
from fieldcal.batch.flights import flights
from fieldcal.batch.limits import notes
from fieldcal.flight.processes import one_of_many
from fieldcal.flows.farewell import tell_while_heard
from fieldcal.flows.runners import Answers, answer_of

LISTEN_S = 0.25
TRIES = 2
"""Of a batch whose process is killed by whom nobody knows."""
Context = dict[str, Any]
"""As Prefect's own `serialize_context` gives it."""


class Processes:
    """Processes that inherit nothing of this one, and end with it; they import what a batch needs from the start.

    Each is a pool of its own: one that is killed takes its own batch with it, and no other.
    """

    def __init__(self, number: int) -> None:
        self.free: list[ProcessPoolExecutor] = []
        for _ in range(number):
            self.add()

    def add(self) -> None:
        """Start one more."""
        process = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=one_of_many)
        process.submit(_import)
        self.free.append(process)

    def release(self) -> None:
        """Those that are free end; they still tell Prefect the rest while the night publishes."""
        while self.free:
            self.free.pop().shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.release()


@dataclass(frozen=True)
class _Given:
    """A batch, how often its process was killed, and which of its logs had been ended for their limits before."""

    batch: Batch
    killed: int = 0

    def ended(self) -> frozenset[tuple[str, int]]:
        return notes(Path(self.batch["root"]), [job["flight_id"] for job in self.batch["jobs"]])


def process_answers(number: int, inputs: Sequence[Batch], ahead: Processes | None = None) -> Answers:
    """Run the batches in so many processes; call it within the flow run that their tasks belong to.

    A batch whose process was ended because a log took more than its limits runs again: that log is rejected then. One
    whose process was killed otherwise runs once more; killed again, it comes back as an error.
    """
    context = _context()
    waiting = deque(_Given(batch) for batch in inputs)
    busy: dict[Future[Answer], tuple[_Given, frozenset[tuple[str, int]], ProcessPoolExecutor]] = {}
    with ahead or Processes(number) as processes:
        try:
            while waiting or busy:
                while waiting and processes.free:
                    process, given = processes.free.pop(), waiting[0]
                    try:
                        busy[process.submit(_batch, context, given.batch)] = given, given.ended(), process
                        waiting.popleft()
                    except BrokenProcessPool:  # it was killed before it had anything to do
                        processes.add()
                if not waiting:
                    processes.release()
                # A wait without end would not hear Ctrl-C.
                for future in wait(busy, LISTEN_S, FIRST_COMPLETED).done:
                    given, ended, process = busy.pop(future)
                    answer = answer_of(future)
                    if not isinstance(answer, BrokenProcessPool):
                        processes.free.append(process)
                        yield given.batch, answer
                        continue
                    killed = given.killed + (given.ended() == ended)
                    if killed < TRIES:
                        waiting.append(replace(given, killed=killed))
                    else:
                        yield given.batch, answer
                    processes.add()
        finally:
            processes.free += [process for _, _, process in busy.values()]


def _context() -> Context:
    """Prefect's context, with the name of its flow instead of the flow: a function is not sent."""
    from prefect.context import serialize_context

    context = serialize_context()
    run = context["flow_run_context"]
    return {**context, "flow_run_context": {**run, "flow": run["flow"].name}}


def _import() -> None:
    import_module("fieldcal.flows.nightly")


def _batch(context: Context, given: Batch) -> Answer:
    """One batch, in one of the processes; where Prefect itself fails, without it."""
    from prefect.context import hydrated_context

    from fieldcal.flows import nightly
    from fieldcal.flows.tasks import run_batch

    run = context["flow_run_context"]
    flow = {known.name: known for known in (nightly.nightly, nightly.session)}[run["flow"]]
    try:
        with hydrated_context({**context, "flow_run_context": {**run, "flow": flow}}):
            tell_while_heard()
            return run_batch(**given)
    except Exception:
        return flights(given["root"], given["source"], given["jobs"], given["code"], watched=True)
