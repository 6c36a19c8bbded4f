"""Batches in a Prefect work pool: each a flow run of the deployment `batch/fieldcal`, answered by a file or an object.

Whoever works for the pool sees the same archive and the same warehouse, as folders or by URL. A flow run's own result
is not used: Prefect would store it with a serialiser that the reader does not choose.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast
from uuid import UUID, uuid4

from fieldcal.batch.documents import Batch
from fieldcal.batch.elsewhere.work import FarAnswer, far
from fieldcal.errors import FieldcalError
from fieldcal.flows.cluster.answers import FarAnswers
from fieldcal.flows.runners import Answers
from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.objects import Objects
from fieldcal.remote.url import is_url
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.remote.heads import HANDED_OVER
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

if TYPE_CHECKING:
    from prefect.client.schemas.objects import State

BATCH_DEPLOYMENT = "batch/fieldcal"
LOOK_EVERY_S = 1.0
TRIES = 2
"""Of a batch whose flow run leaves no answer."""
BEAT_EVERY_S, SILENT_FOR_S = 15.0, 120.0
"""A flow run that works says so; one that has not for so long was lost with its worker, whatever Prefect thinks."""


def hand_over(root: str, name: str, answer: Mapping[str, object]) -> None:
    """Keep the answer of a batch for the night that asked; `root`: folder or URL of the warehouse."""
    _put(root, f"{name}.json", seal(answer))


@contextmanager
def beating(root: str, name: str) -> Iterator[None]:
    """During the block the night that waits for this answer is told that somebody works on it."""
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(BEAT_EVERY_S):
            with suppress(FieldcalError):
                _put(root, f"{name}.beat", str(time.time_ns()).encode())

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()


def pool_answers(inputs: Sequence[Batch]) -> Answers:
    """Run the batches in the work pool; each with its answer, in the order in which they end.

    Raises
    ------
    FieldcalError
        `no_deployment`.
    """
    return cast(Answers, _answers([(given, dict(given)) for given in inputs]))


def far_pool_answers(inputs: Sequence[Batch]) -> FarAnswers:
    """The same, by workers that see no folder of the night's."""
    answers = _answers([(given, dict(far(given))) for given in inputs])
    return cast(Iterator[tuple[Batch, FarAnswer | Exception]], answers)


@dataclass
class _Asked:
    """A flow run that a batch waits for: what it was given, under which name it answers, when it was last heard of."""

    given: Batch
    parameters: dict[str, object]
    tries: int = 1
    name: str = field(default_factory=lambda: uuid4().hex)
    beat: bytes | None = None
    heard_s: float = field(default_factory=time.monotonic)

    @property
    def root(self) -> str:
        return str(self.parameters["root"])

    def is_silent(self) -> bool:
        """Whether nothing was heard of it for long, though it runs."""
        beat = _get(self.root, f"{self.name}.beat")
        if beat != self.beat:
            self.beat, self.heard_s = beat, time.monotonic()
        return time.monotonic() - self.heard_s > SILENT_FOR_S


def _answers(
    inputs: Sequence[tuple[Batch, dict[str, object]]],
) -> Iterator[tuple[Batch, Mapping[str, Json] | Exception]]:
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    with get_client(sync_client=True) as client:
        try:
            deployment = client.read_deployment_by_name(BATCH_DEPLOYMENT)
        except ObjectNotFound as error:
            what = f"The server has no deployment {BATCH_DEPLOYMENT}: run `prefect deploy --all` (prefect.yaml)."
            raise FieldcalError(ReasonCode.NO_DEPLOYMENT, what) from error

        def ask(one: _Asked) -> UUID:
            parameters = {**one.parameters, "handed_over": one.name}
            return client.create_flow_run_from_deployment(deployment.id, parameters=parameters).id

        waiting = {ask(one): one for one in (_Asked(*each) for each in inputs)}
        while waiting:
            for run_id, one in list(waiting.items()):
                state = client.read_flow_run(run_id).state
                if not _is_over(one, state):
                    continue
                del waiting[run_id]
                answer = _taken(one.root, one.name, None if state is None else state.name)
                if isinstance(answer, Exception) and one.tries < TRIES:
                    again = _Asked(one.given, one.parameters, one.tries + 1)
                    waiting[ask(again)] = again
                else:
                    yield one.given, answer
            time.sleep(LOOK_EVERY_S)


def _is_over(one: _Asked, state: State | None) -> bool:
    if state is None or not state.is_running():
        one.heard_s = time.monotonic()
    return state is not None and (state.is_final() or (state.is_running() and one.is_silent()))


def _taken(root: str, name: str, state: str | None) -> Mapping[str, Json] | Exception:
    try:
        answer = unseal(_get(root, f"{name}.json") or b"")
    except BrokenSeal:
        return FieldcalError(ReasonCode.BATCH_LOST, f"its flow run ended as {state} and left no answer")
    _delete(root, [f"{name}.json", f"{name}.beat"])
    return answer


def _put(root: str, name: str, data: bytes) -> None:
    if is_url(root):
        Objects(root).put(f"{HANDED_OVER}/{name}", data)
    else:
        write_bytes(_folder(root) / name, data, durable=False)


def _get(root: str, name: str) -> bytes | None:
    if is_url(root):
        found = Objects(root).get(f"{HANDED_OVER}/{name}")
        return None if found is None else found[0]
    try:
        return (_folder(root) / name).read_bytes()
    except OSError:
        return None


def _delete(root: str, names: Sequence[str]) -> None:
    """Whoever may not delete by URL leaves it to those who prune."""
    if is_url(root):
        with suppress(FieldcalError):
            Objects(root).delete([f"{HANDED_OVER}/{name}" for name in names])
    else:
        for name in names:
            (_folder(root) / name).unlink(missing_ok=True)


def _folder(root: str) -> Path:
    return Path(root) / "night" / "handed-over"
