"""Folders that exporters write, one file a sensor: found as one log, read whole, with what is missing told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from logs_support import vehicle
from preset_files import Readings, made, motive, over, seconds, table, x_imu3

from fieldcal.config.configuration import CsvMap
from fieldcal.logs.discovery import find_logs, log_format
from fieldcal.logs.facts import Facts
from fieldcal.logs.ingest import read_flight
from fieldcal.logs.unread import find_unread

READINGS = made(200)
UPPER = ("X", "Y", "Z")


def phyphox(folder: Path, r: Readings = READINGS) -> Path:
    """Three sensors with stamps of their own, 3 and 4 ms behind the gyroscope's."""
    folder.mkdir(parents=True)
    for name, pattern, values, late_ns in (
        ("Gyroscope", "Gyroscope * (rad/s)", r.rate, 0),
        ("Accelerometer", "Acceleration * (m/s^2)", r.force, 3_000_000),
        ("Magnetometer", "Magnetic Field * (µT)", r.field * 1e6, 4_000_000),
    ):
        names = [f'"{column}"' for column in ("Time (s)", *over(pattern))]
        (folder / f"{name}.csv").write_text(table(names, [seconds(r.t_ns + late_ns), values]), encoding="utf-8")
    return folder


def x_imu3_folder(folder: Path, axis: str = "* Axis (a.u.)") -> Path:
    folder.mkdir(parents=True)
    us = READINGS.t_ns // 1000
    (folder / "Inertial.csv").write_text(x_imu3(READINGS))
    (folder / "Magnetometer.csv").write_text(
        table(["Timestamp (us)", *over(axis, UPPER)], [us[::4], READINGS.field[::4]])
    )
    (folder / "Temperature.csv").write_text(table(["Timestamp (us)", "Temperature (degC)"], [us[::20], "41.25"]))
    (folder / "Quaternion.csv").write_text("Timestamp (us),W,X,Y,Z\n0,1,0,0,0\n")
    return folder


def told(facts: Facts) -> list[str]:
    return [finding["code"] for finding in facts["findings"]]


def triad(frame: pl.DataFrame, sensor: str) -> np.ndarray:
    return np.asarray(frame.select([f"{sensor}_{axis}" for axis in "xyz"]).to_numpy())


def test_phyphox_files_are_one_log_and_joined(tmp_path: Path) -> None:
    frames, facts = read_flight(phyphox(tmp_path / "log"), vehicle())
    assert facts["verdict"] == "ok"
    assert told(facts) == ["preset", "preset", "preset", "sensors_joined"]
    assert facts["units"] == {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "uT"}
    imu, field = frames["imu"], frames["magnetometer"]
    # The first gyroscope's reading is before the first accelerometer's.
    np.testing.assert_array_equal(imu["t_ns"].to_numpy(), READINGS.t_ns[1:])
    np.testing.assert_array_equal(triad(imu, "gyroscope"), READINGS.rate[1:])
    between = 0.3 * READINGS.force[:-1] + 0.7 * READINGS.force[1:]
    np.testing.assert_allclose(triad(imu, "accelerometer"), between, atol=1e-12)
    np.testing.assert_allclose(triad(field, "magnetometer"), READINGS.field * 1e6)
    np.testing.assert_array_equal(field["t_ns"].to_numpy(), READINGS.t_ns + 4_000_000)


@pytest.mark.parametrize("axis", ["* Axis (a.u.)", "* (a.u.)"])
def test_the_files_of_an_x_imu3_are_one_log(tmp_path: Path, axis: str) -> None:
    folder = x_imu3_folder(tmp_path / "log", axis)
    frames, facts = read_flight(folder, vehicle())
    assert facts["verdict"] == "ok"
    assert set(told(facts)) == {"preset"}
    assert (len(frames["imu"]), len(frames["magnetometer"]), len(frames["temperature"])) == (200, 50, 10)
    np.testing.assert_allclose(triad(frames["imu"], "gyroscope"), np.degrees(READINGS.rate))
    np.testing.assert_array_equal(triad(frames["magnetometer"], "magnetometer"), READINGS.field[::4])
    assert facts["units"]["magnetometer"] == "counts"
    assert facts["temperature_mean_degc"] == 41.25


def test_a_vps_beside_them(tmp_path: Path) -> None:
    folder = phyphox(tmp_path / "log")
    (folder / "vps.csv").write_text(motive(READINGS))
    frames, facts = read_flight(folder, vehicle())
    assert (len(frames["vps"]), facts["world"], facts["verdict"]) == (200, "enu", "ok")


@pytest.mark.parametrize(
    ("content", "code"),
    [
        ("", "empty_file"),
        ("Time (s),a,b\n0,1,2\n", "missing_sensor"),
        ('"Time (s)","Light (lx)"\n' + "0.1,2\n" * 30, "missing_sensor"),
        ("Magnetic Field x (µT),Magnetic Field y (µT)\n1,2\n", "missing_sensor"),
    ],
)
def test_a_magnetometer_that_is_not_understood_costs_nothing_else(tmp_path: Path, content: str, code: str) -> None:
    folder = phyphox(tmp_path / "log")
    (folder / "Magnetometer.csv").write_text(content)
    frames, facts = read_flight(folder, vehicle())
    assert set(frames) == {"imu"}
    (finding,) = [finding for finding in facts["findings"] if "Magnetometer.csv" in finding["sentence"]]
    assert (finding["code"], finding["count"], facts["verdict"]) == (code, 1, "partial")
    (folder / "Magnetometer.csv").unlink()
    frames, facts = read_flight(folder, vehicle())
    assert (set(frames), facts["verdict"]) == ({"imu"}, "ok")


def test_a_needed_file_that_is_none_refuses_the_log(tmp_path: Path) -> None:
    folder = phyphox(tmp_path / "log")
    (folder / "Accelerometer.csv").write_text("")
    _, facts = read_flight(folder, vehicle())
    assert (facts["verdict"], facts["reason_code"]) == ("rejected", "empty_file")
    _, facts = read_flight(phyphox(tmp_path / "other"), vehicle(csv=CsvMap(preset="euroc")))
    assert facts["reason_code"] == "preset_not_fitting"


def test_they_are_found_as_logs_and_nothing_of_them_is_unread(tmp_path: Path) -> None:
    phyphox(tmp_path / "a" / "s1" / "phone")
    x_imu3_folder(tmp_path / "a" / "s1" / "x-IMU3 0042")
    (tmp_path / "a" / "s1" / "other").mkdir()
    (tmp_path / "a" / "s1" / "other" / "Gyroscope.csv").write_text("x")
    logs = find_logs(tmp_path)
    assert [log.log_uri for log in logs] == ["a/s1/phone", "a/s1/x-IMU3 0042"]
    assert {log.log_format for log in logs} == {"csv"}
    assert log_format(tmp_path / "a" / "s1" / "other") is None
    assert [one.path for one in find_unread(tmp_path, [log.log_uri for log in logs])] == ["a/s1/other"]
