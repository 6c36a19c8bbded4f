"""The night as a command runs it: server, flow, and what it says. Prefect is imported here, when it is needed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldcal.config.find import configuration_of, find_source
from fieldcal.flows.server import running_server
from fieldcal.warehouse.layout import prepare

if TYPE_CHECKING:
    from fieldcal.flows.watching import Watcher


def run_night(
    archive: Path,
    root: Path,
    config: Path | None = None,
    session: Path | None = None,
    workers: int = 1,
    progress: Watcher | None = None,
    **where: str | None,
) -> dict[str, Any]:
    """Run the flow `nightly`, or `session` for that folder of the archive; its JSON, with how long it took.

    `where` may hold `runner` and `scheduler` (`runners`). `seconds` is the whole duration, `server_seconds` what
    of it went into importing Prefect and into waiting for its server once the night was planned, `stage_seconds` the
    stages' own work, summed over the workers.
    """
    began = time.monotonic()
    find_source(config, archive)
    prepare(root)
    named = str(config) if config else None
    runner, scheduler = where.get("runner") or "process", where.get("scheduler")
    with running_server(root) as server:
        starting = time.monotonic()
        from fieldcal.flows.housekeeping import tidy_prefect
        from fieldcal.flows.nightly import prepared, run_nightly
        from fieldcal.flows.runners import Parallel

        imported = time.monotonic()
        with prepared(archive, root, named, session, Parallel(workers, runner, scheduler)):
            waiting = time.monotonic()
            url = server.wait()
            start_s = imported - starting + time.monotonic() - waiting
            tidy_prefect(root, url, own_server=server.own)
            what = {"archive": str(archive)} if session is None else {"folder": str(session)}
            result = run_nightly(url, progress, **what, warehouse=str(root), config=named, workers=workers, **where)
    logs = result.pop("logs")
    times = {"seconds": round(time.monotonic() - began, 3), "server_seconds": round(start_s, 3)}
    return {**result, **times, "logs": logs}


def dry_run(archive: Path, root: Path, config: Path | None, session: Path | None) -> dict[str, Any]:
    """What the night would run; changes nothing."""
    from fieldcal.batch.plan import make_plan

    plan = make_plan(root, archive, configuration_of(find_source(config, archive)), session)
    logs: list[dict[str, Any]] = [
        {
            "log_uri": job.log_uri,
            "flight_id": job.flight_id,
            "would_run": plan.missing.get(job.flight_id, {}),
            "copy_of": plan.copies.get(job.log_uri),
        }
        for job in sorted([*plan.jobs, *plan.copied], key=lambda job: job.log_uri)
    ]
    return {"dry_run": True, "stages_to_run": sum(len(log["would_run"]) for log in logs), "logs": logs}
