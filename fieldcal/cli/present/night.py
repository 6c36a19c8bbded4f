"""A night on the terminal: the table that closes it, and what one would do."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from fieldcal.batch.documents import LogEntry, NightDocument, PlanDocument, PlannedLog, UnreadEntry
from fieldcal.batch.outcome import cause, verdict_counts
from fieldcal.cli.show import table
from fieldcal.logs.unread import Unread, told
from fieldcal.names import Standing, Verdict
from fieldcal.remote.cache import called
from fieldcal.report.fitness import fleet_fitness, ranked, remembered_alerts
from fieldcal.warehouse import Warehouse
from fieldcal.words.flights import is_consequence
from fieldcal.words.numbers import number

WORST = 5
REFUSALS = 12
CHANGES = 20
VEHICLES = 15


def print_night(console: Console, result: NightDocument, root: Path) -> None:
    """The closing table: verdicts, what was refused and why, the worst fits, where to look next."""
    counts = verdict_counts(result)
    work = f"{result['stages_run']} stages run, {result['stages_cached']} from the cache, {result['seconds']:.1f} s"
    console.print(f"{len(result['logs'])} logs: {counts}; {work}", markup=False)
    print_unread(console, result["unread"])
    print_fleet(console, root)
    troubled = [log for log in result["logs"] if log["verdict"] != Verdict.OK or log["reason_code"]]
    if troubled:
        lines = [[log["log_uri"], log["verdict"], log["reason"] or ""] for log in troubled]
        console.print(table(["log", "verdict", "why"], lines, "Logs that need a look"))
    refused = [line for log in result["logs"] for line in _refusals(log)]
    if refused:
        console.print(table(["log", "refused", "why"], refused[:REFUSALS], "Refusals"))
        if len(refused) > REFUSALS:
            console.print(f"  … and {len(refused) - REFUSALS} more: SELECT * FROM refusals", markup=False)
    worst = _worst(root, [log["flight_id"] for log in result["logs"]])
    if worst:
        columns = ["log", "quantity", "method", "against", "TIC", "rms"]
        console.print(table(columns, worst, "Poorest agreement (Theil inequality coefficient, smoothed)"))
    if result["changes"]:
        lines = [[change["kind"], change["sentence"]] for change in result["changes"]]
        console.print(table(["new", "what"], lines[:CHANGES], "What changed in the fleet"))
        if len(lines) > CHANGES:
            console.print(f"  … and {len(lines) - CHANGES} more: fieldcal drift", markup=False)
    console.print(f"History: {called(root)}/tables (fieldcal history, drift, sql)", markup=False)
    console.print(f"Report:  {result['report']} (fieldcal report --vehicle V, --flight ID)", markup=False)
    console.print(
        f"Site:    {result['site']} (every vehicle and flight; any web server serves its folder)", markup=False
    )


def print_fleet(console: Console, root: Path) -> None:
    """Which vehicles are fine to fly, and of the others why not, the gravest first: as the site says it."""
    fleet = fleet_fitness(Warehouse(root), remembered_alerts(root), datetime.now(UTC))
    if not fleet:
        return
    fine = sum(one.standing == Standing.FINE for one in fleet.values())
    console.print(f"Fleet: {fine} of {len(fleet)} vehicles fine to fly", markup=False)
    others = [one for one in ranked(fleet) if one.standing != Standing.FINE]
    if others:
        lines = [[one.vehicle_id, one.standing, one.why(1)] for one in others[:VEHICLES]]
        console.print(table(["vehicle", "standing", "why"], lines))
        if len(others) > VEHICLES:
            console.print(f"  … and {len(others) - VEHICLES} more: the site's first page", markup=False)


def _refusals(log: LogEntry) -> list[list[str]]:
    """Lines of what a log's stages refused, each reason once; what only follows from another refusal is left out."""
    stages: dict[str, list[str]] = {}
    for refusal in log["refusals"]:
        if not is_consequence(refusal):
            stages.setdefault(refusal["reason"] or refusal["reason_code"] or "", []).append(refusal["stage"])
    names = [log["log_uri"], *[""] * len(stages)]
    return [[name, ", ".join(own), reason] for name, (reason, own) in zip(names, stages.items(), strict=False)]


def print_plan(console: Console, plan: PlanDocument) -> None:
    """What a night would do."""
    console.print(
        f"{len(plan['logs'])} logs; {plan['stages_to_run']} stages would run. Nothing was changed.", markup=False
    )
    print_unread(console, plan["unread"])
    lines = [[log["log_uri"], _would(log)] for log in plan["logs"] if log["would_run"] or log["copy_of"]]
    if lines:
        console.print(table(["log", "would run"], lines))


def print_unread(console: Console, unread: Sequence[UnreadEntry]) -> None:
    """A line on what lies beside the logs, where there is something."""
    if unread:
        console.print(told([Unread(**entry) for entry in unread]), markup=False)


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
    return [[*row[:4], number(row[4], 3), f"{number(row[5], 3)} {row[6]}"] for row in rows.iter_rows()]
