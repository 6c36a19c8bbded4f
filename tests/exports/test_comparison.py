"""What flies beside what is estimated: differences in units that one can picture, and whether they matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.constants
from scipy.spatial.transform import Rotation

import fieldcal
from fieldcal.config.loaded import Autopilot, Loaded
from fieldcal.exports.autopilots.comparison import COLUMNS, Compared, lines
from fieldcal.exports.calibration import NOT_TURNED, Constants, Origin, Triad
from fieldcal.names import Sensor

UNIT = {Sensor.GYROSCOPE: "rad/s", Sensor.ACCELEROMETER: "m/s^2", Sensor.MAGNETOMETER: "G"}
IDS = {Sensor.GYROSCOPE: 1, Sensor.ACCELEROMETER: 2, Sensor.MAGNETOMETER: 3}


def constants(
    sensor: Sensor,
    autopilot: Autopilot,
    parameters: dict[str, float],
    *,
    zero: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
    sd: float = 1e-6,
    field_g: float | None = 0.2,
) -> Constants:
    triad = Triad(
        scale=np.diag(scale),
        zero=np.array(zero),
        scale_per_degc=np.zeros((3, 3)),
        zero_per_degc=np.zeros(3),
        scale_sd=np.full(3, sd),
        zero_sd=np.full(3, sd),
        unit=UNIT[sensor],
        logged_unit=UNIT[sensor],
        temperature_degc=25.0,
        flown_degc=None,
        why=(),
    )
    origin = Origin(Loaded(autopilot, IDS[sensor], NOT_TURNED, parameters), horizontal_field_g=field_g)
    return Constants("v", "i", {sensor: triad}, "", {sensor: "b/1"}, {sensor: origin})


def row(c: Constants, axis: str, parameter: str) -> Compared:
    (found,) = [one for one in fieldcal.compare(c) if (one.axis, one.parameter) == (axis, parameter)]
    return found


def test_a_gyroscopes_zero_in_degrees_of_a_minute_and_its_scale_in_degrees_of_a_turn() -> None:
    loaded = {"CAL_GYRO0_ID": 1.0, "CAL_GYRO0_YOFF": 0.01}
    c = constants(Sensor.GYROSCOPE, "px4", loaded, zero=(0.0, 0.012, 0.0), scale=(1.0, 1.0, 1.02))
    y = row(c, "y", "zero")
    assert (y.name, y.flies_with, y.estimate, y.unit) == ("CAL_GYRO0_YOFF", 0.01, 0.012, "rad/s")
    assert (y.effect, y.effect_unit, y.matters) == (pytest.approx(np.rad2deg(0.002) * 60), "° in 60 s", True)
    z = row(c, "z", "scale")
    assert (z.name, z.effect, z.effect_unit, z.matters) == (None, pytest.approx(7.2), "° a turn", True)
    assert not row(c, "x", "zero").matters


def test_an_accelerometers_in_thousandths_of_gravity() -> None:
    loaded = {"CAL_ACC0_ID": 2.0, "CAL_ACC0_XOFF": 0.1, "CAL_ACC0_ZSCALE": 0.99}
    c = constants(Sensor.ACCELEROMETER, "px4", loaded)
    assert row(c, "x", "zero").effect == pytest.approx(100 / 9.80665)
    assert row(c, "z", "scale").effect == pytest.approx(10.0)
    assert (row(c, "z", "scale").name, row(c, "z", "scale").effect_unit) == ("CAL_ACC0_ZSCALE", "mg")


def test_a_magnetometers_in_degrees_of_heading() -> None:
    loaded = {"CAL_MAG0_ID": 3.0, "CAL_MAG0_XOFF": 0.05, "CAL_MAG0_YSCALE": 1.04}
    c = constants(Sensor.MAGNETOMETER, "px4", loaded)
    assert row(c, "x", "zero").effect == pytest.approx(np.rad2deg(np.arctan2(0.05, 0.2)))
    assert row(c, "y", "scale").effect == pytest.approx(np.rad2deg(0.02))
    unknown = constants(Sensor.MAGNETOMETER, "px4", loaded, field_g=None)
    assert (row(unknown, "x", "zero").effect, row(unknown, "x", "zero").matters) == (None, False)


def test_ardupilots_in_gauss_with_our_sign() -> None:
    loaded = {"COMPASS_DEV_ID": 3.0, "COMPASS_OFS_X": -50.0, "COMPASS_SCALE": 1.1, "COMPASS_DIA_X": 1.0}
    loaded |= {"COMPASS_DIA_Y": 1.0, "COMPASS_DIA_Z": 1.0}
    c = constants(Sensor.MAGNETOMETER, "ardupilot", loaded, zero=(0.03, 0.0, 0.0))
    x = row(c, "x", "zero")
    assert (x.name, x.unit) == ("COMPASS_OFS_X", "G")
    assert (x.flies_with, x.estimate) == (pytest.approx(0.05), pytest.approx(0.03))
    assert row(c, "x", "scale").flies_with == pytest.approx(1.1)
    assert row(c, "y", "zero").flies_with == 0.0  # what is not told has its default


def test_a_compass_that_is_turned_before_it_is_corrected_flies_with_its_parameters() -> None:
    """The axes of both are the body's, whatever COMPASS_ORIENT says of an external one (6: by 270°)."""
    loaded = {"COMPASS_DEV_ID": 3.0, "COMPASS_EXTERNAL": 1.0, "COMPASS_ORIENT": 6.0, "AHRS_ORIENTATION": 2.0}
    loaded |= {f"COMPASS_DIA_{axis}": value for axis, value in zip("XYZ", (1.1, 0.9, 1.05), strict=True)}
    loaded |= {f"COMPASS_OFS_{axis}": value for axis, value in zip("XYZ", (10.0, 20.0, -30.0), strict=True)}
    c = constants(Sensor.MAGNETOMETER, "ardupilot", loaded)
    assert [row(c, axis, "scale").flies_with for axis in "xyz"] == pytest.approx([1.1, 0.9, 1.05])
    assert [row(c, axis, "zero").flies_with for axis in "xyz"] == pytest.approx([-0.01, -0.02, 0.03])


def test_of_a_matrix_that_is_not_symmetric_what_can_be_loaded_is_compared() -> None:
    """A magnetometer's is the symmetric one with the same lengths; the others have a factor an axis."""
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    soft = np.array([[1.02, 0.01, -0.02], [0.01, 0.97, 0.03], [-0.02, 0.03, 1.01]])
    for sensor, name in ((Sensor.MAGNETOMETER, "CAL_MAG0_ID"), (Sensor.ACCELEROMETER, "CAL_ACC0_ID")):
        c = constants(sensor, "px4", {name: float(IDS[sensor])})
        c = replace(c, triads={sensor: replace(c.triads[sensor], scale=turn @ soft)})
        wanted = np.diagonal(soft if sensor == Sensor.MAGNETOMETER else turn @ soft)
        assert [row(c, axis, "scale").estimate for axis in "xyz"] == pytest.approx(list(wanted))


def test_what_flies_has_its_compensation_of_temperature_in_it() -> None:
    loaded = {"CAL_GYRO0_ID": 1.0, "TC_G_ENABLE": 1.0, "TC_G1_ID": 1.0, "TC_G1_TREF": 20.0, "TC_G1_X1_0": 1e-3}
    loaded |= {"TC_G1_TMIN": 0.0, "TC_G1_TMAX": 50.0, "CAL_GYRO0_XOFF": 0.002}
    assert row(constants(Sensor.GYROSCOPE, "px4", loaded), "x", "zero").flies_with == pytest.approx(0.007)
    loaded = {"INS_GYR_ID": 1.0, "INS_GYROFFS_X": 0.002, "INS_GYROFFS_Y": 0.0, "INS_GYROFFS_Z": 0.0}
    loaded |= {"INS_TCAL1_ENABLE": 1.0, "INS_TCAL1_TMIN": 0.0, "INS_TCAL1_TMAX": 50.0, "INS_GYR1_CALTEMP": 20.0}
    c = constants(Sensor.GYROSCOPE, "ardupilot", {**loaded, "INS_TCAL1_GYR1_X": 1e3})
    assert row(c, "x", "zero").flies_with == pytest.approx(0.007)


@pytest.mark.parametrize("loaded", [0.0, 0.3])
@pytest.mark.parametrize(("sd", "matters"), [(1e-5, True), (0.0049, True), (0.0051, False), (np.nan, True)])
def test_a_difference_within_its_sd_does_not_matter(sd: float, matters: bool, loaded: float) -> None:
    parameters = {"CAL_GYRO0_ID": 1.0, "CAL_GYRO0_XOFF": loaded}
    c = constants(Sensor.GYROSCOPE, "px4", parameters, zero=(loaded + 0.01, 0.0, 0.0), sd=sd)
    assert row(c, "x", "zero").matters == matters


@pytest.mark.parametrize(
    ("sensor", "parameter", "limit", "by_unit"),
    [
        (Sensor.GYROSCOPE, "zero", 5.0, np.deg2rad(1.0 / 60.0)),
        (Sensor.GYROSCOPE, "scale", 3.0, 1.0 / 360.0),
        (Sensor.ACCELEROMETER, "zero", 5.0, 1e-3 * scipy.constants.g),
        (Sensor.ACCELEROMETER, "scale", 5.0, 1e-3),
        (Sensor.MAGNETOMETER, "scale", 1.0, 2.0 * np.deg2rad(1.0)),
    ],
)
def test_what_is_worth_a_change(sensor: Sensor, parameter: str, limit: float, by_unit: float) -> None:
    """5° in a minute, 3° in a full turn, 5 mg, 1° of heading, as the guide on autopilots says."""
    name = {"gyroscope": "CAL_GYRO0_ID", "accelerometer": "CAL_ACC0_ID", "magnetometer": "CAL_MAG0_ID"}[sensor]
    for share in (0.99, 1.01):
        off = share * limit * by_unit
        own = {"zero": (off, 0.0, 0.0)} if parameter == "zero" else {"scale": (1.0 + off, 1.0, 1.0)}
        found = row(constants(sensor, "px4", {name: float(IDS[sensor])}, **own), "x", parameter)
        assert (found.effect, found.matters) == (pytest.approx(share * limit), share > 1.0)


def test_the_table_has_a_cell_a_column() -> None:
    c = constants(Sensor.GYROSCOPE, "px4", {"CAL_GYRO0_ID": 1.0}, zero=(0.01, 0.0, 0.0), sd=1e-3)
    table = lines(fieldcal.compare(c))
    assert {len(cells) for cells in table} == {len(COLUMNS)}
    assert table[0] == [
        "gyroscope",
        "x",
        "zero, rad/s",
        "0",
        "0.0100 ± 0.0010",
        "0.01",
        "34.4 ° in 60 s",
        "CAL_GYRO0_XOFF",
        "yes",
    ]


@pytest.mark.parametrize(("off", "shown"), [(-0.0123456, ("-0.0123", "42.4 ° in 60 s")), (1e-14, ("0", "0 ° in 60 s"))])
def test_a_difference_is_shown_with_three_digits_and_rounding_as_none(off: float, shown: tuple[str, str]) -> None:
    loaded = {"CAL_GYRO0_ID": 1.0, "CAL_GYRO0_XOFF": 0.5}
    cells = lines(fieldcal.compare(constants(Sensor.GYROSCOPE, "px4", loaded, zero=(0.5 + off, 0.0, 0.0))))[0]
    assert (cells[5].replace("−", "-"), cells[6]) == shown


def test_without_parameters_there_is_nothing_to_compare_with() -> None:
    c = constants(Sensor.GYROSCOPE, "px4", {"CAL_GYRO0_ID": 1.0})
    own = replace(c, origins={Sensor.GYROSCOPE: Origin()})
    with pytest.raises(fieldcal.FieldcalError, match="give --params, a file of PX4's"):
        fieldcal.compare(own)
    with pytest.raises(fieldcal.FieldcalError, match="is not in its logs"):
        fieldcal.compare(own, logged_raw=True)
    for told in ({"CAL_GYRO0_ID": 1.0}, {"INS_GYR_ID": 1.0, **{f"INS_GYROFFS_{axis}": 0.1 for axis in "XYZ"}}):
        assert len(fieldcal.compare(own, parameters=told, logged_raw=True)) == 6
