"""The night as a command runs it: server, flow, and what it says. Prefect is imported here, when it is needed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.jobs import configuration_of, find_source
from flows.server import running_server
from warehouse.files import remove_abandoned
from warehouse.layout import prepare

if TYPE_CHECKING:
    from flows.watching import Watcher


def run_night(
    archive: Path, root: Path, config: Path | None, session: Path | None, workers: int, progress: Watcher | None = None
) -> dict[str, Any]:
    """Run the flow `nightly`; its JSON, `seconds` included."""
    began = time.monotonic()
    find_source(config, archive)
    prepare(root)
    with running_server(root) as server:
        from flows.nightly import run_nightly

        remove_abandoned(root)
        result = run_nightly(
            server.wait(),
            progress,
            archive=str(archive),
            warehouse=str(root),
            config=str(config) if config else None,
            session=str(session) if session else None,
            workers=workers,
        )
    counts = {name: value for name, value in result.items() if name != "logs"}
    return {**counts, "seconds": round(time.monotonic() - began, 3), "logs": result["logs"]}


def dry_run(archive: Path, root: Path, config: Path | None, session: Path | None) -> dict[str, Any]:
    """What the night would run; changes nothing."""
    from flows.plan import make_plan

    plan = make_plan(root, archive, configuration_of(find_source(config, archive)), session)
    logs: list[dict[str, Any]] = [
        {
            "log_uri": job.log_uri,
            "flight_id": job.flight_id,
            "would_run": plan.missing.get(job.flight_id, []),
            "copy_of": plan.copies.get(job.log_uri),
        }
        for job in sorted([*plan.jobs, *plan.copied], key=lambda job: job.log_uri)
    ]
    return {"dry_run": True, "stages_to_run": sum(len(log["would_run"]) for log in logs), "logs": logs}
