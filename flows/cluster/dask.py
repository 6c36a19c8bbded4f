"""Batches on the workers of a Dask scheduler that see no folder of the night's.

They are submitted as they are, not as Prefect tasks: a worker elsewhere seldom reaches the night's server. The
scheduler runs a batch again whose worker is lost, and gives it up when it has lost several (its own
`allowed-failures`, 3); its logs are the night's then, one by one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING
from uuid import uuid4

from fieldcal.batch.documents import Batch
from fieldcal.batch.elsewhere.same import difference, made_by
from fieldcal.batch.elsewhere.work import FarAnswer, far, work
from fieldcal.errors import FieldcalError
from fieldcal.flows.cluster.answers import FarAnswers
from fieldcal.flows.runners import scheduler_client
from fieldcal.reason_codes import ReasonCode
from fieldcal.words.talk import say

if TYPE_CHECKING:
    from distributed import Client, Future


def far_dask_answers(scheduler: str, inputs: Sequence[Batch]) -> FarAnswers:
    """Run the batches on the scheduler's workers; each with its answer, in the order in which they end.

    Raises
    ------
    FieldcalError
        `no_dask`, `no_scheduler`; `code_changed`: a worker has other versions than the night.
    """
    from distributed import as_completed

    with scheduler_client(scheduler) as client:
        check_versions(client)
        run = uuid4().hex
        waiting: dict[Future[FarAnswer], Batch] = {
            client.submit(work, far(given), key=f"fieldcal-{run}-{given['number']}", pure=False): given
            for given in inputs
        }
        for future in as_completed(list(waiting), loop=client.loop):  # type: ignore[no-untyped-call]
            given = waiting.pop(future)
            try:
                yield given, future.result()
            except Exception as error:
                yield given, error


def check_versions(client: Client) -> None:
    """Make sure that all workers compute as the night does; those that come later are asked with each batch.

    Raises
    ------
    FieldcalError
        `code_changed`: names one that does not, and the versions.
    """
    ours = made_by()
    told: Mapping[str, object] = client.run(made_by, on_error="return")
    if not told:
        say("The scheduler has no workers yet; the night waits for them.")
    for worker, theirs in sorted(told.items()):
        if not isinstance(theirs, dict):
            what = f"Worker {worker} does not run this fieldcal ({type(theirs).__name__}: {theirs}): install it there."
            raise FieldcalError(ReasonCode.CODE_CHANGED, what)
        if (other := difference(worker, theirs, ours)) is not None:
            raise FieldcalError(ReasonCode.CODE_CHANGED, other)
