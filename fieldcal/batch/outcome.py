"""What became of a flight, and of a night: plain JSON for other processes, for `--json` and for the closing table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import polars as pl

from fieldcal.batch.documents import LogEntry, NightSummary, PlainOutcome
from fieldcal.batch.reasons import NO_RESULT
from fieldcal.flight.job import Job
from fieldcal.flight.record import Record
from fieldcal.flight.rows import judged, refusals
from fieldcal.flight.versions import versions
from fieldcal.logs import ingest
from fieldcal.logs.facts import Facts
from fieldcal.names import Status, Verdict
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.pipeline import INGEST
from fieldcal.warehouse import Warehouse


@dataclass(frozen=True)
class Outcome:
    """One flight: the record of every step, which of them ran and why, and which were found in the cache.

    `work_s` is the time that the steps' own work took.
    """

    job: Job
    records: Mapping[str, Record]
    ran: tuple[str, ...] = ()
    cached: tuple[str, ...] = ()
    why: Mapping[str, str] = field(default_factory=dict)
    work_s: float = 0.0
    facts: Facts = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "facts", judged(self.records[INGEST]["facts"], self.records))

    def plain(self) -> PlainOutcome:
        """Plain JSON; `Outcome.of` is the outcome again."""
        return {
            "job": self.job.plain(),
            "records": dict(self.records),
            "ran": list(self.ran),
            "cached": list(self.cached),
            "why": dict(self.why),
            "work_s": self.work_s,
        }

    @staticmethod
    def of(plain: PlainOutcome) -> Outcome:
        """From its plain JSON."""
        ran, cached = tuple(plain["ran"]), tuple(plain["cached"])
        return Outcome(Job(**plain["job"]), plain["records"], ran, cached, plain["why"], plain["work_s"])

    def entry(self) -> LogEntry:
        """The flight's place in the JSON of a night."""
        return {
            "log_uri": self.job.log_uri,
            "flight_id": self.job.flight_id,
            "vehicle_id": self.job.vehicle_id,
            "session_id": self.job.session_id,
            "verdict": self.facts["verdict"],
            "reason_code": self.facts["reason_code"],
            "reason": self.facts["reason"],
            "findings": self.facts["findings"],
            "refusals": refusals(self.records) if len(self.records) > 1 else [],
            "stages_run": len(self.ran),
            "stages_cached": len(self.cached),
            "ran": {step: self.why.get(step) for step in self.ran},
        }


def cause(why: Mapping[str, str | None]) -> str:
    """Why steps run (step → reason, in their order) in a few words: the first reason, and how many others follow."""
    if not why:
        return "nothing new"
    step, reason = next(iter(why.items()))
    if step == INGEST and reason == NO_RESULT:
        return "new log"
    return f"{step}: {reason or NO_RESULT}" + (f", and {len(why) - 1} more" if len(why) > 1 else "")


def failed_outcome(job: Job, records: Mapping[str, Record], step: str, reason: str) -> Outcome:
    """Of a flight that something unforeseen stopped at `step`."""
    record: Record = {
        "status": Status.FAILED,
        "reason_code": ReasonCode.STAGE_FAILED,
        "reason": reason,
        "measured": {},
        "versions": versions(),
        "run_key": None,
        "outputs": {},
    }
    if INGEST not in records:
        record["facts"], record["signals"] = ingest.rejected(ReasonCode.INGEST_FAILED, reason), {}
        step = INGEST
    return Outcome(job, {**records, step: record}, ran=(step,))


def summary(
    outcomes: Iterable[Outcome],
    done: Iterable[LogEntry],
    copies: Mapping[str, str],
    copied: Iterable[Job],
    root: Path,
) -> NightSummary:
    """The JSON of a night, without its duration. `done`: of flights that it had nothing to look at."""
    outcomes = list(outcomes)
    entries = {entry["log_uri"]: entry for entry in done}
    entries |= {outcome.job.log_uri: outcome.entry() for outcome in outcomes}
    for job in copied:
        entries[job.log_uri] = _copy(job, copies[job.log_uri], entries, root)
    logs = [entries[log_uri] for log_uri in sorted(entries)]
    counts = Counter(entry["verdict"] for entry in logs)
    return {
        "ok": counts[Verdict.OK],
        "partial": counts[Verdict.PARTIAL],
        "no_result": counts[Verdict.NO_RESULT],
        "quarantined": counts[Verdict.QUARANTINED],
        "rejected": counts[Verdict.REJECTED],
        "stages_run": sum(len(outcome.ran) for outcome in outcomes),
        "stages_cached": sum(entry["stages_cached"] for entry in logs),
        "stage_seconds": round(sum(outcome.work_s for outcome in outcomes), 3),
        "logs": logs,
    }


def verdict_counts(night: NightSummary) -> str:
    """How many logs have which verdict, in words."""
    counts: Mapping[str, object] = night
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in Verdict)


def _copy(job: Job, first: str, entries: Mapping[str, LogEntry], root: Path) -> LogEntry:
    """Entry of a log whose content is that of another: it shares its verdict, and says where the results are."""
    verdict = entries[first]["verdict"] if first in entries else _recorded_verdict(job.flight_id, root)
    return {
        "log_uri": job.log_uri,
        "flight_id": job.flight_id,
        "vehicle_id": job.vehicle_id,
        "session_id": job.session_id,
        "verdict": verdict,
        "reason_code": ReasonCode.COPY,
        "reason": f"It has the same content as {first}, under which its results are.",
        "copy_of": first,
        "findings": [],
        "refusals": [],
        "stages_run": 0,
        "stages_cached": 0,
        "ran": {},
    }


def _recorded_verdict(flight_id: str, root: Path) -> str:
    rows = Warehouse(root).scan("flight").filter(pl.col("flight_id") == flight_id).select("verdict").collect()
    return str(rows.item(0, 0)) if rows.height else "ok"
