"""Further IMUs and magnetometers: numbered from 1 by kind as they are met, and told with their rates."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.logs.further_units import FurtherUnits
from fieldcal.logs.interface import Columns, LogSummary

S = 10**9


def columns(*sensors: str, t_s: tuple[float, ...] = (0.0, 0.5, 1.0)) -> Columns:
    """Readings of these sensors."""
    axes = {f"{sensor}_{axis}": np.zeros(len(t_s)) for sensor in sensors for axis in "xyz"}
    return {"t_ns": (np.array(t_s) * S).astype(np.int64), **axes}


def table(units: FurtherUnits, name: str, unit_id: str) -> str | None:
    placed = units.placed((name, columns("magnetometer" if name == "magnetometer" else "gyroscope")), "s", unit_id)
    return None if placed is None else placed[0]


def test_units_are_numbered_by_kind_in_the_order_in_which_they_are_met() -> None:
    units = FurtherUnits()
    met = [
        ("imu", ""), ("magnetometer", ""), ("imu", "b"), ("magnetometer", "m"), ("imu", "a"), ("imu", "b"),
        ("imu", "c"), ("magnetometer", "n"), ("temperature", "a"), ("temperature", "d"), ("temperature", ""),
    ]  # fmt: skip
    assert [table(units, name, unit) for name, unit in met] == [
        "imu", "magnetometer", "imu.1", "magnetometer.1", "imu.2", "imu.1", "imu.3",
        "magnetometer.2", "temperature.2", "temperature.4", "temperature",
    ]  # fmt: skip


def test_a_further_unit_has_readings_alone() -> None:
    units = FurtherUnits()
    assert units.placed(("vps", columns()), "s", "b") is None
    assert units.placed(("vps", columns()), "s", "") is not None
    assert table(units, "imu", "b") == "imu.1"


def test_a_log_of_one_unit_tells_nothing_and_several_are_told_with_their_rates() -> None:
    units, summary = FurtherUnits(), LogSummary("dataflash")
    units.placed(("imu", columns("gyroscope", "accelerometer")), "IMU[0]", "")
    units.tell(summary, "1.bin")
    assert summary.sources == []
    units.placed(("imu", columns("gyroscope", t_s=(2.0, 2.25))), "IMU[1]", "b")
    units.placed(("imu", columns("gyroscope", t_s=(1.75, 2.5, 3.0))), "IMU[1]", "b")
    units.placed(("magnetometer", columns("magnetometer", t_s=(2.0,))), "MAG[1]", "m")
    units.tell(summary, "1.bin")
    told = [(s.sensor, s.table, s.unit_id, s.stream, s.rate_hz, s.primary) for s in summary.sources]
    assert told == [
        ("accelerometer", "imu", "", "IMU[0]", pytest.approx(2.0), True),
        ("gyroscope", "imu", "", "IMU[0]", pytest.approx(2.0), True),
        ("gyroscope", "imu.1", "b", "IMU[1]", pytest.approx(4 / 1.25), False),
        ("magnetometer", "magnetometer.1", "m", "MAG[1]", 0.0, False),
    ]
    assert [finding.code for finding in summary.findings] == ["further_units"]
