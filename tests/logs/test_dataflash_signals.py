"""Messages as columns and as units, small cases at their limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataflash_support import own_fmt, packed, rows_of

from fieldcal.logs.dataflash import signals, units
from fieldcal.logs.dataflash.clock import stamps_ns
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.dataflash.parameters import Parameters
from fieldcal.logs.dataflash.signals import Stream
from fieldcal.logs.interface import LogSummary

IMU = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")


def stream_of(name: str, letters: str, columns: Mapping[str, Sequence[Any]], **options: Any) -> Stream:
    rows = rows_of(name, letters, columns, **options)
    t_ns = stamps_ns(rows)
    assert t_ns is not None
    return Stream(0, name, rows, t_ns)


def file_of(path: Path, *messages: tuple[str, str, Mapping[str, Sequence[Any]]]) -> DataflashFile:
    """A located log of messages, definitions first."""
    parts = [packed(130 + number, *one) for number, one in enumerate(messages)]
    path.write_bytes(own_fmt() + b"".join(d for d, _ in parts) + b"".join(content for _, content in parts))
    file = DataflashFile(path)
    file.locate(signals.LOCATED)
    return file


def imu_rows(t_us: Sequence[int], names: Sequence[str] = IMU, **more: Sequence[int]) -> dict[str, Sequence[Any]]:
    return {"TimeUS": t_us, **more, **{name: np.arange(len(t_us)) + i for i, name in enumerate(names)}}


@pytest.mark.parametrize(
    ("t_us", "rate"),
    [([], 0), ([5], 0), ([5, 5], 0), ([0, 20_000], 50), ([0, 10_000, 20_000, 90_000], 100), ([0, 1], 10**6)],
)
@pytest.mark.filterwarnings("error")
def test_a_rate_is_that_of_the_usual_interval(t_us: list[int], rate: float) -> None:
    stream = stream_of("T", "Q", {"TimeUS": t_us})
    assert stream.rate_hz == rate
    assert Stream(0, "T", stream.rows, stream.t_ns // 1000).rate_hz == 1000 * rate


@pytest.mark.parametrize(("rows", "sizes"), [(0, []), (2, [2]), (3, [3]), (4, [3, 1]), (7, [3, 3, 1])])
def test_pieces_are_the_whole(monkeypatch: pytest.MonkeyPatch, rows: int, sizes: list[int]) -> None:
    monkeypatch.setattr(signals, "PIECE_ROWS", 3)
    pieces = list(stream_of("T", "Q", {"TimeUS": range(rows)}).pieces())
    assert [len(piece.t_ns) for piece in pieces] == sizes
    assert [v for piece in pieces for v in piece.rows.integers("TimeUS").tolist()] == list(range(rows))
    assert [v for piece in pieces for v in piece.t_ns.tolist()] == [1000 * i for i in range(rows)]


@pytest.mark.parametrize("field", ["I", "Instance", "Inst"])
def test_instances_by_a_field_come_before_those_by_name(tmp_path: Path, field: str) -> None:
    own = ("IMU", "QBffffff", imu_rows([1, 2, 3], **{field: [2, 0, 2]}))
    second = ("IMU2", "Qffffff", imu_rows([4]))
    third = ("IMU3", "Qffffff", imu_rows([5, 6]))
    found = signals.streams(file_of(tmp_path / "a.bin", third, own, second), "IMU", IMU, {})
    assert {i: (one.instance, one.name, one.t_ns.tolist()) for i, one in found.items()} == {
        0: (0, "IMU[0]", [2000]),
        1: (1, "IMU2", [4000]),
        2: (2, "IMU[2]", [1000, 3000]),
    }
    assert list(found) == [0, 1, 2]


def test_instances_by_name_alone(tmp_path: Path) -> None:
    for first in ("ACC", "ACC1"):
        names = (first, "ACC2", "ACC3")
        messages = [(name, "Qfff", imu_rows([n], IMU[3:])) for n, name in enumerate(names, 1)]
        found = signals.streams(file_of(tmp_path / f"{first}.bin", *messages), "ACC", IMU[3:], {})
        told = {i: (one.instance, one.name, one.t_ns.tolist()) for i, one in found.items()}
        assert told == {n: (n, name, [1000 * n + 1000]) for n, name in enumerate(names)}


def test_messages_without_a_needed_column_or_a_stamp_are_counted(tmp_path: Path) -> None:
    lacks = ("IMU", "Qfffff", imu_rows([1, 2], IMU[:5]))
    stampless = ("IMU2", "ffffff", {name: [1.0] for name in IMU})
    malformed: dict[str, int] = {}
    file = file_of(tmp_path / "a.bin", lacks, stampless, ("IMU3", "Qffffff", imu_rows([7])))
    assert list(signals.streams(file, "IMU", IMU, malformed)) == [2]
    assert malformed == {"IMU": 2, "IMU2": 1}


@pytest.mark.parametrize(
    ("letters", "columns", "sampled"),
    [
        ("QQ", {"TimeUS": [1000], "SampleUS": [990]}, 990),
        ("QI", {"TimeUS": [(1 << 32) + 10], "S": [(1 << 32) - 5]}, (1 << 32) - 5),
        ("QI", {"TimeUS": [(3 << 32) + 10], "S": [5]}, (3 << 32) + 5),
        ("QQ", {"TimeUS": [(1 << 32) + 10], "S": [5]}, (1 << 32) + 10),  # 64 bits do not wrap
        ("QQI", {"TimeUS": [1000], "SampleUS": [990], "S": [980]}, 990),
        ("QI", {"TimeUS": [1000], "Other": [990]}, 1000),
    ],
)
def test_messages_at_their_times_of_sampling(letters: str, columns: dict[str, list[int]], sampled: int) -> None:
    assert signals.by_sample(stream_of("GYR", letters, columns)).t_ns.tolist() == [sampled * 1000]


@pytest.mark.parametrize(
    ("letters", "columns", "found"),
    [
        ("Qf", {"TimeUS": [1, 2], "T": [0.0, 25.5]}, [0.0, 25.5]),
        ("Qc", {"TimeUS": [1, 2], "Temp": [0, 2550]}, [0.0, 25.5]),
        ("Qf", {"TimeUS": [1, 2], "T": [0.0, 0.0]}, None),
        ("Qf", {"TimeUS": [1, 2], "X": [1.0, 1.0]}, None),
    ],
)
def test_temperature(letters: str, columns: dict[str, list[float]], found: list[float] | None) -> None:
    table = signals.temperature(stream_of("IMU", letters, columns))
    assert (None if table is None else table["temperature_degc"].tolist()) == found


@pytest.mark.parametrize("names", [("MOX", "MOY", "MOZ"), ("MOfsX", "MOfsY", "MOfsZ")])
def test_motors_count_where_any_axis_has_a_part(names: tuple[str, ...]) -> None:
    parts = dict(zip(names, ([0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 5]), strict=True))
    assert signals.motors(stream_of("MAG", "Qhhh", {"TimeUS": range(4), **parts})) == 3
    assert signals.motors(stream_of("MAG", "Qhh", {"TimeUS": range(4), **dict(list(parts.items())[:2])})) == 0


def test_a_fix_is_three_dimensional_from_3_on() -> None:
    gps = stream_of("GPS", "QB", {"TimeUS": range(5), "Status": [0, 2, 3, 4, 6]})
    assert signals.fixed(gps).tolist() == [False, False, True, True, True]


def test_stored_units_without_the_logs_own_are_milligauss_and_centiamperes() -> None:
    mag = stream_of("MAG", "Qhhh", {"TimeUS": [1], "MagX": [100], "MagY": [-200], "MagZ": [300]})
    columns = signals.magnetometer(mag)
    assert [columns[f"magnetometer_{axis}"].tolist() for axis in "xyz"] == [[0.1], [-0.2], [0.3]]
    assert signals.power(stream_of("CURR", "Qh", {"TimeUS": [1], "Curr": [1234]}))["current_a"].tolist() == [12.34]
    own = {"MagX": 0.01, "MagY": 0.01, "MagZ": 0.01}
    mag = stream_of("MAG", "Qhhh", {"TimeUS": [1], "MagX": [100], "MagY": [-200], "MagZ": [300]}, multipliers=own)
    assert signals.magnetometer(mag)["magnetometer_x"].tolist() == [1.0]


def test_velocity_by_speed_and_course() -> None:
    columns = {"TimeUS": range(4), "Spd": [2.0] * 4, "GCrs": [0.0, 90.0, 180.0, 270.0], "VZ": [1.0, -1.0, 0.0, 3.0]}
    found = signals.velocity(stream_of("GPS", "Qfff", columns), None)
    assert np.allclose(found["velocity_north_mps"], [2.0, 0.0, -2.0, 0.0], atol=1e-15)
    assert np.allclose(found["velocity_east_mps"], [0.0, 2.0, 0.0, -2.0], atol=1e-15)
    assert found["velocity_down_mps"].tolist() == columns["VZ"]
    assert "velocity_sd_mps" not in found


@pytest.mark.parametrize(
    ("at_us", "sd"),
    [
        (0, 0.25),  # a second before the first, the most there is
        (1_000_000, 0.25),
        (1_500_000, 0.5),  # as near to the one before: the later one
        (1_499_999, 0.25),
        (1_500_001, 0.5),
        (2_000_000, 0.5),
        (2_400_000, 0.5),
        (2_600_000, 654.99),
        (3_600_000, None),  # 655 and more says nothing
        (5_000_000, None),
        (5_000_001, None),
        (9_999_999, None),
        (10_000_000, 1.0),
        (12_000_000, 1.0),
        (12_000_001, None),
    ],
)
def test_speed_accuracy_is_the_nearest_within_a_second(at_us: int, sd: float | None) -> None:
    t_us, stored = [11_000_000, 2_000_000, 1_000_000, 3_000_000, 4_000_000], [100, 50, 25, 65_499, 65_500]
    accuracy = stream_of("GPA", "QC", {"TimeUS": t_us, "SAcc": stored})
    gps = stream_of("GPS", "Qfff", {"TimeUS": [at_us], "Spd": [1.0], "GCrs": [0.0], "VZ": [0.0]})
    (found,) = signals.velocity(gps, accuracy)["velocity_sd_mps"].tolist()
    assert np.isnan(found) if sd is None else found == sd
    assert "velocity_sd_mps" not in signals.velocity(gps, stream_of("GPA", "QC", {"TimeUS": [], "SAcc": []}))


@pytest.mark.parametrize(("angles", "letters"), [(("Roll", "Pitch", "Yaw"), "fff"), (("R", "P", "Y"), "fff")])
@pytest.mark.parametrize(("taken", "t_ns"), [({"CTimeMS": [4990]}, 4_990_000_000), ({}, 5_000_000_000)])
def test_a_pose_by_its_angles(angles: tuple[str, ...], letters: str, taken: dict[str, list[int]], t_ns: int) -> None:
    columns = {"TimeUS": [5_000_000], **taken, "PX": [1.0], "PY": [2.0], "PZ": [3.0]}
    columns |= dict(zip(angles, ([0.0], [0.0], [90.0]), strict=True))
    found = signals.vps(stream_of("VISP", "Q" + "I" * len(taken) + "fff" + letters, columns))
    assert found["t_ns"].tolist() == [t_ns]
    assert np.allclose([found[f"q{axis}"][0] for axis in "xyzw"], [0, 0, 0.5**0.5, 0.5**0.5], atol=1e-15)
    assert [found[f"p{axis}_m"].tolist() for axis in "xyz"] == [[1.0], [2.0], [3.0]]


def axes_of(sensor: str, t_us: Sequence[int]) -> dict[str, Sequence[Any]]:
    """Readings that number the rows: x from 0 on, or 3 of the accelerometer, y and z from one more each."""
    whole = imu_rows(t_us)
    return {name: column for name, column in whole.items() if name.startswith(("Time", sensor.capitalize()))}


@pytest.mark.parametrize(
    ("step_us", "count", "taken"),
    [
        (10_000, 101, True),
        (20_000, 51, False),  # 1.5 times the rate and no more
        (19_999, 52, True),
        (10_000, 91, True),  # 0.9 of the time
        (10_000, 90, False),
    ],
)
def test_gyr_and_acc_are_taken_where_they_are_faster_and_span_the_flight(
    tmp_path: Path, step_us: int, count: int, taken: bool
) -> None:
    t_us = 1_000_000 + step_us * np.arange(count)
    slow = ("IMU", "Qffffff", imu_rows((1_000_000 + np.array([0, 30_000, 60_000, 90_000, 1_000_000])).tolist()))
    whole = (1_000_000 + np.arange(0, 1_000_001, 5000)).tolist()
    for name, other in (("GYR", "ACC"), ("ACC", "GYR")):
        parts = [(name, "Qfff", t_us.tolist()), (other, "Qfff", whole)]
        messages = [(f"{n}1", f, axes_of(n, t)) for n, f, t in parts]
        (unit,) = units.imus(file_of(tmp_path / "a.bin", slow, *messages), Parameters(None, ()), {})
        assert (unit.fast is not None) is taken
        assert unit.stream == ("GYR1 and ACC1" if taken else "IMU")
        joined = unit.joined()
        assert (joined is not None) is taken
        if joined is not None and name == "ACC":
            inside = [t * 1000 for t in whole if t <= t_us[-1]]
            assert joined.columns["t_ns"].tolist() == inside
            assert joined.columns["gyroscope_y"].tolist() == [1.0 + i for i in range(len(inside))]
            rows = (np.array(inside) / 1000 - t_us[0]) / step_us
            assert np.allclose(joined.columns["accelerometer_z"], 5.0 + rows, rtol=1e-12)
    only = [one for one in messages if one[0] == "GYR1"]
    (unit,) = units.imus(file_of(tmp_path / "a.bin", slow, *only), Parameters(None, ()), {})
    assert unit.fast is None


def changed(history: Sequence[tuple[int, str, float]]) -> Parameters:
    names, values = [name.encode() for _, name, _ in history], [value for _, _, value in history]
    return Parameters(rows_of("PARM", "Nf", {"Name": names, "Value": values}), [t for t, _, _ in history])


@pytest.mark.parametrize(
    ("history", "count"),
    [
        ([(0, "INS_GYR_ID", 5)], None),
        ([(0, "INS_GYR_ID", 5), (10_000, "INS_GYR_ID", 6)], None),  # with the first message
        ([(0, "INS_GYR_ID", 5), (10_001, "INS_GYR_ID", 6)], 1),
        ([(0, "INS_GYR_ID", 5), (10_001, "INS_GYR_ID", 6), (20_000, "INS_GYR_ID", 7)], 2),
        ([(0, "INS_GYR_ID", 0), (10_001, "INS_GYR_ID", 6)], None),  # told late
        ([(0, "INS_GYR2_ID", 5), (10_001, "INS_GYR2_ID", 6)], None),
    ],
)
def test_another_unit_within_the_recording(history: list[tuple[int, str, float]], count: int | None) -> None:
    unit = units.Unit(stream_of("IMU", "Qffffff", imu_rows([20, 10, 30])))
    summary = LogSummary("dataflash")
    units.imu_sources([unit], changed(history), 0, summary, "a.bin")
    told = [(finding.count, finding.sentence) for finding in summary.findings if finding.code == "unit_changed"]
    assert [number for number, _ in told] == ([] if count is None else [count])
    assert all(f"becomes {history[-1][2]:.0f} within the recording, and was 5" in sentence for _, sentence in told)


def test_units_in_use_come_first_and_are_told_with_their_tables() -> None:
    parameters = Parameters.of({"INS_GYR_ID": 7.0, "INS_ACC2_ID": 8.0, "COMPASS_DEV_ID3": 9.0})
    slow = [units.Unit(Stream(i, f"IMU[{i}]", (one := stream_of("IMU", "Qffffff", imu_rows([10, 20]))).rows, one.t_ns))
            for i in (0, 1)]  # fmt: skip
    found = units.imu_sources(slow, parameters, 5, LogSummary("dataflash"), "a.bin")
    told = [(str(s.sensor), s.table, s.unit_id, s.primary, s.filtered, s.device_id) for s in found]
    assert told == [
        ("gyroscope", "imu", "7", True, True, 7),
        ("accelerometer", "imu", "7", True, True, None),
        ("gyroscope", "imu.1", "instance-1", False, True, None),
        ("accelerometer", "imu.1", "instance-1", False, True, 8),
    ]
    mag = stream_of("MAG", "Qhhh", {"TimeUS": [10, 20], "MagX": [1, 2], "MagY": [1, 2], "MagZ": [1, 2]})
    mags = [Stream(i, f"MAG[{i}]", mag.rows, mag.t_ns) for i in (0, 2)]
    found = units.magnetometer_sources(mags, parameters, 5, LogSummary("dataflash"), "a.bin")
    told = [(str(s.sensor), s.table, s.unit_id, s.primary, s.filtered, s.device_id) for s in found]
    assert told == [
        ("magnetometer", "magnetometer", "instance-0", True, False, None),
        ("magnetometer", "magnetometer.1", "9", False, False, 9),
    ]


@pytest.mark.parametrize(
    ("options", "filtered"), [(0, False), (3, False), (4, True), (8, False), (12, False), (20, True)]
)
def test_a_bit_of_the_options_says_whether_gyr_is_filtered(tmp_path: Path, options: int, filtered: bool) -> None:
    t_us = list(range(0, 1000, 10))
    messages = [("IMU", "Qffffff", imu_rows(t_us[::2])), ("IMU2", "Qffffff", imu_rows(t_us[::2]))]
    messages += [(f"{n}1", "Qfff", axes_of(n, t_us)) for n in ("GYR", "ACC")]
    file = file_of(tmp_path / "a.bin", *messages)
    found = units.imus(file, Parameters.of({"INS_RAW_LOG_OPT": float(options)}), {})
    assert [(unit.slow.instance, unit.fast is not None, unit.filtered) for unit in found] == [
        (0, True, filtered),
        (1, False, True),
    ]


@pytest.mark.parametrize(
    ("use", "order"), [({}, [0, 1, 2]), ({"": 0}, [1, 2, 0]), ({"2": 0}, [0, 2, 1]), ({"": 0, "2": 0}, [2, 0, 1])]
)
def test_the_first_unit_that_may_be_used_is_the_primary_one(
    tmp_path: Path, use: dict[str, float], order: list[int]
) -> None:
    mag = {"MagX": [1], "MagY": [2], "MagZ": [3]}
    file = file_of(
        tmp_path / "a.bin",
        ("IMU", "QBffffff", imu_rows([1, 2, 3], I=[2, 0, 1])),
        *((f"MAG{n}", "Qhhh", {"TimeUS": [1], **mag}) for n in ("", "2", "3")),
    )
    imus = units.imus(file, Parameters.of({f"INS_USE{n}": v for n, v in use.items()}), {})
    assert [unit.slow.instance for unit in imus] == order
    mags = units.magnetometers(file, Parameters.of({f"COMPASS_USE{n}": v for n, v in use.items()}), {})
    assert [stream.instance for stream in mags] == order


def test_corrections_begin_with_the_sensors_first_message_by_the_logs_clock() -> None:
    names = [f"INS_{part}_{axis}" for part in ("GYROFFS", "ACCOFFS") for axis in "XYZ"]
    held = Parameters.of({**dict.fromkeys(names, 0.5), "INS_TCAL1_ENABLE": 1.0, "COMPASS_OFS_X": 7.0})
    unit = units.Unit(stream_of("IMU", "Qffffff", imu_rows([20, 10, 30])))
    for source in units.imu_sources([unit], held, 5, LogSummary("dataflash"), "a.bin"):
        (correction,) = source.corrections
        assert (correction.from_ns, correction.temperature_degc) == (10_005, None)
    old = units.Unit(stream_of("IMU", "Iffffff", {"TimeMS": [1, 2], **{n: [0, 0] for n in IMU}}))
    turned = Parameters.of({**dict.fromkeys(names, 0.5), "AHRS_ORIENTATION": 4.0})
    for one, offset in ((old, (-0.5, -0.5, -0.5)), (unit, (0.5, 0.5, -0.5))):  # before 3.3 board axes came first
        source = units.imu_sources([one], turned, 0, LogSummary("dataflash"), "a.bin")[0]
        assert source.corrections[0].offset == offset
    columns = {"TimeUS": [30, 10, 20], "MagX": [0] * 3, "MagY": [0] * 3, "MagZ": [0] * 3}
    offsets = {"OfsX": [3, 1, 1], "OfsY": [5] * 3, "OfsZ": [6] * 3}
    whole = stream_of("MAG", "Qhhhhhh", columns | offsets)
    part = stream_of("MAG", "Qhhhh", columns | {"OfsX": offsets["OfsX"]})
    for stream, found in ((whole, [(10_005, (0.001, 0.005, 0.006)), (30_005, (0.003, 0.005, 0.006))]), (part, [])):
        (source,) = units.magnetometer_sources([stream], Parameters(None, ()), 5, LogSummary("dataflash"), "a.bin")
        assert [(one.from_ns, tuple(np.round(one.offset, 12))) for one in source.corrections] == found
