"""When a flight was: by its log's clock, else by the date in its session's name, else in the order of names."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import TypedDict

from fieldcal.flight.job import Job
from fieldcal.logs.facts import Facts
from fieldcal.logs.ingest import started_at
from fieldcal.names import DatedBy

_DATE = re.compile(r"(?<!\d)(\d{4})([-_.]?)(\d{2})\2(\d{2})(?:[T _-]?(\d{2})[-_:.]?(\d{2})(?:[-_:.]?(\d{2}))?)?(?!\d)")
FIRST_YEAR, LAST_YEAR = 1980, 2200


class When(TypedDict):
    """Columns of the history that order flights."""

    started_at: datetime | None
    dated_by: str
    sequence: str


def when(job: Job, facts: Facts) -> When:
    """Start of a flight, what told it, and its place among flights that nothing else orders."""
    by_clock, by_session = started_at(facts), date_in(job.session_id)
    told_by = DatedBy.LOG if by_clock else DatedBy.SESSION if by_session else DatedBy.NAME
    name = job.log_uri.rpartition("/")[2]
    return {
        "started_at": by_clock or by_session,
        "dated_by": told_by,
        "sequence": natural_order(f"{job.session_id}/{name}"),
    }


def date_in(session_id: str) -> datetime | None:
    """The first date that a name holds, UTC, with its time where it holds one: 2026-05-04, 20260504_1030, …"""
    for year, _, month, day, hour, minute, second in _DATE.findall(session_id):
        try:
            found = datetime(
                int(year), int(month), int(day), int(hour or 0), int(minute or 0), int(second or 0), tzinfo=UTC
            )
        except ValueError:
            continue
        if FIRST_YEAR <= found.year < LAST_YEAR:
            return found
    return None


def natural_order(name: str) -> str:
    """A text that sorts as people would sort names, flight-9 before flight-10: before each number stands its length."""
    return re.sub(r"\d+", _with_length, name.casefold())


def _with_length(digits: re.Match[str]) -> str:
    number = digits.group().lstrip("0") or "0"
    return f"{len(number):02d}{number}"
