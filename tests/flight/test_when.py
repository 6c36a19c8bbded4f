"""When a flight was, where its log's clock does not tell."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from fieldcal.flight.job import Job
from fieldcal.flight.when import date_in, natural_order, when
from fieldcal.logs.ingest import rejected
from fieldcal.reason_codes import ReasonCode

MAY = datetime(2026, 5, 4, tzinfo=UTC)


@pytest.mark.parametrize(
    ("name", "moment"),
    [
        ("2026-05-04", MAY),
        ("2026-05-04-A1", MAY),
        ("flights_20260504", MAY),
        ("2026_05_04 afternoon", MAY),
        ("2026-05-04_10-30", MAY.replace(hour=10, minute=30)),
        ("20260504_103015", MAY.replace(hour=10, minute=30, second=15)),
        ("2026-05-04T10:30:15", MAY.replace(hour=10, minute=30, second=15)),
        ("2026-13-04 was 2026-05-04", MAY),
        ("bench", None),
        ("run-12", None),
        ("2026-05-32", None),
        ("20260504123456789", None),
        ("1779-05-04", None),
        ("2026-05_04", None),
    ],
)
def test_a_date_in_a_sessions_name(name: str, moment: datetime | None) -> None:
    assert date_in(name) == moment


def test_names_sort_as_people_sort_them() -> None:
    names = ["bench/flight-2", "bench/flight-10", "Bench/flight-007", "bench/flight-1a", "bench/flight-1", "a/z"]
    wanted = ["a/z", "bench/flight-1", "bench/flight-1a", "bench/flight-2", "Bench/flight-007", "bench/flight-10"]
    assert sorted(names, key=natural_order) == wanted


@pytest.mark.parametrize(
    ("stamp_ns", "session", "told_by", "moment"),
    [
        (int(MAY.timestamp()) * 1_000_000_000, "2020-01-01", "log", MAY),
        (None, "2026-05-04", "session", MAY),
        (None, "bench", "name", None),
    ],
)
def test_the_logs_clock_goes_before_the_sessions_name(
    stamp_ns: int | None, session: str, told_by: str, moment: datetime | None
) -> None:
    facts = {**rejected(ReasonCode.NO_IMU, ""), "started_at_ns": stamp_ns}
    job = Job("/x", f"v/{session}/flight-9.csv", "v", session, "csv", None, "f")
    found = when(job, facts)  # type: ignore[arg-type]
    assert (found["dated_by"], found["started_at"]) == (told_by, moment)
    assert found["sequence"] == natural_order(f"{session}/flight-9.csv")
