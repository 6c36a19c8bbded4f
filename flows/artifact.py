"""The table of the night as a Prefect artifact, beside the flow run that made it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fieldcal.batch.documents import LogEntry, NightDocument
from fieldcal.batch.outcome import verdict_counts
from fieldcal.flows.connection import answers
from fieldcal.names import Verdict
from fieldcal.report.standing.news import Change

KEY = "fieldcal-night"
MOST_ROWS = 500

EVENT = "fieldcal.fleet.changed"


def keep_artifact(result: NightDocument, root: Path) -> None:
    """Keep the logs that are not `ok` or refused something, under the night's counts. A lost server is no error."""
    from prefect.artifacts import create_table_artifact
    from prefect.settings import PREFECT_API_URL

    if not answers(str(PREFECT_API_URL.value())):
        return  # Prefect would try for long
    counts = verdict_counts(result)
    news = [
        {"log": change["vehicle_id"], "what": change["kind"], "why": change["sentence"]} for change in result["changes"]
    ]
    rows = news + [row for log in result["logs"] for row in _rows(log)]
    told = (
        f"{len(result['logs'])} logs: {counts}. {result['stages_run']} stages run, {result['stages_cached']} from the "
        f"cache. History: `{root}/tables`. Report: `{result['report']}`."
        + (f" Site: `{result['site']}`." if result["site"] else "")
    )
    if len(rows) > MOST_ROWS:
        told += f" The first {MOST_ROWS} of {len(rows)} rows; all: `fieldcal sql 'SELECT * FROM refusals'`."
    try:
        create_table_artifact(table=rows[:MOST_ROWS], key=KEY, description=told)
    except Exception as error:
        from fieldcal.words.talk import say

        say(f"Prefect keeps no table of this night ({type(error).__name__}); the warehouse has it all.")


def _rows(log: LogEntry) -> list[dict[str, str | None]]:
    own = [] if log["verdict"] == Verdict.OK else [{"what": log["verdict"], "why": log["reason"] or log["reason_code"]}]
    refused = [{"what": f"{r['stage']} {r['status']}", "why": r["reason"] or r["reason_code"]} for r in log["refusals"]]
    return [{"log": log["log_uri"], **row} for row in own + refused]


def tell_prefect(told: Sequence[Change]) -> None:
    """Emit `fieldcal.fleet.changed`, on which an automation can act; without news nothing is emitted."""
    if not told:
        return
    from prefect.events import emit_event

    emit_event(
        event=EVENT,
        resource={"prefect.resource.id": "fieldcal.fleet"},
        payload={"changes": [change.row() for change in told]},
    )
