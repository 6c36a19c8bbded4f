"""Batches in a Prefect work pool: each a flow run of the deployment `batch/fieldcal`, answered by a file.

Whoever works for the pool sees the same archive and the same warehouse. A flow run's own result is not used: Prefect
would store it with a serialiser that the reader does not choose.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast
from uuid import UUID, uuid4

from fieldcal.batch.documents import Answer, Batch
from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

BATCH_DEPLOYMENT = "batch/fieldcal"
LOOK_EVERY_S = 1.0


def hand_over(root: Path, name: str, answer: Answer) -> None:
    """Keep the answer of a batch for the night that asked."""
    write_bytes(_place(root, name), seal(answer), durable=False)


def pool_answers(inputs: Sequence[Batch]) -> Iterator[tuple[Batch, Answer | Exception]]:
    """Run the batches in the work pool; each with its answer, in the order in which they end.

    Raises
    ------
    FieldcalError
        `no_deployment`.
    """
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    with get_client(sync_client=True) as client:
        try:
            deployment = client.read_deployment_by_name(BATCH_DEPLOYMENT)
        except ObjectNotFound as error:
            what = f"The server has no deployment {BATCH_DEPLOYMENT}: run `prefect deploy --all` (prefect.yaml)."
            raise FieldcalError(ReasonCode.NO_DEPLOYMENT, what) from error
        waiting: dict[UUID, tuple[Batch, str]] = {}
        for given in inputs:
            name = uuid4().hex
            run = client.create_flow_run_from_deployment(deployment.id, parameters={**given, "handed_over": name})
            waiting[run.id] = (given, name)
        while waiting:
            for run_id, (given, name) in list(waiting.items()):
                state = client.read_flow_run(run_id).state
                if state is not None and state.is_final():
                    del waiting[run_id]
                    yield given, _taken(Path(given["root"]), name, state.name)
            time.sleep(LOOK_EVERY_S)


def _taken(root: Path, name: str, state: str | None) -> Answer | Exception:
    place = _place(root, name)
    try:
        answer = cast(Answer, unseal(place.read_bytes()))
    except (OSError, BrokenSeal):
        return FieldcalError(ReasonCode.BATCH_LOST, f"its flow run ended as {state} and left no answer")
    place.unlink(missing_ok=True)
    return answer


def _place(root: Path, name: str) -> Path:
    return root / "night" / "handed-over" / f"{name}.json"
