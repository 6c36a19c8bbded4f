"""Readings, units and what else PX4 logs, small cases at their limits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldcal.logs.ulog import aids, streams, units
from fieldcal.logs.ulog.file import Change, UlogFile
from fieldcal.logs.ulog.parameters import History, correction, corrections, parameters_of, slot_of
from fieldcal.logs.ulog.records import Topic
from fieldcal.logs.ulog.rotations import FIRST_OF_MAVLINK, rotation
from fieldcal.logs.ulog.streams import Clock
from fieldcal.logs.ulog.units import Selection, longest
from fieldcal.logs.ulog.write import Rows, write_ulog
from fieldcal.names import Sensor

LATEST = 4 * 10**15
AXES = tuple(enumerate("xyz", 1))


def log_of(path: Path, *topics: Rows, **options: Any) -> UlogFile:
    write_ulog(path, topics, **options)
    return UlogFile(path)


def rows_of(file: UlogFile, name: str, instance: int = 0) -> tuple[Topic, Any]:
    topic = next(one for one in file.topics if (one.name, one.instance) == (name, instance))
    return topic, file.rows(topic)


def stamps(*t_us: int) -> np.ndarray:
    return np.array(t_us, np.uint64)


def numbers(kind: type[np.generic], *values: float) -> np.ndarray:
    return np.array(values).astype(kind)


def triples(n: int) -> np.ndarray:
    return np.arange(3 * n, dtype=np.float32).reshape(n, 3)


def imu_topic(name: str, device_id: int, hz: float, instance: int = 0, n: int = 40) -> Rows:
    """A topic of three axes at a rate."""
    t_us = np.arange(n, dtype=np.float64) * 1e6 / hz + 1000
    axes = {axis: np.full(n, i, np.float32) for i, axis in enumerate("xyz")}
    return Rows(
        name, {"timestamp": t_us.astype(np.uint64), "device_id": np.full(n, device_id, np.uint32), **axes}, instance
    )


# streams -------------------------------------------------------------------------------------------------------------


def test_stamps_are_cut_where_no_boot_clock_reaches() -> None:
    assert Clock(7).ns(np.array([0, 5, LATEST, LATEST + 1, 2**64 - 1], np.uint64)).tolist() == [
        7, 5007, *[LATEST * 1000 + 7] * 3
    ]  # fmt: skip
    assert Clock().ns(np.array([-1, 0])).tolist() == [0, 0]


def test_a_time_of_sampling_goes_before_that_of_logging(tmp_path: Path) -> None:
    both = {"timestamp": stamps(10, 20, 30), "timestamp_sample": stamps(9, 0, 1)}
    other = {"timestamp": stamps(10, 20, 30), "timestamp_sample": numbers(np.float32, 9, 8, 7)}
    file = log_of(tmp_path / "a.ulg", Rows("a", both), Rows("b", other), Rows("c", {"timestamp": stamps(10)}))
    assert streams.stamps_us(rows_of(file, "a")[1]).tolist() == [9, 20, 1]
    assert streams.stamps_us(rows_of(file, "b")[1]).tolist() == [10, 20, 30]
    assert streams.stamps_us(rows_of(file, "c")[1]).tolist() == [10]


def test_fields_of_numbers(tmp_path: Path) -> None:
    columns = {"timestamp": stamps(1), "a": triples(1), "b": numbers(np.int8, 1)}
    topic, _ = rows_of(log_of(tmp_path / "a.ulg", Rows("a", columns)), "a")
    assert streams.has(topic, "timestamp", "b")
    assert streams.has(topic, "a", shape=(3,))
    assert not streams.has(topic, "a")
    assert not streams.has(topic, "b", "c")
    assert not streams.has(topic, "b", shape=(3,))
    assert streams.has(topic)


@pytest.mark.parametrize(
    ("t_us", "rate"), [((), 0), ((5,), 0), ((5, 5), 0), ((0, 20_000), 50), ((0, 1), 10**6), ((0, 10, 20, 90), 10**5)]
)
@pytest.mark.filterwarnings("error")
def test_rates(tmp_path: Path, t_us: tuple[int, ...], rate: float) -> None:
    fifo = {"timestamp": stamps(*t_us), "samples": np.full(len(t_us), 8, np.uint8)}
    file = log_of(tmp_path / "a.ulg", Rows("a", {"timestamp": stamps(*t_us)}), Rows("sensor_gyro_fifo", fifo))
    if len(t_us):
        assert streams.rate_hz(file, file.topics[1]) == 8 * rate
    assert streams.rate_hz(file, file.topics[0]) == rate


def test_samples_of_a_fifo_lie_before_its_stamp(tmp_path: Path) -> None:
    """Four places; a message says how many are filled, how far apart, and what a count is."""
    counts = numbers(np.int16, *range(12)).reshape(3, 4)
    columns = {
        "timestamp": stamps(10**6, 2 * 10**6, 3 * 10**8),
        "dt": numbers(np.float32, 125.5, np.nan, 1.2e7),
        "scale": numbers(np.float32, 0.5, 2.0, 1.0),
        "samples": numbers(np.uint8, 3, 9, 2),
        **{axis: counts + 100 * i for i, axis in enumerate("xyz")},
    }
    topic, rows = rows_of(log_of(tmp_path / "a.ulg", Rows("sensor_gyro_fifo", columns)), "sensor_gyro_fifo")
    t_ns, values = streams.readings(rows, topic, Clock(1))
    first = [10**9 - 251_000 + 1, 10**9 - 125_500 + 1, 10**9 + 1]
    assert t_ns.tolist() == [*first, *[2 * 10**9 + 1] * 4, 3 * 10**11 - 10**10 + 1, 3 * 10**11 + 1]
    assert values[:, 0].tolist() == [0.0, 0.5, 1.0, 8.0, 10.0, 12.0, 14.0, 8.0, 9.0]
    assert values[:, 2].tolist() == [100.0, 100.5, 101.0, 408.0, 410.0, 412.0, 414.0, 208.0, 209.0]


@pytest.mark.parametrize("at_once", [1, 2, 3, 7, 1000])
@pytest.mark.parametrize("sorted_by_time", [True, False])
def test_sensors_apart_are_joined_whatever_the_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int, sorted_by_time: bool
) -> None:
    monkeypatch.setattr(streams, "ROWS_AT_ONCE", at_once)

    def ramp(name: str, t_us: np.ndarray) -> Rows:
        """Readings that interpolation gives exactly: the time, twice and three times it."""
        return Rows(name, {"timestamp": t_us.astype(np.uint64), **{a: t_us.astype(np.float32) * i for i, a in AXES}})

    gyro_us, accel_us = np.arange(995, 1400, 7), np.arange(990, 1500, 10)
    path = tmp_path / "a.ulg"
    write_ulog(path, [ramp("sensor_gyro", gyro_us), ramp("sensor_accel", accel_us)])
    if not sorted_by_time:  # the second and a late accelerometer message change places
        content = bytearray(path.read_bytes())
        size = 3 + 2 + 8 + 12
        places = [content.index(b"D\1\0" + int(t).to_bytes(8, "little")) - 2 for t in (1000, 1440)]
        first, second = (bytes(content[at : at + size]) for at in places)
        for at, message in zip(places, (second, first), strict=True):
            content[at : at + size] = message
        path.write_bytes(content)
    file = UlogFile(path)
    found = list(streams.joined(file, rows_of(file, "sensor_gyro")[0], rows_of(file, "sensor_accel")[0], Clock()))
    assert np.concatenate([one.columns["t_ns"] for one in found]).tolist() == (gyro_us * 1000).tolist()
    assert np.allclose(np.concatenate([one.columns["accelerometer_y"] for one in found]), 2 * gyro_us, rtol=1e-6)


def test_without_an_accelerometer_or_samples_nothing_is_joined(tmp_path: Path) -> None:
    empty = imu_topic("sensor_accel", 8, 100.0, n=0)
    file = log_of(tmp_path / "a.ulg", imu_topic("sensor_gyro", 7, 100.0, n=3), empty)
    (one,) = streams.joined(file, file.topics[0], file.topics[1], Clock())
    assert (len(one.columns["t_ns"]), one.outside) == (0, 3)
    fifo = {"timestamp": stamps(5), "dt": numbers(np.float32, 1), "scale": numbers(np.float32, 1)}
    fifo |= {"samples": numbers(np.uint8, 0), **{axis: np.ones((1, 4), np.int16) for axis in "xyz"}}
    file = log_of(tmp_path / "b.ulg", Rows("sensor_gyro_fifo", fifo), imu_topic("sensor_accel", 8, 100.0, n=3))
    (one,) = streams.joined(file, file.topics[0], file.topics[1], Clock())
    assert (len(one.columns["t_ns"]), one.outside) == (0, 0)


def test_axes_of_a_fifo_are_read_as_far_as_all_are_there(tmp_path: Path) -> None:
    columns = {"timestamp": stamps(9), "dt": numbers(np.float32, 1), "scale": numbers(np.float32, 1)}
    columns |= {
        "samples": numbers(np.uint8, 9),
        **{axis: np.ones((1, 3 + i), np.int16) for i, axis in enumerate("yxz")},
    }
    topic, rows = rows_of(log_of(tmp_path / "a.ulg", Rows("sensor_accel_fifo", columns)), "sensor_accel_fifo")
    assert streams.readings(rows, topic, Clock())[0].tolist() == [7000, 8000, 9000]


def test_rows_of_sensor_combined(tmp_path: Path) -> None:
    columns = {
        "timestamp": stamps(0, 2000, 3000, 4000),
        "gyro_rad": triples(4),
        "accelerometer_m_s2": triples(4) + 100,
        "accelerometer_timestamp_relative": numbers(np.int32, 0, 2**31 - 1, 0, 0),
    }
    _, rows = rows_of(log_of(tmp_path / "a.ulg", Rows("sensor_combined", columns)), "sensor_combined")
    joined = streams.combined(rows, Clock(5))
    assert (joined.interpolated, joined.left_out, joined.outside) == (0, 0, 0)
    found = joined.columns
    assert found["t_ns"].tolist() == [5, 2_000_005, 3_000_005, 4_000_005]
    assert found["gyroscope_z"].tolist() == [2.0, 5.0, 8.0, 11.0]
    assert np.array_equal(found["accelerometer_x"], [100.0, np.nan, 106.0, 109.0], equal_nan=True)


def test_an_accelerometers_time_is_told_relative_to_the_gyroscopes(tmp_path: Path) -> None:
    columns = {
        "timestamp": stamps(1000, 2000, 3000),
        "gyro_rad": triples(3),
        "accelerometer_m_s2": triples(3),
        "accelerometer_timestamp_relative": numbers(np.int32, -250, -250, -250),
    }
    _, rows = rows_of(log_of(tmp_path / "a.ulg", Rows("sensor_combined", columns)), "sensor_combined")
    joined = streams.combined(rows, Clock())
    assert (joined.interpolated, joined.outside) == (2, 1)
    assert np.allclose(joined.columns["accelerometer_x"], [0.75, 3.75])


def test_a_reading_that_is_held_counts_once(tmp_path: Path) -> None:
    columns = {
        "timestamp": stamps(100, 200, 300, 400, 500),
        "magnetometer_ga": triples(5),
        "magnetometer_timestamp_relative": numbers(np.int32, 0, -100, 2**31 - 1, -10, -110),
    }
    topic, rows = rows_of(log_of(tmp_path / "a.ulg", Rows("sensor_combined", columns)), "sensor_combined")
    t_ns, values, last = streams.combined_magnetometer(rows, Clock(5), -1)
    assert (t_ns.tolist(), values[:, 0].tolist(), last) == ([100_005, 390_005], [0.0, 9.0], 390)
    t_ns, _, last = streams.combined_magnetometer(rows[:2], Clock(), 100)
    assert (t_ns.tolist(), last) == ([], 100)
    assert topic.instance == 0


def test_means_over_intervals(tmp_path: Path) -> None:
    columns = {
        "timestamp": stamps(1000, 2000),
        "delta_angle": triples(2),
        "delta_velocity": triples(2) + 1,
        "delta_angle_dt": numbers(np.uint16, 2000, 4000),
        "delta_velocity_dt": numbers(np.uint16, 5000, 0),
    }
    _, rows = rows_of(log_of(tmp_path / "a.ulg", Rows("vehicle_imu", columns)), "vehicle_imu")
    t_ns, rate, force = streams.averaged(rows, Clock())
    assert t_ns.tolist() == [10**6, 2 * 10**6]
    assert np.allclose(rate, [[0, 500, 1000], [750, 1000, 1250]])
    assert np.allclose(force[0], [200, 400, 600])
    assert not np.isfinite(force[1]).any()


# units ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chosen", "end_us", "found"),
    [
        ([], 100, None),
        ([Selection(0, 1, 2)], 100, 0),
        ([Selection(0, 1, 2), Selection(40, 3, 4)], 100, 1),
        ([Selection(0, 1, 2), Selection(50, 3, 4)], 100, 0),  # as long: the first
        ([Selection(0, 1, 2), Selection(30, 3, 4), Selection(70, 1, 2)], 100, 0),
        ([Selection(0, 1, 2), Selection(30, 1, 4), Selection(90, 1, 2)], 100, 1),
        ([Selection(0, 1, 2), Selection(90, 3, 4)], 80, 0),  # times that do not grow
        ([Selection(5, 1, 2), Selection(5, 3, 4)], 6, 1),
    ],
)
def test_the_unit_chosen_for_the_longest_time(chosen: list[Selection], end_us: int, found: int | None) -> None:
    assert longest(chosen, end_us) == (None if found is None else chosen[found])


def test_choices_in_order_without_repetitions(tmp_path: Path) -> None:
    rows = [(5, 1, 2), (6, 1, 2), (7, 1, 3), (8, 4, 3), (LATEST + 9, 1, 2)]
    columns = {
        "timestamp": stamps(*(t for t, *_ in rows)),
        "gyro_device_id": numbers(np.uint32, *(g for _, g, _ in rows)),
        "accel_device_id": numbers(np.uint32, *(a for *_, a in rows)),
    }
    other = {"timestamp": stamps(1), "gyro_device_id": numbers(np.uint32, 9), "accel_device_id": numbers(np.uint32, 9)}
    file = log_of(tmp_path / "a.ulg", Rows("sensor_selection", columns), Rows("sensor_selection", other, 1))
    assert units.selections(file) == [
        Selection(5, 1, 2), Selection(7, 1, 3), Selection(8, 4, 3), Selection(LATEST, 1, 2)
    ]  # fmt: skip
    lacks = Rows("sensor_selection", {"timestamp": stamps(1), "gyro_device_id": numbers(np.uint32, 9)})
    assert units.selections(log_of(tmp_path / "b.ulg", lacks)) == []


@pytest.mark.parametrize(("raw_hz", "name"), [(50.0, "sensor_gyro.0 and sensor_accel.0"), (49.9, "vehicle_imu.0")])
def test_rawer_readings_are_preferred_down_to_a_rate(tmp_path: Path, raw_hz: float, name: str) -> None:
    n = 200
    averaged = {
        "timestamp": (np.arange(n) * 5000 + 1000).astype(np.uint64),
        "gyro_device_id": np.full(n, 7, np.uint32),
        "accel_device_id": np.full(n, 8, np.uint32),
        **{f"delta_{what}": triples(n) for what in ("angle", "velocity")},
        **{f"delta_{what}_dt": np.full(n, 5000, np.uint16) for what in ("angle", "velocity")},
    }
    raw = [imu_topic("sensor_gyro", 7, raw_hz), imu_topic("sensor_accel", 8, 100.0)]
    (unit,) = units.imus(log_of(tmp_path / "a.ulg", *raw, Rows("vehicle_imu", averaged)))
    assert (unit.stream.name, unit.device_id, unit.accelerometer_id, unit.primary) == (name, 7, 8, True)
    slow = [imu_topic("sensor_gyro", 7, 20.0), imu_topic("sensor_accel", 8, 10.0)]
    (unit,) = units.imus(log_of(tmp_path / "b.ulg", *slow))
    assert unit.stream.rate_hz == 10.0
    averaged |= {"timestamp": averaged["timestamp"] * np.uint64(5)}
    (unit,) = units.imus(log_of(tmp_path / "c.ulg", *slow, Rows("vehicle_imu", averaged)))
    assert unit.stream.name == "vehicle_imu.0"  # none is fast enough: the fastest
    lacks = {name: column for name, column in averaged.items() if name != "delta_angle_dt"}
    assert units.imus(log_of(tmp_path / "d.ulg", Rows("vehicle_imu", lacks))) == []


def combined_topic(last_us: int, instance: int = 0, **left_out: bool) -> Rows:
    """sensor_combined every ms up to a time."""
    t_us = np.arange(1000, last_us + 1, 1000).astype(np.uint64)
    columns = {"timestamp": t_us, "gyro_rad": triples(len(t_us)), "accelerometer_m_s2": triples(len(t_us))}
    columns |= {"accelerometer_timestamp_relative": np.zeros(len(t_us), np.int32)}
    return Rows("sensor_combined", {n: c for n, c in columns.items() if n not in left_out}, instance)


def selection_topic(*chosen: tuple[int, int, int]) -> Rows:
    """sensor_selection: when, gyroscope, accelerometer."""
    t_us, gyro, accel = zip(*chosen, strict=True)
    ids = {"gyro_device_id": numbers(np.uint32, *gyro), "accel_device_id": numbers(np.uint32, *accel)}
    return Rows("sensor_selection", {"timestamp": stamps(*t_us), **ids})


RAW = (7, 8)


@pytest.mark.parametrize(
    ("raw", "chosen", "found"),
    [
        (None, (), [(0, 0, True, "sensor_combined.0")]),
        (None, ((0, 9, 10),), [(9, 10, True, "sensor_combined.0")]),
        (RAW, (), [(7, 8, True, "sensor_gyro.0 and sensor_accel.0")]),
        (RAW, ((0, 7, 8),), [(7, 8, True, "sensor_gyro.0 and sensor_accel.0")]),
        (
            RAW,
            ((0, 9, 10),),
            [(9, 10, True, "sensor_combined.0"), (7, 8, False, "sensor_gyro.0 and sensor_accel.0")],
        ),
        (RAW, ((0, 7, 11),), [(7, 11, True, "sensor_combined.0")]),  # one gyroscope is in one unit
        ((0, 0), (), [(0, 0, True, "sensor_gyro.0 and sensor_accel.0")]),
        (
            (0, 0),
            ((0, 0, 5),),
            [(0, 5, True, "sensor_combined.0"), (0, 0, False, "sensor_gyro.0 and sensor_accel.0")],
        ),
        (
            RAW,
            ((0, 9, 10), (60_000, 7, 8)),  # until the log ends at 100 ms
            [(9, 10, True, "sensor_combined.0"), (7, 8, False, "sensor_gyro.0 and sensor_accel.0")],
        ),
        (RAW, ((0, 9, 10), (40_000, 7, 8)), [(7, 8, True, "sensor_gyro.0 and sensor_accel.0")]),
    ],
)
def test_sensor_combined_is_of_the_unit_that_the_autopilot_flew_by(
    tmp_path: Path,
    raw: tuple[int, int] | None,
    chosen: tuple[tuple[int, int, int], ...],
    found: list[tuple[int, int, bool, str]],
) -> None:
    topics = [combined_topic(100_000), combined_topic(3000, 1)]
    topics += [
        imu_topic(name, number, 200.0) for name, number in zip(("sensor_gyro", "sensor_accel"), raw or (), strict=False)
    ]
    topics += [selection_topic(*chosen)] if chosen else []
    told = units.imus(log_of(tmp_path / "a.ulg", *topics))
    assert [(u.device_id, u.accelerometer_id, u.primary, u.stream.name) for u in told] == found


def test_layouts_that_are_not_whole_are_no_units(tmp_path: Path) -> None:
    n = 4
    whole = {"timestamp": stamps(*range(1, n + 1)), "device_id": np.full(n, 7, np.uint32)}
    whole |= {"samples": np.full(n, 2, np.uint8), "dt": np.ones(n, np.float32), "scale": np.ones(n, np.float32)}
    whole |= {axis: np.ones((n, 2), np.int16) for axis in "xyz"}
    mate = Rows("sensor_accel_fifo", whole | {"device_id": np.full(n, 8, np.uint32)})

    def found(columns: Mapping[str, Any]) -> list[str]:
        file = log_of(tmp_path / "a.ulg", Rows("sensor_gyro_fifo", columns), mate)
        return [unit.stream.name for unit in units.imus(file)]

    assert found(whole) == ["sensor_gyro_fifo.0 and sensor_accel_fifo.0"]
    for lacking in ("scale", "dt", "samples", "y"):
        assert found({name: column for name, column in whole.items() if name != lacking}) == []
    for other in (np.ones((n, 2), np.float32), np.ones(n, np.int16)):
        assert found(whole | {"z": other}) == []
    lacks = combined_topic(5000, accelerometer_timestamp_relative=True)
    assert units.imus(log_of(tmp_path / "b.ulg", lacks)) == []


def test_without_ids_sensors_are_paired_by_instance(tmp_path: Path) -> None:
    topics = [
        imu_topic("sensor_gyro", 0, 200.0, 1),
        imu_topic("sensor_accel", 0, 200.0),
        imu_topic("sensor_accel", 0, 200.0, 1),
    ]
    (unit,) = units.imus(log_of(tmp_path / "a.ulg", *topics))
    assert unit.stream.name == "sensor_gyro.1 and sensor_accel.1"


def test_drivers_that_corrected_have_raw_counts_beside_it(tmp_path: Path) -> None:
    raw = Rows("sensor_gyro", {"timestamp": stamps(1), "x_raw": numbers(np.int16, 1)})
    file = log_of(tmp_path / "a.ulg", raw, Rows("sensor_mag", {"timestamp": stamps(1)}))
    assert [units.corrected_by_driver(topic) for topic in file.topics] == [True, False]


def test_sensors_are_paired_by_instance(tmp_path: Path) -> None:
    topics = [imu_topic("sensor_gyro", 7, 200.0), imu_topic("sensor_gyro", 9, 200.0, 1)]
    topics += [imu_topic("sensor_accel", 8, 200.0), imu_topic("sensor_accel", 10, 200.0, 1)]
    chosen = {
        "timestamp": stamps(1),
        "gyro_device_id": numbers(np.uint32, 9),
        "accel_device_id": numbers(np.uint32, 10),
    }
    found = units.imus(log_of(tmp_path / "a.ulg", *topics, Rows("sensor_selection", chosen)))
    assert [(u.device_id, u.accelerometer_id, u.primary) for u in found] == [(9, 10, True), (7, 8, False)]
    found = units.imus(log_of(tmp_path / "b.ulg", *topics))
    assert [(u.device_id, u.accelerometer_id, u.primary) for u in found] == [(7, 8, True), (9, 10, False)]
    found = units.imus(log_of(tmp_path / "c.ulg", *topics[:1], *topics[3:]))  # no mate of its instance
    assert found == []


@pytest.mark.parametrize(
    ("parameters", "order"),
    [
        ({}, [7, 9]),
        ({"CAL_MAG0_ID": 9, "CAL_MAG0_PRIO": 75, "CAL_MAG1_ID": 7, "CAL_MAG1_PRIO": 50}, [9, 7]),
        ({"CAL_MAG3_ID": 9, "CAL_MAG3_PRIO": 75}, [9, 7]),
        ({"CAL_MAG4_ID": 9, "CAL_MAG4_PRIO": 75}, [7, 9]),
        ({"CAL_MAG0_ID": 9}, [7, 9]),
        ({"CAL_MAG0_ID": 9, "CAL_MAG0_PRIO": 1}, [9, 7]),
        ({"CAL_MAG0_ID": 9, "CAL_MAG0_PRIO": 50, "CAL_MAG1_ID": 7, "CAL_MAG1_PRIO": 50}, [7, 9]),
    ],
)
def test_the_magnetometer_of_the_highest_priority_is_the_primary_one(
    tmp_path: Path, parameters: Mapping[str, float], order: list[int]
) -> None:
    file = log_of(tmp_path / "a.ulg", imu_topic("sensor_mag", 7, 20.0), imu_topic("sensor_mag", 9, 20.0, 1))
    found = units.magnetometers(file, parameters)
    assert [(u.device_id, u.accelerometer_id, u.primary) for u in found] == [(order[0], 0, True), (order[1], 0, False)]


@pytest.mark.parametrize(("number", "primary"), [(0, 7), (1, 1)])
def test_a_slot_without_a_device_has_no_priority(tmp_path: Path, number: int, primary: int) -> None:
    file = log_of(tmp_path / "a.ulg", imu_topic("sensor_mag", 7, 20.0), imu_topic("sensor_mag", number, 20.0, 1))
    found = units.magnetometers(file, {"CAL_MAG0_ID": number, "CAL_MAG0_PRIO": 75})
    assert next(unit.device_id for unit in found) == primary


def test_the_first_calibrated_magnetometer_is_the_primary_one(tmp_path: Path) -> None:
    def calibrated(device_id: int, instance: int) -> Rows:
        columns = {"timestamp": stamps(*range(1, 9)), "device_id": np.full(8, device_id, np.uint32)}
        return Rows("vehicle_magnetometer", columns | {"magnetometer_ga": triples(8)}, instance)

    topics = [calibrated(9, 0), calibrated(7, 1)]
    raw = [imu_topic("sensor_mag", 7, 20.0), imu_topic("sensor_mag", 9, 20.0, 1)]
    for more, names in (
        ([], ["vehicle_magnetometer.0", "vehicle_magnetometer.1"]),
        (raw, ["sensor_mag.1", "sensor_mag.0"]),
    ):
        found = units.magnetometers(log_of(tmp_path / "a.ulg", *topics, *more), {"CAL_MAG0_ID": 7, "CAL_MAG0_PRIO": 9})
        assert [(unit.device_id, unit.primary) for unit in found] == [(9, True), (7, False)]
        assert [unit.stream.name for unit in found] == names
    assert units.magnetometers(log_of(tmp_path / "b.ulg", combined_topic(5000)), {}) == []


@pytest.mark.parametrize(("ids", "count"), [((7, 9), 2), ((7, 7), 2), ((0, 0), 2), ((7, 7, 7), 3)])
def test_magnetometers_of_one_id_are_units_of_their_own(tmp_path: Path, ids: tuple[int, ...], count: int) -> None:
    topics = [imu_topic("sensor_mag", number, 20.0, i) for i, number in enumerate(ids)]
    found = units.magnetometers(log_of(tmp_path / "a.ulg", *topics), {})
    assert sorted(unit.stream.topic.instance for unit in found) == list(range(count))


@pytest.mark.parametrize(("raw_hz", "name"), [(5.0, "sensor_mag.0"), (4.9, "vehicle_magnetometer.0")])
def test_a_raw_magnetometer_is_preferred_down_to_a_rate(tmp_path: Path, raw_hz: float, name: str) -> None:
    n = 40
    calibrated = {
        "timestamp": (np.arange(n) * 100_000 + 1000).astype(np.uint64),
        "device_id": np.full(n, 7, np.uint32),
        "magnetometer_ga": triples(n),
    }
    topics = imu_topic("sensor_mag", 7, raw_hz), Rows("vehicle_magnetometer", calibrated)
    (unit,) = units.magnetometers(log_of(tmp_path / "a.ulg", *topics), {})
    assert (unit.stream.name, unit.primary) == (name, True)


@pytest.mark.filterwarnings("error")
def test_a_magnetometer_held_in_sensor_combined(tmp_path: Path) -> None:
    for relatives, rate in (
        ((0, -10_000, 0, -10_000), 50.0),
        ((0, -10_000), 0.0),
        ((0, -10_000, 0), 50.0),
        ((0, -5000, -20_000), 0.0),  # times that do not grow
        ((2**31 - 1, 2**31 - 1), 0.0),
    ):
        n = len(relatives)
        columns = {
            "timestamp": stamps(*(10_000 * i + 1 for i in range(n))),
            "magnetometer_ga": triples(n),
            "magnetometer_timestamp_relative": numbers(np.int32, *relatives),
        }
        (unit,) = units.magnetometers(log_of(tmp_path / "a.ulg", Rows("sensor_combined", columns)), {})
        assert (unit.device_id, unit.stream.rate_hz, unit.primary) == (0, rate, True)
        beside = log_of(tmp_path / "b.ulg", Rows("sensor_combined", columns), imu_topic("sensor_mag", 9, 20.0))
        assert [unit.stream.name for unit in units.magnetometers(beside, {})] == ["sensor_mag.0"]
        del columns["magnetometer_timestamp_relative"]
        assert units.magnetometers(log_of(tmp_path / "c.ulg", Rows("sensor_combined", columns)), {}) == []


def test_ids_of_a_topic(tmp_path: Path) -> None:
    columns = {"timestamp": stamps(1, 2, 3), "device_id": numbers(np.uint32, 5, 6, 6)}
    file = log_of(tmp_path / "a.ulg", Rows("a", columns), Rows("b", {"timestamp": stamps(1)}))
    assert (units.first_id(file, file.topics[0]), units.usual_id(file, file.topics[0])) == (5, 6)
    assert (units.first_id(file, file.topics[1]), units.usual_id(file, file.topics[1])) == (0, 0)
    file = log_of(tmp_path / "b.ulg", imu_topic("a", 5, 10.0, n=0), imu_topic("b", 5, 10.0))
    assert (units.first_id(file, file.topics[0]), units.usual_id(file, file.topics[0])) == (0, 0)


# what else is logged -------------------------------------------------------------------------------------------------

YEAR_2001_US = 10**15


@pytest.mark.parametrize(
    ("fix", "boot_us", "utc_us", "known"),
    [
        (3, 100, YEAR_2001_US + 1, True),
        (2, 100, YEAR_2001_US + 1, False),
        (3, 100, YEAR_2001_US, False),
        (3, 100, LATEST - 1, True),
        (3, 100, LATEST, False),
        (3, 0, YEAR_2001_US + 1, True),
        (3, LATEST - 1, YEAR_2001_US + 1, True),
        (3, LATEST, YEAR_2001_US + 1, False),
    ],
)
def test_the_date_by_a_fix(tmp_path: Path, fix: int, boot_us: int, utc_us: int, known: bool) -> None:
    columns = {
        "timestamp": stamps(boot_us),
        "time_utc_usec": stamps(utc_us),
        "fix_type": numbers(np.uint8, fix),
    }
    found = aids.epoch(log_of(tmp_path / "a.ulg", Rows("sensor_gps", columns)))
    assert (None if found is None else found.offset_ns) == ((utc_us - boot_us) * 1000 if known else None)


def test_of_the_date_is_told_how_far_fixes_differ(tmp_path: Path) -> None:
    columns = {
        "timestamp": stamps(1000, 2000, 3000, 4000),
        "time_utc_usec": stamps(*(2 * YEAR_2001_US + t for t in (1000, 12_000, 3000 - 25_000, 99_000))),
        "fix_type": numbers(np.uint8, 3, 3, 3, 1),
    }
    found = aids.epoch(log_of(tmp_path / "a.ulg", Rows("sensor_gps", columns)))
    assert found is not None
    assert found.offset_ns == 2 * YEAR_2001_US * 1000
    assert found.source == "sensor_gps, 3 fixes, -25 to +10 ms about their median"


@pytest.mark.parametrize(
    ("noted", "known"),
    [(YEAR_2001_US, False), (YEAR_2001_US + 1, True), (LATEST - 1, True), (LATEST, False)],
)
def test_the_date_by_the_loggers_note(tmp_path: Path, noted: int, known: bool) -> None:
    file = log_of(tmp_path / "a.ulg", Rows("a", {"timestamp": stamps(1)}), infos={"boot_time_utc_us": noted})
    found = aids.epoch(file)
    assert (None if found is None else found.offset_ns) == (noted * 1000 if known else None)


def test_velocities_count_where_they_are_valid(tmp_path: Path) -> None:
    columns = {
        "timestamp": stamps(1, 2, 3),
        "fix_type": numbers(np.uint8, 2, 3, 4),
        "lat": numbers(np.int32, 1, 471_234_567, 2),
        "lon": numbers(np.int32, 1, 81_234_567, 2),
        "alt": numbers(np.int32, 1, 430_250, 2),
        **{name: triples(3)[:, i] for i, name in enumerate(("vel_n_m_s", "vel_e_m_s", "vel_d_m_s"))},
        "vel_ned_valid": numbers(np.uint8, 1, 0, 1),
        "s_variance_m_s": numbers(np.float32, 1, 2, 4),
    }
    file = log_of(tmp_path / "a.ulg", Rows("vehicle_gps_position", columns))
    batches = list(aids.gnss_batches(file, Clock(3)))
    found = dict(batches)
    newer = {"latitude_deg": stamps(1) * 47.5, "longitude_deg": stamps(1) * 8.5, "altitude_msl_m": stamps(1) * 430.25}
    newer |= {"timestamp": stamps(9), "fix_type": numbers(np.uint8, 3)}
    other = log_of(tmp_path / "b.ulg", Rows("vehicle_gps_position", newer), Rows("vehicle_gps_position", newer, 1))
    (((_, one),)) = list(aids.gnss_batches(other, Clock()))
    assert [column.tolist() for column in one.values()] == [[9000], [47.5], [8.5], [430.25]]
    assert found["position"]["t_ns"].tolist() == [2003, 3003]
    place = [found["position"][name][0] for name in ("latitude_deg", "longitude_deg", "altitude_m")]
    assert np.allclose(place, [47.1234567, 8.1234567, 430.25], rtol=1e-12)
    velocity = found["gnss_velocity"]
    assert [velocity[name].tolist() for name in velocity] == [[3003], [6.0], [7.0], [8.0], [4.0]]


@pytest.mark.parametrize(("field", "usable"), [("local_frame", (0, 1)), ("pose_frame", (1, 2))])
def test_frames_of_poses_whose_z_is_down(tmp_path: Path, field: str, usable: tuple[int, ...]) -> None:
    q = np.arange(16, dtype=np.float32).reshape(4, 4)
    q[3, 0] = np.nan
    columns = {"timestamp": stamps(1, 2, 3, 4), "q": q, "position": triples(4), field: numbers(np.uint8, 0, 1, 2, 1)}
    topic, rows = rows_of(
        log_of(tmp_path / "a.ulg", Rows("vehicle_visual_odometry", columns)), "vehicle_visual_odometry"
    )
    found, unusable = aids.pose_columns(topic, rows, Clock())
    assert unusable == 1
    assert found["t_ns"].tolist() == [1000 * (i + 1) for i in usable]
    assert [[found[f"q{axis}"][i] for axis in "wxyz"] for i in (0, 1)] == [q[i].tolist() for i in usable]
    assert found["pz_m"].tolist() == [3.0 * i + 2 for i in usable]


def test_a_position_in_three_fields(tmp_path: Path) -> None:
    columns = {"timestamp": stamps(1), "q": np.ones((1, 4), np.float32), **{a: numbers(np.float32, i) for i, a in AXES}}
    topic, rows = rows_of(log_of(tmp_path / "a.ulg", Rows("vehicle_mocap_odometry", columns)), "vehicle_mocap_odometry")
    found, _ = aids.pose_columns(topic, rows, Clock())
    assert [found[f"p{axis}_m"].tolist() for axis in "xyz"] == [[1.0], [2.0], [3.0]]


def test_the_pose_with_the_most_messages(tmp_path: Path) -> None:
    def pose(name: str, n: int, width: int = 4) -> Rows:
        return Rows(name, {"timestamp": stamps(*range(n)), "q": np.ones((n, width), np.float32)})

    mocap, visual = pose("vehicle_mocap_odometry", 2), pose("vehicle_visual_odometry", 3)
    for topics, name in (((mocap, visual), visual.topic), ((mocap,), mocap.topic), ((pose(visual.topic, 3, 3),), None)):
        found = aids.pose_topic(log_of(tmp_path / "a.ulg", *topics))
        assert (None if found is None else found.name) == name


def test_temperatures_by_the_sensors_of_the_unit_first(tmp_path: Path) -> None:
    def sensor(name: str, device_id: int, degc: float, instance: int = 0) -> Rows:
        columns = {"timestamp": stamps(1, 2), "device_id": numbers(np.uint32, device_id, device_id)}
        return Rows(name, columns | {"temperature": numbers(np.float32, degc, np.nan)}, instance)

    status = {"timestamp": stamps(5), "accel_device_id": numbers(np.uint32, 8), "gyro_device_id": numbers(np.uint32, 7)}
    status |= {"temperature_accel": numbers(np.float32, 30), "temperature_gyro": numbers(np.float32, 40)}
    fitting = [sensor("sensor_accel", 8, 10), sensor("sensor_gyro", 7, 20), Rows("vehicle_imu_status", status)]
    for number, degc in enumerate((10.0, 20.0, 30.0)):
        file = log_of(tmp_path / "a.ulg", sensor("sensor_accel", 9, 50, 1), *fitting[number:])
        unit = units.Unit(7, 8, units.Stream(file.topics[0], 1.0), True)
        found = aids.temperature(file, unit, Clock())
        assert found is not None
        assert found["temperature_degc"].tolist() == [degc]
    assert aids.temperature(log_of(tmp_path / "b.ulg", sensor("sensor_accel", 8, np.nan)), unit, Clock()) is None


def test_currents_are_not_negative(tmp_path: Path) -> None:
    battery = {"timestamp": stamps(1, 2, 3), "current_a": numbers(np.float32, -1, 0, 5)}
    found = aids.current(log_of(tmp_path / "a.ulg", Rows("battery_status", battery)), Clock())
    assert found is not None
    assert (found["t_ns"].tolist(), found["current_a"].tolist()) == ([2000, 3000], [0.0, 5.0])
    none = {"timestamp": stamps(1), "current_a": numbers(np.float32, -1)}
    assert aids.current(log_of(tmp_path / "b.ulg", Rows("battery_status", none)), Clock()) is None


# parameters ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "device_id", "slot"),
    [
        ({"CAL_ACC0_ID": 7, "CAL_ACC1_ID": 8}, 8, 1),
        ({"CAL_ACC3_ID": 8}, 8, 3),
        ({"CAL_ACC4_ID": 8}, 8, None),
        ({"CAL_ACC0_ID": 0}, 0, None),
        ({"CAL_ACC0_ID": -1}, 2**32 - 1, 0),
        ({"CAL_ACC0_ID": -(2**31)}, 2**31, 0),
        ({"CAL_ACC0_ID": np.nan, "CAL_ACC1_ID": 8}, 8, 1),
    ],
)
def test_the_slot_of_a_device(values: Mapping[str, float], device_id: int, slot: int | None) -> None:
    assert slot_of("CAL_ACC", device_id, values) == slot


def test_states_begin_with_the_log_and_with_what_was_set_of_it() -> None:
    """What is set at one time is set at once, whatever stands last of it."""
    changes = [
        Change(5, "A_X", 1.0),
        Change(5, "A_Y", 2.0),
        Change(5, "B_Y", 0.5),
        Change(6, "B_X", 3.0),
        Change(7, "A_X", 4.0),
    ]
    history = History({"A_X": 0.0}, changes, 3)
    at_5, at_6 = {"A_X": 1.0, "A_Y": 2.0, "B_Y": 0.5}, {"A_X": 1.0, "A_Y": 2.0, "B_Y": 0.5, "B_X": 3.0}
    at_7 = at_6 | {"A_X": 4.0}
    assert list(history.states("A_")) == [(3, {"A_X": 0.0}), (5, at_5), (7, at_7)]
    assert list(history.states("B_")) == [(3, {"A_X": 0.0}), (5, at_5), (6, at_6)]
    assert [at for at, _ in history.states("A_", "B_")] == [3, 5, 6, 7]
    assert history.last == at_7
    assert (History({}).start_us, History({}).release) == (0, None)


def test_what_is_set_as_the_log_begins_is_its_first_correction() -> None:
    values = {"CAL_ACC0_ID": 5.0, "CAL_ACC0_XOFF": 1.0}
    changes = [Change(3, "CAL_ACC0_XOFF", 2.0), Change(4, "CAL_ACC0_XOFF", 3.0), Change(4, "CAL_GYRO0_XOFF", 3.0)]
    found = corrections(Sensor.ACCELEROMETER, 5, History(values, changes, 3), offset_ns=7)
    assert [(one.from_ns, one.offset[0]) for one in found] == [(3007, -2.0), (4007, -3.0)]


@pytest.mark.parametrize(
    ("mounted", "turned"), [({}, True), ({"CAL_MAG0_ROT": -1.0}, True), ({"CAL_MAG0_ROT": 0.0}, False)]
)
def test_an_external_magnetometer_may_be_mounted_straight_on_a_turned_board(
    mounted: Mapping[str, float], turned: bool
) -> None:
    found = correction(Sensor.MAGNETOMETER, 5, {"CAL_MAG0_ID": 5.0, "SENS_BOARD_ROT": 4.0, **mounted})
    assert np.allclose(found.matrix, np.diag([-1.0, -1.0, 1.0]) if turned else np.eye(3), atol=1e-12)


@pytest.mark.parametrize(("degc", "slope"), [(9.9, 0.0), (10.0, 2.0), (40.0, 2.0), (40.1, 0.0)])
def test_a_thermal_offset_slopes_up_to_its_limits(degc: float, slope: float) -> None:
    values = {"TC_A_ENABLE": 1.0, "TC_A0_ID": 5.0, "TC_A0_TMIN": 10.0, "TC_A0_TMAX": 40.0, "TC_A0_X1_0": 2.0}
    found = correction(Sensor.ACCELEROMETER, 5, values, degc)
    assert found.offset_per_degc == (-slope, 0.0, 0.0)
    assert found.offset[0] == pytest.approx(-2.0 * (min(max(degc, 10.0), 40.0) - 25.0), abs=1e-12)


def test_parameters_of_a_sensor_are_those_that_there_are() -> None:
    values = {"CAL_GYRO0_ID": 5.0, "CAL_GYRO3_ID": 6.0, "TC_G0_ID": np.nan, "TC_G_ENABLE": 1.0, "IMU_GYRO_CAL_EN": 0.0}
    found = parameters_of(Sensor.GYROSCOPE, 5, values | {"OTHER": 1.0, "CAL_GYRO0_XOFF": 0.25})
    wanted = {
        "CAL_GYRO0_ID": 5.0,
        "CAL_GYRO3_ID": 6.0,
        "TC_G_ENABLE": 1.0,
        "IMU_GYRO_CAL_EN": 0.0,
        "CAL_GYRO0_XOFF": 0.25,
    }
    assert found == wanted


def test_rotations_end_with_their_table_and_are_mavlinks_from_a_release_on() -> None:
    for release in (None, FIRST_OF_MAVLINK, FIRST_OF_MAVLINK - 1):
        turned = [not np.array_equal(rotation(number, release), np.eye(3)) for number in range(-1, 60)]
        last = max(np.flatnonzero(turned)) - 1
        assert turned[:3] == [False, False, True]
        assert all(turned[2 : last + 2])
    assert FIRST_OF_MAVLINK == 1 << 24 | 12 << 16
    assert np.array_equal(rotation(30, FIRST_OF_MAVLINK), rotation(30))
    assert not np.array_equal(rotation(30, FIRST_OF_MAVLINK - 1), rotation(30))
