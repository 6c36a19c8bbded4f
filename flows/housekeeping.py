"""Keep Prefect's records true and small: runs whose process died are ended, old ones are removed."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from fieldcal.flows.alive import dead
from fieldcal.flows.connection import connected

if TYPE_CHECKING:
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.client.schemas.filters import FlowRunFilter

KEPT_DAYS = 30
MOST_RUNS = 1000
EVERY_S = 3600.0
AT_ONCE = 200


def tidy_prefect(root: Path, url: str, *, own_server: bool) -> None:
    """End the runs of killed processes and, on a server of ours, once an hour, remove old runs and all beyond many."""
    from prefect.client.orchestration import get_client

    marks = dead(root)
    last = root / "prefect" / "tidied"
    due = own_server and not (last.exists() and time.time() - last.stat().st_mtime < EVERY_S)
    if not marks and not due:
        return
    with connected(url), get_client(sync_client=True) as client:
        for mark in marks:
            _end(client, mark)
        if due:
            _remove_old(client)
            last.parent.mkdir(parents=True, exist_ok=True)
            last.touch()


def keep_tidy(root: Path, url: str) -> None:
    """Do so from time to time, beside what this process does, for as long as it lives."""

    def look() -> None:
        while True:
            time.sleep(EVERY_S)
            with suppress(Exception):  # a server that is lost, or busy: the next time
                tidy_prefect(root, url, own_server=True)

    threading.Thread(target=look, daemon=True).start()


def _end(client: SyncPrefectClient, mark: Path) -> None:
    """Say of a run and its tasks that they crashed, if this server knows them as running."""
    from prefect.client.schemas.filters import (
        FlowRunFilter,
        FlowRunFilterId,
        TaskRunFilter,
        TaskRunFilterState,
        TaskRunFilterStateType,
    )
    from prefect.client.schemas.objects import StateType
    from prefect.exceptions import ObjectNotFound
    from prefect.states import Crashed

    try:
        run_id = UUID(mark.name)
        run = client.read_flow_run(run_id)
    except ObjectNotFound:  # it ran on another server, which may be asked later
        if time.time() - mark.stat().st_mtime > KEPT_DAYS * 86_400:
            mark.unlink(missing_ok=True)
        return
    except ValueError:
        mark.unlink(missing_ok=True)
        return
    why = "Its process was killed. What it had done is kept; the next night goes on from there."
    open_states = TaskRunFilterState(type=TaskRunFilterStateType(any_=[StateType.RUNNING, StateType.PENDING]))
    tasks = client.read_task_runs(
        flow_run_filter=FlowRunFilter(id=FlowRunFilterId(any_=[run_id])),
        task_run_filter=TaskRunFilter(state=open_states),
        limit=AT_ONCE,
    )
    for task in tasks:
        client.set_task_run_state(task.id, Crashed(message=why), force=True)
    if run.state is None or not run.state.is_final():
        client.set_flow_run_state(run_id, Crashed(message=why), force=True)
    mark.unlink(missing_ok=True)


def _remove_old(client: SyncPrefectClient) -> None:
    """Runs that ended long ago, and of the others, should they be many, all but the last."""
    from prefect.client.schemas.sorting import FlowRunSort

    for days, kept in ((KEPT_DAYS, 0), (0, MOST_RUNS)):
        while runs := client.read_flow_runs(
            flow_run_filter=_ended_before(days), sort=FlowRunSort.END_TIME_DESC, offset=kept, limit=AT_ONCE
        ):
            for run in runs:
                client.delete_flow_run(run.id)


def _ended_before(days: float) -> FlowRunFilter:
    from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterEndTime

    before = datetime.now(UTC) - timedelta(days=days)
    return FlowRunFilter(end_time=FlowRunFilterEndTime.model_validate({"before_": before}))
