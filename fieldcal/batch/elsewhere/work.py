"""A batch that goes to another machine, what is done there, and how its results come back.

The batch names the logs by their places in the archive's store, each in the version that the night saw and with its
sha256. The worker fetches them into its own cache, computes in a data root of its own, and hands over what it made
(`warehouse.remote.handed_over`). The night takes that into its copy and publishes as if it had computed it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypedDict

from fieldcal.batch.documents import Answer, Batch, PlainOutcome
from fieldcal.batch.elsewhere.heard import heard
from fieldcal.batch.elsewhere.own_root import own_root
from fieldcal.batch.elsewhere.same import difference, made_by, this_worker
from fieldcal.batch.flights import Round, flights, take
from fieldcal.config.find import Source
from fieldcal.flight.job import Job, PlainJob
from fieldcal.logs import log_sha256
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import ARCHIVES, called, origin
from fieldcal.remote.content import here
from fieldcal.remote.objects import Objects
from fieldcal.remote.sent import SentLog, received, sent
from fieldcal.remote.url import RemoteError, is_url
from fieldcal.warehouse.remote.handed_over import HandedOver, hand_over, take_over
from fieldcal.warehouse.remote.known import objects_of


class FarBatch(TypedDict):
    """A `Batch` for a worker that sees no folder of the night's. `root`: URL of the warehouse, or the folder that all
    share; `logs`: by flight, of those in an archive by URL; `made_by`: versions of the night."""

    number: int
    root: str
    source: Source
    jobs: list[PlainJob]
    code: str
    logs: dict[str, SentLog]
    made_by: dict[str, str]


class FarAnswer(TypedDict):
    """`answer`, of which `handed` has the results; None where they lie in a folder that all share. `logged`: what the
    night has to say of the worker."""

    answer: Answer
    handed: HandedOver | None
    worker: str
    logged: list[str]


def is_far(archive: Path, root: Path) -> bool:
    """Whether workers on other machines see not all that the night works on, since some of it is a copy."""
    return origin(ARCHIVES, archive) is not None or objects_of(root) is not None


def far(given: Batch) -> FarBatch:
    """The batch as it goes to another machine."""
    root = Path(given["root"])
    places = {job["flight_id"]: sent(Path(job["path"])) for job in given["jobs"] if job["problem"] is None}
    logs = {flight_id: one for flight_id, one in places.items() if one is not None}
    return {**given, "root": called(root), "logs": logs, "made_by": made_by()}


def work(given: FarBatch, do: Round = take) -> FarAnswer:
    """Calibrate a batch on this machine, which need not see anything of the night's.

    What concerns every log is told in the answer: other versions than the night's, a store that refuses.
    """
    worker = this_worker()
    handed: HandedOver | None = None
    other = difference(worker, made_by(), given["made_by"])
    with heard() as lines:
        try:
            if other is not None:
                answer = _refused(ReasonCode.CODE_CHANGED, other)
            else:
                answer, handed = _worked(given, do)
        except RemoteError as error:
            answer = _refused(error.reason_code, f"{error.sentence} (Told by worker {worker}.)")
    return {"answer": answer, "handed": handed, "worker": worker, "logged": lines}


def _worked(given: FarBatch, do: Round) -> tuple[Answer, HandedOver | None]:
    jobs = [_arrived(job, given["logs"]) for job in given["jobs"]]
    if not is_url(given["root"]):
        return _as_asked(flights(given["root"], given["source"], jobs, given["code"], do, watched=True), given), None
    with own_root() as root:
        answer = flights(str(root), given["source"], jobs, given["code"], do, watched=True)
        handed = hand_over(Objects(given["root"]), root) if answer["error"] is None else None
        return _as_asked(answer, given), handed


def take_in(root: Path, answer: FarAnswer) -> Answer:
    """Have a batch's results in the copy of the warehouse.

    Raises
    ------
    FieldcalError
        `batch_lost`: they are not there any more; `damaged_file`, or the store's refusal, or the disk's.
    """
    objects, handed = objects_of(root), answer["handed"]
    if handed is not None and objects is not None:
        take_over(objects, root, handed)
    return answer["answer"]


def _refused(reason_code: str, sentence: str) -> Answer:
    return {"outcomes": [], "error": [reason_code, sentence]}


def _arrived(plain: PlainJob, logs: Mapping[str, SentLog]) -> PlainJob:
    """A log at its place on this machine, with the content that the night saw."""
    given = logs.get(plain["flight_id"])
    if given is None:
        return plain
    job = replace(Job(**plain), path=str(received(given)))
    try:
        with here(Path(job.path)):
            same = log_sha256(Path(job.path)) == job.sha256
    except (RemoteError, OSError):  # told when it is read
        same = True
    if not same:
        why = f"{job.log_uri} came to {this_worker()} with another content than it was planned with; run it again."
        job = replace(job, problem=why)
    return job.plain()


def _as_asked(answer: Answer, given: FarBatch) -> Answer:
    """The answer about the logs as the night knows them: where they lie on its own machine."""
    asked = {job["flight_id"]: job for job in given["jobs"]}
    outcomes: list[PlainOutcome] = [{**one, "job": asked[one["job"]["flight_id"]]} for one in answer["outcomes"]]
    return {"outcomes": outcomes, "error": answer["error"]}
