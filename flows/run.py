"""The night as a command runs it: server, flow, and what it says. Prefect is imported here, when it is needed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from fieldcal.batch.documents import NightDocument, PlanDocument, PlannedLog, UnreadEntry
from fieldcal.config.find import configuration_of, find_source
from fieldcal.flows.connection import connected
from fieldcal.flows.server import running_server
from fieldcal.warehouse.layout import prepare
from fieldcal.words.talk import say

if TYPE_CHECKING:
    from prefect import State

    from fieldcal.batch.night import Watcher


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

    `where` may hold `runner` and `scheduler` (`runners`). `seconds` is the whole duration, `server_seconds` what
    of it went into importing Prefect and into waiting for its server once the night was planned, `stage_seconds` the
    stages' own work, summed over the workers.
    """
    began = time.monotonic()
    find_source(config, archive)
    prepare(root)
    runner, scheduler = where.get("runner") or "process", where.get("scheduler")
    with running_server(root) as server:
        starting = time.monotonic()
        from fieldcal.batch.night import plan_night
        from fieldcal.flows.housekeeping import tidy_prefect
        from fieldcal.flows.nightly import flow_of
        from fieldcal.flows.processes import Processes
        from fieldcal.flows.runners import Parallel, batches

        imported = time.monotonic()
        night = plan_night(archive, root, config, session)
        parallel = Parallel(workers, runner, scheduler)
        with Processes(parallel.spawned(len(batches(night.missing(), workers)))) as processes:
            waiting = time.monotonic()
            url = server.wait()
            start_s = imported - starting + time.monotonic() - waiting
            with server.explained(), connected(url):
                tidy_prefect(root, url, own_server=server.own)
                kept: list[NightDocument] = []
                planned = flow_of(night, parallel, progress, processes, kept.append)
                try:
                    state: State[None] = cast(Any, planned)(
                        str(session or archive), str(root), workers, runner, return_state=True
                    )
                    if not kept:
                        state.result()  # raises what ended it
                    result = kept[0]
                except Exception as error:
                    if not kept:
                        raise
                    result = kept[0]
                    why = type(error).__name__
                    say(f"Prefect's server was lost ({why}): the night is whole, Prefect's record of it is not.")
    told: dict[str, object] = dict(result)
    logs = told.pop("logs")
    told |= {"seconds": round(time.monotonic() - began, 3), "server_seconds": round(start_s, 3)}
    return cast(NightDocument, {**told, "logs": logs})


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
