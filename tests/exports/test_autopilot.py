"""What PX4 and ArduPilot share: constants brought to an autopilot's units say the same of the same readings, and every
warning stands where it is due and nowhere else."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import autopilot_formulas as formulas
import numpy as np
import pytest
import scipy.constants
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fieldcal.config.loaded import Loaded
from fieldcal.errors import FieldcalError
from fieldcal.exports.autopilots.affine import angle_deg, rotation_and_symmetric
from fieldcal.exports.autopilots.ardupilot import ardupilot
from fieldcal.exports.autopilots.ardupilot_slot import thermal_block as ardupilot_block
from fieldcal.exports.autopilots.loading import Request
from fieldcal.exports.autopilots.px4 import px4
from fieldcal.exports.autopilots.px4_slot import thermal_block as px4_block
from fieldcal.exports.autopilots.thermal import Curve, curve_to_load
from fieldcal.exports.autopilots.units import dropped_rotation, in_autopilot_units, not_held
from fieldcal.exports.calibration import NOT_TURNED, Constants, Export, Origin, Triad
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


IDS = {Sensor.GYROSCOPE: 21, Sensor.ACCELEROMETER: 22, Sensor.MAGNETOMETER: 3_000_000_000}
"""Device ids; the last is negative in 32 bits."""
CALIBRATED = {
    "px4": {
        "CAL_GYRO0_ID": 21.0,
        "CAL_ACC0_ID": 22.0,
        "CAL_MAG0_ID": 3e9 - 2.0**32,
        "TC_G_ENABLE": 0.0,
        "TC_A_ENABLE": 0.0,
        "TC_M_ENABLE": 0.0,
    },
    "ardupilot": {"INS_GYR_ID": 21.0, "INS_ACC_ID": 22.0, "COMPASS_DEV_ID": 3e9, "COMPASS_SCALE": 1.0},
}


def constants(autopilot: str | None = None, more: dict[str, float] | None = None, **triads: Triad) -> Constants:
    """From logs of an autopilot with these parameters; of no known origin without one."""
    found = {Sensor(name): t for name, t in triads.items()}
    origins = {}
    if autopilot is not None:
        parameters = {**CALIBRATED[autopilot], **(more or {})}
        origins = {
            s: Origin(Loaded("px4" if autopilot == "px4" else "ardupilot", IDS[s], NOT_TURNED, parameters))
            for s in found
        }
    return Constants("v", "i", found, "", origins=origins)


@pytest.mark.parametrize("magnetic_unit", [1.0, 1e-3])
@pytest.mark.parametrize(
    ("sensor", "logged_unit", "unit"),
    [(sensor, one, other) for sensor, one in IN_AUTOPILOT_UNITS for of, other in IN_AUTOPILOT_UNITS if of == sensor],
)
def test_units_are_converted_before_or_after(sensor: Sensor, logged_unit: str, unit: str, magnetic_unit: float) -> None:
    """Calibrating and then converting is converting and then calibrating, at every temperature; shares of sd stay."""
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
        scale_sd=rng.uniform(0.1, 1.0, 3),
        zero_sd=rng.uniform(0.1, 1.0, 3),
        zero_per_degc_sd=rng.uniform(0.1, 1.0, 3),
    )
    raw, warm = rng.normal(size=(50, 3)), rng.uniform(-10.0, 50.0, 50)
    found = in_autopilot_units(sensor, given, magnetic_unit)
    assert isinstance(found, Triad)
    np.testing.assert_allclose(found.apply(raw * of, warm), given.apply(raw, warm) * to, rtol=1e-9, atol=0)
    np.testing.assert_allclose(found.scale_sd * np.diagonal(given.scale), given.scale_sd * np.diagonal(found.scale))
    np.testing.assert_allclose(found.zero_sd * given.zero, given.zero_sd * found.zero)
    np.testing.assert_allclose(
        found.zero_per_degc_sd * given.zero_per_degc, given.zero_per_degc_sd * found.zero_per_degc
    )


@pytest.mark.parametrize(("logged_unit", "unit", "named"), [("counts", "G", "counts"), ("G", "norm", "norm")])
def test_a_unit_that_no_autopilot_has_is_named(logged_unit: str, unit: str, named: str) -> None:
    why = in_autopilot_units(Sensor.MAGNETOMETER, triad(unit, logged_unit), 1.0)
    assert isinstance(why, str)
    assert why.startswith(f"Its constants are in {named};")


@pytest.mark.parametrize("write", [px4, ardupilot])
@pytest.mark.parametrize("least", [0.0, -1e-6])
def test_an_axis_without_positive_scale_is_left_out(write: Callable[..., Export], least: float) -> None:
    dead = si(Sensor.ACCELEROMETER, scale=np.diag([1.0, 1.0, least]))
    with pytest.raises(FieldcalError, match="negative scale") as caught:
        write(constants(write.__name__, accelerometer=dead))
    assert caught.value.reason_code == "not_loadable"
    export = write(constants(write.__name__, accelerometer=dead, gyroscope=si(Sensor.GYROSCOPE)))
    assert "ACCSCAL" not in export.text
    assert "CAL_ACC" not in export.text
    assert any("accelerometer: left out." in told for told in export.warnings)


def test_the_gyroscopes_worst_scale_is_told_in_per_cent() -> None:
    scale = np.diag([1.004, 0.9625, 1.0])
    (told,) = not_held(Sensor.GYROSCOPE, si(Sensor.GYROSCOPE, scale=scale), "PX4")
    assert "wrong by up to 3.75 %" in told


@pytest.mark.parametrize("sensor", [Sensor.GYROSCOPE, Sensor.ACCELEROMETER])
def test_cross_axis_terms_are_told_with_their_size(sensor: Sensor) -> None:
    scale = np.eye(3)
    scale[0, 2], scale[1, 0] = -0.0125, 0.01
    assert any("those of up to 1.25 % are left out" in told for told in not_held(sensor, si(sensor, scale=scale), "X"))
    rounded = np.eye(3) + 1e-12
    assert not any("cross-axis" in told for told in not_held(sensor, si(sensor, scale=rounded), "X"))


def test_nothing_is_told_of_what_is_held() -> None:
    for sensor in (Sensor.ACCELEROMETER, Sensor.MAGNETOMETER):
        assert not_held(sensor, si(sensor), "PX4") == []
    one = np.array([0.0, 1e-3, 0.0])
    assert not_held(Sensor.ACCELEROMETER, si(Sensor.ACCELEROMETER, zero_per_degc=one), "PX4") == []


@pytest.mark.parametrize("sensor", [Sensor.ACCELEROMETER, Sensor.MAGNETOMETER])
def test_a_slope_of_one_axis_scale_is_told(sensor: Sensor) -> None:
    sloped = si(sensor, scale_per_degc=np.diag([0.0, 1e-4, 0.0]))
    (told,) = not_held(sensor, sloped, "PX4")
    assert told == (
        f"{sensor}: PX4 has no slope of the scale on temperature (up to 0.01 % per °C); it is that at 20 °C."
    )


@pytest.mark.parametrize(("angle", "told"), [(0.0, False), (0.9e-6, False), (1.05e-6, True), (3.0, True)])
def test_the_nearest_symmetric_matrix_keeps_lengths_and_the_rotation_is_told(angle: float, told: bool) -> None:
    turn = Rotation.from_rotvec([0.0, np.deg2rad(angle), 0.0]).as_matrix()
    soft = np.array([[1.02, 0.01, -0.02], [0.01, 0.97, 0.03], [-0.02, 0.03, 1.01]])
    found, symmetric = rotation_and_symmetric(turn @ soft)
    np.testing.assert_allclose(symmetric, soft, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, turn, rtol=0, atol=1e-12)
    assert angle_deg(found) == pytest.approx(angle, abs=1e-9)
    assert bool(dropped_rotation("magnetometer", found, "PX4")) == told


def warm(**changes: ArrayLike) -> Triad:
    arrays = {name: np.asarray(value, dtype=float) for name, value in changes.items()}
    return si(Sensor.ACCELEROMETER, flown_degc=(-5.0, 45.0), **arrays)


def test_a_single_bend_of_a_single_axis_is_worth_a_table() -> None:
    assert curve_to_load(warm(), None, AT) is None
    for term in ("zero_per_degc", "zero_per_degc2", "zero_per_degc3"):
        for axis in np.eye(3):
            bent = warm(**{term: 1e-3 * axis})
            found = curve_to_load(bent, None, 33.0)
            assert found is not None
            for degc in (-5.0, 10.0, 45.0):
                d = degc - AT
                wanted = bent.zero_per_degc * d + bent.zero_per_degc2 * d**2 + bent.zero_per_degc3 * d**3
                np.testing.assert_allclose(found.at(degc) - found.at(AT), wanted, rtol=0, atol=1e-12)
            assert curve_to_load(replace(bent, flown_degc=None), None, AT) is None


def test_a_slope_counts_where_it_differs_from_what_is_loaded_by_its_sd() -> None:
    slope, sd = [1e-3, 2e-3, 3e-3], [0.9e-3, 2.1e-3, np.inf]
    found = curve_to_load(warm(zero_per_degc=slope, zero_per_degc_sd=sd), None, AT)
    assert found is not None
    np.testing.assert_allclose(found.coefficients[0], [1e-3, 0.0, 0.0])
    there = Curve(AT, -10.0, 60.0, np.array([[1e-4, 1e-4, 5e-3], [0.0] * 3, [0.0] * 3]), np.zeros(3))
    # The first is 0.9 mm/s² per °C from what is loaded.
    assert curve_to_load(warm(zero_per_degc=slope, zero_per_degc_sd=[0.91e-3, 2.1e-3, np.inf]), there, AT) is None
    found = curve_to_load(warm(zero_per_degc=slope, zero_per_degc_sd=[0.8e-3, 2.1e-3, np.inf]), there, AT)
    assert found is not None
    np.testing.assert_allclose(found.coefficients[0], [1e-3, 1e-4, 5e-3])
    assert (found.low_degc, found.high_degc) == (-10.0, 60.0)


def test_a_straight_history_does_not_replace_a_bend_that_is_loaded() -> None:
    bend = np.array([[1e-3] * 3, [1e-5, 0.0, 0.0], [0.0] * 3])
    there = Curve(AT, -10.0, 60.0, bend, np.zeros(3))
    found = curve_to_load(warm(zero_per_degc=[5e-3] * 3, zero_per_degc_sd=[1e-4] * 3), there, AT)
    assert found is not None
    np.testing.assert_allclose(found.coefficients, [[1e-3, 5e-3, 5e-3], [1e-5, 0.0, 0.0], [0.0] * 3])
    assert curve_to_load(warm(zero_per_degc=bend[0], zero_per_degc2=bend[1]), there, AT) is None


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("degc", [-20.0, 12.0, 50.0, 120.0])
def test_a_block_is_the_firmwares_curve_with_its_own_range_or_the_default(degc: float, given: bool) -> None:
    """Defaults: INS_TCAL1_TMIN 0 and _TMAX 70; TC_A0_TREF 25, _TMIN 0 and _TMAX 100, coefficients 0."""
    axes = tuple(zip("XYZ", (3.0, -2.0, 1.0), strict=True))
    p = {"INS_TCAL1_ENABLE": 1.0, "INS_ACC1_CALTEMP": 20.0}
    p |= {f"INS_TCAL1_ACC{order}_{axis}": 1e3 * value / order**6 for order in (1, 2, 3) for axis, value in axes}
    told = {"INS_TCAL1_TMIN": 5.0, "INS_TCAL1_TMAX": 45.0} if given else {}
    curve = ardupilot_block(Sensor.ACCELEROMETER, 0, p | told)
    assert curve is not None
    defaults = {"INS_TCAL1_TMIN": 0.0, "INS_TCAL1_TMAX": 70.0}
    wanted = formulas.ardupilot_thermal("ACC", 0, defaults | p | told, np.array([degc]))
    np.testing.assert_allclose(curve.at(degc) - curve.at(20.0), wanted[0], rtol=1e-9)

    p = {"TC_A_ENABLE": 1.0, "TC_A0_ID": 22.0}
    p |= {f"TC_A0_X{order}_{i}": value / 10.0**order for order in range(4) for i, (_, value) in enumerate(axes)}
    none = dict.fromkeys(("TC_A0_X0_1", "TC_A0_X2_0"), 0.0)
    p = p | none if given else {name: value for name, value in p.items() if name not in none}
    told = {"TC_A0_TREF": 30.0, "TC_A0_TMIN": 5.0, "TC_A0_TMAX": 45.0} if given else {}
    curve = px4_block(Sensor.ACCELEROMETER, 22, p | told)
    assert curve is not None
    defaults = {"TC_A0_TREF": 25.0, "TC_A0_TMIN": 0.0, "TC_A0_TMAX": 100.0}
    wanted = formulas.px4_thermal("accelerometer", 22, defaults | none | p | told, np.array([degc]))
    np.testing.assert_allclose(curve.at(degc), wanted[0], rtol=1e-9)


@pytest.mark.parametrize(("change", "differs"), [(1e-10, False), (1e-8, True)])
@pytest.mark.parametrize(("square", "cube"), [(1e-5, 1e-7), (1e-5, 1e-3)])
def test_a_bend_counts_where_it_differs_by_more_than_rounding_of_itself(
    square: float, cube: float, change: float, differs: bool
) -> None:
    there = Curve(AT, -10.0, 60.0, np.array([[0.0] * 3, [square] * 3, [cube] * 3]), np.zeros(3))
    for squares in (1.0 + change, 1.0):
        cubes = 1.0 if squares != 1.0 else 1.0 + change
        own = warm(zero_per_degc2=[square * squares] * 3, zero_per_degc3=[cube * cubes] * 3)
        assert (curve_to_load(own, there, AT) is not None) == differs


def test_a_square_alone_replaces_a_cubic() -> None:
    there = Curve(AT, -10.0, 60.0, np.array([[0.0] * 3, [1e-5] * 3, [1e-7] * 3]), np.zeros(3))
    found = curve_to_load(warm(zero_per_degc2=[2e-5] * 3), there, AT)
    assert found is not None
    np.testing.assert_allclose(found.coefficients, [[0.0] * 3, [2e-5] * 3, [0.0] * 3])


def warm_accelerometer(autopilot: str, low: float, high: float) -> Constants:
    return constants(
        autopilot,
        accelerometer=si(Sensor.ACCELEROMETER, flown_degc=(low, high), zero_per_degc=np.array([1e-3, 0.0, 0.0])),
    )


def px4_rows(c: Constants) -> dict[str, tuple[str, str]]:
    rows = [line.split("\t") for line in px4(c).text.splitlines() if not line.startswith("#")]
    return {row[2]: (row[3], row[4]) for row in rows}


def ardupilot_rows(c: Constants) -> dict[str, str]:
    return dict(line.split(",") for line in ardupilot(c).text.splitlines() if not line.startswith("#"))


def test_px4_says_the_type_as_mavlink_numbers_it() -> None:
    """MAV_PARAM_TYPE of MAVLink's common.xml: INT32 is 6, REAL32 is 9; ENABLE is a switch, 0 or 1."""
    rows = px4_rows(warm_accelerometer("px4", -5.0, 45.0))
    assert rows.pop("TC_A_ENABLE") == ("1", "6")
    assert rows.pop("TC_A0_ID") == ("22", "6")
    assert {kind for _, kind in rows.values()} == {"9"}


@pytest.mark.parametrize(("low", "high"), [(-5.0, 45.0), (25.0, 45.0), (-5.0, 15.0)])
def test_the_range_covers_the_temperature_of_the_constants(low: float, high: float) -> None:
    """Both firmwares clip the temperature to the range before they evaluate the cubic."""
    p, a = px4_rows(warm_accelerometer("px4", low, high)), ardupilot_rows(warm_accelerometer("ardupilot", low, high))
    wanted = (min(low, AT), max(high, AT))
    assert (float(p["TC_A0_TMIN"][0]), float(p["TC_A0_TMAX"][0])) == wanted
    assert (float(a["INS_TCAL1_TMIN"]), float(a["INS_TCAL1_TMAX"])) == wanted
    assert a["INS_TCAL1_ENABLE"] == "1"


def test_the_range_covers_that_of_both_sensors() -> None:
    slope = np.array([1e-3, 0.0, 0.0])
    for one, other in (((-5.0, 30.0), (10.0, 45.0)), ((10.0, 45.0), (-5.0, 30.0))):
        a = ardupilot_rows(
            constants(
                "ardupilot",
                accelerometer=si(Sensor.ACCELEROMETER, flown_degc=one, zero_per_degc=slope),
                gyroscope=si(Sensor.GYROSCOPE, flown_degc=other, zero_per_degc=slope),
            )
        )
        assert (float(a["INS_TCAL1_TMIN"]), float(a["INS_TCAL1_TMAX"])) == (-5.0, 45.0)


@pytest.mark.parametrize(("high", "enough"), [(24.9, False), (25.0, True), (25.5, True)])
def test_ardupilot_wants_ten_degrees(high: float, enough: bool) -> None:
    """AP_InertialSensor_tempcal.h, TEMP_RANGE_MIN: 10 °C."""
    assert ("INS_TCAL1_ENABLE" in ardupilot_rows(warm_accelerometer("ardupilot", 15.0, high))) == enough


def test_no_temperature_terms_without_slopes() -> None:
    flat = si(Sensor.ACCELEROMETER, flown_degc=(-5.0, 45.0))
    assert not any(name.startswith("TC_") for name in px4_rows(constants("px4", accelerometer=flat)))
    assert not any("TCAL" in name for name in ardupilot_rows(constants("ardupilot", accelerometer=flat)))


def test_what_changes_offsets_by_itself_is_told_where_it_may() -> None:
    gyroscope = {"gyroscope": si(Sensor.GYROSCOPE)}
    assert not any("INS_GYR_CAL" in w for w in ardupilot(warm_accelerometer("ardupilot", -5.0, 45.0)).warnings)
    for value, told in ((0.0, False), (1.0, True)):
        warnings = ardupilot(constants("ardupilot", {"INS_GYR_CAL": value}, **gyroscope)).warnings
        assert any("INS_GYR_CAL" in w for w in warnings) == told
        warnings = px4(constants("px4", {"IMU_GYRO_CAL_EN": value}, **gyroscope)).warnings
        assert any("IMU_GYRO_CAL_EN" in w for w in warnings) == told
    assert any("INS_GYR_CAL" in w for w in ardupilot(constants("ardupilot", **gyroscope)).warnings)
    assert any("IMU_GYRO_CAL_EN" in w for w in px4(constants("px4", **gyroscope)).warnings)


def test_one_unit_that_px4_may_change_is_enough_to_tell() -> None:
    one, other = (
        constants("px4", {"SENS_IMU_AUTOCAL": value, "CAL_ACC1_ID": 31.0}, accelerometer=si(Sensor.ACCELEROMETER))
        for value in (0.0, 1.0)
    )
    assert not any("SENS_IMU_AUTOCAL" in w for w in px4(one).warnings)
    loaded = other.origins[Sensor.ACCELEROMETER].loaded
    assert loaded is not None
    second = replace(other, origins={Sensor.ACCELEROMETER: Origin(replace(loaded, device_id=31))})
    assert any("SENS_IMU_AUTOCAL" in w for w in px4(replace(one, further=(second,))).warnings)


@pytest.mark.parametrize(("enabled", "told"), [(0.0, True), (1.0, False)])
def test_what_wakes_the_blocks_of_other_devices_is_told(enabled: float, told: bool) -> None:
    """TC_A_ENABLE is of all accelerometers: it is told where it was not on before."""
    c = warm_accelerometer("px4", -5.0, 45.0)
    loaded = Loaded("px4", 22, NOT_TURNED, {**CALIBRATED["px4"], "TC_A_ENABLE": enabled})
    export = px4(replace(c, origins={Sensor.ACCELEROMETER: Origin(loaded)}))
    assert "TC_A_ENABLE\t1\t" in export.text
    assert any("TC_A_ENABLE becomes 1, for every TC_An_ID that is not 0" in w for w in export.warnings) == told


@pytest.mark.parametrize(("learn", "told"), [(None, False), (0.0, False), (1.0, True), (3.0, True)])
def test_a_compass_that_learns_is_told(learn: float | None, told: bool) -> None:
    """COMPASS_LEARN: 0 is off, and that is its default. Of a gyroscope alone nothing is said of compasses."""
    more = {} if learn is None else {"COMPASS_LEARN": learn}
    for sensor in (Sensor.MAGNETOMETER, Sensor.GYROSCOPE):
        warnings = ardupilot(constants("ardupilot", more, **{sensor: si(sensor)})).warnings
        assert any("COMPASS_LEARN" in w for w in warnings) == (told and sensor == Sensor.MAGNETOMETER)


def test_what_stays_and_the_reboot_are_told() -> None:
    c = constants("px4", magnetometer=si(Sensor.MAGNETOMETER))
    told = px4(c).warnings[-1]
    assert all(part in told for part in ("CAL_*_ID", "CAL_*_ROT", "CAL_*_PRIO", "stay", "Reboot"))
    assert not any(name.endswith(("_ID", "_ROT", "_PRIO")) for name in px4_rows(c))
    assert "Reboot" in ardupilot(constants("ardupilot", magnetometer=si(Sensor.MAGNETOMETER))).warnings[-1]


@pytest.mark.parametrize(("asked", "wanted"), [(Request(system_id=17), "17"), (Request(), "1")])
def test_the_system_id_is_the_one_asked_for_else_a_vehicles_default(asked: Request, wanted: str) -> None:
    """MAV_SYS_ID is 1 until it is set."""
    text = px4(constants("px4", gyroscope=si(Sensor.GYROSCOPE)), asked).text
    assert {line.split("\t")[0] for line in text.splitlines() if not line.startswith("#")} == {wanted}


def test_px4_corrects_a_magnetometer_for_temperature_where_its_firmware_can() -> None:
    sloped = si(Sensor.MAGNETOMETER, flown_degc=(10.0, 50.0), zero_per_degc=np.array([1e-4, 0.0, 0.0]))
    rows = px4_rows(constants("px4", magnetometer=sloped))
    assert (rows["TC_M_ENABLE"], rows["TC_M0_ID"]) == (("1", "6"), ("-1294967296", "6"))
    assert float(rows["TC_M0_X1_0"][0]) == pytest.approx(1e-4)
    older = constants("px4", magnetometer=sloped)
    parameters = {name: value for name, value in CALIBRATED["px4"].items() if not name.startswith("TC_M")}
    origin = Origin(Loaded("px4", IDS[Sensor.MAGNETOMETER], NOT_TURNED, parameters))
    export = px4(replace(older, origins={Sensor.MAGNETOMETER: origin}))
    assert "TC_M" not in export.text
    assert any("up to 0.004 G over what was flown" in told for told in export.warnings)
    warnings = ardupilot(constants("ardupilot", magnetometer=sloped)).warnings
    assert any("moved by up to 4 mG" in told for told in warnings)
    not_known = constants("ardupilot", magnetometer=replace(sloped, flown_degc=None))
    assert not any("moved by" in told for told in ardupilot(not_known).warnings)


@pytest.mark.parametrize(
    ("sensor", "changes", "beyond"),
    [
        ("accelerometer", {"scale": np.diag([1.0, 0.0999, 1.0])}, True),
        ("accelerometer", {"scale": np.diag([1.0, 0.1, 3.0])}, False),
        ("accelerometer", {"scale": np.diag([0.2, 1.0, 3.001])}, True),
        ("magnetometer", {"scale": np.diag([3.001, 1.0, 1.0])}, True),
        ("gyroscope", {"scale": np.diag([3.001, 1.0, 1.0])}, False),
    ],
)
def test_px4s_limits(sensor: str, changes: dict[str, np.ndarray], beyond: bool) -> None:
    """module.yaml of PX4's sensors: 0.1 to 3.0. What is told of is beyond them."""
    other = "gyroscope" if sensor != "gyroscope" else "accelerometer"
    c = constants("px4", **{sensor: si(Sensor(sensor), **changes), other: si(Sensor(other))})
    export = px4(c)
    left_out = [told for told in export.warnings if told.startswith(f"{sensor}: left out. A scale")]
    assert len(left_out) == beyond
    assert all(re.search(r"of (0\.0999|3\.001) is beyond the 0\.1 to 3 that", told) for told in left_out)
    short = {"accelerometer": "CAL_ACC0_", "magnetometer": "CAL_MAG0_", "gyroscope": "CAL_GYRO0_"}[sensor]
    assert (short in export.text) != beyond


@pytest.mark.parametrize(
    ("sensor", "changes", "parameter"),
    [
        ("accelerometer", {"scale": np.diag([1.0, 0.799, 1.0])}, "INS_ACCSCAL_Y"),
        ("accelerometer", {"scale": np.diag([1.0, 0.801, 1.199])}, None),
        ("accelerometer", {"scale": np.diag([1.0, 1.0, 1.201])}, "INS_ACCSCAL_Z"),
        ("accelerometer", {"zero": np.array([3.5, -3.5, 0.0])}, None),
        ("accelerometer", {"zero": np.array([0.0, -3.501, 0.0])}, "INS_ACCOFFS_Y"),
        ("magnetometer", {"zero": np.array([1.499, -1.499, 0.0])}, None),
        ("magnetometer", {"zero": np.array([0.0, 0.0, 1.501])}, "COMPASS_OFS_Z"),
        ("magnetometer", {"scale": np.diag([1.49, 1.49, 1.49])}, None),
        ("magnetometer", {"scale": np.diag([1.51, 1.51, 1.51])}, "COMPASS_SCALE"),
        ("magnetometer", {"scale": np.diag([1.21, 0.9, 0.89])}, "COMPASS_DIA_X"),
        ("magnetometer", {"scale": np.diag([1.19, 1.0, 0.81])}, None),
        ("magnetometer", {"scale": np.diag([1.19, 1.02, 0.79])}, "COMPASS_DIA_Z"),
        ("magnetometer", {"scale": np.eye(3) + 0.201 * np.eye(3)[[1, 0, 2]] * [[1], [1], [0]]}, "COMPASS_ODI_X"),
        ("magnetometer", {"scale": np.eye(3) + 0.199 * np.eye(3)[[1, 0, 2]] * [[1], [1], [0]]}, None),
    ],
)
def test_ardupilots_limits(sensor: str, changes: dict[str, np.ndarray], parameter: str | None) -> None:
    c = constants("ardupilot", **{sensor: si(Sensor(sensor), **changes), "gyroscope": si(Sensor.GYROSCOPE)})
    export = ardupilot(c)
    left_out = [told for told in export.warnings if told.startswith(f"{sensor}: left out. ")]
    assert (len(left_out) == 1) == (parameter is not None)
    assert parameter is None or f"{parameter} of" in left_out[0]
    assert (("INS_ACCSCAL" if sensor == "accelerometer" else "COMPASS") in export.text) == (parameter is None)


def test_an_offset_of_exactly_zero_is_not_taken_for_none() -> None:
    """AP_InertialSensor::accel_calibrated_ok_all and Compass::configured: a vector of zeros is not calibrated."""
    a = ardupilot_rows(
        constants("ardupilot", accelerometer=si(Sensor.ACCELEROMETER), magnetometer=si(Sensor.MAGNETOMETER))
    )
    for name, most in (("INS_ACCOFFS_X", 1e-4), ("COMPASS_OFS_X", 0.1)):
        assert np.finfo(np.float32).eps < float(a[name]) < most
    one = si(Sensor.ACCELEROMETER, zero=np.array([0.0, 0.0, 1e-3]))
    assert float(ardupilot_rows(constants("ardupilot", accelerometer=one))["INS_ACCOFFS_X"]) == 0.0
    for smallest, kept in ((2.0**-23, True), (2.0**-24, False)):  # AP_Math: is_zero is |x| < FLT_EPSILON
        one = si(Sensor.ACCELEROMETER, zero=np.full(3, smallest))
        a = ardupilot_rows(constants("ardupilot", accelerometer=one))
        assert (float(a["INS_ACCOFFS_X"]) == smallest) == kept


def test_ardupilot_gets_the_device_ids_that_make_a_calibration_count() -> None:
    a = ardupilot_rows(constants("ardupilot", accelerometer=si(Sensor.ACCELEROMETER), gyroscope=si(Sensor.GYROSCOPE)))
    assert (a["INS_ACC_ID"], a["INS_GYR_ID"]) == ("22", "21")
    assert (float(a["INS_ACC1_CALTEMP"]), float(a["INS_GYR1_CALTEMP"])) == (AT, AT)


def test_a_thermal_block_of_ardupilot_is_written_whole_and_keeps_the_other_sensors() -> None:
    loaded = {"INS_TCAL1_ENABLE": 1.0, "INS_TCAL1_TMIN": 0.0, "INS_TCAL1_TMAX": 60.0, "INS_TCAL1_ACC2_Y": 12.0}
    sloped = si(Sensor.GYROSCOPE, flown_degc=(10.0, 40.0), zero_per_degc=np.array([0.0, 0.0, 1e-4]))
    a = ardupilot_rows(constants("ardupilot", loaded, gyroscope=sloped))
    names = [f"INS_TCAL1_{kind}{order}_{axis}" for kind in ("ACC", "GYR") for order in "123" for axis in "XYZ"]
    assert {name for name in a if name.startswith("INS_TCAL1_")} == {
        *names,
        "INS_TCAL1_ENABLE",
        "INS_TCAL1_TMIN",
        "INS_TCAL1_TMAX",
    }
    assert float(a["INS_TCAL1_ACC2_Y"]) == pytest.approx(12.0)
    assert float(a["INS_TCAL1_GYR1_Z"]) == pytest.approx(100.0)
    assert (float(a["INS_TCAL1_TMIN"]), float(a["INS_TCAL1_TMAX"])) == (0.0, 60.0)


def test_the_other_sensors_terms_are_those_of_its_own_log() -> None:
    """Each sensor's log tells of its own terms only; the block of both is written whole."""
    block = {"INS_TCAL1_ENABLE": 1.0, "INS_TCAL1_TMIN": 0.0, "INS_TCAL1_TMAX": 60.0}
    slopes = {Sensor.GYROSCOPE: ("INS_TCAL1_GYR1_X", 100.0), Sensor.ACCELEROMETER: ("INS_TCAL1_ACC1_X", 2000.0)}
    for moved, kept in (tuple(slopes), tuple(reversed(slopes))):
        steep = si(moved, flown_degc=(10.0, 40.0), zero_per_degc=np.array([0.0, 0.0, 1e-2]))
        unknown = si(kept, flown_degc=(10.0, 40.0), zero_per_degc_sd=np.full(3, np.inf))
        c = constants("ardupilot", **{moved: steep, kept: unknown})
        origins = {
            s: Origin(Loaded("ardupilot", IDS[s], NOT_TURNED, {**CALIBRATED["ardupilot"], **block, name: value}))
            for s, (name, value) in slopes.items()
        }
        a = ardupilot_rows(replace(c, origins=origins))
        name, value = slopes[kept]
        assert float(a[name]) == pytest.approx(value)
        assert float(a[slopes[moved][0].replace("_X", "_Z")]) == pytest.approx(1e4)


def test_what_is_handed_out_is_all_of_the_file_and_nothing_of_another_sensor() -> None:
    """What both share, the block's range, is of both; an offset or a thermal term is of one."""
    slope = np.array([1e-3, 0.0, 0.0])
    own = {s: si(s, flown_degc=(0.0, 40.0), zero_per_degc=slope) for s in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER)}
    c = constants("ardupilot", **own)
    found = {s: {w.name: w.value for w in ardupilot(c).written if w.sensor == s} for s in own}
    every = {name: float(value) for name, value in ardupilot_rows(c).items()}
    for s, kind, other in ((Sensor.GYROSCOPE, "GYR", "ACC"), (Sensor.ACCELEROMETER, "ACC", "GYR")):
        assert found[s] == {name: value for name, value in every.items() if other not in name}
        assert sum(name.startswith(f"INS_TCAL1_{kind}") for name in found[s]) == 9


def test_older_ardupilot_has_no_compass_scale() -> None:
    soft = si(Sensor.MAGNETOMETER, scale=np.diag([1.1, 1.05, 1.0]))
    c = constants("ardupilot", magnetometer=soft)
    parameters = {"COMPASS_DEV_ID": 3e9}
    origin = Origin(Loaded("ardupilot", IDS[Sensor.MAGNETOMETER], NOT_TURNED, parameters))
    a = ardupilot_rows(replace(c, origins={Sensor.MAGNETOMETER: origin}))
    assert "COMPASS_SCALE" not in a
    assert float(a["COMPASS_DIA_X"]) == pytest.approx(1.1)
    a = ardupilot_rows(c)
    assert float(a["COMPASS_SCALE"]) == pytest.approx(1.05)
    assert float(a["COMPASS_DIA_X"]) == pytest.approx(1.1 / 1.05)
