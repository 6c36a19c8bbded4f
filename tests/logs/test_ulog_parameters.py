"""What PX4 does to readings: its formulas written out here axis by axis, and undone again."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega
from ulog_support import ACCEL_ID, GYRO_ID, MAG_ID, changed

from fieldcal.logs.ulog.parameters import History, corrected, correction, corrections, slot_of, uncorrected
from fieldcal.logs.ulog.rotations import from_euler, rotation
from fieldcal.names import Sensor

FLOAT32_ROUNDING = 2e-6
G, A, M = Sensor.GYROSCOPE, Sensor.ACCELEROMETER, Sensor.MAGNETOMETER


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll), degrees, written out."""
    r, p, y = (math.radians(angle) for angle in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    about_y = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    about_z = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def test_eulers_are_px4s() -> None:
    np.testing.assert_allclose(from_euler(10.0, -20.0, 130.0), turned(10, -20, 130), atol=1e-15)


@pytest.mark.parametrize(
    ("number", "of_x", "of_y", "of_z"),
    [
        (0, "+x", "+y", "+z"),
        (2, "+y", "-x", "+z"),  # yaw 90: what the sensor has on x, the board has on y
        (4, "-x", "-y", "+z"),
        (6, "-y", "+x", "+z"),
        (8, "+x", "-y", "-z"),
        (12, "-x", "+y", "-z"),
        (16, "+x", "+z", "-y"),
        (24, "-z", "+y", "+x"),
        (10, "+y", "+x", "-z"),
        (26, "-y", "-x", "-z"),
    ],
)
def test_numbered_rotations_turn_the_axes_as_px4_writes_them_out(number: int, of_x: str, of_y: str, of_z: str) -> None:
    """PX4 has these as swaps and signs too (rotate_3)."""
    for sensed, board in zip(np.eye(3), (of_x, of_y, of_z), strict=True):
        expected = np.zeros(3)
        expected["xyz".index(board[1])] = 1.0 if board[0] == "+" else -1.0
        np.testing.assert_allclose(rotation(number) @ sensed, expected, atol=1e-15)


def test_rotations_of_recent_firmware_are_those_of_mavlinks_names() -> None:
    checked = 0
    for number, entry in ardupilotmega.enums["MAV_SENSOR_ORIENTATION"].items():
        if number > 40:
            continue
        angles = {axis: float(degrees) for axis, degrees in re.findall(r"(ROLL|PITCH|YAW)_(\d+)", entry.name)}
        expected = turned(*(angles.get(axis, 0.0) for axis in ("ROLL", "PITCH", "YAW")))
        for release in (None, 0x010C0000):
            np.testing.assert_allclose(rotation(number, release), expected, atol=1e-12, err_msg=entry.name)
        if number < 26:
            np.testing.assert_allclose(rotation(number, 0x010BFFFF), expected, atol=1e-12, err_msg=entry.name)
        checked += 1
    assert checked == 41


OLDER_NAMES = [
    "ROLL_270_YAW_270", "ROLL_180_PITCH_270", "PITCH_90_YAW_180", "PITCH_90_ROLL_90", "YAW_293_PITCH_68_ROLL_90",
    "PITCH_90_ROLL_270", "PITCH_9_YAW_180", "PITCH_45", "PITCH_315", "ROLL_90_YAW_270",
]  # fmt: skip
"""Of the numbers from 26 on, in rotation.h of v1.11."""


def test_rotations_of_older_firmware_are_those_of_its_names() -> None:
    for number, name in enumerate(OLDER_NAMES, start=26):
        angles = {axis: float(degrees) for axis, degrees in re.findall(r"(ROLL|PITCH|YAW)_(\d+)", name)}
        expected = turned(*(angles.get(axis, 0.0) for axis in ("ROLL", "PITCH", "YAW")))
        np.testing.assert_allclose(rotation(number, 0x010B0000), expected, atol=1e-12, err_msg=name)


def test_a_rotation_that_there_is_not_is_none_and_old_firmware_had_other_numbers() -> None:
    for number in (-1, 41, 1_104_674_816):
        np.testing.assert_array_equal(rotation(number), np.eye(3))
    np.testing.assert_allclose(rotation(26, 0x010A0000), turned(270, 0, 270), atol=1e-15)
    np.testing.assert_allclose(rotation(26, 0x010E0000), turned(0, 180, 90), atol=1e-15)


def random_parameters(seed: int) -> dict[str, float]:
    """All that is used, of slot 1; slot 0 is another device's."""
    rng = np.random.default_rng(seed)
    found: dict[str, float] = {"SENS_BOARD_ROT": float(rng.integers(0, 26)), "TC_A_ENABLE": 1.0, "TC_G_ENABLE": 1.0}
    for name in "XYZ":
        found[f"SENS_BOARD_{name}_OFF"] = rng.uniform(-5, 5)
    for prefix, number in (("CAL_GYRO", GYRO_ID), ("CAL_ACC", ACCEL_ID), ("CAL_MAG", MAG_ID)):
        for slot in (0, 1):
            found[f"{prefix}{slot}_ID"] = float(number if slot else 77)
            for axis in "XYZ":
                found[f"{prefix}{slot}_{axis}OFF"] = rng.uniform(-0.5, 0.5)
                found[f"{prefix}{slot}_{axis}SCALE"] = rng.uniform(0.9, 1.1)
                found[f"{prefix}{slot}_{axis}ODIAG"] = rng.uniform(-0.05, 0.05)
    for prefix, number in (("TC_G", GYRO_ID), ("TC_A", ACCEL_ID)):
        found |= {f"{prefix}2_ID": float(number), f"{prefix}2_TREF": 40.0}
        found |= {f"{prefix}2_TMIN": 10.0, f"{prefix}2_TMAX": 60.0}
        for k in range(4):
            for axis in range(3):
                found[f"{prefix}2_X{k}_{axis}"] = rng.uniform(-1, 1) * 10.0 ** (-2 * k - 1)
    return found


def thermal(values: dict[str, float], prefix: str, warm: float) -> list[float]:
    """T of the three axes, as the firmware adds it up."""
    d = min(max(warm, 10.0), 60.0) - 40.0
    terms = [[values[f"{prefix}2_X{k}_{axis}"] * d**k for k in range(4)] for axis in range(3)]
    return [sum(axis) for axis in terms]


def logged_by_px4(sensor: Sensor, values: dict[str, float], raw: np.ndarray, warm: float) -> np.ndarray:
    """The formula, axis by axis."""
    board = turned(*(values[f"SENS_BOARD_{axis}_OFF"] for axis in "XYZ")) @ rotation(values["SENS_BOARD_ROT"])
    out = []
    for row in raw:
        if sensor == M:
            x, y, z = (row[i] - values[f"CAL_MAG1_{axis}OFF"] for i, axis in enumerate("XYZ"))
            sx, sy, sz = (values[f"CAL_MAG1_{axis}SCALE"] for axis in "XYZ")
            ox, oy, oz = (values[f"CAL_MAG1_{axis}ODIAG"] for axis in "XYZ")
            out.append(board @ [sx * x + ox * y + oy * z, ox * x + sy * y + oz * z, oy * x + oz * y + sz * z])
            continue
        prefix, t = ("CAL_GYRO1", "TC_G") if sensor == G else ("CAL_ACC1", "TC_A")
        cold = thermal(values, t, warm)
        own = [
            (row[i] - cold[i] - values[f"{prefix}_{axis}OFF"]) * values[f"{prefix}_{axis}SCALE"]
            for i, axis in enumerate("XYZ")
        ]
        out.append(board @ own)
    return np.array(out)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("sensor", "device_id"), [(G, GYRO_ID), (A, ACCEL_ID), (M, MAG_ID)])
@pytest.mark.parametrize("warm", [-5.0, 25.0, 55.0, 71.0])
def test_logged_values_are_the_formulas_and_can_be_undone(
    sensor: Sensor, device_id: int, seed: int, warm: float
) -> None:
    values = random_parameters(seed)
    raw = np.random.default_rng(seed + 100).normal(size=(20, 3))
    piece = correction(sensor, device_id, values, warm)
    logged = logged_by_px4(sensor, values, raw, warm)
    np.testing.assert_allclose(corrected(piece, raw), logged, atol=1e-12)
    np.testing.assert_allclose(uncorrected(piece, logged), raw, atol=1e-12)
    assert set(piece.parameters) <= set(values)


def test_the_slope_is_that_of_the_offset() -> None:
    values = random_parameters(3)
    step = 1e-4
    for warm in (25.0, 55.0):
        low, high = (correction(A, ACCEL_ID, values, warm + side * step) for side in (-1, 1))
        slope = (np.array(high.offset) - np.array(low.offset)) / (2 * step)
        piece = correction(A, ACCEL_ID, values, warm)
        np.testing.assert_allclose(piece.offset_per_degc, slope, atol=1e-8)
        near = corrected(piece, np.zeros((1, 3)), warm + step)[0]
        np.testing.assert_allclose(near, high.offset, atol=1e-10)
    assert correction(A, ACCEL_ID, values, 80.0).offset_per_degc == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("warm", [-5.0, 40.0, 120.0])
def test_temperatures_that_are_not_told_are_the_firmwares(warm: float) -> None:
    """TC_A0_TREF 25, TC_A0_TMIN 0, TC_A0_TMAX 100 °C."""
    values = random_parameters(6)
    defaults = {"TC_A2_TREF": 25.0, "TC_A2_TMIN": 0.0, "TC_A2_TMAX": 100.0}
    untold = {name: value for name, value in values.items() if name not in defaults}
    found, wanted = (correction(A, ACCEL_ID, p, warm) for p in (untold, values | defaults))
    assert (found.offset, found.offset_per_degc) == (wanted.offset, wanted.offset_per_degc)
    assert correction(A, ACCEL_ID, untold).temperature_degc == 25.0


def test_thermal_compensation_holds_only_where_it_is_switched_on() -> None:
    values = random_parameters(4) | {"TC_A_ENABLE": 0.0}
    piece = correction(A, ACCEL_ID, values, 20.0)
    assert piece.temperature_degc is None
    assert not any(name.startswith("TC_") for name in piece.parameters)


def test_an_external_magnetometer_is_turned_by_its_own_rotation() -> None:
    values: dict[str, float] = {"SENS_BOARD_ROT": 4.0, "CAL_MAG0_ID": MAG_ID, "CAL_MAG0_ROT": 2.0}
    np.testing.assert_allclose(correction(M, MAG_ID, values).matrix, turned(0, 0, 90), atol=1e-15)
    values["CAL_MAG0_ROT"] = -1.0
    np.testing.assert_allclose(correction(M, MAG_ID, values).matrix, turned(0, 0, 180), atol=1e-15)
    values |= {"CAL_MAG0_ROT": 100.0, "CAL_MAG0_ROLL": 3.0, "CAL_MAG0_PITCH": 4.0, "CAL_MAG0_YAW": 5.0}
    np.testing.assert_allclose(correction(M, MAG_ID, values).matrix, turned(3, 4, 5), atol=1e-15)


def test_ids_are_logged_signed_and_unsigned() -> None:
    assert slot_of("CAL_ACC", 0xFFFF_FFFE, {"CAL_ACC0_ID": 5.0, "CAL_ACC2_ID": -2.0}) == 2
    assert slot_of("CAL_ACC", 0, {"CAL_ACC0_ID": 0.0}) is None
    assert slot_of("CAL_ACC", 8, {"CAL_ACC0_ID": math.nan}) is None


def test_what_is_not_calibrated_is_turned_only() -> None:
    piece = correction(G, 5, {"SENS_BOARD_ROT": 8.0, "CAL_GYRO0_ID": 6.0, "CAL_GYRO0_XOFF": 1.0})
    np.testing.assert_allclose(piece.matrix, turned(180, 0, 0), atol=1e-15)
    assert piece.offset == (0.0, 0.0, 0.0)
    assert piece.parameters == {"SENS_BOARD_ROT": 8.0}


def history(**more: Any) -> History:
    initial = {"CAL_GYRO0_ID": float(GYRO_ID), "CAL_GYRO0_XOFF": 0.1}
    return History(initial, start_us=1_000, **more)


def test_parameters_hold_piecewise() -> None:
    changes = [
        changed(5_000, "CAL_GYRO0_XOFF", 0.2),
        changed(5_000, "CAL_GYRO0_YOFF", 0.3),
        changed(6_000, "CAL_ACC0_XOFF", 9.0),  # another sensor's
        changed(7_000, "CAL_GYRO0_ZOFF", 0.0),  # what it was
        changed(8_000, "CAL_GYRO0_XOFF", 0.4),
    ]
    found = corrections(G, GYRO_ID, history(changes=changes), offset_ns=50)
    assert [piece.from_ns for piece in found] == [1_000_050, 5_000_050, 8_000_050]
    assert [piece.offset for piece in found] == [(-0.1, 0.0, 0.0), (-0.2, -0.3, 0.0), (-0.4, -0.3, 0.0)]


def test_without_changes_there_is_one_piece() -> None:
    (piece,) = corrections(G, GYRO_ID, history())
    assert (piece.from_ns, piece.parameters["CAL_GYRO0_XOFF"]) == (1_000_000, 0.1)
