"""ArduPilot's corrections against its formulas written out step by step, its orientations against MAVLink's names."""

from __future__ import annotations

import re
from math import radians

import numpy as np
import pytest
from dataflash_support import rows_of
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.rotmat import Matrix3

from fieldcal.logs.dataflash.applied import Temperatures, inertial_corrections, magnetometer_corrections
from fieldcal.logs.dataflash.corrections import Thermal
from fieldcal.logs.dataflash.orientation import ROLL_PITCH_YAW_DEG, orientation_matrix
from fieldcal.logs.dataflash.parameters import Parameters, compass_names, inertial_names
from fieldcal.logs.interface import Correction

NO_TEMPERATURE = Temperatures(np.empty(0, np.int64), np.empty(0))
RIGHT_ANGLES = {90, 180, 270}


def undone(logged: np.ndarray, correction: Correction, degc: float | None = None) -> np.ndarray:
    offset = np.array(correction.offset)
    if degc is not None and correction.temperature_degc is not None:
        offset = offset + np.array(correction.offset_per_degc) * (degc - correction.temperature_degc)
    return np.linalg.solve(np.array(correction.matrix), (logged - offset).T).T


def mavlink_matrix(roll: float, pitch: float, yaw: float) -> np.ndarray:
    matrix = Matrix3()
    matrix.from_euler(radians(roll), radians(pitch), radians(yaw))
    return np.array([[getattr(getattr(matrix, row), axis) for axis in "xyz"] for row in "abc"])


def test_orientations_are_those_of_mavlinks_names() -> None:
    checked = 0
    for number, entry in ardupilotmega.enums["MAV_SENSOR_ORIENTATION"].items():
        if number >= len(ROLL_PITCH_YAW_DEG):
            continue
        angles = {"ROLL": 0.0, "PITCH": 0.0, "YAW": 0.0}
        angles |= {axis: float(degrees) for axis, degrees in re.findall(r"(ROLL|PITCH|YAW)_(\d+)", entry.name)}
        expected = mavlink_matrix(angles["ROLL"], angles["PITCH"], angles["YAW"])
        found = orientation_matrix(number, lambda name: 0.0)
        assert found is not None
        # 38 is 68.8 and 293.3 degrees in ArduPilot's code, whole degrees in its name.
        assert np.allclose(found, expected, atol=0.02 if number == 38 else 1e-12), entry.name
        checked += 1
    assert checked == 41  # MAVLink has no names for 41 to 43


def test_orientation_38_is_the_matrix_of_the_firmware() -> None:
    firmware = [0.14303897231223747, 0.36877648650320383, -0.91844638134308709]
    found = orientation_matrix(38, lambda name: 0.0)
    assert found is not None
    assert np.allclose(found[0], firmware, atol=2e-4)


@pytest.mark.parametrize(
    ("number", "turned"),
    [  # as Vector3::rotate of the firmware writes them out, of (1, 2, 3)
        (41, (0.99254615 + 0.12186934 * 3, 2.0, -0.12186934 + 0.99254615 * 3)),
        (42, (1.0, 0.5**0.5 * (2 - 3), 0.5**0.5 * (2 + 3))),
        (43, (1.0, 0.5**0.5 * (2 + 3), 0.5**0.5 * (3 - 2))),
    ],
)
def test_orientations_that_mavlink_has_no_names_for(number: int, turned: tuple[float, float, float]) -> None:
    found = orientation_matrix(number, lambda name: 0.0)
    assert found is not None
    assert np.allclose(found @ [1.0, 2.0, 3.0], turned, atol=1e-7)


def test_custom_orientations_take_their_angles() -> None:
    angles = {"CUST_ROT1_ROLL": 10.0, "CUST_ROT1_PITCH": -20.0, "CUST_ROT1_YAW": 35.0}
    found = orientation_matrix(101, angles.__getitem__)
    assert found is not None
    assert np.allclose(found, mavlink_matrix(10.0, -20.0, 35.0), atol=1e-12)


@pytest.mark.parametrize("number", [-1, 44, 99, 103])
def test_a_number_that_is_no_orientation(number: int) -> None:
    assert orientation_matrix(number, lambda name: 0.0) is None
    parameters = Parameters.of({"AHRS_ORIENTATION": number, **dict.fromkeys(inertial_names("GYR", 0).offset, 0.0)})
    assert inertial_corrections("GYR", 0, parameters, 0, NO_TEMPERATURE) == ()


def random_parameters(kind: str, slot: int, generator: np.random.Generator) -> dict[str, float]:
    names = inertial_names(kind, slot)
    values = dict(zip(names.offset, generator.normal(0, 0.3, 3), strict=True))
    if names.scale:
        values |= dict(zip(names.scale, generator.uniform(0.95, 1.05, 3), strict=True))
    values |= {names.thermal_enable: 1.0, names.thermal_min_degc: 5.0, names.thermal_max_degc: 60.0}
    values |= {names.calibrated_degc: float(generator.uniform(20, 40))}
    for power, size in zip(names.thermal, (2e4, 300.0, 5.0), strict=True):
        values |= dict(zip(power, generator.normal(0, size, 3), strict=True))
    return values


@pytest.mark.parametrize("slot", range(5))
@pytest.mark.parametrize("kind", ["GYR", "ACC"])
def test_inertial_corrections_are_the_firmwares_steps(kind: str, slot: int) -> None:
    generator = np.random.default_rng(slot)
    names, values = inertial_names(kind, slot), random_parameters(kind, slot, generator)
    orientation = int(generator.integers(0, 44))
    raw, degc = generator.normal(0, 5, (50, 3)), 47.3
    coefficients = np.array([[values[name] for name in power] for power in names.thermal])

    def polynomial(temperature: float) -> np.ndarray:  # AP_InertialSensor_TCal::polynomial_eval
        d = temperature - 35.0
        return (coefficients[0] + (coefficients[1] + coefficients[2] * d) * d) * d * 1e-6

    logged = raw - polynomial(degc) + polynomial(values[names.calibrated_degc])
    logged = logged - np.array([values[name] for name in names.offset])
    if names.scale:
        logged = logged * np.array([values[name] for name in names.scale])
    logged = logged @ mavlink_matrix(*ROLL_PITCH_YAW_DEG[orientation]).T

    parameters = Parameters.of({"AHRS_ORIENTATION": orientation, **values})
    at = Temperatures(np.zeros(1, np.int64), np.array([degc]))
    (correction,) = inertial_corrections(kind, slot, parameters, 0, at)
    assert np.allclose(undone(logged, correction), raw, atol=1e-12)
    assert correction.temperature_degc == degc
    assert correction.parameters.items() >= values.items()


def test_firmware_before_3_3_turned_first() -> None:
    values = {"AHRS_ORIENTATION": 2.0}
    values |= dict(zip(inertial_names("ACC", 0).offset, (0.1, -0.2, 0.3), strict=True))
    values |= dict(zip(inertial_names("ACC", 0).scale or (), (1.01, 0.98, 1.03), strict=True))
    raw = np.random.default_rng(0).normal(0, 5, (20, 3))
    logged = raw @ mavlink_matrix(0, 0, 90).T * [1.01, 0.98, 1.03] - [0.1, -0.2, 0.3]
    (correction,) = inertial_corrections("ACC", 0, Parameters.of(values), 0, NO_TEMPERATURE, before_3_3=True)
    assert np.allclose(undone(logged, correction), raw, atol=1e-12)


def test_a_slope_is_that_of_the_thermal_offset_and_zero_beyond_its_limits() -> None:
    thermal = Thermal(np.random.default_rng(0).normal(0, 100, (3, 3)), 30.0, 10.0, 50.0)
    assert np.allclose(
        thermal.slope(42.0), (thermal.offset(42.0 + 1e-4) - thermal.offset(42.0 - 1e-4)) / 2e-4, rtol=1e-6
    )
    assert np.array_equal(thermal.slope(51.0), np.zeros(3))
    assert np.array_equal(thermal.offset(80.0), thermal.offset(50.0))
    assert np.array_equal(thermal.offset(30.0), np.zeros(3))


def test_while_it_warms_up_corrections_follow_within_half_a_percent_of_the_cubic() -> None:
    generator = np.random.default_rng(3)
    values = random_parameters("ACC", 0, generator)
    t_ns, degc = np.arange(2000) * 10**8, np.linspace(20.0, 58.0, 2000)
    found = inertial_corrections("ACC", 0, Parameters.of(values), 0, Temperatures(t_ns, degc))
    assert 35 <= len(found) <= 39
    starts = np.array([correction.from_ns for correction in found])
    worst = 0.0
    for place in range(0, 2000, 7):
        held = found[int(np.searchsorted(starts, t_ns[place], "right")) - 1]
        (exact,) = inertial_corrections(
            "ACC", 0, Parameters.of(values), 0, Temperatures(t_ns[:1], degc[place : place + 1])
        )
        logged = np.array(exact.offset)  # of a raw reading of zero
        worst = max(worst, float(np.abs(undone(logged[None], held, degc[place])).max()))
    span = np.ptp([correction.offset for correction in found], axis=0).max()
    assert worst < 0.005 * span


@pytest.mark.parametrize("degc", [-20.0, 40.0, 90.0])
def test_a_thermal_range_that_is_not_told_is_the_firmwares(degc: float) -> None:
    """INS_TCALn_TMIN 0, INS_TCALn_TMAX 70 °C."""
    values, names = random_parameters("ACC", 1, np.random.default_rng(3)), inertial_names("ACC", 1)
    defaults = {names.thermal_min_degc: 0.0, names.thermal_max_degc: 70.0}
    untold = {name: value for name, value in values.items() if name not in defaults}
    warm = Temperatures(np.zeros(1, np.int64), np.array([degc]))
    found, wanted = (inertial_corrections("ACC", 1, Parameters.of(p), 0, warm)[0] for p in (untold, values | defaults))
    assert (found.offset, found.offset_per_degc) == (wanted.offset, wanted.offset_per_degc)


def test_without_thermal_enable_temperature_does_not_count() -> None:
    values = random_parameters("GYR", 0, np.random.default_rng(1)) | {"INS_TCAL1_ENABLE": 0.0}
    warm = Temperatures(np.arange(100) * 10**9, np.linspace(20, 60, 100))
    (correction,) = inertial_corrections("GYR", 0, Parameters.of(values), 0, warm)
    assert correction.offset == tuple(-values[name] for name in inertial_names("GYR", 0).offset)
    assert correction.temperature_degc is None


@pytest.mark.parametrize("slot", range(3))
@pytest.mark.parametrize(("scale", "applied"), [(0.0, 1.0), (1.2, 1.2), (1.6, 1.0)])
def test_magnetometer_corrections_are_the_firmwares_steps(slot: int, scale: float, applied: float) -> None:
    generator = np.random.default_rng(slot)
    names = compass_names(slot)
    values = {names.external: 1.0, names.orientation: 6.0, names.scale: scale, "AHRS_ORIENTATION": 4.0}
    values |= dict(zip(names.offset, generator.normal(0, 200, 3), strict=True))
    values |= dict(zip(names.diagonal, generator.uniform(0.9, 1.1, 3), strict=True))
    values |= dict(zip(names.off_diagonal, generator.normal(0, 0.05, 3), strict=True))
    raw = generator.normal(0, 0.4, (50, 3))
    (dx, dy, dz), (xy, xz, yz) = ([values[n] for n in triad] for triad in (names.diagonal, names.off_diagonal))
    milligauss = raw * 1e3 @ mavlink_matrix(0, 0, 270).T + [values[n] for n in names.offset]
    logged = milligauss * applied @ np.array([[dx, xy, xz], [xy, dy, yz], [xz, yz, dz]]).T * 1e-3
    (correction,) = magnetometer_corrections(slot, Parameters.of(values), np.zeros(1, np.int64), None)
    assert np.allclose(undone(logged, correction), raw, atol=1e-12)


def test_an_internal_magnetometer_turns_with_the_board_and_a_diagonal_of_zeros_is_one() -> None:
    values = {"AHRS_ORIENTATION": 4.0, "COMPASS_ORIENT": 6.0, **dict.fromkeys(compass_names(0).offset, 0.0)}
    (correction,) = magnetometer_corrections(0, Parameters.of(values), np.zeros(1, np.int64), None)
    assert np.allclose(correction.matrix, np.diag([-1.0, -1.0, 1.0]))


def test_offsets_learned_in_flight_count_where_the_parameters_lag() -> None:
    parameters = Parameters.of(dict(zip(compass_names(0).offset, (10.6, 20.4, -30.9), strict=True)))
    t_ns = np.arange(6) * 10**8
    cut = np.array([[10.0, 20.0, -30.0]] * 3 + [[14.0, 20.0, -30.0]] * 3)
    found = magnetometer_corrections(0, parameters, t_ns, cut)
    assert [correction.from_ns for correction in found] == [0, 3 * 10**8]
    assert np.allclose(
        [correction.offset for correction in found], np.array([[10.6, 20.4, -30.9], [14, 20, -30]]) * 1e-3
    )


def test_names_of_slots() -> None:
    assert inertial_names("GYR", 0).offset[0] == "INS_GYROFFS_X"
    assert inertial_names("GYR", 1).offset[1] == "INS_GYR2OFFS_Y"
    assert inertial_names("ACC", 2).scale == ("INS_ACC3SCAL_X", "INS_ACC3SCAL_Y", "INS_ACC3SCAL_Z")
    assert inertial_names("ACC", 3).offset[2] == "INS4_ACCOFFS_Z"
    assert [inertial_names("GYR", slot).device_id for slot in (0, 1, 4)] == ["INS_GYR_ID", "INS_GYR2_ID", "INS5_GYR_ID"]
    assert inertial_names("ACC", 0).calibrated_degc == "INS_ACC1_CALTEMP"
    assert inertial_names("ACC", 1).thermal[2][0] == "INS_TCAL2_ACC3_X"
    assert [compass_names(slot).external for slot in (0, 1)] == ["COMPASS_EXTERNAL", "COMPASS_EXTERN2"]
    assert compass_names(2).off_diagonal == ("COMPASS_ODI3_X", "COMPASS_ODI3_Y", "COMPASS_ODI3_Z")


def test_a_temperature_is_the_latest_and_a_step_is_more_than_a_degree() -> None:
    t_ns, degc = np.arange(10, 80, 10), np.array([20.0, 21.0, np.nan, 21.5, 21.75, 20.5, 20.25])
    assert Temperatures(t_ns, degc).steps() == [(10, 20.0), (40, 21.5), (70, 20.25)]
    at = Temperatures(np.array([10, 20, 30]), np.array([1.0, np.nan, 3.0])).at
    assert [at(t) for t in (5, 10, 29, 30, 99)] == [1.0, 1.0, 1.0, 3.0, 3.0]
    assert np.isnan(NO_TEMPERATURE.at(5))
    assert NO_TEMPERATURE.steps() == []


@pytest.mark.parametrize("kind", ["GYR", "ACC", "MAG"])
@pytest.mark.parametrize("missing", [None, 0, 1, 2])
def test_where_an_offset_is_missing_the_log_does_not_say(kind: str, missing: int | None) -> None:
    names = compass_names(0) if kind == "MAG" else inertial_names(kind, 0)
    parameters = Parameters.of({name: 0.0 for i, name in enumerate(names.offset) if i != missing})
    t_ns = np.array([5])
    found = (
        magnetometer_corrections(0, parameters, t_ns, None)
        if kind == "MAG"
        else inertial_corrections(kind, 0, parameters, 5, NO_TEMPERATURE)
    )
    assert [one.from_ns for one in found] == ([5] if missing is None else [])
    assert [np.array(one.matrix).tolist() for one in found] == [np.eye(3).tolist()] * len(found)


def test_offsets_in_the_messages_do_without_parameters() -> None:
    none, t_ns, logged = Parameters(None, ()), np.array([5]), np.array([[10.0, 20.0, 30.0]])
    (found,) = magnetometer_corrections(0, none, t_ns, logged)
    assert np.allclose(found.offset, [0.01, 0.02, 0.03], rtol=1e-15)
    assert magnetometer_corrections(0, none, t_ns[:0], logged[:0]) == ()
    assert magnetometer_corrections(0, Parameters.of(dict.fromkeys(compass_names(0).offset, 1.0)), t_ns[:0], None) == ()


@pytest.mark.parametrize(("stated", "offset"), [(10.0, 10.0), (10.9, 10.9), (11.0, 10.0), (9.1, 9.1), (9.0, 10.0)])
def test_a_parameter_counts_within_what_was_cut_off(stated: float, offset: float) -> None:
    """Of 10 in a message the parameter is between 9 and 11."""
    parameters = Parameters.of(dict.fromkeys(compass_names(0).offset, stated))
    (found,) = magnetometer_corrections(0, parameters, np.array([5]), np.full((1, 3), 10.0))
    assert np.allclose(found.offset, offset * 1e-3, rtol=1e-15)


def test_between_messages_the_last_ones_offsets_hold() -> None:
    x, y, z = compass_names(0).offset
    history = {"Name": [n.encode() for n in (x, y, z, "AHRS_ORIENTATION")] * 2, "Value": [0.0] * 7 + [4.0]}
    parameters = Parameters(rows_of("PARM", "Nf", history), [0] * 4 + [25] * 4)
    t_ns, logged = np.array([10, 20, 30]), np.array([[50.0, 0, 0], [60.0, 0, 0], [70.0, 0, 0]])
    found = magnetometer_corrections(0, parameters, t_ns, logged)
    assert [(one.from_ns, round(one.offset[0], 9)) for one in found] == [(10, 0.05), (20, 0.06), (25, 0.06), (30, 0.07)]
    assert [one.matrix[0][0] for one in found] == [1.0, 1.0, -1.0, -1.0]
