"""Deployments: `nightly` on a schedule, `session` on demand, and `session-landed` for those who emit the event."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import cast

from prefect import flow, serve
from prefect.deployments.runner import RunnerDeployment
from prefect.events import DeploymentEventTrigger
from prefect.schedules import Cron
from prefect.settings import PREFECT_API_URL
from prefect.types.entrypoint import EntrypointType

from fieldcal.batch.landing import Landing
from fieldcal.errors import FieldcalError
from fieldcal.flows.nightly import nightly, session
from fieldcal.flows.trigger import DEPLOYMENT, EVENT, trigger
from fieldcal.reason_codes import ReasonCode
from fieldcal.words.talk import say

AT_ONCE = 2
LOOK_EVERY_S = 5.0


@flow(name="session-landed", persist_result=False, validate_parameters=False)
def session_landed(folder: str) -> str:
    """What the automation on `fieldcal.session.landed` runs: it asks for the session as `fieldcal trigger` does.

    So an event that comes twice, or beside a command, runs the session once.
    """
    url = PREFECT_API_URL.value()
    if url is None or not Path(folder).is_dir():
        raise FieldcalError(ReasonCode.NO_SESSION, f"There is no session folder at {folder}, which the event names.")
    return str(trigger(url, Path(folder).absolute())["flow_run_id"])


def deployments(
    archive: Path, root: Path, config: Path | None, cron: str, workers: int, timezone: str | None = None
) -> list[RunnerDeployment]:
    """The three deployments. Parameters name absolute paths, so that they hold wherever they run on this machine."""
    common: dict[str, str | int | None] = {
        "warehouse": str(root.absolute()),
        "config": str(config.absolute()) if config else None,
        "workers": workers,
    }
    landed = DeploymentEventTrigger(
        name=EVENT, expect={EVENT}, parameters={"folder": "{{ event.payload.folder }}"}, enabled=True
    )
    module = EntrypointType.MODULE_PATH
    found = [
        nightly.to_deployment(
            DEPLOYMENT,
            schedule=Cron(cron, timezone=timezone or local_timezone()),
            parameters={"archive": str(archive.absolute()), **common},
            entrypoint_type=module,
        ),
        session.to_deployment(DEPLOYMENT, parameters=common, entrypoint_type=module),
        session_landed.to_deployment(DEPLOYMENT, triggers=[landed], entrypoint_type=module),
    ]
    # A coroutine is what these are only where an event loop runs, which no command has.
    return cast(list[RunnerDeployment], found)


def host(hosted: list[RunnerDeployment], url: str, watched: Path | None, quiet_s: float) -> None:
    """Host deployments until interrupted; with `watched`, trigger its sessions when they have stopped growing."""
    if watched is not None:
        threading.Thread(target=_watch, args=(watched, url, quiet_s), daemon=True).start()
    serve(*hosted, pause_on_shutdown=False, print_starting_message=False, limit=AT_ONCE)


def local_timezone() -> str:
    """IANA name of this machine's time zone; UTC where it has none."""
    from tzlocal import get_localzone_name

    return str(get_localzone_name() or "UTC")


def _watch(archive: Path, url: str, quiet_s: float) -> None:
    landing = Landing(archive, quiet_s)
    while True:
        for folder in landing.finished(time.monotonic()):
            try:
                asked = trigger(url, folder)
            except Exception as error:  # the watch goes on; the night takes what it missed
                say(f"{folder}: could not be triggered ({error}); the next night takes it.")
                continue
            say(f"{folder} has landed: flow run {asked['name']}, {asked['state']}")
        time.sleep(LOOK_EVERY_S)
