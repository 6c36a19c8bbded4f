"""The one message of a night: what is new, the gravest first, by vehicle; nothing where nothing is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldcal.batch.documents import LogEntry, NightDocument
from fieldcal.names import Verdict
from fieldcal.report.standing.reason import KINDS
from fieldcal.words.printable import printable

MOST_OF_VEHICLE, MOST_VEHICLES, MOST_LOGS = 4, 15, 15
"""So much is said; of the rest how much there is."""
GOOD_NEWS = ("recovered",)
BAD_LOGS = (Verdict.QUARANTINED, Verdict.REJECTED, Verdict.PARTIAL, Verdict.NO_RESULT)
"""The gravest first."""


@dataclass(frozen=True)
class Message:
    """Plain text."""

    title: str
    body: str


def news_of(night: NightDocument, archive: Path, link: str | None = None) -> Message | None:
    """What a night has to tell, that the nights before did not: changes in the fleet, and logs looked at tonight that
    are not fine.

    Parameters
    ----------
    night : NightDocument
    archive : Path
        What it was about.
    link : str, optional
        Where readers find the reports, a URL of their folder; else their path on this machine.
    """
    bad = [change for change in night["changes"] if change["kind"] not in GOOD_NEWS]
    good = [change for change in night["changes"] if change["kind"] in GOOD_NEWS]
    logs = [log for log in night["logs"] if log["stages_run"] and log["verdict"] in BAD_LOGS]
    if not (bad or good or logs):
        return None
    by_vehicle: dict[str, list[str]] = {}
    for change in sorted(bad, key=lambda change: KINDS.index(change["kind"])):
        by_vehicle.setdefault(change["vehicle_id"], []).append(change["sentence"])
    lines = [*_vehicles(by_vehicle), *_logs(logs)]
    if good:
        lines += ["", "Fine again:", *_some([change["sentence"] for change in good], MOST_LOGS, "fieldcal drift")]
    path = Path(night["report"])
    report = f"{link.rstrip('/')}/{path.name}" if link else path.absolute()
    lines += ["", f"Report: {report}"]
    return Message(_title(archive, by_vehicle, logs), _printed(lines))


def failure_of(error: Exception, archive: Path) -> Message:
    """That a night ended early, and why."""
    why = getattr(error, "sentence", None) or f"{type(error).__name__}: {error}"
    told = "What it had done is kept; the next night goes on from there."
    return Message(printable(f"fieldcal, {archive.name}: the night failed"), _printed([why, told]))


def _printed(lines: Sequence[str]) -> str:
    """Lines of a message, whatever is in a name."""
    return "\n".join(printable(line) for line in lines).strip() + "\n"


def _title(archive: Path, by_vehicle: dict[str, list[str]], logs: Sequence[LogEntry]) -> str:
    names = list(by_vehicle)
    if names:
        some = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        need = "needs" if len(names) == 1 else "need"
        return printable(f"fieldcal, {archive.name}: {some} {need} a look")
    if logs:
        what = "1 new log is" if len(logs) == 1 else f"{len(logs)} new logs are"
        return printable(f"fieldcal, {archive.name}: {what} not fine")
    return printable(f"fieldcal, {archive.name}: fine again")


def _vehicles(by_vehicle: dict[str, list[str]]) -> Iterator[str]:
    for vehicle_id, sentences in list(by_vehicle.items())[:MOST_VEHICLES]:
        yield from ("", vehicle_id)
        yield from _some(sentences, MOST_OF_VEHICLE, f"fieldcal drift --vehicle {vehicle_id}")
    if len(by_vehicle) > MOST_VEHICLES:
        yield from ("", f"… and {len(by_vehicle) - MOST_VEHICLES} more vehicles: fieldcal drift")


def _logs(logs: Sequence[LogEntry]) -> Iterator[str]:
    if logs:
        yield from ("", "New logs that are not fine:")
        gravest = sorted(logs, key=lambda log: BAD_LOGS.index(Verdict(log["verdict"])))
        told = [f"{log['log_uri']}: {log['verdict']}. {log['reason'] or ''}".strip() for log in gravest]
        yield from _some(told, MOST_LOGS, 'fieldcal sql "FROM refusals"')


def _some(sentences: Sequence[str], most: int, where: str) -> Iterator[str]:
    yield from (f"- {sentence}" for sentence in sentences[:most])
    if len(sentences) > most:
        yield f"- … and {len(sentences) - most} more: {where}"
