"""Batches in spawned processes of this machine, within the night's flow run.

A module of its own, because Prefect may load `nightly` under another name, which other processes would not find. Each
process tells Prefect's server of its tasks itself: through this one every event would be sent twice.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from multiprocessing import get_context
from typing import Any

from fieldcal.batch.documents import Answer, Batch
from fieldcal.batch.flights import flights
from fieldcal.flows.farewell import end_with_parent, tell_while_heard
from fieldcal.flows.runners import Answers, answer_of

LISTEN_S = 0.25
Context = dict[str, Any]
"""As Prefect's own `serialize_context` gives it."""


def spawned(workers: int) -> ProcessPoolExecutor:
    """Processes that inherit nothing of this one, and end with it."""
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=end_with_parent)


def spawned_ahead(workers: int) -> ProcessPoolExecutor:
    """The same, already importing what a batch needs."""
    pool = spawned(workers)
    for _ in range(workers):
        pool.submit(_import)
    return pool


def process_answers(workers: int, inputs: Sequence[Batch], ahead: ProcessPoolExecutor | None = None) -> Answers:
    """Run the batches; call it within the flow run that their tasks belong to.

    A process that is killed takes all batches of its pool with it, not only its own, and there is no saying which that
    was. They run in a second pool; those that were in it too when it broke come back as errors.
    """
    context = _context()
    lost = yield from _answers(ahead or spawned(workers), context, inputs)
    if lost:
        lost = yield from _answers(spawned(workers), context, [given for given, _ in lost])
    yield from lost


def _answers(
    pool: ProcessPoolExecutor, context: Context, inputs: Sequence[Batch]
) -> Generator[tuple[Batch, Answer | Exception], None, list[tuple[Batch, Exception]]]:
    """The answers of one pool; returns the batches that it lost because it broke."""
    lost: list[tuple[Batch, Exception]] = []
    with pool:
        waiting: dict[Future[Answer], Batch] = {}
        for given in inputs:
            try:
                waiting[pool.submit(_batch, context, given)] = given
            except BrokenProcessPool as error:
                lost.append((given, error))
        while waiting:
            # A wait without end would not hear Ctrl-C.
            for future in wait(waiting, LISTEN_S, FIRST_COMPLETED).done:
                given, answer = waiting.pop(future), answer_of(future)
                if isinstance(answer, BrokenProcessPool):
                    lost.append((given, answer))
                else:
                    yield given, answer
        pool.shutdown(wait=False)  # they tell Prefect the rest while the night publishes
    return lost


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
        return flights(given["root"], given["source"], given["jobs"], given["code"])
