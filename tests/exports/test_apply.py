"""`apply` on a small log whose readings and temperatures are written here, with constants given by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from logs_support import EPOCH_NS, messages_by_mcap_ros2

import fieldcal
from fieldcal.errors import FieldcalError
from fieldcal.exports import apply, calibrated_files
from fieldcal.exports.calibration import Constants, Triad
from fieldcal.logs.mcap.write import (
    MessageChannel,
    imu_channel,
    magnetic_field_channel,
    temperature_channel,
    write_mcap,
)
from fieldcal.names import Sensor
from fieldcal.stages.tables import matrix, triad

SAMPLES = 400
T_NS = EPOCH_NS + 5_000_000 * np.arange(SAMPLES)
RNG = np.random.default_rng(11)
RATE, FORCE, FIELD = RNG.normal(size=(3, SAMPLES, 3))
WARM_T_NS = EPOCH_NS - 500_000_000 + 100_000_000 * np.arange(31)
UNITS = {Sensor.GYROSCOPE: "rad/s", Sensor.ACCELEROMETER: "m/s^2", Sensor.MAGNETOMETER: "T"}
EQUAL = 1e-9


def degc(t_ns: np.ndarray) -> np.ndarray:
    """From 20 °C half a second before the first reading, 4 °C a second."""
    return 20.0 + 4.0 * ((t_ns - EPOCH_NS) * 1e-9 + 0.5)


def constant(sensor: Sensor, **changes: Any) -> Triad:
    plain = Triad(
        scale=np.diag([1.1, 0.9, 1.2]),
        zero=np.array([0.1, -0.2, 0.3]),
        scale_per_degc=np.zeros((3, 3)),
        zero_per_degc=np.array([0.01, -0.02, 0.03]),
        scale_sd=np.ones(3),
        zero_sd=np.ones(3),
        unit=UNITS[sensor],
        logged_unit=UNITS[sensor],
        temperature_degc=25.0,
        flown_degc=(0.0, 50.0),
        why=(),
    )
    return replace(plain, **changes)


def by_hand(t: Triad, logged: np.ndarray, temperature: np.ndarray | float) -> np.ndarray:
    """Eq. 5 with independent axes, sample by sample."""
    warmer = np.broadcast_to(np.asarray(temperature) - 25.0, len(logged))
    return np.diagonal(t.scale) * (logged - t.zero - warmer[:, None] * t.zero_per_degc)


def log_of(folder: Path, *channels: MessageChannel) -> Path:
    path = folder / "archive" / "v" / "s" / "log.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_mcap(path, channels)
    return path


IMU = imu_channel(T_NS, None, RATE, FORCE)
MAG = magnetic_field_channel(T_NS[::2], None, FIELD[::2])
WARM = temperature_channel(WARM_T_NS, None, degc(WARM_T_NS))


def flown_with(*sensors: Sensor, **changes: Any) -> Constants:
    return Constants("v", "i", {s: constant(s, **changes) for s in sensors or Sensor}, "2026")


def calibrated(
    log: Path, constants: Constants, *, follow_temperature: bool = True, config: Path | None = None
) -> apply.CalibratedReadings:
    return fieldcal.apply(log, constants, follow_temperature=follow_temperature, config=config)


def test_every_sample_at_its_own_temperature(tmp_path: Path) -> None:
    """Temperatures lie ten times as far apart as readings and do not begin with them: a straight line between them."""
    constants = flown_with()
    found = calibrated(log_of(tmp_path, IMU, MAG, WARM), constants).readings
    for sensor, t_ns, logged in (
        (Sensor.GYROSCOPE, T_NS, RATE),
        (Sensor.ACCELEROMETER, T_NS, FORCE),
        (Sensor.MAGNETOMETER, T_NS[::2], FIELD[::2]),
    ):
        np.testing.assert_array_equal(found[sensor][0], t_ns)
        wanted = by_hand(constants.triads[sensor], logged, degc(t_ns))
        np.testing.assert_allclose(found[sensor][1], wanted, rtol=0, atol=EQUAL)


def test_outside_the_temperatures_the_nearest_one_counts(tmp_path: Path) -> None:
    constants = flown_with()
    late = WARM_T_NS + 1_000_000_000
    warm = temperature_channel(late, None, degc(late))
    found = calibrated(log_of(tmp_path, IMU, warm), constants).readings[Sensor.GYROSCOPE][1]
    wanted = by_hand(constants.triads[Sensor.GYROSCOPE], RATE, degc(np.maximum(T_NS, late[0])))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=EQUAL)


@pytest.mark.parametrize(("channels", "follow"), [((IMU,), True), ((IMU, WARM), False)])
def test_constants_as_they_are_without_temperatures_or_where_they_are_not_followed(
    tmp_path: Path, channels: tuple[MessageChannel, ...], follow: bool
) -> None:
    constants = flown_with()
    found = calibrated(log_of(tmp_path, *channels), constants, follow_temperature=follow)
    wanted = by_hand(constants.triads[Sensor.GYROSCOPE], RATE, 25.0)
    np.testing.assert_allclose(found.readings[Sensor.GYROSCOPE][1], wanted, rtol=0, atol=EQUAL)
    assert found.warnings == ()


@pytest.mark.parametrize(
    ("flown", "told"),
    [
        (None, None),
        ((20.0, 32.0), None),
        ((20.1, 40.0), "20.0 to 32.0 °C goes beyond the 20.1 to 40.0 °C flown"),
        ((10.0, 31.9), "20.0 to 32.0 °C goes beyond the 10.0 to 31.9 °C flown"),
        ((22.0, 28.0), "20.0 to 32.0 °C goes beyond the 22.0 to 28.0 °C flown"),
    ],
)
def test_colder_or_warmer_than_flown_is_told(
    tmp_path: Path, flown: tuple[float, float] | None, told: str | None
) -> None:
    """The log's temperatures are 20 to 32 °C."""
    constants = flown_with(flown_degc=flown)
    warnings = calibrated(log_of(tmp_path, IMU, WARM), constants).warnings
    assert [w.split(": ")[1].rstrip(".") for w in warnings] == ([told, told] if told else [])
    assert calibrated(log_of(tmp_path, IMU, WARM), constants, follow_temperature=False).warnings == ()


def test_one_temperature_is_enough_to_tell(tmp_path: Path) -> None:
    one = temperature_channel(T_NS[:1], None, np.array([60.0]))
    warnings = calibrated(log_of(tmp_path, IMU, one), flown_with()).warnings
    assert len(warnings) == 2
    assert all("60.0 to 60.0 °C goes beyond the 0.0 to 50.0 °C flown" in told for told in warnings)


def test_what_an_autopilot_had_made_of_readings_is_undone(tmp_path: Path) -> None:
    """logged = M raw + o, M with cross-axis terms and turned; a sensor of which nothing is known is as it is logged."""
    m, o = np.array([[0.1, -1.2, 0.05], [0.9, 0.02, 0.3], [-0.2, 0.1, 1.1]]), np.array([0.4, -0.7, 0.2])
    settings = calibrated(log_of(tmp_path, IMU), flown_with()).settings
    settings = replace(
        settings,
        applied_matrix={**settings.applied_matrix, Sensor.GYROSCOPE: tuple(map(tuple, m))},
        applied_offset={**settings.applied_offset, Sensor.GYROSCOPE: tuple(o)},
    )
    found = apply.raw_readings(RATE @ m.T + o, Sensor.GYROSCOPE, settings)
    np.testing.assert_allclose(found, RATE, rtol=0, atol=EQUAL)
    np.testing.assert_array_equal(apply.raw_readings(FORCE, Sensor.ACCELEROMETER, settings), FORCE)


def test_sensors_without_constants_or_readings_are_left_out(tmp_path: Path) -> None:
    found = calibrated(log_of(tmp_path, IMU), flown_with(Sensor.ACCELEROMETER, Sensor.MAGNETOMETER))
    assert list(found.readings) == [Sensor.ACCELEROMETER]
    assert found.warnings == ("gyroscope: no constants, so it is left out.",)
    with pytest.raises(FieldcalError, match="no sensor of this log has constants") as caught:
        calibrated(log_of(tmp_path, IMU), flown_with(Sensor.MAGNETOMETER))
    assert caught.value.reason_code == "no_calibration"
    with pytest.raises(FieldcalError, match="gyroscope is in rad/s, the constants are for counts") as caught:
        calibrated(log_of(tmp_path, IMU), flown_with(logged_unit="counts"))
    assert caught.value.reason_code == "unit_mismatch"


def test_the_archives_own_configuration_counts_unless_another_is_given(tmp_path: Path) -> None:
    log = log_of(tmp_path, IMU)
    (tmp_path / "archive" / "fieldcal.toml").write_text('[vehicles.v.units]\ngyroscope = "deg/s"\n')
    other = tmp_path / "other.toml"
    other.write_text('[vehicles.v.units]\ngyroscope = "rad/s"\n')
    with pytest.raises(FieldcalError, match="gyroscope is in deg/s"):
        calibrated(log, flown_with())
    assert Sensor.GYROSCOPE in calibrated(log, flown_with(), config=other).readings


def test_an_absent_sensor_is_null_in_parquet_and_marked_in_ros(tmp_path: Path) -> None:
    """Folders are made, and made again; REP-103 has x forward, y left, z up, the log says it is so already."""
    for sensor, other in (
        (Sensor.GYROSCOPE, Sensor.ACCELEROMETER),
        (Sensor.ACCELEROMETER, Sensor.GYROSCOPE),
    ):
        constants = flown_with(sensor)
        found = calibrated(log_of(tmp_path, IMU), constants)
        for _ in range(2):
            (path,) = calibrated_files.write_folder(found, tmp_path / "deep" / "er" / sensor)
        frame = pl.read_parquet(path)
        logged = {Sensor.GYROSCOPE: RATE, Sensor.ACCELEROMETER: FORCE}[sensor]
        wanted = by_hand(constants.triads[sensor], logged, 25.0)
        np.testing.assert_allclose(matrix(frame, triad(sensor)), wanted, rtol=0, atol=EQUAL)
        assert all(frame[f"{other}_{axis}"].null_count() == SAMPLES for axis in "xyz")
        assert calibrated_files.write_ros(found, tmp_path / "far" / "off" / f"{sensor}.mcap") == ()
        messages = [m for _, m in messages_by_mcap_ros2(tmp_path / "far" / "off" / f"{sensor}.mcap", "/imu/data")]
        assert len(messages) == SAMPLES
        here, there = ("angular_velocity", "linear_acceleration")[:: 1 if sensor == Sensor.GYROSCOPE else -1]
        for row in (0, SAMPLES - 1):
            vector = getattr(messages[row], here)
            np.testing.assert_allclose([vector.x, vector.y, vector.z], wanted[row], rtol=0, atol=EQUAL)
            assert getattr(messages[row], f"{here}_covariance")[0] == 0.0
            assert getattr(messages[row], f"{there}_covariance")[0] == -1.0


@pytest.mark.parametrize(
    ("sensors", "channels", "topics"),
    [
        ((), (IMU,), {"/imu/data"}),
        ((), (IMU, MAG, WARM), {"/imu/data", "/imu/mag", "/imu/temperature"}),
        ((Sensor.MAGNETOMETER,), (IMU, MAG), {"/imu/mag"}),
    ],
)
def test_only_what_the_log_holds_is_written(
    tmp_path: Path, sensors: tuple[Sensor, ...], channels: tuple[MessageChannel, ...], topics: set[str]
) -> None:
    found = calibrated(log_of(tmp_path, *channels), flown_with(*sensors))
    path = tmp_path / "out.mcap"
    calibrated_files.write_ros(found, path)
    rows = {"/imu/data": SAMPLES, "/imu/mag": SAMPLES // 2, "/imu/temperature": len(WARM_T_NS)}
    for topic, count in rows.items():
        assert len(list(messages_by_mcap_ros2(path, topic))) == (count if topic in topics else 0)


@pytest.mark.parametrize(("unit", "tesla"), [("T", 1.0), ("G", 1e-4), ("uT", 1e-6), ("norm", None)])
def test_ros_gets_tesla_or_another_topic(tmp_path: Path, unit: str, tesla: float | None) -> None:
    """Parts of a field whose strength is not known are no tesla: they are as they are, under another name."""
    found = calibrated(log_of(tmp_path, IMU, MAG), flown_with(Sensor.MAGNETOMETER, unit=unit))
    told = calibrated_files.write_ros(found, tmp_path / "out.mcap")
    assert [one.endswith("is not in tesla.") for one in told] == ([True] if tesla is None else [])
    topic = "/imu/mag_norm" if tesla is None else "/imu/mag"
    messages = [m.magnetic_field for _, m in messages_by_mcap_ros2(tmp_path / "out.mcap", topic)]
    field = np.array([[v.x, v.y, v.z] for v in messages])
    np.testing.assert_allclose(field, (tesla or 1.0) * found.readings[Sensor.MAGNETOMETER][1], rtol=1e-12)


def test_a_table_without_temperatures_has_no_column_for_them(tmp_path: Path) -> None:
    calibrated(log_of(tmp_path, IMU), flown_with()).write(tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == "t_s,gx,gy,gz,ax,ay,az"


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_one_table_of_all_readings_by_the_names_ending(tmp_path: Path, ending: str) -> None:
    """A row a stamp of any sensor; the magnetometer is at every second, temperatures between."""
    found = calibrated(log_of(tmp_path, IMU, MAG, WARM), flown_with())
    path = tmp_path / "far" / f"out.{ending.upper()}"
    assert found.write(path) == ([path], ())
    names = {"gyroscope": "gx", "accelerometer": "ax", "magnetometer": "mx"}
    if ending == "csv":
        lines = path.read_text().splitlines()
        assert lines[:2] == ["t_s,gx,gy,gz,ax,ay,az,mx,my,mz,temp", "s,rad/s,rad/s,rad/s,m/s^2,m/s^2,m/s^2,T,T,T,degC"]
        frame = pl.read_csv("\n".join([lines[0], *lines[2:]]).encode(), infer_schema_length=None)
        whole = pl.Series([line.split(",")[0] for line in lines[2:]]).str.replace(".", "", literal=True)
        frame = frame.with_columns(t_ns=whole.cast(pl.Int64))
    else:
        frame = pl.read_parquet(path)
        assert pl.read_parquet_metadata(path)["vehicle_id"] == "v"
        names = {sensor: f"{sensor}_x" for sensor in names}
    assert frame["t_ns"].is_sorted()
    assert frame["t_ns"].to_list() == sorted({*T_NS.tolist(), *WARM_T_NS.tolist()})
    for sensor, (t_ns, z) in found.readings.items():
        own = frame.filter(pl.col(names[sensor]).is_not_null())
        assert own["t_ns"].to_list() == t_ns.tolist()
        np.testing.assert_allclose(own[names[sensor]].to_numpy(), z[:, 0], rtol=1e-12)


def test_a_written_csv_is_read_as_a_log_again(tmp_path: Path) -> None:
    found = calibrated(log_of(tmp_path, IMU, MAG, WARM), flown_with())
    path = tmp_path / "v" / "s" / "again.csv"
    found.write(path)
    again = fieldcal.read_log(path)
    for sensor, (t_ns, z) in found.readings.items():
        stamps, readings = again.readings(sensor)
        np.testing.assert_allclose(stamps - stamps[0], 1e-9 * (t_ns - t_ns[0]), rtol=0, atol=1e-9)
        np.testing.assert_allclose(readings, z, rtol=1e-12)


@pytest.mark.parametrize("name", ["out.ulg", "out.bin", "out.mcap.zip"])
def test_an_ending_that_is_none_is_refused(tmp_path: Path, name: str) -> None:
    found = calibrated(log_of(tmp_path, IMU), flown_with())
    with pytest.raises(FieldcalError, match=r"written as \.mcap, \.csv or \.parquet") as caught:
        found.write(tmp_path / name)
    assert caught.value.reason_code == "wrong_option"
    assert not (tmp_path / name).exists()
