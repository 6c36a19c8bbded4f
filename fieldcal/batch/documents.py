"""What a night hands between processes and says in the end: plain JSON with known keys."""

from __future__ import annotations

from typing import NotRequired, TypedDict

from fieldcal.config.find import Source
from fieldcal.flight.job import PlainJob
from fieldcal.flight.record import Record, Refusal
from fieldcal.logs.facts import FindingFacts
from fieldcal.report.standing.news import PlainChange


class PlainOutcome(TypedDict):
    """An `Outcome`."""

    job: PlainJob
    records: dict[str, Record]
    ran: list[str]
    cached: list[str]
    why: dict[str, str]
    work_s: float


class Batch(TypedDict):
    """Flights that one process calibrates. `code`: the `code_digest` of the process that planned the night."""

    number: int
    root: str
    source: Source
    jobs: list[PlainJob]
    code: str


class Answer(TypedDict):
    """What became of a batch. `error`: reason code and sentence of what concerns every log of the night."""

    outcomes: list[PlainOutcome]
    error: list[str] | None


class LogEntry(TypedDict):
    """A log in the document of a night. `ran`: steps that ran, each with why; `copy_of` of a log with another's
    bytes."""

    log_uri: str
    flight_id: str
    vehicle_id: str
    session_id: str
    verdict: str
    reason_code: str | None
    reason: str | None
    findings: list[FindingFacts]
    refusals: list[Refusal]
    stages_run: int
    stages_cached: int
    ran: dict[str, str | None]
    copy_of: NotRequired[str]


class NightSummary(TypedDict):
    """Logs by verdict, and what was done for them."""

    ok: int
    partial: int
    no_result: int
    quarantined: int
    rejected: int
    stages_run: int
    stages_cached: int
    stage_seconds: float
    logs: list[LogEntry]


class UnreadEntry(TypedDict):
    """A file or folder of the archive that is no log, and why."""

    path: str
    why: str


class NightDocument(NightSummary):
    """What `nightly --json` prints. `site` None where `[site]` says that none is written; `seconds` the whole duration,
    `server_seconds` what Prefect took of it."""

    changes: list[PlainChange]
    report: str
    site: str | None
    unread: list[UnreadEntry]
    seconds: NotRequired[float]
    server_seconds: NotRequired[float]


class PlannedLog(TypedDict):
    """A log in what a night would do."""

    log_uri: str
    flight_id: str
    would_run: dict[str, str]
    copy_of: str | None


class PlanDocument(TypedDict):
    """What `nightly --dry-run --json` prints."""

    dry_run: bool
    stages_to_run: int
    unread: list[UnreadEntry]
    logs: list[PlannedLog]
