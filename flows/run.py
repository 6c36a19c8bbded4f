"""The night as a command runs it: server, flow, and what it says. Prefect is imported here, when it is needed."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from fieldcal.batch.documents import NightDocument, PlanDocument, PlannedLog, UnreadEntry
from fieldcal.config.find import configuration_of, find_source
from fieldcal.flows.connection import URL, connected
from fieldcal.flows.server import Server, running_server
from fieldcal.warehouse.layout import prepare
from fieldcal.words.talk import say

if TYPE_CHECKING:
    from prefect import State

    from fieldcal.batch.night import Night, Watcher


def run_night(
    archive: Path,
    root: Path,
    config: Path | None = None,
    session: Path | None = None,
    workers: int = 1,
    progress: Watcher | None = None,
    **where: str | None,
) -> NightDocument:
    """Run the flow `nightly`, or `session` for that folder of the archive; its JSON, with how long it took.

    Where nothing is new no server is started and no flow runs, unless the environment names a server: it hears of the
    night. A night of new code has it start while it plans.

    `where` may hold `runner` and `scheduler` (`runners`). `seconds` is the whole duration, `server_seconds` what
    of it went into importing Prefect and into waiting for its server once the night was planned, `stage_seconds` the
    stages' own work, summed over the workers.
    """
    began = time.monotonic()
    find_source(config, archive)
    prepare(root)
    from fieldcal.batch.ending import quiet_night
    from fieldcal.batch.night import plan_night
    from fieldcal.batch.sources import is_new_to

    named = bool(os.environ.get(URL))
    with ExitStack() as held:
        server = held.enter_context(running_server(root)) if is_new_to(root) else None
        night = plan_night(archive, root, config, session)
        if night.has_work() or named:
            server = server or held.enter_context(running_server(root))
            result, start_s = _with_prefect(server, night, workers, progress, **where)
        else:
            result, start_s = quiet_night(night, progress, workers), 0.0
    told: dict[str, object] = dict(result)
    logs = told.pop("logs")
    told |= {"seconds": round(time.monotonic() - began, 3), "server_seconds": round(start_s, 3)}
    return cast(NightDocument, {**told, "logs": logs})


def _with_prefect(
    server: Server,
    night: Night,
    workers: int,
    progress: Watcher | None,
    runner: str | None = None,
    scheduler: str | None = None,
) -> tuple[NightDocument, float]:
    """The night as a flow run; what came out, and the seconds that went into Prefect's start."""
    starting = time.monotonic()
    from fieldcal.flows.housekeeping import tidy_prefect
    from fieldcal.flows.nightly import flow_of
    from fieldcal.flows.processes import Processes
    from fieldcal.flows.runners import Parallel, batches

    parallel = Parallel(workers, runner or "process", scheduler)
    with Processes(parallel.spawned(len(batches(night.missing(), workers)))) as processes:
        url = server.wait()
        start_s = time.monotonic() - starting
        with server.explained(), connected(url):
            tidy_prefect(night.root, url, own_server=server.own)
            kept: list[NightDocument] = []
            planned = flow_of(night, parallel, progress, processes, kept.append)
            folder = str(night.session or night.archive)
            try:
                state: State[None] = cast(Any, planned)(
                    folder, str(night.root), workers, parallel.runner, return_state=True
                )
                if not kept:
                    state.result()  # raises what ended it
            except Exception as error:
                if not kept:
                    raise
                why = type(error).__name__
                say(f"Prefect's server was lost ({why}): the night is whole, Prefect's record of it is not.")
    return kept[0], start_s


def dry_run(archive: Path, root: Path, config: Path | None, session: Path | None) -> PlanDocument:
    """What the night would run; changes nothing."""
    from fieldcal.batch.plan import make_plan

    plan = make_plan(root, archive, configuration_of(find_source(config, archive)), session)
    logs: list[PlannedLog] = [
        {
            "log_uri": job.log_uri,
            "flight_id": job.flight_id,
            "would_run": plan.missing.get(job.flight_id, {}),
            "copy_of": plan.copies.get(job.log_uri),
        }
        for job in sorted([*plan.jobs, *plan.copied], key=lambda job: job.log_uri)
    ]
    unread: list[UnreadEntry] = [{"path": one.path, "why": one.why} for one in plan.unread]
    to_run = sum(len(log["would_run"]) for log in logs)
    return {"dry_run": True, "stages_to_run": to_run, "unread": unread, "logs": logs}
