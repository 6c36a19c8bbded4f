"""What a tidied log is said to hold: means, ranges and rates by hand, and the gravest finding's word."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from logs_support import Flight, vehicle

from fieldcal.config.configuration import Vehicle
from fieldcal.config.flight_settings import flight_settings
from fieldcal.errors import UnreadableLog
from fieldcal.logs import Columns, Finding, LogSummary, ingest
from fieldcal.logs.ingest import (
    TidyLog,
    logged_units,
    read_flight,
    rejected,
    settings_of,
    started_at,
    tidy_log,
    verdict,
)
from fieldcal.logs.interface import stamps_are_epoch
from fieldcal.reason_codes import ReasonCode

STEP_NS = 10_000_000
EPOCH_NS = 1_000_000_000_000_000_000  # 2001-09-09 01:46:40


def table(*names: str, n: int = 20, first_ns: int = STEP_NS, **given: np.ndarray) -> Columns:
    """Rows at 100 Hz; columns that are not given count up."""
    t = first_ns + STEP_NS * np.arange(n)
    return {"t_ns": t, **{name: np.arange(n) * 1.0 for name in names}, **given}


IMU = ("gyroscope_x", "gyroscope_y", "gyroscope_z", "accelerometer_x", "accelerometer_y", "accelerometer_z")
VPS = ("qx", "qy", "qz", "qw", "px_m", "py_m", "pz_m")


class Reader:
    """A log of the given batches."""

    def __init__(self, *batches: tuple[str, Columns]) -> None:
        self.summary = LogSummary("csv", units={"gyroscope": "rad/s"}, world="ned")
        self._batches = batches

    def batches(self) -> Iterator[tuple[str, Columns]]:
        yield from self._batches


def read(*batches: tuple[str, Columns]) -> TidyLog:
    log = TidyLog(Reader(*batches), "a.csv")
    for _ in log.tables():
        pass
    return log


def test_means_and_ranges_are_over_all_batches() -> None:
    warm = [np.array([20.0, 30.0, 22.0]), np.array([10.0, 12.0])]
    place = {"latitude_deg": np.array([50.0, 52.0]), "longitude_deg": np.array([8.0, 10.0])}
    later = {"latitude_deg": np.array([54.0]), "longitude_deg": np.array([12.0]), "altitude_m": np.array([200.0])}
    facts = read(
        ("imu", table(*IMU, n=20)),
        ("temperature", table(n=3, temperature_degc=warm[0])),
        ("temperature", table(n=2, first_ns=10 * STEP_NS, temperature_degc=warm[1])),
        ("position", table(n=2, altitude_m=np.array([100.0, 300.0]), **place)),
        ("position", table(n=1, first_ns=9 * STEP_NS, **later)),
        ("vps", table(*VPS, n=5)),
    ).facts()  # fmt: skip
    assert (facts["temperature_min_degc"], facts["temperature_max_degc"]) == (10.0, 30.0)
    assert facts["temperature_mean_degc"] == pytest.approx(94.0 / 5.0)
    assert facts["position"] == pytest.approx([52.0, 10.0, 200.0])
    assert facts["rows"] == {"imu": 20, "position": 3, "temperature": 5, "vps": 5}
    assert (facts["imu_rate_hz"], facts["vps_rate_hz"]) == (100.0, 100.0)
    assert facts["duration_s"] == pytest.approx(0.19)
    assert (facts["n_samples"], facts["started_at_ns"]) == (20, None)
    assert (facts["units"], facts["world"], facts["body"], facts["verifiable"]) == (
        {"gyroscope": "rad/s"},
        "ned",
        None,
        False,
    )


def test_what_a_log_does_not_have_is_none() -> None:
    facts = read(("imu", table(*IMU))).facts()
    for name in ("vps_rate_hz", "temperature_min_degc", "temperature_mean_degc", "temperature_max_degc", "position"):
        assert facts[name] is None
    assert facts["verdict"] == "ok"
    assert facts["reason"] is None


@pytest.mark.parametrize(("n", "code"), [(0, "no_imu"), (9, "too_few_samples"), (10, None)])
def test_ten_samples_of_the_imu_are_the_least(n: int, code: str | None) -> None:
    batches = [("temperature", table(n=3, temperature_degc=np.ones(3)))] + ([("imu", table(*IMU, n=n))] if n else [])
    if code is None:
        assert read(*batches).facts()["n_samples"] == 10
        return
    log = TidyLog(Reader(*batches), "a.csv")
    log._reader.summary.add(ReasonCode.RAGGED_ROW, 1, "First.")
    log._reader.summary.add(ReasonCode.RAGGED_ROW, 1, "Second.")
    with pytest.raises(UnreadableLog) as refused:
        for _ in log.tables():
            pass
    assert refused.value.reason_code == code
    assert "First." in refused.value.sentence
    assert "Second." not in refused.value.sentence
    assert ("9 IMU samples" in refused.value.sentence) == (n == 9)


def test_units_are_told_at_the_end() -> None:
    log = TidyLog(Reader(("imu", table(*IMU))), "a.csv")
    assert log.units() is None
    assert [name for name, _ in log.tables()] == ["imu"]
    assert log.units() == {"gyroscope": "rad/s"}


def test_a_log_that_takes_too_long_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    log = TidyLog(
        Reader(*[("imu", table(*IMU, first_ns=STEP_NS * (1 + 20 * i))) for i in range(3)]), "a.csv", seconds=60.0
    )
    now[0] = 160.0
    rows = log.tables()
    for _ in rows:
        pass
    log = TidyLog(Reader(("imu", table(*IMU))), "a.csv", seconds=60.0)
    now[0] = 220.1
    with pytest.raises(UnreadableLog, match="after 60 s, 60 s and 1 s for every MB") as refused:
        list(log.tables())
    assert refused.value.reason_code == "too_slow"


def test_a_minute_and_a_second_for_every_megabyte(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text("t,gx,gy,gz\n" + "1,2,3,4\n" * 250_000)
    (tmp_path / "vps.csv").write_text("t,qx,qy,qz,qw\n" + "1,0,0,0,1\n" * 100_000)
    assert tidy_log(tmp_path / "imu.csv", vehicle())._seconds == pytest.approx(62.0, abs=0.01)
    assert tidy_log(tmp_path, vehicle())._seconds == pytest.approx(63.0, abs=0.01)


def test_stamps_from_2001_on_are_times_of_day() -> None:
    assert not stamps_are_epoch(np.array([EPOCH_NS]))
    assert stamps_are_epoch(np.array([EPOCH_NS + 1000]))
    assert not stamps_are_epoch(np.array([0, EPOCH_NS, EPOCH_NS + 5]))
    assert not stamps_are_epoch(np.array([], np.int64))
    for first, known in ((EPOCH_NS, False), (EPOCH_NS + 1, True)):
        log = read(("imu", table(*IMU, first_ns=first)))
        log._reader.summary.epoch_known = True
        assert log.facts()["started_at_ns"] == (first if known else None)
    log._reader.summary.epoch_known = False
    assert log.facts()["started_at_ns"] is None


def test_the_first_samples_time_to_the_microsecond(tmp_path: Path) -> None:
    flight = Flight(30)
    frames, facts = read_flight(flight.write(tmp_path / "a.mcap"), vehicle())
    assert started_at(facts) == datetime.fromtimestamp(flight.t_ns[0] // 1000 / 1e6, UTC)
    assert frames["imu"].height == 30
    assert settings_of(facts, vehicle()) is not None
    assert logged_units(tmp_path / "a.mcap", vehicle())["gyroscope"] == "rad/s"
    nothing = rejected(ReasonCode.NO_IMU, "None.")
    assert started_at(nothing) is None
    assert (nothing["verdict"], nothing["reason_code"], nothing["reason"]) == ("rejected", "no_imu", "None.")
    assert nothing["units"] == dict.fromkeys(("gyroscope", "accelerometer", "magnetometer"), "unknown")
    (tmp_path / "b.mcap").write_bytes(b"no log")
    assert read_flight(tmp_path / "b.mcap", vehicle())[1]["reason_code"] == "not_mcap"


def test_the_gravest_finding_gives_the_verdict() -> None:
    plain = Finding(ReasonCode.AMBIGUOUS_TOPIC, 2, "Told.")
    losing = Finding(ReasonCode.RAGGED_ROW, 3, "Lost.", loses_data=True)
    fatal = Finding(ReasonCode.CHANNEL_REDEFINED, 1, "Fatal.", fatal=True)
    for findings, name, code, reason in (
        ([], "ok", None, None),
        ([plain], "ok", None, None),
        ([plain, losing], "partial", "ragged_row", "Lost."),
        ([losing, fatal], "quarantined", "channel_redefined", "Fatal."),
    ):
        judged = verdict(findings)
        assert (judged["verdict"], judged["reason_code"], judged["reason"]) == (name, code, reason)
        assert [f["count"] for f in judged["findings"]] == [f.count for f in findings]


@pytest.mark.parametrize("late", [False, True])
def test_a_log_in_disorder_is_read_again_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late: bool) -> None:
    """Ever later stamps, then the first ones: more than what is held back while streaming."""
    monkeypatch.setattr(ingest, "HELD_ROWS", 100)
    order = np.r_[np.arange(300, 1500), np.arange(300)] if late else np.arange(1500)
    (tmp_path / "log.csv").write_text("t,gx,gy,gz\n" + "".join(f"{i / 100},{i},0,0\n" for i in order))
    opened: list[bool] = []

    def opening(path: Path, of: Vehicle, *, whole: bool) -> TidyLog:
        opened.append(whole)
        return tidy_log(path, of, whole=whole)

    monkeypatch.setattr(ingest, "tidy_log", opening)
    monkeypatch.setattr("fieldcal.logs.csv.text.BLOCK_BYTES", 4096)
    frames, facts = read_flight(tmp_path / "log.csv", vehicle())
    assert opened == [False, True][: 1 + late]
    assert facts["n_samples"] == 1500
    assert frames["imu"]["gyroscope_x"].to_list() == list(range(1500))


def test_rows_are_handed_on_while_reading_unless_they_are_to_be_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ingest, "HELD_ROWS", 50)
    batch = ("imu", table(*IMU, n=200))
    assert len(list(TidyLog(Reader(batch), "a.csv").tables())) == 2
    assert len(list(TidyLog(Reader(batch), "a.csv", whole=True).tables())) == 1
    (tmp_path / "log.csv").write_text("t,gx,gy,gz\n" + "".join(f"{i / 100},{i},0,0\n" for i in range(200)))
    assert len(list(tidy_log(tmp_path / "log.csv", vehicle()).tables())) == 2


@pytest.mark.parametrize("first_ns", [0, -19 * STEP_NS])
def test_a_flight_may_begin_or_end_at_zero(first_ns: int) -> None:
    facts = read(("imu", table(*IMU, n=20, first_ns=first_ns))).facts()
    assert facts["duration_s"] == pytest.approx(0.19, abs=1e-12)


def test_the_place_is_the_means_with_unknown_heights_at_sea_level(tmp_path: Path) -> None:
    place = {"latitude_deg": np.array([50.0, 52.0]), "longitude_deg": np.array([8.0, 10.0])}
    facts = read(("imu", table(*IMU)), ("position", table(n=2, altitude_m=np.full(2, np.nan), **place))).facts()
    assert facts["position"] == [51.0, 9.0, 0.0]
    facts["position"] = [51.0, 9.0, 200.0]
    settings = settings_of(facts, vehicle())
    expected = flight_settings(
        vehicle(), units=facts["units"], world="ned", body=None, gravity_sign=None, position=(51.0, 9.0, 200.0),
        started_at=None,
    )  # fmt: skip
    assert settings == expected
