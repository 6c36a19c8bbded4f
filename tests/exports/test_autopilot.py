"""What PX4 and ArduPilot share: constants brought to an autopilot's units say the same of the same readings, and every
warning stands where it is due and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.constants

from fieldcal.exports.ardupilot import ardupilot
from fieldcal.exports.autopilot import in_autopilot_units, not_held, symmetric, thermal
from fieldcal.exports.calibration import Constants, Triad
from fieldcal.exports.px4 import px4
from fieldcal.names import Sensor

AT = 20.0
IN_AUTOPILOT_UNITS = {
    (Sensor.GYROSCOPE, "rad/s"): 1.0,
    (Sensor.GYROSCOPE, "deg/s"): np.deg2rad(1.0),
    (Sensor.ACCELEROMETER, "m/s^2"): 1.0,
    (Sensor.ACCELEROMETER, "g"): scipy.constants.g,
    (Sensor.MAGNETOMETER, "T"): 1e4,
    (Sensor.MAGNETOMETER, "uT"): 1e4 * scipy.constants.micro,
    (Sensor.MAGNETOMETER, "G"): 1.0,
}
"""rad/s, m/s² and gauss in one of the unit: SciPy's and the definition of the gauss."""


def triad(unit: str = "1", logged_unit: str = "1", **changes: object) -> Triad:
    """Perfect axes, and no temperature but for what is changed."""
    perfect = Triad(
        scale=np.eye(3),
        zero=np.zeros(3),
        scale_per_degc=np.zeros((3, 3)),
        zero_per_degc=np.zeros(3),
        scale_sd=np.full(3, 1e-3),
        zero_sd=np.full(3, 1e-3),
        unit=unit,
        logged_unit=logged_unit,
        temperature_degc=AT,
        flown_degc=None,
        why=(),
    )
    return replace(perfect, **changes)


def si(sensor: Sensor, **changes: object) -> Triad:
    """The same in the units that need no conversion."""
    unit = {Sensor.GYROSCOPE: "rad/s", Sensor.ACCELEROMETER: "m/s^2", Sensor.MAGNETOMETER: "G"}[sensor]
    return triad(unit, unit, **changes)


def constants(**triads: Triad) -> Constants:
    return Constants("v", "i", {Sensor(name): t for name, t in triads.items()}, "")


@pytest.mark.parametrize("magnetic_unit", [1.0, 1e-3])
@pytest.mark.parametrize(
    ("sensor", "logged_unit", "unit"),
    [(sensor, one, other) for sensor, one in IN_AUTOPILOT_UNITS for of, other in IN_AUTOPILOT_UNITS if of == sensor],
)
def test_units_are_converted_before_or_after(sensor: Sensor, logged_unit: str, unit: str, magnetic_unit: float) -> None:
    """Calibrating and then converting is converting and then calibrating, at every temperature."""
    rng = np.random.default_rng(5)
    of, to = (
        IN_AUTOPILOT_UNITS[sensor, u] / (magnetic_unit if sensor == Sensor.MAGNETOMETER else 1.0)
        for u in (logged_unit, unit)
    )
    given = triad(
        unit,
        logged_unit,
        scale=np.eye(3) + 0.1 * rng.normal(size=(3, 3)),
        zero=rng.normal(size=3),
        scale_per_degc=0.01 * rng.normal(size=(3, 3)),
        zero_per_degc=0.1 * rng.normal(size=3),
        zero_per_degc2=0.01 * rng.normal(size=3),
        zero_per_degc3=0.001 * rng.normal(size=3),
    )
    raw, warm = rng.normal(size=(50, 3)), rng.uniform(-10.0, 50.0, 50)
    triads, warnings = in_autopilot_units(constants(**{sensor: given}), magnetic_unit)
    np.testing.assert_allclose(triads[sensor].apply(raw * of, warm), given.apply(raw, warm) * to, rtol=1e-9, atol=0)
    assert warnings == []


@pytest.mark.parametrize("least", [0.0, -1e-6])
def test_an_axis_without_positive_scale_is_left_out(least: float) -> None:
    dead = si(Sensor.ACCELEROMETER, scale=np.diag([1.0, 1.0, least]))
    triads, (warning,) = in_autopilot_units(constants(accelerometer=dead), 1.0)
    assert triads == {}
    assert "negative scale" in warning


def test_the_gyroscopes_worst_scale_is_told_in_per_cent() -> None:
    scale = np.diag([1.004, 0.9625, 1.0])
    (warning,) = not_held({Sensor.GYROSCOPE: si(Sensor.GYROSCOPE, scale=scale)}, "PX4")
    assert "wrong by up to 3.75 %" in warning


def test_nothing_is_told_of_what_is_held() -> None:
    triads = {sensor: si(sensor) for sensor in (Sensor.ACCELEROMETER, Sensor.MAGNETOMETER)}
    assert not_held(triads, "PX4") == []
    one = np.array([0.0, 1e-3, 0.0])
    triads[Sensor.ACCELEROMETER] = si(Sensor.ACCELEROMETER, zero_per_degc=one)
    assert not_held(triads, "PX4") == []
    triads[Sensor.MAGNETOMETER] = si(Sensor.MAGNETOMETER, zero_per_degc=one)
    (warning,) = not_held(triads, "PX4")
    assert warning.startswith("magnetometer: PX4 does not correct it for temperature; offsets are those at 20 °C")


@pytest.mark.parametrize("sensor", [Sensor.ACCELEROMETER, Sensor.MAGNETOMETER])
def test_a_slope_of_one_axis_scale_is_told(sensor: Sensor) -> None:
    sloped = si(sensor, scale_per_degc=np.diag([0.0, 1e-4, 0.0]))
    (warning,) = not_held({sensor: sloped}, "PX4")
    assert warning == f"{sensor}: PX4 has no slope of the scale on temperature; it is that at 20 °C."
    gyroscope = si(Sensor.GYROSCOPE, scale_per_degc=np.diag([0.0, 1e-4, 0.0]))
    (warning,) = not_held({Sensor.GYROSCOPE: gyroscope}, "PX4")
    assert "no gyroscope scale" in warning


@pytest.mark.parametrize("size", [1.0, 1e3])
@pytest.mark.parametrize(("off", "told"), [(0.0, False), (1.9e-9, False), (2e-9, False), (2.1e-9, True), (0.1, True)])
def test_halves_that_differ_beyond_rounding_are_told(size: float, off: float, told: bool) -> None:
    """The mean differs from either half by half of `off`; a billionth of the largest entry is rounding."""
    scale = size * np.eye(3)
    scale[0, 1] = size * off
    matrix, warnings = symmetric(si(Sensor.MAGNETOMETER, scale=scale), "PX4")
    assert bool(warnings) == told
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_allclose(matrix[0, 1] + matrix[1, 0], size * off)


def test_a_single_bend_of_a_single_axis_is_worth_a_table() -> None:
    flown = (-5.0, 45.0)
    assert not thermal(si(Sensor.GYROSCOPE, flown_degc=flown))
    for term in ("zero_per_degc", "zero_per_degc2", "zero_per_degc3"):
        for axis in np.eye(3):
            bent = si(Sensor.GYROSCOPE, flown_degc=flown, **{term: 1e-3 * axis})
            assert thermal(bent)
            assert not thermal(replace(bent, flown_degc=None))


def warm_accelerometer(low: float, high: float) -> Constants:
    return constants(
        accelerometer=si(Sensor.ACCELEROMETER, flown_degc=(low, high), zero_per_degc=np.array([1e-3, 0.0, 0.0]))
    )


def px4_rows(c: Constants) -> dict[str, tuple[str, str]]:
    rows = [line.split("\t") for line in px4(c).text.splitlines() if not line.startswith("#")]
    return {row[2]: (row[3], row[4]) for row in rows}


def ardupilot_rows(c: Constants) -> dict[str, str]:
    return dict(line.split(",") for line in ardupilot(c).text.splitlines() if not line.startswith("#"))


def test_px4_says_the_type_as_mavlink_numbers_it() -> None:
    """MAV_PARAM_TYPE of MAVLink's common.xml: INT32 is 6, REAL32 is 9; ENABLE is a switch, 0 or 1."""
    rows = px4_rows(warm_accelerometer(-5.0, 45.0))
    assert rows.pop("TC_A_ENABLE") == ("1", "6")
    assert {kind for _, kind in rows.values()} == {"9"}


@pytest.mark.parametrize(("low", "high"), [(-5.0, 45.0), (25.0, 45.0), (-5.0, 15.0)])
def test_the_range_covers_the_temperature_of_the_constants(low: float, high: float) -> None:
    """Both firmwares clip the temperature to the range before they evaluate the cubic."""
    c = warm_accelerometer(low, high)
    p, a = px4_rows(c), ardupilot_rows(c)
    wanted = (min(low, AT), max(high, AT))
    assert (float(p["TC_A0_TMIN"][0]), float(p["TC_A0_TMAX"][0])) == wanted
    assert (float(a["INS_TCAL1_TMIN"]), float(a["INS_TCAL1_TMAX"])) == wanted
    assert a["INS_TCAL1_ENABLE"] == "1"


def test_the_range_covers_that_of_both_sensors() -> None:
    slope = np.array([1e-3, 0.0, 0.0])
    for one, other in (((-5.0, 30.0), (10.0, 45.0)), ((10.0, 45.0), (-5.0, 30.0))):
        a = ardupilot_rows(
            constants(
                accelerometer=si(Sensor.ACCELEROMETER, flown_degc=one, zero_per_degc=slope),
                gyroscope=si(Sensor.GYROSCOPE, flown_degc=other, zero_per_degc=slope),
            )
        )
        assert (float(a["INS_TCAL1_TMIN"]), float(a["INS_TCAL1_TMAX"])) == (-5.0, 45.0)


@pytest.mark.parametrize(("high", "enough"), [(24.9, False), (25.0, True), (25.5, True)])
def test_ardupilot_wants_ten_degrees(high: float, enough: bool) -> None:
    """AP_InertialSensor_tempcal.h, TEMP_RANGE_MIN: 10 °C."""
    assert ("INS_TCAL1_ENABLE" in ardupilot_rows(warm_accelerometer(15.0, high))) == enough


def test_no_temperature_terms_without_slopes() -> None:
    flat = constants(accelerometer=si(Sensor.ACCELEROMETER, flown_degc=(-5.0, 45.0)))
    assert not any(name.startswith("TC_") for name in px4_rows(flat))
    assert not any("TCAL" in name for name in ardupilot_rows(flat))


def test_the_start_up_calibration_of_gyroscopes_is_told_with_a_gyroscope_only() -> None:
    assert not any("INS_GYR_CAL" in w for w in ardupilot(warm_accelerometer(-5.0, 45.0)).warnings)
    assert any("INS_GYR_CAL" in w for w in ardupilot(constants(gyroscope=si(Sensor.GYROSCOPE))).warnings)
