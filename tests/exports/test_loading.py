"""Which constants go into which slot: by device id, in the autopilot's axes and sign, or not at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldcal.cli.main import run
from fieldcal.config.loaded import Autopilot, Loaded
from fieldcal.errors import FieldcalError
from fieldcal.exports import AUTOPILOTS
from fieldcal.exports.autopilots.ardupilot_slot import ArduPilot
from fieldcal.exports.autopilots.loading import Request
from fieldcal.exports.autopilots.parameter_file import read_parameters
from fieldcal.exports.autopilots.px4_slot import signed, thermal_slot
from fieldcal.exports.calibration import NOT_TURNED, Constants, Origin, Triad
from fieldcal.names import SENSORS, Sensor

UNIT = {Sensor.GYROSCOPE: "rad/s", Sensor.ACCELEROMETER: "m/s^2", Sensor.MAGNETOMETER: "G"}
SCALE = {s: np.diag([1.01, 0.99, 1.02]) for s in SENSORS}
ZERO = {
    Sensor.GYROSCOPE: np.array([0.02, -0.03, 0.015]),
    Sensor.ACCELEROMETER: np.array([0.2, -0.3, 0.15]),
    Sensor.MAGNETOMETER: np.array([0.12, -0.08, 0.2]),
}
NAMES = {Sensor.GYROSCOPE: "CAL_GYRO", Sensor.ACCELEROMETER: "CAL_ACC", Sensor.MAGNETOMETER: "CAL_MAG"}


def triad(sensor: Sensor) -> Triad:
    return Triad(
        scale=SCALE[sensor],
        zero=ZERO[sensor],
        scale_per_degc=np.zeros((3, 3)),
        zero_per_degc=np.zeros(3),
        scale_sd=np.full(3, 1e-3),
        zero_sd=np.full(3, 1e-3),
        unit=UNIT[sensor],
        logged_unit=UNIT[sensor],
        temperature_degc=25.0,
        flown_degc=None,
        why=(),
    )


def constants(origin: Origin | None, *sensors: Sensor) -> Constants:
    own = sensors or SENSORS
    origins = {} if origin is None else dict.fromkeys(own, origin)
    return Constants("v", "i", {s: triad(s) for s in own}, "", {s: f"board/{s}" for s in own}, origins)


def px4(c: Constants, **request: Any) -> dict[str, float]:
    text = AUTOPILOTS["px4"](c, Request(**request)).text
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    return {row[2]: float(row[3]) for row in rows}


def of(p: dict[str, float], stem: str, what: str) -> np.ndarray:
    return np.array([p[f"{stem}{axis}{what}"] for axis in "XYZ"])


def flown(autopilot: Autopilot, device_id: int | None, parameters: dict[str, float]) -> Origin:
    return Origin(Loaded(autopilot, device_id, NOT_TURNED, parameters))


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize("origin", [None, Origin()])
def test_constants_of_readings_that_may_have_been_corrected_are_refused(autopilot: str, origin: Origin | None) -> None:
    with pytest.raises(FieldcalError, match=r"does not tell whether .*--params FILE.*--logged-raw") as caught:
        AUTOPILOTS[autopilot](constants(origin), None)
    assert caught.value.reason_code == "not_loadable"


def test_where_nobody_knows_the_axes_they_are_told() -> None:
    told = AUTOPILOTS["px4"](constants(None), Request(logged_raw=True)).warnings
    assert sum("taken for forward, right, down" in one for one in told) == len(SENSORS)
    told = AUTOPILOTS["px4"](constants(Origin()), Request(logged_raw=True)).warnings
    assert not any("taken for" in one for one in told)
    assert sum("goes into the first slot" in one for one in told) == len(SENSORS)


def test_forward_left_up_becomes_forward_right_down() -> None:
    p = px4(constants(Origin(body="flu")), logged_raw=True)
    for s in SENSORS:
        np.testing.assert_allclose(of(p, f"{NAMES[s]}0_", "OFF"), ZERO[s] * [1, -1, -1])
    for s in (Sensor.ACCELEROMETER, Sensor.MAGNETOMETER):
        np.testing.assert_allclose(of(p, f"{NAMES[s]}0_", "SCALE"), np.diagonal(SCALE[s]))


@pytest.mark.parametrize(("body", "signs"), [("frd", [-1, -1, -1]), ("flu", [-1, 1, 1])])
def test_gravity_becomes_specific_force(body: str, signs: list[int]) -> None:
    """Only of the accelerometer: −(raw − zero) = −raw − (−zero)."""
    p = px4(constants(Origin(body=body, gravity_sign="gravity")), logged_raw=True)
    np.testing.assert_allclose(of(p, "CAL_ACC0_", "OFF"), ZERO[Sensor.ACCELEROMETER] * signs)
    others = -np.array(signs) if body == "flu" else [1, 1, 1]
    np.testing.assert_allclose(of(p, "CAL_GYRO0_", "OFF"), ZERO[Sensor.GYROSCOPE] * others)


def test_a_sensor_that_is_mounted_turned_is_calibrated_in_its_own_axes() -> None:
    """An autopilot corrects before it turns; ArduPilot turns compasses before it corrects them."""
    yaw = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    turned = constants(Origin(rotation_body_from_sensor=tuple(map(tuple, yaw))))
    p = px4(turned, logged_raw=True)
    for s in SENSORS:
        np.testing.assert_allclose(of(p, f"{NAMES[s]}0_", "OFF"), ZERO[s])
    told = AUTOPILOTS["px4"](turned, Request(logged_raw=True)).warnings
    assert sum("turned by 90° against the body; SENS_BOARD_ROT" in one for one in told) == len(SENSORS)
    text = AUTOPILOTS["ardupilot"](turned, Request(logged_raw=True)).text
    a = {name: float(value) for name, value in (row.split(",") for row in text.splitlines()[1:])}
    np.testing.assert_allclose([a[f"INS_GYROFFS_{axis}"] for axis in "XYZ"], ZERO[Sensor.GYROSCOPE])
    wanted = -1e3 * yaw @ ZERO[Sensor.MAGNETOMETER]
    np.testing.assert_allclose([a[f"COMPASS_OFS_{axis}"] for axis in "XYZ"], wanted)


@pytest.mark.parametrize(("angle", "counts"), [(0.0099, False), (0.0101, True)])
def test_a_mounting_within_a_hundredth_of_a_degree_is_none(angle: float, counts: bool) -> None:
    yaw = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    turned = constants(Origin(rotation_body_from_sensor=tuple(map(tuple, yaw))), Sensor.GYROSCOPE)
    told = AUTOPILOTS["px4"](turned, Request(logged_raw=True)).warnings
    assert any("it is mounted turned" in one for one in told) == counts


def test_the_log_turns_constants_back_by_its_mounting() -> None:
    yaw = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    loaded = Loaded("px4", 7, tuple(map(tuple, yaw)), {"CAL_ACC2_ID": 7.0})
    p = px4(constants(Origin(loaded), Sensor.ACCELEROMETER))
    np.testing.assert_allclose(of(p, "CAL_ACC2_", "OFF"), yaw.T @ ZERO[Sensor.ACCELEROMETER])
    np.testing.assert_allclose(of(p, "CAL_ACC2_", "SCALE"), [0.99, 1.01, 1.02])


def test_corrected_readings_that_the_configuration_turns_contradict_themselves() -> None:
    yaw = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    turned = constants(Origin(rotation_body_from_sensor=tuple(map(tuple, yaw))))
    with pytest.raises(FieldcalError, match=r"in body axes, but fieldcal\.toml turns them"):
        px4(turned, parameters={"CAL_GYRO0_ID": 1.0, "CAL_ACC0_ID": 2.0, "CAL_MAG0_ID": 3.0})


def test_every_unit_goes_into_the_slot_of_its_device() -> None:
    ids = {"CAL_GYRO0_ID": 31.0, "CAL_GYRO1_ID": 32.0, "CAL_GYRO2_ID": 33.0}
    units = [constants(flown("px4", device, ids), Sensor.GYROSCOPE) for device in (32, 31, 40, 32)]
    other = replace(units[1], triads={Sensor.GYROSCOPE: replace(triad(Sensor.GYROSCOPE), zero=np.full(3, 0.5))})
    export = AUTOPILOTS["px4"](replace(units[0], further=(other, units[2], units[3])), None)
    p = px4(replace(units[0], further=(other, units[2], units[3])))
    np.testing.assert_allclose(of(p, "CAL_GYRO1_", "OFF"), ZERO[Sensor.GYROSCOPE])
    np.testing.assert_allclose(of(p, "CAL_GYRO0_", "OFF"), 0.5)
    assert len(p) == 6
    told = [one for one in export.warnings if "left out" in one]
    assert told[0].startswith("gyroscope of unit board/gyroscope: left out. No CAL_GYROn_ID is its device id, 40")
    assert "31, 32, 33" in told[0]
    assert told[1].endswith("Its slot has another unit's already.")


def test_a_device_id_of_32_bits_is_found_where_it_is_negative() -> None:
    p = px4(constants(flown("px4", 3_000_000_000, {"CAL_ACC1_ID": 3e9 - 2.0**32}), Sensor.ACCELEROMETER))
    np.testing.assert_allclose(of(p, "CAL_ACC1_", "OFF"), ZERO[Sensor.ACCELEROMETER])


def test_without_a_device_id_the_only_slot_is_taken_or_none() -> None:
    own = constants(Origin(), Sensor.GYROSCOPE)
    p = px4(own, parameters={"CAL_GYRO2_ID": 5.0, "CAL_GYRO2_XOFF": 0.1})
    np.testing.assert_allclose(of(p, "CAL_GYRO2_", "OFF"), ZERO[Sensor.GYROSCOPE] + [0.1, 0.0, 0.0])
    for several, there in (({}, "none"), ({"CAL_GYRO0_ID": 5.0, "CAL_GYRO1_ID": 6.0}, "5, 6")):
        with pytest.raises(FieldcalError, match=rf"there is not one device \({there}\)"):
            px4(own, parameters=several)
    p = px4(own, parameters={"CAL_GYRO2_ID": 5.0, "CAL_GYRO2_XOFF": 0.1}, logged_raw=True)
    np.testing.assert_allclose(of(p, "CAL_GYRO2_", "OFF"), ZERO[Sensor.GYROSCOPE])


def test_older_ardupilot_has_no_device_ids() -> None:
    """A log tells of each unit the parameters of its own slot."""
    loaded = {f"INS_GYR2OFFS_{axis}": 0.01 for axis in "XYZ"}
    own = constants(flown("ardupilot", None, loaded), Sensor.GYROSCOPE)
    export = AUTOPILOTS["ardupilot"](own, None)
    assert "INS_GYR2OFFS_X,0.02" in export.text
    assert "_ID" not in export.text
    assert any(told.startswith("INS_GYRn_ID stay as they are") for told in export.warnings)
    both = {**loaded, **{f"INS_GYROFFS_{axis}": 0.01 for axis in "XYZ"}}
    with pytest.raises(FieldcalError, match="there is not one device"):
        AUTOPILOTS["ardupilot"](constants(flown("ardupilot", None, both), Sensor.GYROSCOPE), None)


def test_parameters_that_are_given_are_what_is_loaded_now() -> None:
    """The log's own tell how the raw sensor is mounted; its slot may be another one since."""
    own = constants(flown("px4", 9, {"CAL_GYRO0_ID": 9.0}), Sensor.GYROSCOPE)
    assert "CAL_GYRO1_XOFF" in px4(own, parameters={"CAL_GYRO0_ID": 4.0, "CAL_GYRO1_ID": 9.0})


def test_a_log_of_another_autopilot_needs_a_statement() -> None:
    own = constants(flown("ardupilot", 9, {"INS_GYR_ID": 9.0}), Sensor.GYROSCOPE)
    for request in ({}, {"parameters": {"CAL_GYRO0_ID": 9.0}}):
        with pytest.raises(FieldcalError, match="one of another autopilot than PX4"):
            px4(own, **request)
    np.testing.assert_allclose(of(px4(own, logged_raw=True), "CAL_GYRO0_", "OFF"), ZERO[Sensor.GYROSCOPE])


@pytest.mark.parametrize(
    ("sensor", "ids", "beyond"),
    [
        (Sensor.GYROSCOPE, ["INS_GYR_ID", "INS_GYR2_ID", "INS_GYR3_ID", "INS4_GYR_ID", "INS5_GYR_ID"], "INS6_GYR_ID"),
        (
            Sensor.ACCELEROMETER,
            ["INS_ACC_ID", "INS_ACC2_ID", "INS_ACC3_ID", "INS4_ACC_ID", "INS5_ACC_ID"],
            "INS6_ACC_ID",
        ),
        (Sensor.MAGNETOMETER, ["COMPASS_DEV_ID", "COMPASS_DEV_ID2", "COMPASS_DEV_ID3"], "COMPASS_DEV_ID4"),
    ],
)
def test_ardupilot_has_five_inertial_slots_and_three_of_compasses(sensor: Sensor, ids: list[str], beyond: str) -> None:
    """COMPASS_DEV_ID4 and on tell of further compasses that were found: they have no calibration."""
    parameters = {name: 100.0 + i for i, name in enumerate([*ids, beyond])}
    assert ArduPilot().devices(sensor, parameters) == {i: 100 + i for i in range(len(ids))}
    assert ArduPilot().slot(sensor, 100 + len(ids), parameters) is None


@pytest.mark.parametrize(
    ("others", "wanted"),
    [({}, 2), ({2: 9.0}, 0), ({2: 9.0, 0: 8.0}, 1), ({1: 7.0}, 1), ({0: 5.0, 1: 6.0, 2: 8.0, 3: 9.0}, None)],
)
def test_a_thermal_slot_of_px4_is_the_devices_else_a_free_one(others: dict[int, float], wanted: int | None) -> None:
    """Device 7 is calibrated in slot 2; PX4 finds a thermal slot by its ID, which must be nobody else's."""
    parameters = {"CAL_ACC2_ID": 7.0, "TC_A_ENABLE": 0.0, **{f"TC_A{slot}_ID": n for slot, n in others.items()}}
    assert thermal_slot(Sensor.ACCELEROMETER, 7, parameters) == wanted
    del parameters["TC_A_ENABLE"]
    assert thermal_slot(Sensor.ACCELEROMETER, 7, parameters) == (1 if 7.0 in others.values() else None)


@pytest.mark.parametrize("device_id", [1, 2**31 - 1, 2**31, 2**32 - 1])
def test_a_device_id_is_written_as_a_parameter_of_32_bits_holds_it(device_id: int) -> None:
    assert signed(device_id) == np.array(device_id, np.uint32).view(np.int32)


@pytest.mark.parametrize(
    ("sensor", "zero", "scale"),
    [
        (Sensor.GYROSCOPE, "INS_GYR2OFFS_Z", None),
        (Sensor.ACCELEROMETER, "INS_ACC2OFFS_Z", "INS_ACC2SCAL_Z"),
        (Sensor.MAGNETOMETER, "COMPASS_OFS2_Z", "COMPASS_DIA2_Z"),
    ],
)
def test_ardupilots_parameter_of_a_constant(sensor: Sensor, zero: str, scale: str | None) -> None:
    assert ArduPilot().parameter(sensor, 1, "zero", 2) == zero
    assert ArduPilot().parameter(sensor, 1, "scale", 2) == scale


QGROUNDCONTROL = """# Onboard parameters for Vehicle 1
#
# Vehicle-Id Component-Id Name Value Type
1\t1\tCAL_ACC0_ID\t1310988\t6
1\t1\tCAL_ACC0_XOFF\t-0.0123000005\t9
1\t51\tCAL_ACC0_XOFF\t7\t9
"""
MISSION_PLANNER = "#NOTE: 5/4/2026 Copter\nINS_ACC_ID,2753028\nINS_ACCOFFS_X,1.5e-2\n"
MAVPROXY = "INS_ACC_ID       2753028\nINS_ACCOFFS_X    0.015000  # by hand\n\n"


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (QGROUNDCONTROL, {"CAL_ACC0_ID": 1310988.0, "CAL_ACC0_XOFF": -0.0123000005}),
        (MISSION_PLANNER, {"INS_ACC_ID": 2753028.0, "INS_ACCOFFS_X": 0.015}),
        (MAVPROXY, {"INS_ACC_ID": 2753028.0, "INS_ACCOFFS_X": 0.015}),
        ("\ufeffA,1\r\nB,2\r\n", {"A": 1.0, "B": 2.0}),
    ],
)
def test_parameters_as_ground_stations_save_them(text: str, wanted: dict[str, float], tmp_path: Path) -> None:
    path = tmp_path / "x.params"
    path.write_text(text, encoding="utf-8", newline="")
    assert read_parameters(path) == wanted


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "holds no parameters"),
        ("# only\n", "holds no parameters"),
        ("A,1\nB\n", "line 2: 'B'"),
        ("A,x\n", "line 1"),
    ],
)
def test_a_file_of_something_else_is_refused(text: str, part: str, tmp_path: Path) -> None:
    path = tmp_path / "x.params"
    path.write_text(text)
    with pytest.raises(FieldcalError, match=part) as caught:
        read_parameters(path)
    assert caught.value.reason_code == "wrong_option"
    path.write_bytes(b"\xff\xfe\x00A")
    with pytest.raises(FieldcalError, match="is no text"):
        read_parameters(path)
    with pytest.raises(FieldcalError, match="no file of parameters"):
        read_parameters(tmp_path / "none")


def test_options_for_autopilots_are_for_those(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export", "v", "--logged-raw", "--warehouse", str(tmp_path)]) == 2
    assert "for px4 and ardupilot" in capsys.readouterr().err
