"""Batches in spawned processes of this machine, within the night's flow run.

A module of its own, because Prefect may load `nightly` under another name, which other processes would not find. Each
process tells Prefect's server of its tasks itself: through this one every event would be sent twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from importlib import import_module
from multiprocessing import get_context
from typing import Any

from fieldcal.batch.documents import Answer, Batch
from fieldcal.flows.runners import Answers, answer_of

LISTEN_S = 0.25
Context = dict[str, Any]
"""As Prefect's own `serialize_context` gives it."""


def spawned(workers: int) -> ProcessPoolExecutor:
    """Processes that inherit nothing of this one."""
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"))


def spawned_ahead(workers: int) -> ProcessPoolExecutor:
    """The same, already importing what a batch needs."""
    pool = spawned(workers)
    for _ in range(workers):
        pool.submit(_import)
    return pool


def process_answers(pool: ProcessPoolExecutor, inputs: Sequence[Batch]) -> Answers:
    """Run the batches; call it within the flow run that their tasks belong to."""
    context = _context()
    with pool:
        waiting: dict[Future[Answer], Batch] = {}
        waiting |= {pool.submit(_batch, context, given): given for given in inputs}
        while waiting:
            # A wait without end would not hear Ctrl-C.
            for future in wait(waiting, LISTEN_S, FIRST_COMPLETED).done:
                yield waiting.pop(future), answer_of(future)
        pool.shutdown(wait=False)  # they tell Prefect the rest while the night publishes


def _context() -> Context:
    """Prefect's context, with the name of its flow instead of the flow: a function is not sent."""
    from prefect.context import serialize_context

    context = serialize_context()
    run = context["flow_run_context"]
    return {**context, "flow_run_context": {**run, "flow": run["flow"].name}}


def _import() -> None:
    import_module("fieldcal.flows.nightly")


def _batch(context: Context, given: Batch) -> Answer:
    """One batch, in one of the processes."""
    from prefect.context import hydrated_context

    from fieldcal.flows import nightly
    from fieldcal.flows.tasks import run_batch

    run = context["flow_run_context"]
    flow = {known.name: known for known in (nightly.nightly, nightly.session)}[run["flow"]]
    with hydrated_context({**context, "flow_run_context": {**run, "flow": flow}}):
        return run_batch(**given)
