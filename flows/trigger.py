"""Ask a Prefect server to run `session` for a finished field session: once, however often one asks."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from fieldcal.batch.session_folder import archive_of
from fieldcal.errors import FieldcalError
from fieldcal.flows.connection import (
    OF_THE_USER,
    SECRET,
    URL,
    answers,
    connected,
    environment_for,
    kept_secret,
    need_entry,
    no_answer,
    of_ours,
)
from fieldcal.flows.server import home_of, prepare_environment, serving_address
from fieldcal.reason_codes import ReasonCode
from fieldcal.warehouse.files import file_sha256

if TYPE_CHECKING:
    from uuid import UUID

    from prefect.client.orchestration import SyncPrefectClient
    from prefect.client.schemas.objects import FlowRun

DEPLOYMENT = "fieldcal"
EVENT = "fieldcal.session.landed"
UNSUCCESSFUL = ("FAILED", "CRASHED", "CANCELLED")
MOST_TRIES = 100


def session_digest(folder: Path) -> str:
    """Digest of a session folder's content: every file's place in it and its sha256; links out of it do not count."""
    inside = folder.resolve()
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*"), key=lambda path: path.relative_to(folder).as_posix()):
        if path.is_file() and path.resolve().is_relative_to(inside):
            digest.update(
                f"{path.relative_to(folder).as_posix()}\0{file_sha256(path)}\0".encode("utf-8", "surrogatepass")
            )
    return digest.hexdigest()


def server_address(root: Path) -> str:
    """Where to ask: `PREFECT_API_URL`, else the server that `fieldcal serve` started for this data root.

    Prefect finds what it needs to talk to it in the environment afterwards.

    Raises
    ------
    FieldcalError
        `prefect_unavailable`: none is known, or it does not answer. `wrong_secret`.
    """
    if url := os.environ.get(URL):
        if not answers(url):
            raise FieldcalError(ReasonCode.PREFECT_UNAVAILABLE, no_answer(url))
        prepare_environment(root, serving=True)
        os.environ.update(environment_for(url, os.environ.get(SECRET)))
        need_entry(url, OF_THE_USER)
        return url
    own = serving_address(root)
    if own is None or not answers(own):
        raise FieldcalError(
            ReasonCode.PREFECT_UNAVAILABLE,
            f"No server runs for the warehouse {root}: start `fieldcal serve`, or set PREFECT_API_URL. The session is "
            "not lost: the next night takes it, and `fieldcal session` runs it now.",
        )
    prepare_environment(root, serving=True)
    home = home_of(root, serving=True)
    os.environ.update(environment_for(own, kept_secret(home)))
    need_entry(own, of_ours(home))
    return own


class Asked(TypedDict):
    """The flow run of a session. `created` False: it had been asked for before; `digest` of the session's content."""

    flow_run_id: str
    name: str
    state: str
    created: bool
    digest: str


def trigger(url: str, folder: Path, **changes: str | int | None) -> Asked:
    """Create the flow run of a session, unless there is one for the same content already.

    A run that failed is followed by a new one. `changes` overrule parameters of a deployment of the user's own; those
    of `fieldcal serve` stay as they are.

    Returns
    -------
    dict
        `flow_run_id`, `name`, `state`, `created` (False: it had been asked for before), `digest`.

    Raises
    ------
    FieldcalError
        `no_deployment`: nobody hosts the flow on this server. `outside_archives`, `wrong_option`: `fieldcal serve`
        takes no such folder, or no such change.
    """
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    with connected(url), get_client(sync_client=True) as client:
        try:
            deployment = client.read_deployment_by_name(f"session/{DEPLOYMENT}")
        except ObjectNotFound as error:
            raise FieldcalError(
                ReasonCode.NO_DEPLOYMENT,
                f"The server at {url} has no deployment session/{DEPLOYMENT}: start `fieldcal serve` there, or deploy "
                "prefect.yaml.",
            ) from error
        if (archives := deployment.parameters.get("archives")) is not None:
            archive_of(folder, [Path(archive) for archive in archives])
            _need_no_change(deployment.parameters, changes)
            changes = {}
        digest = session_digest(folder)
        run, created = _run_for(client, deployment.id, digest, {"folder": str(folder), **changes})
        state = (run.state.name if run.state else None) or "Scheduled"
        return {"flow_run_id": str(run.id), "name": run.name, "state": state, "created": created, "digest": digest}


def _need_no_change(served: dict[str, object], changes: dict[str, str | int | None]) -> None:
    """What `fieldcal serve` was started with, it refuses to change; better said before it is asked."""
    for name, wanted in changes.items():
        own = served.get(name)
        if own is None or Path(str(own)).resolve() != Path(str(wanted)).resolve():
            what = (
                f"fieldcal serve was started with {name} {own}; a session cannot have {wanted} instead: leave it out."
            )
            raise FieldcalError(ReasonCode.WRONG_OPTION, what)


def _run_for(
    client: SyncPrefectClient, deployment: UUID, digest: str, parameters: dict[str, str | int | None]
) -> tuple[FlowRun, bool]:
    """The run with this digest as idempotency key, and whether it is new; after one that failed, the next try's."""
    from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterIdempotencyKey

    for number in range(1, MOST_TRIES + 1):
        key = digest if number == 1 else f"{digest}-{number}"
        asked = FlowRunFilter(idempotency_key=FlowRunFilterIdempotencyKey(any_=[key]))
        before = client.read_flow_runs(flow_run_filter=asked, limit=1)
        if before and before[0].state_type is not None and before[0].state_type.value in UNSUCCESSFUL:
            continue
        run = client.create_flow_run_from_deployment(deployment, parameters=parameters, idempotency_key=key)
        return run, not before
    raise FieldcalError(
        ReasonCode.SESSION_FAILS, f"{MOST_TRIES} runs of this session failed; look at them on the server."
    )
