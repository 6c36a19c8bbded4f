"""Deployments: `nightly` on a schedule, `session` on demand, and `session-landed` for those who emit the event."""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import suppress
from pathlib import Path

from prefect import flow
from prefect.events import DeploymentEventTrigger
from prefect.exceptions import TerminationSignal
from prefect.runner import Runner
from prefect.schedules import Cron
from prefect.settings import PREFECT_API_URL
from prefect.types.entrypoint import EntrypointType

from fieldcal.batch.landing import Landing
from fieldcal.errors import FieldcalError
from fieldcal.flows.served import Served, served_landed, served_nightly, served_session
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


def register(served: Served, cron: str, timezone: str | None = None) -> Runner:
    """Register the three deployments anew, as they are meant, and give what runs them.

    The runner holds the flows themselves. It runs a deployment that somebody has overwritten as it was registered, and
    no step to pull code from anywhere.

    Raises
    ------
    ValueError
        `cron` or `timezone` is none.
    """
    runner = Runner(pause_on_shutdown=False, limit=AT_ONCE)
    landed = DeploymentEventTrigger(
        name=EVENT, expect={EVENT}, parameters={"folder": "{{ event.payload.folder }}"}, enabled=True
    )
    module = EntrypointType.MODULE_PATH
    given = served.parameters()
    schedule = Cron(cron, timezone=timezone or local_timezone())
    runner.add_flow(served_nightly(served), DEPLOYMENT, schedule=schedule, parameters=given, entrypoint_type=module)
    runner.add_flow(served_session(served), DEPLOYMENT, parameters=given, entrypoint_type=module)
    runner.add_flow(served_landed(served), DEPLOYMENT, triggers=[landed], entrypoint_type=module)
    return runner


def host(runner: Runner, url: str, watched: Path | None, quiet_s: float) -> None:
    """Host deployments until interrupted; with `watched`, trigger its sessions when they have stopped growing."""
    if watched is not None:
        threading.Thread(target=_watch, args=(watched, url, quiet_s), daemon=True).start()
    with suppress(KeyboardInterrupt, TerminationSignal):
        asyncio.run(runner.start())


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
