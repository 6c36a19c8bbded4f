"""Joining sensors that are logged apart; names of units."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.logs.autopilot import join_on_gyroscope, tell_join, tell_simulated, unit_ids
from fieldcal.logs.interface import LogSummary

MS = 1_000_000


def linear(t_ns: np.ndarray) -> np.ndarray:
    """Readings that interpolation must give exactly."""
    return np.column_stack([t_ns / MS, -2.0 * t_ns / MS, np.full(len(t_ns), 7.0)])


def accelerometer(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.column_stack([columns[f"accelerometer_{axis}"] for axis in "xyz"])


def test_readings_of_one_stamp_stay_as_they_are() -> None:
    t = np.arange(100) * 5 * MS
    values = np.random.default_rng(1).normal(size=(2, 100, 3))
    joined = join_on_gyroscope(t, values[0], t, values[1])
    np.testing.assert_array_equal(accelerometer(joined.columns), values[1])
    assert (joined.interpolated, joined.left_out, joined.outside) == (0, 0, 0)


def test_one_sensor_without_a_reading_leaves_no_row_and_all_of_the_gyroscopes_are_outside() -> None:
    t, values = np.arange(5), np.ones((5, 3))
    for gyro, accel, outside in ((0, 5, 0), (5, 0, 5), (0, 0, 0)):
        joined = join_on_gyroscope(t[:gyro], values[:gyro], t[:accel], values[:accel])
        assert {len(column) for column in joined.columns.values()} == {0}
        assert joined.outside == outside


@pytest.mark.parametrize("order", [1, -1])
def test_others_are_interpolated_within_the_recording(order: int) -> None:
    gyro_t, accel_t = np.arange(50) * 4 * MS, 10 * MS + np.arange(20) * 5 * MS
    joined = join_on_gyroscope(gyro_t, linear(gyro_t), accel_t[::order], linear(accel_t)[::order])
    t = joined.columns["t_ns"]
    np.testing.assert_allclose(accelerometer(joined.columns), linear(t), rtol=1e-12)
    inside = (gyro_t >= accel_t[0]) & (gyro_t <= accel_t[-1])
    np.testing.assert_array_equal(t, gyro_t[inside])
    assert joined.outside == np.count_nonzero(~inside)
    assert joined.interpolated == np.count_nonzero(gyro_t[inside] % (5 * MS))


def test_nothing_is_interpolated_across_a_pause() -> None:
    gyro_t = np.arange(100) * 4 * MS
    accel_t = np.concatenate([np.arange(0, 100, 5), np.arange(200, 400, 5)]) * MS
    joined = join_on_gyroscope(gyro_t, linear(gyro_t), accel_t, linear(accel_t))
    t = joined.columns["t_ns"]
    pause = (gyro_t > 95 * MS) & (gyro_t < 200 * MS)
    assert joined.left_out == np.count_nonzero(pause)
    assert not ((t > 95 * MS) & (t < 200 * MS)).any()


def test_without_an_accelerometer_nothing_is_joined() -> None:
    t = np.arange(3) * MS
    joined = join_on_gyroscope(t, linear(t), t[:0], linear(t[:0]))
    assert len(joined.columns["t_ns"]) == 0
    assert joined.outside == 3


@pytest.mark.filterwarnings("error")
def test_a_single_reading_is_joined_with_what_has_its_stamp() -> None:
    t = np.arange(3) * MS
    joined = join_on_gyroscope(t, linear(t), t[1:2], linear(t[1:2]))
    np.testing.assert_array_equal(joined.columns["t_ns"], t[1:2])
    assert (joined.interpolated, joined.left_out, joined.outside) == (0, 0, 2)


def test_only_a_pause_loses_data() -> None:
    for left_out, loses in ((0, False), (2, True)):
        summary = LogSummary("x")
        tell_join(summary, "log", "topic", interpolated=0, left_out=left_out, outside=3)
        (finding,) = summary.findings
        assert (finding.code, finding.count, finding.loses_data) == ("incomplete_row", 3 + left_out, loses)


def test_units_are_named_by_device_and_by_instance_where_that_does_not_tell() -> None:
    summary = LogSummary("x")
    assert unit_ids([7, None, 9], "IMU", summary, "log") == ["7", "instance-1", "9"]
    assert summary.findings == []
    assert unit_ids([7, 9, 7], "IMU", summary, "log") == ["instance-0", "9", "instance-2"]
    (finding,) = summary.findings
    assert (finding.code, finding.count) == ("shared_device_id", 2)


def test_a_simulation_is_fatal_unless_it_is_expected() -> None:
    for expected in (False, True):
        summary = LogSummary("x")
        tell_simulated(summary, "log", "SYS_HITL = 1", expected=expected)
        (finding,) = summary.findings
        assert finding.fatal is not expected
        assert ("simulated = true" in finding.sentence) is not expected
