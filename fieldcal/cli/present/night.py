"""A night on the terminal: the table that closes it, and what one would do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fieldcal.batch.documents import LogEntry, NightDocument, PlanDocument, PlannedLog, UnreadEntry
from fieldcal.batch.outcome import cause
from fieldcal.cli.present.flight import agreement, tic_and_rms
from fieldcal.cli.present.screen import Screen, table
from fieldcal.logs.unread import Unread, told
from fieldcal.names import Standing, Verdict
from fieldcal.report.fitness import ranked
from fieldcal.report.standing.memory import remembered_fleet
from fieldcal.report.words import count
from fieldcal.warehouse import Warehouse
from fieldcal.words.flights import is_consequence

WORST = 5
REFUSALS = 12
CHANGES = 20
VEHICLES = 15


def print_night(console: Screen, result: NightDocument, root: Path) -> None:
    """The answer first: who is fine to fly, what changed; then logs that need a look, and what was refused and why."""
    work = f"{result['stages_run']} stages run, {result['stages_cached']} from the cache, {result['seconds']:.1f} s"
    console.print(f"{count(len(result['logs']), 'log')}: {_verdicts(result)}; {work}")
    print_unread(console, result["unread"])
    print_fleet(console, root)
    if result["changes"]:
        lines = [[change["kind"].replace("_", " "), change["sentence"]] for change in result["changes"]]
        console.print(table(["new", "what"], lines[:CHANGES], "What changed in the fleet"))
        if len(lines) > CHANGES:
            console.print(f"… and {len(lines) - CHANGES} more: fieldcal drift")
    troubled = [log for log in result["logs"] if log["verdict"] != Verdict.OK or log["reason_code"]]
    if troubled:
        lines = [[log["log_uri"], log["verdict"], log["reason"] or ""] for log in troubled]
        console.print(table(["log", "verdict", "why"], lines, "Logs that need a look"))
    refused = [line for log in result["logs"] for line in _refusals(log)]
    if refused:
        console.print(table(["log", "refused", "why"], refused[:REFUSALS], "Refusals"))
        if len(refused) > REFUSALS:
            console.print(f"… and {len(refused) - REFUSALS} more: SELECT * FROM refusals")
    worst = _worst(root, [log["flight_id"] for log in result["logs"]]) if console.is_wide else []
    if worst:
        columns = ["log", "agreement", "TIC", "rms"]
        console.print(table(columns, worst, "Poorest agreement (Theil inequality coefficient, smoothed)"))
    console.print()
    console.print(f"Report: {result['report']}")
    if result["site"]:
        console.print(f"Site:   {result['site']}")
    console.print("Ask:    fieldcal drift, history, sql, report --vehicle V, --flight ID")


def _verdicts(result: NightDocument) -> str:
    counts = Counter(log["verdict"] for log in result["logs"])
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in Verdict if counts[verdict]) or "none"


def print_fleet(console: Screen, root: Path) -> None:
    """Which vehicles are fine to fly, and of the others why not, the gravest first: what the night said of them."""
    fleet = remembered_fleet(root)
    if not fleet:
        return
    fine = sum(one.standing == Standing.FINE for one in fleet.values())
    console.print(f"Fleet: {fine} of {len(fleet)} vehicles fine to fly")
    others = [one for one in ranked(fleet) if one.standing != Standing.FINE]
    if others:
        lines = [[one.vehicle_id, one.standing, one.why(1)] for one in others[:VEHICLES]]
        console.print(table(["vehicle", "standing", "why"], lines))
        if len(others) > VEHICLES:
            console.print(f"… and {len(others) - VEHICLES} more: the site's first page")
    following = [[one.vehicle_id, one.next] for one in ranked(fleet) if one.next and one.next not in one.why(1)]
    if following:
        console.print(table(["vehicle", "next calibration"], following[:VEHICLES]))


def _refusals(log: LogEntry) -> list[list[str]]:
    """Lines of what a log's stages refused, each reason once; what only follows from another refusal is left out."""
    stages: dict[str, list[str]] = {}
    for refusal in log["refusals"]:
        if not is_consequence(refusal):
            stages.setdefault(refusal["reason"] or refusal["reason_code"] or "", []).append(refusal["stage"])
    names = [log["log_uri"], *[""] * len(stages)]
    return [[name, ", ".join(own), reason] for name, (reason, own) in zip(names, stages.items(), strict=False)]


def print_plan(console: Screen, plan: PlanDocument) -> None:
    """What a night would do."""
    console.print(f"{len(plan['logs'])} logs; {plan['stages_to_run']} stages would run. Nothing was changed.")
    print_unread(console, plan["unread"])
    lines = [[log["log_uri"], _would(log)] for log in plan["logs"] if log["would_run"] or log["copy_of"]]
    if lines:
        console.print(table(["log", "would run"], lines))


def print_unread(console: Screen, unread: Sequence[UnreadEntry]) -> None:
    """A line on what lies beside the logs, where there is something."""
    if unread:
        console.print(told([Unread(**entry) for entry in unread]))


def _would(log: PlannedLog) -> str:
    if log["copy_of"]:
        return f"nothing: a copy of {log['copy_of']}"
    return cause(log["would_run"])


def _worst(root: Path, flights: Sequence[str]) -> list[list[str]]:
    import polars as pl

    warehouse = Warehouse(root)
    places = warehouse.scan("flight").select("flight_id", "log_uri")
    rows = (
        warehouse.scan("fit")
        .filter(pl.col("flight_id").is_in(list(flights)) & (pl.col("signal") == "smoothed") & pl.col("is_primary"))
        .join(places, on="flight_id")
        .sort("tic", "log_uri", "quantity", "method", descending=[True, False, False, False], nulls_last=True)
        .select("log_uri", "quantity", "method", "reference", "tic", "rms", "rms_unit")
        .head(WORST)
        .collect()
    )
    return [
        [row["log_uri"], agreement(row), *tic_and_rms(row["tic"], row["rms"], row["rms_unit"])]
        for row in rows.iter_rows(named=True)
    ]
