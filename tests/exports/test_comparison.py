"""What flies beside what is estimated: differences in units that one can picture, and whether they matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

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


def test_what_flies_has_its_compensation_of_temperature_in_it() -> None:
    loaded = {"CAL_GYRO0_ID": 1.0, "TC_G_ENABLE": 1.0, "TC_G1_ID": 1.0, "TC_G1_TREF": 20.0, "TC_G1_X1_0": 1e-3}
    loaded |= {"TC_G1_TMIN": 0.0, "TC_G1_TMAX": 50.0, "CAL_GYRO0_XOFF": 0.002}
    assert row(constants(Sensor.GYROSCOPE, "px4", loaded), "x", "zero").flies_with == pytest.approx(0.007)
    loaded = {"INS_GYR_ID": 1.0, "INS_GYROFFS_X": 0.002, "INS_GYROFFS_Y": 0.0, "INS_GYROFFS_Z": 0.0}
    loaded |= {"INS_TCAL1_ENABLE": 1.0, "INS_TCAL1_TMIN": 0.0, "INS_TCAL1_TMAX": 50.0, "INS_GYR1_CALTEMP": 20.0}
    c = constants(Sensor.GYROSCOPE, "ardupilot", {**loaded, "INS_TCAL1_GYR1_X": 1e3})
    assert row(c, "x", "zero").flies_with == pytest.approx(0.007)


@pytest.mark.parametrize(("sd", "matters"), [(1e-5, True), (0.0049, True), (0.0051, False), (np.nan, True)])
def test_a_difference_within_its_sd_does_not_matter(sd: float, matters: bool) -> None:
    c = constants(Sensor.GYROSCOPE, "px4", {"CAL_GYRO0_ID": 1.0}, zero=(0.01, 0.0, 0.0), sd=sd)
    assert row(c, "x", "zero").matters == matters


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


def test_without_parameters_there_is_nothing_to_compare_with() -> None:
    c = constants(Sensor.GYROSCOPE, "px4", {"CAL_GYRO0_ID": 1.0})
    own = replace(c, origins={Sensor.GYROSCOPE: Origin()})
    with pytest.raises(fieldcal.FieldcalError, match="give --params, a file of PX4's"):
        fieldcal.compare(own)
    with pytest.raises(fieldcal.FieldcalError, match="is not in its logs"):
        fieldcal.compare(own, logged_raw=True)
    for told in ({"CAL_GYRO0_ID": 1.0}, {"INS_GYR_ID": 1.0, **{f"INS_GYROFFS_{axis}": 0.1 for axis in "XYZ"}}):
        assert len(fieldcal.compare(own, parameters=told, logged_raw=True)) == 6
