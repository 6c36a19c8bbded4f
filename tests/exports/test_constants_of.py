"""Constants looked up in a warehouse of a few rows: which IMU, which axes, what is known at which temperature."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from history_rows import lead, rows

from fieldcal.errors import FieldcalError
from fieldcal.exports.calibration_at import constants_of
from fieldcal.names import Sensor
from fieldcal.warehouse.publish import publish

DIAGONAL = ("x", "y", "z")
FULL = tuple(a + b for a in DIAGONAL for b in DIAGONAL)
GYROSCOPE = {"sensor": "gyroscope", "method": "output_error"}
SLOPES = {"x": 0.5, "y": -0.25, "z": 0.125}
BENDS = {"x": 0.03, "y": 0.02, "z": -0.01}
TWISTS = {"x": -0.002, "y": 0.001, "z": 0.003}


def calibration(
    first: dict[str, Any], axes: tuple[str, ...] = DIAGONAL, parameter: str = "scale", value: float = 2.0
) -> list[dict[str, Any]]:
    """Rows whose value is `value` and a hundredth for every further axis."""
    unit = "rad/s/counts" if parameter == "scale" else "counts"
    common = {**first, **GYROSCOPE, "parameter": parameter, "unit": unit, "status": "ok", "temperature_degc": 25.0}
    return [{**common, "axis": axis, "value": value + 0.01 * i, "sd": 0.1} for i, axis in enumerate(axes)]


def trend(first: dict[str, Any]) -> list[dict[str, Any]]:
    """A cubic over temperature for each axis of the zero; their ranges of temperature overlap from 3 to 38 °C."""
    common = {k: first[k] for k in ("vehicle_id", "imu_id")} | GYROSCOPE
    return [
        {
            **common,
            "parameter": "zero",
            "axis": axis,
            "unit": "counts",
            "n_flights": 9,
            "n_sessions": 9,
            "value_at_25degc": 100.0 + i,
            "sd": 0.1,
            "slope_per_degc": SLOPES[axis],
            "slope_per_degc_sd": 0.001,
            "curve_per_degc2": BENDS[axis],
            "curve_per_degc3": TWISTS[axis],
            "temperature_min_degc": (1.0, 3.0, 2.0)[i],
            "temperature_max_degc": (40.0, 39.0, 38.0)[i],
            "status": "stable",
        }
        for i, axis in enumerate(DIAGONAL)
    ]


def warehouse(root: Path, *flights: list[dict[str, Any]], drift: list[dict[str, Any]] | None = None) -> Path:
    for records in flights:
        first = records[0]
        publish(root, first["vehicle_id"], {"calibration": rows("calibration", *records)}, [first["flight_id"]])
    if drift:
        publish(root, drift[0]["vehicle_id"], {"drift": rows("drift", *drift)}, [])
    return root


def flight(first: dict[str, Any], value: float = 2.0) -> list[dict[str, Any]]:
    return calibration(first, value=value) + calibration(first, parameter="zero", value=100.0)


@pytest.mark.parametrize("at", [25.0, 5.0, 33.0])
def test_a_curve_is_the_same_from_every_temperature(tmp_path: Path, at: float) -> None:
    """The table holds a cubic about 25 °C; constants at T0 hold the same curve about T0."""
    first = lead("v", "f1")
    t = constants_of(warehouse(tmp_path, flight(first), drift=trend(first)), "v", at).triads[Sensor.GYROSCOPE]
    assert t.temperature_degc == at
    assert t.flown_degc == (3.0, 38.0)
    for i, axis in enumerate(DIAGONAL):
        curve = np.polynomial.Polynomial([100.0 + i, SLOPES[axis], BENDS[axis], TWISTS[axis]])
        for warm in (-10.0, 10.0, 25.0, 45.0):
            d = warm - at
            found = t.zero[i] + t.zero_per_degc[i] * d + t.zero_per_degc2[i] * d**2 + t.zero_per_degc3[i] * d**3
            assert found == pytest.approx(curve(warm - 25.0), rel=1e-9)


def test_no_slope_no_range(tmp_path: Path) -> None:
    t = constants_of(warehouse(tmp_path, flight(lead("v", "f1"))), "v").triads[Sensor.GYROSCOPE]
    assert (t.flown_degc, t.unit, t.logged_unit) == (None, "rad/s", "counts")
    np.testing.assert_array_equal(t.scale, np.diag([2.0, 2.01, 2.02]))
    for slope in (t.scale_per_degc, t.zero_per_degc, t.zero_per_degc2, t.zero_per_degc3):
        assert not np.any(slope)
    np.testing.assert_array_equal(t.zero_per_degc_sd, np.full(3, np.inf))


def test_how_well_a_slope_is_known(tmp_path: Path) -> None:
    """A slope without sd is taken as it is; where there is none, nothing is known of it."""
    x, y, z = trend(lead("v", "f1"))
    drift = [x, y | {"slope_per_degc_sd": None}, z | dict.fromkeys(("slope_per_degc", "slope_per_degc_sd"))]
    t = constants_of(warehouse(tmp_path, flight(lead("v", "f1")), drift=drift), "v").triads[Sensor.GYROSCOPE]
    np.testing.assert_array_equal(t.zero_per_degc_sd, [0.001, 0.0, np.inf])
    np.testing.assert_array_equal(t.zero_per_degc, [SLOPES["x"], SLOPES["y"], 0.0])
    assert t.flown_degc == (3.0, 39.0)


def test_an_sd_that_is_not_known_is_none(tmp_path: Path) -> None:
    records = [{**r, "sd": None if r["axis"] == "y" else r["sd"]} for r in flight(lead("v", "f1"))]
    t = constants_of(warehouse(tmp_path, records), "v").triads[Sensor.GYROSCOPE]
    for sd in (t.scale_sd, t.zero_sd):
        np.testing.assert_array_equal(sd, [0.1, np.nan, 0.1])


@pytest.mark.parametrize(
    ("scale", "logged", "unit"),
    [("rad/s/counts", "counts", "rad/s"), ("rad/s/(deg/s)", "deg/s", "rad/s"), ("1", "deg/s", "deg/s")],
)
def test_the_unit_of_the_result_is_that_of_the_scale_times_the_logged_one(
    tmp_path: Path, scale: str, logged: str, unit: str
) -> None:
    records = [{**r, "unit": scale if r["parameter"] == "scale" else logged} for r in flight(lead("v", "f1"))]
    t = constants_of(warehouse(tmp_path, records), "v").triads[Sensor.GYROSCOPE]
    assert (t.unit, t.logged_unit) == (unit, logged)


def test_a_full_matrix_is_one_flights(tmp_path: Path) -> None:
    """Cross-axis terms of an older fit do not go with newer scales."""
    old, new = lead("v", "f1", 0), lead("v", "f2", 1)
    zero = calibration(old, parameter="zero")
    full = calibration(old, DIAGONAL, value=2.0) + calibration(old, FULL, value=5.0) + zero
    t = constants_of(warehouse(tmp_path / "one", full), "v").triads[Sensor.GYROSCOPE]
    np.testing.assert_allclose(t.scale, 5.0 + 0.01 * np.arange(9).reshape(3, 3))
    root = warehouse(tmp_path / "two", full, calibration(new, DIAGONAL, value=3.0))
    t = constants_of(root, "v").triads[Sensor.GYROSCOPE]
    np.testing.assert_array_equal(t.scale, np.diag([3.0, 3.01, 3.02]))
    # One axis alone is newer: the matrix is no longer of one fit.
    root = warehouse(tmp_path / "three", full, calibration(new, ("x",), value=3.0))
    t = constants_of(root, "v").triads[Sensor.GYROSCOPE]
    np.testing.assert_array_equal(t.scale, np.diag([3.0, 2.01, 2.02]))


@pytest.mark.parametrize("missing", [("scale", "y"), ("zero", "z")])
def test_a_sensor_without_all_its_axes_has_no_constants(tmp_path: Path, missing: tuple[str, str]) -> None:
    records = [r for r in flight(lead("v", "f1")) if (r["parameter"], r["axis"]) != missing]
    with pytest.raises(FieldcalError, match="No sensor of 'v' has all its axes calibrated") as caught:
        constants_of(warehouse(tmp_path, records), "v")
    assert caught.value.reason_code == "no_calibration"


@pytest.mark.parametrize(("days", "wanted"), [((2, 1), 2.0), ((1, 2), 3.0), ((1, None), 2.0), ((None, 1), 3.0)])
def test_the_imu_that_flew_last_counts(tmp_path: Path, days: tuple[int | None, int | None], wanted: float) -> None:
    """A flight whose clock is unknown counts as older than every other."""
    one = lead("v", "f1", days[0]) | {"imu_id": "one"}
    other = lead("v", "f2", days[1]) | {"imu_id": "other"}
    found = constants_of(warehouse(tmp_path, flight(one, 2.0), flight(other, 3.0)), "v")
    assert found.triads[Sensor.GYROSCOPE].scale[0, 0] == wanted
    assert found.imu_id == ("one" if wanted == 2.0 else "other")
    latest = one if wanted == 2.0 else other
    assert found.as_of == latest["started_at"].isoformat()


def test_without_any_clock_there_is_no_date(tmp_path: Path) -> None:
    assert constants_of(warehouse(tmp_path, flight(lead("v", "f1", None))), "v").as_of == ""


@pytest.mark.parametrize("vehicles", [3, 25])
def test_an_unknown_vehicle_is_told_the_known_ones(tmp_path: Path, vehicles: int) -> None:
    names = [f"v{i:02}" for i in range(vehicles)]
    root = warehouse(tmp_path, *(flight(lead(name, f"f-{name}")) for name in names))
    with pytest.raises(FieldcalError, match="No calibration of vehicle 'other'") as caught:
        constants_of(root, "other")
    assert f"there is: {', '.join(names[:20])}." in str(caught.value)


def test_a_unit_that_was_swapped_does_not_lend_its_constants(tmp_path: Path) -> None:
    """The sensor that flies now was refused: what is known is of the one that was taken out."""
    old = lead("v", "f1", 0) | {"unit_id": "old"}
    new = lead("v", "f2", 1) | {"unit_id": "new"}
    refused = [{**row, "status": "refused", "reason_code": "too_little_motion"} for row in flight(new, 3.0)]
    accelerometer = [{**row, "sensor": "accelerometer"} for row in flight(new, 1.0)]
    root = warehouse(tmp_path, flight(old), [*refused, *accelerometer])
    found = constants_of(root, "v")
    assert (set(found.triads), found.unit_ids) == ({"accelerometer"}, {"accelerometer": "new"})
    assert constants_of(root, "v", unit_id="old").triads[Sensor.GYROSCOPE].scale[0, 0] == 2.0


def test_the_primary_unit_counts_whichever_flew_beside_it(tmp_path: Path) -> None:
    """In the second flight the vehicle flew with the unit that was a further one before."""
    both = [
        [
            *flight(lead("v", f"f{day}", day) | {"unit_id": "one", "is_primary": day == 0}, 2.0),
            *flight(lead("v", f"f{day}", day) | {"unit_id": "two", "is_primary": day == 1}, 3.0),
        ]
        for day in (0, 1)
    ]
    assert constants_of(warehouse(tmp_path / "a", both[0]), "v").unit_ids == {"gyroscope": "one"}
    found = constants_of(warehouse(tmp_path / "b", *both), "v")
    assert found.unit_ids == {"gyroscope": "two"}
    assert found.triads[Sensor.GYROSCOPE].scale[0, 0] == 3.0
