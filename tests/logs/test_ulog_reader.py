"""PX4 logs as signals: which stream is read, what had been done to it, whose it is, when it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from ulog_support import (
    ACCEL_ID,
    GYRO_ID,
    MAG_ID,
    SECOND_ID,
    START_US,
    changed,
    combined,
    flight,
    gnss,
    parts_of,
    readings,
    selection,
    sensor,
    times_us,
)

from fieldcal.config.configuration import parse
from fieldcal.errors import UnreadableLog
from fieldcal.flight.calibrate import identify, read
from fieldcal.logs import ingest, read_log
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.ulog.parameters import corrected, correction, uncorrected
from fieldcal.logs.ulog.write import Rows
from fieldcal.names import SENSORS, Sensor

FLOAT32_ROUNDING = 3e-6
UTC_MINUS_BOOT_US = 1_700_000_000_000_000
GYRO_COLUMNS = [f"gyroscope_{axis}" for axis in "xyz"]
ACCEL_COLUMNS = [f"accelerometer_{axis}" for axis in "xyz"]
MAG_COLUMNS = [f"magnetometer_{axis}" for axis in "xyz"]


def read_topics(
    folder: Path, topics: list[Rows], text: str = "", **more: Any
) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    path = folder / "f.ulg"
    path.write_bytes(b"".join(parts_of(topics, **more)))
    return read_log(path, parse(text, None).vehicle("v"))


def codes(summary: LogSummary) -> list[str]:
    return [finding.code for finding in summary.findings]


def source(summary: LogSummary, table: str, sensor: Sensor) -> Any:
    (found,) = [one for one in summary.sources if (one.table, one.sensor) == (table, sensor)]
    return found


def test_signals_are_what_was_written(tmp_path: Path) -> None:
    topics = flight()
    tables, summary = read_topics(tmp_path, topics)
    imu, mag, gps = topics[0].columns, topics[1].columns, topics[2].columns
    offset = UTC_MINUS_BOOT_US * 1000
    np.testing.assert_array_equal(tables["imu"]["t_ns"], imu["timestamp"].astype(np.int64) * 1000 + offset)
    np.testing.assert_array_equal(tables["imu"].select(GYRO_COLUMNS), imu["gyro_rad"])
    np.testing.assert_array_equal(tables["imu"].select(ACCEL_COLUMNS), imu["accelerometer_m_s2"])
    sampled = mag["timestamp_sample"].astype(np.int64) * 1000 + offset
    np.testing.assert_array_equal(tables["magnetometer"]["t_ns"], sampled)
    np.testing.assert_array_equal(tables["magnetometer"]["magnetometer_y"], mag["y"])
    np.testing.assert_array_equal(tables["gnss_velocity"]["velocity_down_mps"], gps["vel_d_m_s"])
    assert tables["gnss_velocity"]["velocity_sd_mps"].unique().to_list() == [0.25]
    assert tables["position"].row(0)[1:] == (47.5, 8.5, 430.0)
    assert summary.units == {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "G"}
    assert (summary.world, summary.body, summary.gravity_sign) == ("ned", "frd", "specific_force")
    assert summary.epoch_known
    assert summary.metadata["ver_hw"] == "X"
    assert summary.metadata["utc_minus_boot_s"] == "1700000000.000000"
    assert codes(summary) == ["already_corrected"]


@pytest.mark.parametrize("seed", range(4))
def test_readings_that_px4_corrected_come_back(tmp_path: Path, seed: int) -> None:
    """Raw → PX4's formula → file → read → undone: raw within float32."""
    rng = np.random.default_rng(seed)
    t_us = times_us(2.0)
    ids = {Sensor.GYROSCOPE: GYRO_ID, Sensor.ACCELEROMETER: ACCEL_ID, Sensor.MAGNETOMETER: MAG_ID}
    parameters: dict[str, float] = {"SENS_BOARD_ROT": int(rng.integers(0, 40)), "SENS_BOARD_Y_OFF": 2.5}
    for prefix, number in zip(("CAL_GYRO", "CAL_ACC", "CAL_MAG"), ids.values(), strict=True):
        parameters[f"{prefix}1_ID"] = number
        parameters |= {f"{prefix}1_{axis}OFF": float(np.float32(rng.uniform(-0.3, 0.3))) for axis in "XYZ"}
        parameters |= {f"{prefix}1_{axis}SCALE": float(np.float32(rng.uniform(0.9, 1.1))) for axis in "XYZ"}
    raw = {name: readings(len(t_us), seed + 10 * i).astype(np.float64) for i, name in enumerate(ids)}
    logged = {name: corrected(correction(name, number, parameters), raw[name]) for name, number in ids.items()}
    field = {
        "timestamp": t_us,
        "timestamp_sample": t_us,
        "device_id": np.full(len(t_us), MAG_ID, np.uint32),
        "magnetometer_ga": logged[Sensor.MAGNETOMETER].astype(np.float32),
    }
    topics = [
        combined(t_us, logged[Sensor.GYROSCOPE], logged[Sensor.ACCELEROMETER]),
        Rows("vehicle_magnetometer", field),
        selection((START_US, GYRO_ID, ACCEL_ID)),
    ]
    tables, summary = read_topics(tmp_path, topics, parameters=parameters, infos={})
    for name in SENSORS:
        table = "magnetometer" if name == Sensor.MAGNETOMETER else "imu"
        (piece,) = source(summary, table, name).corrections
        found = tables[table].select([f"{name}_{axis}" for axis in "xyz"]).to_numpy()
        np.testing.assert_allclose(uncorrected(piece, found), raw[name], atol=FLOAT32_ROUNDING)
    assert not summary.epoch_known


def test_parameters_set_in_flight_make_another_piece(tmp_path: Path) -> None:
    topics = [combined(t := times_us(2.0), readings(len(t), 1), readings(len(t), 2))]
    topics.append(selection((START_US, GYRO_ID, ACCEL_ID)))
    change = changed(int(t[150]), "CAL_GYRO0_XOFF", 0.5)
    _, summary = read_topics(tmp_path, topics, changes=[change])
    first, second = source(summary, "imu", Sensor.GYROSCOPE).corrections
    assert (first.from_ns, second.from_ns) == (0, int(t[150]) * 1000)
    assert (first.offset[0], second.offset[0]) == (0.0, -0.5)


def test_raw_topics_that_are_fast_enough_are_preferred_and_joined(tmp_path: Path) -> None:
    t_us = times_us(2.0)
    gyro, accel = readings(len(t_us), 3), readings(len(t_us), 4)
    topics = [
        combined(t_us, readings(len(t_us), 1), readings(len(t_us), 2)),
        sensor("sensor_gyro", t_us, gyro, GYRO_ID),
        sensor("sensor_accel", t_us, accel, ACCEL_ID),
        selection((START_US, GYRO_ID, ACCEL_ID)),
    ]
    tables, summary = read_topics(tmp_path, topics)
    np.testing.assert_array_equal(tables["imu"].select(GYRO_COLUMNS), gyro)
    np.testing.assert_array_equal(tables["imu"].select(ACCEL_COLUMNS), accel)
    assert tables["temperature"]["temperature_degc"].unique().to_list() == [31.5]
    one = source(summary, "imu", Sensor.ACCELEROMETER)
    assert (one.stream, one.device_id, one.corrected, one.filtered) == (
        "sensor_gyro.0 and sensor_accel.0",
        ACCEL_ID,
        False,
        False,
    )
    assert one.rate_hz == pytest.approx(200.0)
    assert one.unit_id == str(GYRO_ID)
    assert codes(summary) == []


def test_raw_topics_that_are_slow_only_give_the_temperature(tmp_path: Path) -> None:
    t_us, slow = times_us(3.0), times_us(3.0, 1.0)
    topics = [
        combined(t_us, readings(len(t_us), 1), readings(len(t_us), 2)),
        sensor("sensor_gyro", slow, readings(len(slow), 3), GYRO_ID),
        sensor("sensor_accel", slow, readings(len(slow), 3), ACCEL_ID),
        selection((START_US, GYRO_ID, ACCEL_ID)),
    ]
    tables, summary = read_topics(tmp_path, topics)
    assert source(summary, "imu", Sensor.GYROSCOPE).stream == "sensor_combined.0"
    assert tables["temperature"].height == 3


def test_every_sample_of_a_fifo_is_read(tmp_path: Path) -> None:
    """1000 samples a second, 8 a message; the message's stamp is its last sample's."""
    rng = np.random.default_rng(5)
    t_us, held = times_us(2.0, 125.0), 8
    counts = {name: rng.integers(-3000, 3000, (len(t_us), 32, 3)).astype(np.int16) for name in ("gyro", "accel")}
    topics = []
    for name, number in (("gyro", GYRO_ID), ("accel", ACCEL_ID)):
        axes = {axis: counts[name][:, :, i] for i, axis in enumerate("xyz")}
        columns = {
            "timestamp": t_us + np.uint64(900),
            "timestamp_sample": t_us,
            "device_id": np.full(len(t_us), number, np.uint32),
            "dt": np.full(len(t_us), 1000.0, np.float32),
            "scale": np.full(len(t_us), 0.001, np.float32),
            "samples": np.full(len(t_us), held, np.uint8),
        }
        topics.append(Rows(f"sensor_{name}_fifo", {**columns, **axes}))
    topics.append(sensor("sensor_gyro", t_us, readings(len(t_us), 6), GYRO_ID))
    topics.append(sensor("sensor_accel", t_us, readings(len(t_us), 7), ACCEL_ID))
    tables, summary = read_topics(tmp_path, topics)
    scale = float(np.float32(0.001))
    t_ns = (t_us.astype(np.int64)[:, None] - 1000 * np.arange(held - 1, -1, -1)) * 1000
    np.testing.assert_array_equal(tables["imu"]["t_ns"], t_ns.ravel())
    for name, columns in (("gyro", GYRO_COLUMNS), ("accel", ACCEL_COLUMNS)):
        np.testing.assert_array_equal(tables["imu"].select(columns), counts[name][:, :held].reshape(-1, 3) * scale)
    assert source(summary, "imu", Sensor.GYROSCOPE).stream == "sensor_gyro_fifo.0 and sensor_accel_fifo.0"
    assert source(summary, "imu", Sensor.GYROSCOPE).rate_hz == pytest.approx(1000.0)


def test_further_units_have_tables_of_their_own(tmp_path: Path) -> None:
    t_us = times_us(1.0)
    topics = [combined(t_us, readings(len(t_us), 1), readings(len(t_us), 2))]
    expected = {}
    for instance, number in ((0, SECOND_ID), (1, GYRO_ID)):
        angle, velocity = readings(len(t_us), 20 + instance), readings(len(t_us), 30 + instance)
        columns = {
            "timestamp": t_us + np.uint64(50),
            "timestamp_sample": t_us,
            "gyro_device_id": np.full(len(t_us), number, np.uint32),
            "accel_device_id": np.full(len(t_us), number, np.uint32),
            "delta_angle": angle,
            "delta_velocity": velocity,
            "delta_angle_dt": np.full(len(t_us), 5000, np.uint32),
            "delta_velocity_dt": np.full(len(t_us), 4000, np.uint32),
        }
        topics.append(Rows("vehicle_imu", columns, instance))
        expected[number] = np.hstack([angle.astype(float) / 5e-3, velocity.astype(float) / 4e-3])
    topics.append(selection((START_US, GYRO_ID, GYRO_ID)))
    tables, summary = read_topics(tmp_path, topics)
    for table, number in (("imu", GYRO_ID), ("imu.1", SECOND_ID)):
        found = tables[table].select(GYRO_COLUMNS + ACCEL_COLUMNS)
        np.testing.assert_allclose(found, expected[number], rtol=1e-12)
    assert [(one.table, one.primary) for one in summary.sources[::2]] == [("imu", True), ("imu.1", False)]
    assert codes(summary) == ["already_corrected", "further_units"]
    path = tmp_path / "f.ulg"
    frames, facts = ingest.read_flight(path, parse("", None).vehicle("v"))
    assert set(frames) == {"imu", "imu.1"}
    assert facts["verdict"] == "ok"


def test_units_of_one_device_id_are_told_apart_by_instance(tmp_path: Path) -> None:
    t_us = times_us(1.0)
    topics = [combined(t_us, readings(len(t_us), 1), readings(len(t_us), 2))]
    topics += [sensor("sensor_mag", t_us, readings(len(t_us), 3 + i), MAG_ID, i) for i in range(2)]
    tables, summary = read_topics(tmp_path, topics)
    np.testing.assert_array_equal(tables["magnetometer.1"].select(MAG_COLUMNS), readings(len(t_us), 4))
    names = {one.unit_id for one in summary.sources if one.sensor == Sensor.MAGNETOMETER}
    assert names == {"instance-0", "instance-1"}
    assert "shared_device_id" in codes(summary)


def test_rows_of_a_unit_that_was_chosen_for_a_while_are_left_out_and_told(tmp_path: Path) -> None:
    t_us = times_us(2.0)
    changes = selection((START_US, GYRO_ID, ACCEL_ID), (int(t_us[300]), SECOND_ID, SECOND_ID))
    tables, summary = read_topics(tmp_path, [combined(t_us, readings(400, 1), readings(400, 2)), changes])
    np.testing.assert_array_equal(tables["imu"]["t_ns"], t_us[:300].astype(np.int64) * 1000)
    (finding,) = [one for one in summary.findings if one.code == "unit_changed"]
    assert (finding.count, finding.loses_data) == (100, True)


def test_an_accelerometer_of_another_time_is_interpolated_and_told(tmp_path: Path) -> None:
    t_us = times_us(1.0)
    relative = np.zeros(len(t_us), np.int32)
    relative[50] = -2000
    ramp = np.column_stack([np.arange(len(t_us))] * 3).astype(np.float32)
    ramp[50] -= 0.4  # 2 of 5 ms before
    topic = combined(t_us, readings(len(t_us), 1), ramp, accelerometer_timestamp_relative=relative)
    tables, summary = read_topics(tmp_path, [topic])
    np.testing.assert_allclose(tables["imu"]["accelerometer_x"], np.arange(len(t_us)), atol=1e-5)
    (finding,) = [one for one in summary.findings if one.code == "interpolated"]
    assert (finding.count, finding.loses_data) == (1, False)


def test_an_accelerometer_that_was_missing_is_not_invented(tmp_path: Path) -> None:
    t_us = times_us(1.0)
    relative = np.zeros(len(t_us), np.int32)
    relative[10:13] = 2**31 - 1
    topic = combined(t_us, readings(len(t_us), 1), readings(len(t_us), 2), accelerometer_timestamp_relative=relative)
    read_topics(tmp_path, [topic])
    frames, facts = ingest.read_flight(tmp_path / "f.ulg", parse("", None).vehicle("v"))
    np.testing.assert_array_equal(frames["imu"]["t_ns"], np.delete(t_us, range(10, 13)).astype(np.int64) * 1000)
    assert facts["reason_code"] == "not_finite"


def test_the_magnetometer_of_old_firmware_is_taken_once_a_reading(tmp_path: Path) -> None:
    t_us = times_us(1.0)
    field = readings(len(t_us) // 4, 8)
    since = (-5000 * (np.arange(len(t_us)) % 4) - 700).astype(np.int32)
    since[8:12] = 2**31 - 1
    topic = combined(
        t_us,
        readings(len(t_us), 1),
        readings(len(t_us), 2),
        magnetometer_timestamp_relative=since,
        magnetometer_ga=np.repeat(field, 4, axis=0),
    )
    tables, summary = read_topics(tmp_path, [topic])
    np.testing.assert_array_equal(tables["magnetometer"].select(MAG_COLUMNS), np.delete(field, 2, axis=0))
    sampled = np.delete(t_us[::4].astype(np.int64) - 700, 2)
    np.testing.assert_array_equal(tables["magnetometer"]["t_ns"], sampled * 1000)
    assert source(summary, "magnetometer", Sensor.MAGNETOMETER).rate_hz == pytest.approx(50.0)
    assert "does not tell which of its units" in summary.findings[0].sentence


def pose(t_us: np.ndarray, q: np.ndarray, **more: np.ndarray) -> Rows:
    return Rows("vehicle_visual_odometry", {"timestamp": t_us, "timestamp_sample": t_us, **more, "q": q})


def test_an_external_pose_is_scalar_last_and_in_ned(tmp_path: Path) -> None:
    """Yaw of 90°: the nose, body x, points east."""
    t_us = times_us(1.0, 30.0)
    half = np.sqrt(0.5)
    q = np.tile(np.array([half, 0.0, 0.0, half], np.float32), (len(t_us), 1))
    place = readings(len(t_us), 4)
    frames = np.ones(len(t_us), np.uint8)
    frames[-3:] = 0  # unknown
    q[0] = np.nan
    topics = [*flight(1.0), pose(t_us, q, pose_frame=frames, position=place)]
    tables, summary = read_topics(tmp_path, topics)
    vps = tables["vps"]
    assert vps.height == len(t_us) - 4
    np.testing.assert_allclose(vps.select("qx", "qy", "qz", "qw").row(0), [0, 0, half, half], atol=1e-7)
    np.testing.assert_array_equal(vps.select("px_m", "py_m", "pz_m"), place[1:-3])
    x, y, z, w = vps.select("qx", "qy", "qz", "qw").row(0)
    nose = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    np.testing.assert_allclose(nose, [0, 1, 0], atol=1e-6)
    (finding,) = [one for one in summary.findings if one.code == "unsupported_schema"]
    assert (finding.count, finding.loses_data) == (3, True)


def test_poses_of_older_firmware_have_their_position_in_three_fields(tmp_path: Path) -> None:
    t_us = times_us(1.0, 30.0)
    q = np.tile(np.array([1, 0, 0, 0], np.float32), (len(t_us), 1))
    axes = {axis: readings(len(t_us), i)[:, 0] for i, axis in enumerate("xyz")}
    tables, _ = read_topics(tmp_path, [*flight(1.0), pose(t_us, q, local_frame=np.zeros(len(t_us), np.uint8), **axes)])
    np.testing.assert_array_equal(tables["vps"]["pz_m"], axes["z"])


def test_receivers_of_older_firmware_count_in_1e_7_degrees(tmp_path: Path) -> None:
    t_us = times_us(1.0, 10.0)
    columns = {
        "timestamp": t_us,
        "lat": np.full(len(t_us), 475_000_000, np.int32),
        "lon": np.full(len(t_us), -85_000_000, np.int32),
        "alt": np.full(len(t_us), 430_000, np.int32),
        "fix_type": np.array([2] + [3] * (len(t_us) - 1), np.uint8),
    }
    tables, summary = read_topics(tmp_path, [flight(1.0)[0], Rows("vehicle_gps_position", columns)])
    assert tables["position"].height == len(t_us) - 1
    np.testing.assert_allclose(tables["position"].row(0)[1:], (47.5, -8.5, 430.0), rtol=1e-12)
    assert not summary.epoch_known


def test_a_receiver_without_a_fix_tells_neither_date_nor_place(tmp_path: Path) -> None:
    tables, summary = read_topics(tmp_path, [flight(1.0)[0], gnss(times_us(1.0, 5.0), UTC_MINUS_BOOT_US, fix=2)])
    assert "position" not in tables
    assert not summary.epoch_known


def test_how_far_fixes_disagree_about_the_time_is_told(tmp_path: Path) -> None:
    rows = gnss(times_us(1.0, 5.0), UTC_MINUS_BOOT_US)
    rows.columns["time_utc_usec"][:2] += np.array([-20_000, 30_000]).astype(np.uint64)
    _, summary = read_topics(tmp_path, [flight(1.0)[0], rows])
    assert summary.metadata["utc_from"] == "vehicle_gps_position, 5 fixes, -20 to +30 ms about their median"


def test_the_loggers_own_note_of_the_time_stands_in(tmp_path: Path) -> None:
    infos = {"boot_time_utc_us": UTC_MINUS_BOOT_US}
    tables, summary = read_topics(tmp_path, [flight(1.0)[0]], infos=infos)
    assert summary.epoch_known
    assert int(tables["imu"]["t_ns"][0]) == (UTC_MINUS_BOOT_US + START_US) * 1000
    assert summary.metadata["utc_from"] == "boot_time_utc_us"


def test_a_current_that_is_not_measured_is_none(tmp_path: Path) -> None:
    t_us = times_us(1.0, 10.0)
    amperes = np.where(np.arange(len(t_us)) < 4, -1.0, 2.5).astype(np.float32)
    tables, _ = read_topics(
        tmp_path, [flight(1.0)[0], Rows("battery_status", {"timestamp": t_us, "current_a": amperes})]
    )
    assert tables["power"]["current_a"].to_list() == [2.5] * 6


SIMULATIONS: list[dict[str, Any]] = [
    {"parameters": {"SYS_HITL": 1}},
    {"infos": {"ver_hw": "PX4_SITL"}},
    {"infos": {"replay": "log.ulg"}},
]


@pytest.mark.parametrize("more", SIMULATIONS)
def test_a_simulation_is_quarantined_unless_the_vehicle_is_one(tmp_path: Path, more: dict[str, Any]) -> None:
    read_topics(tmp_path, flight(), **more)
    path = tmp_path / "f.ulg"
    for text, expected in (("", "quarantined"), ("[defaults]\nsimulated = true", "ok")):
        _, facts = ingest.read_flight(path, parse(text, None).vehicle("v"))
        assert facts["verdict"] == expected
        assert "simulated" in [finding["code"] for finding in facts["findings"]]


def test_a_simulation_of_a_moment_is_told_as_one(tmp_path: Path) -> None:
    read_topics(tmp_path, flight(0.02), infos={"ver_hw": "PX4_SITL"})
    _, facts = ingest.read_flight(tmp_path / "f.ulg", parse("", None).vehicle("v"))
    assert facts["reason_code"] == "too_few_samples"
    assert facts["reason"] is not None
    assert "is of a simulation" in facts["reason"]


def test_calibrate_takes_a_simulation(tmp_path: Path) -> None:
    folder = tmp_path / "v" / "s"
    folder.mkdir(parents=True)
    read_topics(folder, flight(), infos={"ver_hw": "PX4_SITL"})
    assert read(*identify(folder / "f.ulg")).facts["verdict"] == "ok"


def test_what_the_logger_dropped_makes_a_log_partial(tmp_path: Path) -> None:
    read_topics(tmp_path, flight(), dropouts_ms=[20, 30])
    _, facts = ingest.read_flight(tmp_path / "f.ulg", parse("", None).vehicle("v"))
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "dropouts_logged")
    assert facts["reason"] is not None
    assert "2 time(s), for 50 ms" in facts["reason"]


def test_a_log_without_sensors_is_refused_with_its_topics(tmp_path: Path) -> None:
    with pytest.raises(UnreadableLog, match=r"telemetry_status.*sensor_combined") as caught:
        read_topics(tmp_path, flight()[3:4])
    assert caught.value.reason_code == "missing_sensor"


def test_layouts_that_are_none_of_px4s_are_not_read(tmp_path: Path) -> None:
    t_us = times_us(1.0)
    odd = [
        Rows("sensor_combined", {"timestamp": t_us, "gyro_rad": np.zeros((len(t_us), 2), np.float32)}),
        Rows("sensor_mag", {"timestamp": t_us.astype(np.float32), "x": np.zeros((len(t_us), 3), np.float32)}),
        Rows("battery_status", {"current_a": np.zeros(len(t_us), np.float32), "timestamp": t_us}),
    ]
    with pytest.raises(UnreadableLog):
        read_topics(tmp_path, odd)
