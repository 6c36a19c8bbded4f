"""Recordings of PX4: what their own description says of them. Needs FIELDCAL_EXAMPLE_LOGS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from example_logs import PARENT, needs_examples

from fieldcal.config.configuration import load
from fieldcal.logs import ingest, read_log
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.ulog.file import UlogFile
from fieldcal.logs.ulog.parameters import History, corrected, corrections
from fieldcal.names import Sensor

pytestmark = needs_examples
LOGS = PARENT / "autopilot-logs"
TUMBLED = LOGS / "px4-fmuv2-tumbled"
GYRO_COLUMNS = [f"gyroscope_{axis}" for axis in "xyz"]
ACCEL_COLUMNS = [f"accelerometer_{axis}" for axis in "xyz"]
MAG_COLUMNS = [f"magnetometer_{axis}" for axis in "xyz"]


def signals(path: Path) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    return read_log(path, load(None).vehicle("v"))


def facts(path: Path) -> Any:
    return ingest.read_flight(path, load(None).vehicle("v"))[1]


@pytest.mark.parametrize(("name", "seconds", "dps"), [("log1", 114.3, 885.0), ("log2", 23.3, None)])
def test_the_tumbled_board(name: str, seconds: float, dps: float | None) -> None:
    tables, summary = signals(TUMBLED / "session-1" / f"{name}.ulg")
    t = tables["imu"]["t_ns"].to_numpy()
    assert (t[-1] - t[0]) * 1e-9 == pytest.approx(seconds, abs=0.2)
    assert len(t) / seconds == pytest.approx(249.0, abs=1.0)
    if dps is not None:
        fastest = np.degrees(np.abs(tables["imu"].select(GYRO_COLUMNS).to_numpy())).max()
        assert fastest == pytest.approx(dps, abs=1.0)
    field = np.linalg.norm(tables["magnetometer"].select(MAG_COLUMNS).to_numpy(), axis=1)
    assert 0.7 < np.percentile(field, 5) < np.percentile(field, 95) < 1.1
    assert "temperature" not in tables
    assert not summary.epoch_known


@pytest.mark.parametrize(("axis", "mean_mps2"), [("x", -9.848), ("y", 9.763), ("z", -9.804)])
def test_the_board_at_rest(axis: str, mean_mps2: float) -> None:
    tables, _ = signals(TUMBLED / "static" / f"static_{axis}.ulg")
    assert tables["imu"][f"accelerometer_{axis}"].mean() == pytest.approx(mean_mps2, abs=5e-4)


def test_three_imus_and_two_magnetometers_on_one_board() -> None:
    path = LOGS / "px4-cubeorange/session-1/rest_12s.ulg"
    tables, summary = signals(path)
    imus = {one.table: (one.unit_id, one.stream) for one in summary.sources if one.sensor == Sensor.GYROSCOPE}
    assert imus == {
        "imu": ("3670050", "sensor_combined.0"),
        "imu.1": ("2621474", "vehicle_imu.1"),
        "imu.2": ("2424842", "vehicle_imu.2"),
    }
    fields = [one.unit_id for one in summary.sources if one.sensor == Sensor.MAGNETOMETER]
    assert fields == ["8944899", "589858"]
    assert 33.0 < tables["temperature"]["temperature_degc"].mean() < 35.0  # type: ignore[operator]
    assert tables["gnss_velocity"].height == 59
    assert summary.metadata["ver_hw"] == "CUBEPILOT_CUBEORANGE"
    known = facts(path)
    assert (known["verdict"], known["reason_code"]) == ("partial", "dropouts_logged")
    # By the note of the logger, which is no receiver's, it was the same second.
    note_us = int(summary.metadata["boot_time_utc_us"])
    assert float(summary.metadata["utc_minus_boot_s"]) == pytest.approx(note_us * 1e-6, abs=1.0)
    assert ingest.started_at(known).isoformat().startswith("2026-03-28T")  # type: ignore[union-attr]


@pytest.mark.parametrize("name", ["px4-hitl/session-1/08_19_52.ulg", "px4-sitl/session-1/with_groundtruth.ulg"])
def test_simulations_are_set_aside(name: str) -> None:
    known = facts(LOGS / name)
    assert (known["verdict"], known["reason_code"]) == ("quarantined", "simulated")


def test_a_log_of_less_than_a_second_is_refused() -> None:
    known = facts(LOGS / "px4-hitl/session-1/05_54_37.ulg")
    assert (known["verdict"], known["reason_code"]) == ("rejected", "too_few_samples")


def test_parameters_change_in_flight() -> None:
    log = UlogFile(LOGS / "px4-sitl/session-1/parameters_change.ulg")
    assert len(log.changes) == 23
    names = {change.name for change in log.changes}
    states = list(History(log.parameters, log.changes).states(*names))
    first, last = states[0][1], states[-1][1]
    assert first == log.parameters
    assert last == log.parameters | {change.name: change.value for change in log.changes}
    assert len(states) == 1 + len({change.t_us for change in log.changes})


def test_a_raw_magnetometer_by_the_formula_is_what_px4_published() -> None:
    log = UlogFile(LOGS / "px4-hitl/session-1/08_19_52.ulg")
    (raw_topic,), (topic,) = log.instances("sensor_mag"), log.instances("vehicle_magnetometer")
    rows = log.rows(raw_topic)
    raw = np.column_stack([rows[axis] for axis in "xyz"]).astype(float)
    published = np.median(log.rows(topic)["magnetometer_ga"], axis=0)
    (piece, *_) = corrections(Sensor.MAGNETOMETER, int(rows["device_id"][0]), History(log.parameters))
    np.testing.assert_allclose(np.median(corrected(piece, raw), axis=0), published, atol=2e-3)
