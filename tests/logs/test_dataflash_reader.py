"""What the DataFlash reader delivers of written flights, and what it says of their sensors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataflash_support import (
    BOOT_US,
    LEAP_NS,
    PARAMETERS,
    TEXTS,
    UTC_AT_BOOT_NS,
    WEEK,
    WEEK_MS,
    DataflashFlight,
)
from logs_support import vehicle
from pymavlink.rotmat import Matrix3

from fieldcal.errors import UnreadableLog
from fieldcal.logs import LogSummary, open_log, read_log
from fieldcal.logs.dataflash import signals, write
from fieldcal.logs.dataflash.clock import leap_seconds, sampled_ns
from fieldcal.logs.dataflash.parameters import Parameters
from fieldcal.logs.ingest import read_flight
from fieldcal.logs.interface import Columns, SensorSource

GYROSCOPE, ACCELEROMETER, MAGNETOMETER = (
    [f"{sensor}_{axis}" for axis in "xyz"] for sensor in ("gyroscope", "accelerometer", "magnetometer")
)


@pytest.fixture
def flight() -> DataflashFlight:
    return DataflashFlight()


def tables(path: Path) -> tuple[dict[str, Columns], LogSummary]:
    reader = open_log(path, vehicle())
    found: dict[str, list[Columns]] = {}
    for table, columns in reader.batches():
        found.setdefault(table, []).append(columns)
    whole = {
        t: {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} for t, parts in found.items()
    }
    return whole, reader.summary


def source(summary: LogSummary, sensor: str, table: str) -> SensorSource:
    return next(one for one in summary.sources if one.sensor == sensor and one.table == table)


def sentence(summary: LogSummary, code: str) -> str:
    return next(finding.sentence for finding in summary.findings if finding.code == code)


def test_every_signal_comes_as_it_was_logged(
    tmp_path: Path, flight: DataflashFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "PIECE_ROWS", 64)
    found, summary = tables(flight.write(tmp_path / "a.bin"))
    imu, further = found["imu"], found["imu.1"]
    assert np.array_equal(imu["t_ns"], UTC_AT_BOOT_NS + flight.t_us * 1000)
    assert np.array_equal(np.stack([imu[n] for n in GYROSCOPE], 1), flight.gyroscope)
    assert np.array_equal(np.stack([imu[n] for n in ACCELEROMETER], 1), flight.accelerometer)
    assert np.array_equal(np.stack([further[n] for n in GYROSCOPE], 1), flight.gyroscope_1)
    assert np.array_equal(found["temperature"]["temperature_degc"], flight.temperature)
    mag = found["magnetometer"]
    assert np.array_equal(mag["t_ns"], UTC_AT_BOOT_NS + (flight.mag_us - 40) * 1000)
    assert np.array_equal(np.stack([mag[n] for n in MAGNETOMETER], 1), flight.magnetometer)
    assert np.array_equal(found["power"]["current_a"], flight.current)
    assert (summary.log_format, summary.world, summary.body, summary.gravity_sign) == (
        "dataflash",
        "ned",
        "frd",
        "specific_force",
    )
    assert summary.units == {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "G"}
    assert summary.counts == {table: len(columns["t_ns"]) for table, columns in found.items()}


def test_gps_counts_with_a_fix_only(tmp_path: Path, flight: DataflashFlight) -> None:
    found, summary = tables(flight.write(tmp_path / "a.bin"))
    fixed = flight.status >= 3
    position = np.stack([found["position"][n] for n in ("latitude_deg", "longitude_deg", "altitude_m")], 1)
    assert np.array_equal(position, flight.position[fixed])
    velocity = np.stack([found["gnss_velocity"][f"velocity_{n}_mps"] for n in ("north", "east", "down")], 1)
    assert np.allclose(velocity, flight.velocity[fixed], atol=1e-5)
    assert found["gnss_velocity"]["velocity_sd_mps"].tolist() == [0.25] * int(fixed.sum())
    assert [(f.count, f.loses_data) for f in summary.findings if f.code == "no_gps_fix"] == [(3, False)]
    assert "a.bin: 3 of 40 GPS messages have no" in sentence(summary, "no_gps_fix")


def test_speed_accuracy_is_that_nearest_in_time_or_none(tmp_path: Path, flight: DataflashFlight) -> None:
    others = [one for one in flight.messages() if one.name != "GPA"]
    gpa = write.gpa_messages(flight.gps_us[[5, 20]] + 30_000, [0.3, 655.35])
    write.write_dataflash(tmp_path / "a.bin", [*others, gpa])
    found, _ = tables(tmp_path / "a.bin")
    t_us = (found["gnss_velocity"]["t_ns"] - UTC_AT_BOOT_NS) // 1000
    expected = np.full(len(t_us), np.nan)
    to_first, to_second = (np.abs(t_us - (flight.gps_us[i] + 30_000)) for i in (5, 20))
    expected[(to_first <= 1_000_000) & (to_first <= to_second)] = 0.3
    assert np.array_equal(found["gnss_velocity"]["velocity_sd_mps"], expected, equal_nan=True)
    write.write_dataflash(tmp_path / "b.bin", others)
    found, _ = tables(tmp_path / "b.bin")
    assert "velocity_sd_mps" not in found["gnss_velocity"]


def test_vision_poses_are_attitudes_of_the_body(tmp_path: Path, flight: DataflashFlight) -> None:
    found, _ = tables(flight.write(tmp_path / "a.bin"))
    vps = found["vps"]
    assert np.array_equal(vps["t_ns"], UTC_AT_BOOT_NS + (flight.vision_us - 12_000) // 1000 * 10**6)
    assert np.allclose(np.stack([vps[f"p{a}_m"] for a in "xyz"], 1), flight.vision_m, atol=1e-5)
    for row in range(0, len(flight.vision_us), 9):
        body_to_world = Matrix3()
        body_to_world.from_euler(*np.deg2rad(flight.vision_deg[row]))
        x, y, z, w = (vps[f"q{a}"][row] for a in "xyzw")
        nose = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]  # where the x axis points
        assert np.allclose(nose, [getattr(body_to_world, r).x for r in "abc"], atol=1e-6)


@pytest.mark.parametrize(
    ("slot", "orientation", "thermal"), [(0, 0, False), (0, 4, False), (1, 25, False), (2, 38, True), (3, 12, True)]
)
def test_what_is_uncorrected_is_raw(tmp_path: Path, slot: int, orientation: int, thermal: bool) -> None:
    generator = np.random.default_rng(slot)
    n, t_us = 600, BOOT_US + np.arange(600) * 20_000
    degc = np.linspace(30.0, 46.0, n).astype(np.float32).astype(float)
    raw_g, raw_a, raw_m = (
        generator.normal(0, 2, (n, 3)),
        generator.normal(0, 9, (n, 3)),
        generator.uniform(-0.5, 0.5, (n, 3)),
    )
    number, mag_slot = "" if slot == 0 else str(slot + 1), min(slot, 2)
    mag_number = "" if mag_slot == 0 else str(mag_slot + 1)
    stem, tcal = ("INS_", f"INS_TCAL{slot + 1}_") if slot < 3 else ("INS4_", "INS4_TCAL_")
    named = number if slot < 3 else ""
    stated = {"AHRS_ORIENTATION": float(orientation)}
    for axis in "XYZ":
        stated |= {
            f"{stem}GYR{'' if slot == 3 else named}OFFS_{axis}" if slot else f"INS_GYROFFS_{axis}": generator.normal(
                0, 0.05
            ),
            f"{stem}ACC{named}OFFS_{axis}": generator.normal(0, 0.3),
            f"{stem}ACC{named}SCAL_{axis}": generator.uniform(0.97, 1.03),
            f"COMPASS_OFS{mag_number}_{axis}": generator.normal(0, 100),
            f"COMPASS_DIA{mag_number}_{axis}": generator.uniform(0.95, 1.05),
            f"COMPASS_ODI{mag_number}_{axis}": generator.normal(0, 0.02),
        }
        if thermal:
            stated |= {f"{tcal}ACC1_{axis}": generator.normal(0, 2e4), f"{tcal}GYR2_{axis}": generator.normal(0, 300)}
    stated |= {f"{tcal}ENABLE": float(thermal), f"{tcal}TMIN": 0.0, f"{tcal}TMAX": 70.0}
    stated = {name: float(np.float32(value)) for name, value in stated.items()}
    logged = {
        kind: write.as_logged(kind, raw, stated, slot=mag_slot if kind == "MAG" else slot, temperature_degc=degc)
        for kind, raw in (("GYR", raw_g), ("ACC", raw_a), ("MAG", raw_m))
    }
    messages = [
        write.imu_messages(t_us, logged["GYR"], logged["ACC"], degc, instance=slot),
        write.mag_messages(
            t_us, logged["MAG"], offsets_mg=[stated[f"COMPASS_OFS{mag_number}_{a}"] for a in "XYZ"], instance=mag_slot
        ),
    ]
    write.write_dataflash(tmp_path / "a.bin", messages, parameters=stated)
    found, summary = tables(tmp_path / "a.bin")
    for sensor, raw, names, resolution in (
        ("gyroscope", raw_g, GYROSCOPE, 1e-6),
        ("accelerometer", raw_a, ACCELEROMETER, 1e-5),
        ("magnetometer", raw_m, MAGNETOMETER, 1.9e-3),  # cut to whole milligauss on three axes
    ):
        columns = found["magnetometer" if sensor == "magnetometer" else "imu"]
        values = np.stack([columns[name] for name in names], 1)
        one = source(summary, sensor, "magnetometer" if sensor == "magnetometer" else "imu")
        assert one.corrected
        starts = np.array([c.from_ns for c in one.corrections])
        which = np.searchsorted(starts, columns["t_ns"], "right") - 1
        assert which.min() == 0
        offsets = np.array([c.offset for c in one.corrections])[which]
        if one.corrections[0].temperature_degc is not None:
            warmer = degc - np.array([c.temperature_degc for c in one.corrections])[which]
            offsets = offsets + np.array([c.offset_per_degc for c in one.corrections])[which] * warmer[:, None]
        found_raw = np.linalg.solve(np.array(one.corrections[0].matrix), (values - offsets).T).T
        slack = 2e-3 if thermal and sensor != "magnetometer" else 0.0  # a cubic by straight pieces of 1 degree
        assert np.abs(found_raw - raw).max() < resolution + slack, sensor


def test_parameters_that_change_in_flight_hold_from_then_on(tmp_path: Path, flight: DataflashFlight) -> None:
    changed_us = int(flight.t_us[200])
    change = write.parameter_messages([changed_us], ["INS_GYROFFS_X"], [0.5])
    write.write_dataflash(tmp_path / "a.bin", [*flight.messages(), change], parameters=PARAMETERS)
    _, summary = tables(tmp_path / "a.bin")
    corrections = source(summary, "gyroscope", "imu").corrections
    assert [one.from_ns - UTC_AT_BOOT_NS for one in corrections] == [int(flight.t_us[0]) * 1000, changed_us * 1000]
    assert [one.offset[0] for one in corrections] == [-float(np.float32(0.01)), -0.5]
    assert corrections[1].parameters["INS_GYROFFS_X"] == 0.5


def test_a_parameters_value_at_a_time() -> None:
    parameters = Parameters(None, ())
    assert parameters.value("X", 5, 7.0) == 7.0
    assert "X" not in parameters
    assert Parameters.of({"X": 2.0}).value("X", -5) == 2.0


def test_what_is_said_of_the_units(tmp_path: Path, flight: DataflashFlight) -> None:
    _, summary = tables(flight.write(tmp_path / "a.bin"))
    primary = source(summary, "gyroscope", "imu")
    assert (primary.unit_id, primary.stream, primary.primary, primary.filtered) == ("3604746", "IMU[0]", True, True)
    assert primary.rate_hz == pytest.approx(50.0, rel=0.01)
    further = source(summary, "accelerometer", "imu.1")
    assert (further.unit_id, further.device_id, further.primary) == ("instance-1", None, False)
    magnetometer = source(summary, "magnetometer", "magnetometer")
    assert (magnetometer.unit_id, magnetometer.primary, magnetometer.filtered) == ("97539", True, False)
    assert "gyroscope 20 Hz, accelerometer 10 Hz" in sentence(summary, "already_corrected")
    assert "ISBH" not in sentence(summary, "already_corrected")
    assert [f.count for f in summary.findings if f.code == "already_corrected"] == [1]  # further units do not count
    assert "imu.1 (instance-1)" in sentence(summary, "further_units")
    assert not [f for f in summary.findings if f.loses_data or f.fatal]


def test_an_imu_that_may_not_be_used_is_not_the_primary_one(tmp_path: Path, flight: DataflashFlight) -> None:
    found, summary = tables(flight.write(tmp_path / "a.bin", parameters=PARAMETERS | {"INS_USE": 0.0}))
    assert np.array_equal(found["imu"]["gyroscope_x"], flight.gyroscope_1[:, 0])
    assert source(summary, "gyroscope", "imu").stream == "IMU[1]"


def test_two_units_with_one_device_id_are_told_apart_by_instance(tmp_path: Path, flight: DataflashFlight) -> None:
    path = flight.write(tmp_path / "a.bin", parameters=PARAMETERS | {"INS_GYR2_ID": PARAMETERS["INS_GYR_ID"]})
    _, summary = tables(path)
    assert [source(summary, "gyroscope", table).unit_id for table in ("imu", "imu.1")] == ["instance-0", "instance-1"]
    assert [f.count for f in summary.findings if f.code == "shared_device_id"] == [2]


def test_another_device_id_within_the_recording_is_told(tmp_path: Path, flight: DataflashFlight) -> None:
    change = write.parameter_messages([int(flight.t_us[100])], ["INS_GYR_ID"], [77.0])
    write.write_dataflash(tmp_path / "a.bin", [*flight.messages(), change], parameters=PARAMETERS)
    _, summary = tables(tmp_path / "a.bin")
    assert "INS_GYR_ID becomes 77 within the recording, and was 3604746" in sentence(summary, "unit_changed")


def test_without_parameters_corrections_are_unknown_and_that_is_told(tmp_path: Path, flight: DataflashFlight) -> None:
    messages = [one for one in flight.messages() if one.name == "IMU"]
    write.write_dataflash(tmp_path / "a.bin", messages)
    _, summary = tables(tmp_path / "a.bin")
    own = source(summary, "gyroscope", "imu")
    assert own.corrected
    assert [one.parameters for one in own.corrections] == [{}]
    assert "the log lacks parameters that say how" in sentence(summary, "already_corrected")
    assert [f.count for f in summary.findings if f.code == "already_corrected"] == [1]


@pytest.fixture
def fast(flight: DataflashFlight) -> list[write.Messages]:
    """GYR and ACC of 1 kHz, sampled at times of their own 300 and 150 µs before they are logged."""
    generator = np.random.default_rng(7)
    t_us = np.arange(flight.t_us[0], flight.t_us[-1], 1000)
    gyro, accel = generator.normal(size=(2, len(t_us), 3))
    raw = [
        write.raw_messages("GYR", t_us, t_us - 300, gyro),
        write.raw_messages("ACC", t_us + 50, t_us - 100, accel),
    ]
    return [*flight.messages(), *raw]


def test_faster_gyr_and_acc_are_taken_instead_of_imu(
    tmp_path: Path, flight: DataflashFlight, fast: list[write.Messages]
) -> None:
    write.write_dataflash(tmp_path / "a.bin", fast, parameters=PARAMETERS)
    found, summary = tables(tmp_path / "a.bin")
    one = source(summary, "gyroscope", "imu")
    assert (one.stream, one.filtered, round(one.rate_hz)) == ("GYR[0] and ACC[0]", False, 1000)
    gyr, acc = (next(m for m in fast if m.name == name) for name in ("GYR", "ACC"))
    sampled = gyr.t_us - 300
    inside = (sampled >= acc.t_us[0] - 150) & (sampled <= acc.t_us[-1] - 150)
    assert np.array_equal(found["imu"]["t_ns"], UTC_AT_BOOT_NS + sampled[inside] * 1000)
    expected = np.interp(sampled[inside], acc.t_us - 150, np.float32(acc.values["AccX"]).astype(float))
    assert np.allclose(found["imu"]["accelerometer_x"], expected, atol=1e-12)
    assert [f.count for f in summary.findings if f.code == "interpolated"] == [int(inside.sum())]


@pytest.mark.parametrize(("options", "filtered"), [(0, False), (4, True), (8, False), (12, False), (20, True)])
def test_the_log_option_says_whether_gyr_is_filtered(
    tmp_path: Path, fast: list[write.Messages], options: int, filtered: bool
) -> None:
    write.write_dataflash(tmp_path / "a.bin", fast, parameters=PARAMETERS | {"INS_RAW_LOG_OPT": float(options)})
    _, summary = tables(tmp_path / "a.bin")
    assert source(summary, "gyroscope", "imu").filtered is filtered


def test_gyr_and_acc_of_a_part_of_the_flight_are_not_taken(tmp_path: Path, fast: list[write.Messages]) -> None:
    def half(one: write.Messages) -> write.Messages:
        kept = one.t_us < np.median(one.t_us)
        values = {n: np.asarray(v)[kept] if np.ndim(v) else v for n, v in one.values.items()}
        return replace(one, t_us=one.t_us[kept], values=values)

    part = [half(one) if one.name in ("GYR", "ACC") else one for one in fast]
    write.write_dataflash(tmp_path / "a.bin", part, parameters=PARAMETERS)
    _, summary = tables(tmp_path / "a.bin")
    assert source(summary, "gyroscope", "imu").stream == "IMU[0]"


def test_old_names_of_instances_and_milliseconds(tmp_path: Path, flight: DataflashFlight) -> None:
    columns = ("TimeMS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
    t_ms = flight.t_us // 1000
    vectors = {0: flight.gyroscope, 1: flight.gyroscope_1}
    messages = []
    for instance, name in ((0, "IMU"), (1, "IMU2")):
        values = {f"Gyr{axis}": vectors[instance][:, i] for i, axis in enumerate("XYZ")}
        values |= {f"Acc{axis}": flight.accelerometer[:, i] for i, axis in enumerate("XYZ")}
        messages.append(write.Messages(name, "Iffffff", columns, t_ms, values))
    mag_columns = ("TimeMS", "MagX", "MagY", "MagZ", "OfsX", "OfsY", "OfsZ")
    mag = {f"Mag{axis}": np.round(flight.magnetometer[:, i] * 1e3) for i, axis in enumerate("XYZ")}
    messages.append(write.Messages("MAG", "Ihhhhhh", mag_columns, flight.mag_us // 1000, mag))
    gps_columns = ("Status", "TimeMS", "Week", "NSats", "HDop", "Lat", "Lng", "RelAlt", "Alt", "Spd", "GCrs", "VZ", "T")
    gps = {
        "Status": 3,
        "TimeMS": WEEK_MS + flight.gps_us // 1000,
        "Week": WEEK,
        "Lat": flight.position[:, 0],
        "Lng": flight.position[:, 1],
        "Alt": flight.position[:, 2],
        "T": flight.gps_us // 1000,
    }
    messages.append(write.Messages("GPS", "BIHBcLLeeEefI", gps_columns, np.full(len(flight.gps_us), 3), gps))
    stated = {"AHRS_ORIENTATION": 2.0, "INS_ACCOFFS_X": 0.1, "INS_ACCOFFS_Y": 0.0, "INS_ACCOFFS_Z": 0.0}
    write.write_dataflash(tmp_path / "a.bin", messages, parameters=stated, self_described=False)
    found, summary = tables(tmp_path / "a.bin")
    assert np.array_equal(found["imu"]["t_ns"], UTC_AT_BOOT_NS + t_ms * 10**6)
    assert np.array_equal(found["imu.1"]["gyroscope_y"], flight.gyroscope_1[:, 1])
    assert np.array_equal(found["magnetometer"]["magnetometer_z"], flight.magnetometer[:, 2])
    assert np.array_equal(found["position"]["latitude_deg"], flight.position[:, 0])
    assert [one.stream for one in summary.sources] == ["IMU", "IMU", "IMU2", "IMU2", "MAG"]
    (correction,) = source(summary, "accelerometer", "imu").corrections
    assert correction.offset == (-float(np.float32(0.1)), 0.0, 0.0)  # subtracted last, in body axes


def test_epoch_by_gps_less_leap_seconds(tmp_path: Path, flight: DataflashFlight) -> None:
    _, summary = tables(flight.write(tmp_path / "a.bin"))
    assert summary.epoch_known
    assert summary.metadata["epoch"].startswith("GPS time less 18 leap seconds")
    assert LEAP_NS == 18 * 10**9
    unfixed = [one for one in flight.messages() if one.name != "GPS"]
    write.write_dataflash(tmp_path / "b.bin", unfixed)
    found, summary = tables(tmp_path / "b.bin")
    assert not summary.epoch_known
    assert found["imu"]["t_ns"][0] == flight.t_us[0] * 1000


@pytest.mark.parametrize(
    ("day", "seconds"),
    [("2001-09-09", 13), ("2008-12-31", 14), ("2016-12-31", 17), ("2017-01-01", 18), ("2026-01-01", 18)],
)
def test_leap_seconds(day: str, seconds: int) -> None:
    assert leap_seconds(int(np.datetime64(day, "ns").astype(np.int64))) == seconds


def test_a_time_of_sampling_that_wraps_or_is_none() -> None:
    hour_ns = 3600 * 10**9
    t_ns = np.array([2 * hour_ns, 2 * hour_ns, 2 * hour_ns, 10**9 + 999])
    sample_us = np.array([(2 * 3600 * 10**6 - 9) % (1 << 32), 0, 77, 10**6 - 20])
    assert sampled_ns(t_ns, sample_us, 32).tolist() == [2 * hour_ns - 9000, 2 * hour_ns, 2 * hour_ns, 10**9 - 20_000]


def test_firmware_and_board(tmp_path: Path, flight: DataflashFlight) -> None:
    _, summary = tables(flight.write(tmp_path / "a.bin"))
    del summary.metadata["epoch"]
    assert summary.metadata == {
        "firmware": TEXTS[0],
        "operating_system": TEXTS[1],
        "hardware": "CubeOrange",
        "board_id": "0030002B 32335117 36343932",
    }


@pytest.mark.parametrize("by", ["message", "text"])
def test_a_simulation_is_set_aside_unless_the_vehicle_is_one(tmp_path: Path, flight: DataflashFlight, by: str) -> None:
    sim = write.Messages("SIM", "Qccc", ("TimeUS", "Roll", "Pitch", "Yaw"), flight.t_us, {})
    messages = [*flight.messages(), *([sim] if by == "message" else [])]
    texts = TEXTS if by == "message" else (*TEXTS, "RC Protocol: SITL")
    write.write_dataflash(tmp_path / "a.bin", messages, parameters=PARAMETERS, texts=texts)
    _, facts = read_flight(tmp_path / "a.bin", vehicle())
    assert (facts["verdict"], facts["reason_code"]) == ("quarantined", "simulated")
    _, facts = read_flight(tmp_path / "a.bin", vehicle().model_copy(update={"simulated": True}))
    assert facts["verdict"] == "ok"
    assert "simulated" in [finding["code"] for finding in facts["findings"]]


def test_dropouts_of_the_logger_lose_data(tmp_path: Path, flight: DataflashFlight) -> None:
    dropped = write.Messages("DSF", "QIH", ("TimeUS", "Dp", "Blk"), flight.t_us[:3], {"Dp": [0, 4, 9]})
    write.write_dataflash(tmp_path / "a.bin", [*flight.messages(), dropped], parameters=PARAMETERS)
    _, facts = read_flight(tmp_path / "a.bin", vehicle())
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "dropouts_logged")
    assert [f["count"] for f in facts["findings"] if f["code"] == "dropouts_logged"] == [9]


def test_motor_compensation_is_told(tmp_path: Path, flight: DataflashFlight) -> None:
    mag = write.mag_messages(flight.mag_us, flight.magnetometer, motors_mg=(0.0, 3.0, 0.0))
    write.write_dataflash(tmp_path / "a.bin", [flight.messages()[0], mag], parameters=PARAMETERS)
    _, summary = tables(tmp_path / "a.bin")
    assert f"In {len(flight.mag_us)} MAG messages a part for the motors" in sentence(summary, "already_corrected")


def test_a_magnetometer_alone_is_read_and_nothing_is_said_of_an_imu(tmp_path: Path, flight: DataflashFlight) -> None:
    write.write_dataflash(tmp_path / "a.bin", [flight.messages()[2]], parameters=PARAMETERS)
    found, summary = tables(tmp_path / "a.bin")
    assert found.keys() == {"magnetometer"}
    assert "low-passed too" not in sentence(summary, "already_corrected")


def test_of_motors_nothing_is_said_where_no_magnetometer_was_logged(tmp_path: Path, flight: DataflashFlight) -> None:
    write.write_dataflash(tmp_path / "a.bin", flight.messages()[:2], parameters=PARAMETERS)
    _, summary = tables(tmp_path / "a.bin")
    assert "motors" not in sentence(summary, "already_corrected")


def test_batches_of_one_sensor_are_told_as_not_read(tmp_path: Path, flight: DataflashFlight) -> None:
    batch = write.Messages("ISBH", "QHBB", ("TimeUS", "N", "type", "instance"), flight.t_us[:7], {})
    write.write_dataflash(tmp_path / "a.bin", [*flight.messages(), batch], parameters=PARAMETERS)
    _, summary = tables(tmp_path / "a.bin")
    assert "The 7 ISBH batches are of one sensor at a time" in sentence(summary, "already_corrected")


def test_a_unit_without_a_temperature_has_no_table_of_it(tmp_path: Path, flight: DataflashFlight) -> None:
    write.write_dataflash(tmp_path / "a.bin", [write.imu_messages(flight.t_us, flight.gyroscope, flight.accelerometer)])
    found, _ = tables(tmp_path / "a.bin")
    assert found.keys() == {"imu"}


def test_a_log_without_sensors_is_refused(tmp_path: Path, flight: DataflashFlight) -> None:
    write.write_dataflash(tmp_path / "a.bin", [write.battery_messages(flight.mag_us, flight.current)])
    with pytest.raises(
        UnreadableLog, match=r"a\.bin holds no readings of an IMU or a magnetometer.*BAT, FMT"
    ) as raised:
        open_log(tmp_path / "a.bin", vehicle())
    assert raised.value.reason_code == "missing_sensor"


def test_a_configured_unit_overrules_the_logs(tmp_path: Path, flight: DataflashFlight) -> None:
    path = flight.write(tmp_path / "a.bin")
    reader = open_log(path, vehicle(units={"magnetometer": "uT"}))
    assert reader.summary.units["magnetometer"] == "uT"
    assert "unit_conflict" in [str(finding.code) for finding in reader.summary.findings]


def test_a_log_in_memory_holds_the_further_units_too(tmp_path: Path, flight: DataflashFlight) -> None:
    frames, _ = read_log(flight.write(tmp_path / "a.bin"), vehicle())
    assert frames["imu.1"]["gyroscope_x"].to_list() == flight.gyroscope_1[:, 0].tolist()


def test_a_tidy_flight_holds_the_further_units_too(tmp_path: Path, flight: DataflashFlight) -> None:
    frames, facts = read_flight(flight.write(tmp_path / "a.bin"), vehicle())
    assert facts["verdict"] == "ok"
    assert facts["started_at_ns"] == UTC_AT_BOOT_NS + int(flight.t_us[0]) * 1000
    of_the_vehicle = {"magnetometer", "position", "gnss_velocity", "vps", "power"}
    assert set(frames) == {"imu", "temperature", "imu.1", "temperature.1", *of_the_vehicle}
    assert [unit["table"] for unit in facts["units_on_board"]] == ["imu", "imu.1"]
