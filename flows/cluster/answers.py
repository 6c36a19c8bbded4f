"""What came back of batches that were elsewhere, taken into the night's copy of the warehouse."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from prefect import task
from prefect.cache_policies import NO_CACHE

from fieldcal.batch.documents import Answer, Batch
from fieldcal.batch.elsewhere.work import FarAnswer, take_in
from fieldcal.errors import FieldcalError
from fieldcal.flows.runners import Answers
from fieldcal.flows.tasks import unseen
from fieldcal.words.talk import say

FarAnswers = Iterator[tuple[Batch, FarAnswer | Exception]]
"""Each input with what came back, in the order in which they end."""


def taken_in(far_answers: FarAnswers) -> Answers:
    """Each batch with its answer, its results in the copy."""
    for given, far_answer in far_answers:
        answer: Answer | Exception
        if isinstance(far_answer, Exception):
            answer = far_answer
        else:
            for line in far_answer["logged"]:
                say(f"Worker {far_answer['worker']}: {line}")
            try:
                answer = _taken_in(Path(given["root"]), given["number"], far_answer)
            except Exception as error:
                answer = error
        yield given, answer


@task(name="take-in", task_run_name="batch {number} from {worker}", cache_policy=NO_CACHE, persist_result=False)
def run_take_in(number: int, worker: str, root: Path, answer: FarAnswer) -> Answer:
    """A batch's results from the store into the copy."""
    return take_in(root, answer)


def _taken_in(root: Path, number: int, answer: FarAnswer) -> Answer:
    """As a Prefect task, from whose name people learn which worker it was; where Prefect itself fails, without it."""
    try:
        return run_take_in(number, answer["worker"], root, unseen(answer))
    except FieldcalError:
        raise
    except Exception:
        return take_in(root, answer)
