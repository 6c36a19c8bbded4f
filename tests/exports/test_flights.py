"""What the history tells of the flights behind constants: whose parameters, which axes, which units beside."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from autopilot_rows import PARAMETERS, composition, gyroscope, history, origin
from history_rows import lead

import fieldcal
from fieldcal.cli.main import run
from fieldcal.exports.calibration_at import constants_of
from fieldcal.names import Sensor
from fieldcal.report import write_vehicle_report


def two_units(root: Path) -> Path:
    """An old flight with another unit; a flight with two, the primary one in the second slot."""
    old = lead("v", "f0", 0) | {"unit_id": "b/10"}
    primary = lead("v", "f1", 1) | {"unit_id": "b/12"}
    other = lead("v", "f1", 1) | {"unit_id": "b/11", "is_primary": False}
    return history(
        root,
        (gyroscope(old, 0.9), [composition(old, origin(10))]),
        (
            gyroscope(primary, 0.03) + gyroscope(other, 0.04),
            [composition(primary, origin(12)), composition(other, origin(11))],
        ),
    )


def test_constants_know_what_was_loaded_and_which_units_flew_beside(tmp_path: Path) -> None:
    constants = constants_of(two_units(tmp_path), "v")
    assert constants.unit_ids == {"gyroscope": "b/12"}
    assert constants.imu_rate_hz == 187.0
    own = constants.origins[Sensor.GYROSCOPE]
    assert own.loaded is not None
    assert (own.loaded.autopilot, own.loaded.device_id, own.loaded.parameters) == ("px4", 12, PARAMETERS)
    assert own.temperature_degc == 31.0
    (beside,) = constants.further
    assert beside.unit_ids == {"gyroscope": "b/11"}
    loaded = beside.origins[Sensor.GYROSCOPE].loaded
    assert loaded is not None
    assert loaded.device_id == 11
    text = fieldcal.export(constants, "px4").text
    assert "CAL_GYRO1_XOFF\t0.03\t" in text
    assert "CAL_GYRO0_XOFF\t0.04\t" in text


def test_one_unit_that_is_asked_for_comes_alone(tmp_path: Path) -> None:
    constants = constants_of(two_units(tmp_path), "v", unit_id="b/11")
    assert constants.further == ()
    assert "CAL_GYRO1" not in fieldcal.export(constants, "px4").text
    with pytest.raises(
        fieldcal.FieldcalError, match="'v' is known of unit 'b/9'; there is: b/10, b/11, b/12"
    ) as caught:
        constants_of(tmp_path, "v", unit_id="b/9")
    assert caught.value.reason_code == "no_calibration"


@pytest.mark.parametrize("day", [0, None])
def test_what_was_loaded_is_that_of_the_latest_flight_behind_any_constant(tmp_path: Path, day: int | None) -> None:
    """One axis is of a later flight than the others; a flight whose clock is unknown counts as older."""
    old, new = (lead("v", name, when) | {"unit_id": "b/12"} for name, when in (("f9", day), ("f1", 1)))
    old["imu_rate_hz"] = 400.0
    one_axis = [r for r in gyroscope(new, 0.05) if (r["parameter"], r["axis"]) == ("zero", "x")]
    now = PARAMETERS | {"CAL_GYRO1_XOFF": 0.25}
    root = history(
        tmp_path,
        (gyroscope(old, 0.1), [composition(old, origin(12))]),
        (one_axis, [composition(new, origin(12, now))]),
    )
    constants = constants_of(root, "v")
    assert constants.triads[Sensor.GYROSCOPE].zero.tolist() == [0.05, 0.1, 0.1]
    assert (constants.imu_rate_hz, constants.as_of) == (187.0, new["started_at"].isoformat())
    loaded = constants.origins[Sensor.GYROSCOPE].loaded
    assert loaded is not None
    assert loaded.parameters == now


def test_the_temperature_is_that_of_the_units_own_zero(tmp_path: Path) -> None:
    primary = lead("v", "f1", 1) | {"unit_id": "b/12"}
    other = lead("v", "f1", 1) | {"unit_id": "b/11", "is_primary": False}
    warm = {("b/12", "zero"): 31.0, ("b/12", "scale"): 20.0, ("b/11", "zero"): 45.0, ("b/11", "scale"): 50.0}
    constants = [
        row | {"temperature_degc": warm[row["unit_id"], row["parameter"]]}
        for row in gyroscope(primary, 0.03) + gyroscope(other, 0.04)
    ]
    found = constants_of(history(tmp_path, (constants, [composition(primary, origin(12))])), "v")
    assert found.origins[Sensor.GYROSCOPE].temperature_degc == 31.0


def test_units_beside_are_those_of_the_latest_flight_whose_clock_is_known(tmp_path: Path) -> None:
    flights = []
    for name, day, beside in (("f9", None, 11), ("f1", 1, 13)):
        primary = lead("v", name, day) | {"unit_id": "b/12"}
        other = lead("v", name, day) | {"unit_id": f"b/{beside}", "is_primary": False}
        runs = [composition(primary, origin(12)), composition(other, origin(beside))]
        flights.append((gyroscope(primary, 0.03) + gyroscope(other, 0.04), runs))
    (beside,) = constants_of(history(tmp_path, *flights), "v").further
    assert beside.unit_ids == {"gyroscope": "b/13"}


def test_a_history_of_before_tells_nothing(tmp_path: Path) -> None:
    first = lead("v", "f1", 1)
    root = history(tmp_path, (gyroscope(first, 0.1), [composition(first, None)]))
    assert constants_of(root, "v").origins == {}


def test_axes_and_sign_are_those_of_the_flight(tmp_path: Path) -> None:
    first = lead("v", "f1", 1)
    told = origin(None, body="flu", gravity_sign="gravity", horizontal_field_g=0.2)
    root = history(tmp_path, (gyroscope(first, 0.1), [composition(first, told)]))
    own = constants_of(root, "v").origins[Sensor.GYROSCOPE]
    assert (own.loaded, own.body, own.gravity_sign, own.horizontal_field_g) == (None, "flu", "gravity", 0.2)


def test_compare_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = two_units(tmp_path / "w")
    capsys.readouterr()
    assert run(["compare", "v", "--json", "--warehouse", str(root)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(r["unit_id"], r["axis"], r["parameter"]) for r in found[:2]] == [
        ("b/12", "x", "zero"),
        ("b/12", "x", "scale"),
    ]
    x = found[0]
    assert (x["name"], x["flies_with"], x["estimate"], x["sd"]) == ("CAL_GYRO1_XOFF", 0.5, 0.03, 1e-3)
    assert x["effect"] == pytest.approx(np.rad2deg(0.47) * 60.0)
    assert run(["compare", "v", "--warehouse", str(root)]) == 0
    shown = capsys.readouterr().out
    assert "CAL_GYRO1_XOFF" in shown
    now = tmp_path / "now.param"
    now.write_text("CAL_GYRO1_ID,12\nCAL_GYRO1_XOFF,0.03\nCAL_GYRO0_ID,11\n")
    assert run(["compare", "v", "--json", "--params", str(now), "--warehouse", str(root)]) == 0
    assert json.loads(capsys.readouterr().out)[0]["matters"] is False


def without_scales(root: Path) -> Path:
    """An autopilot's flight that shows the gyroscope's zeros only, its accelerometer refused."""
    first = lead("v", "f1", 1) | {"unit_id": "b/12"}
    zeros = [row for row in gyroscope(first, 0.03) if row["parameter"] == "zero"]
    refused = [
        row
        | {"sensor": "accelerometer", "status": "refused", "reason_code": "too_few_poses", "reason": "too few poses"}
        for row in gyroscope(first, 0.03)
    ]
    told = origin(12)
    told["loaded"]["accelerometer"] = {
        **told["loaded"]["gyroscope"],
        "device_id": 7,
        "parameters": {"CAL_ACC0_ID": 7.0, "CAL_ACC0_XOFF": 0.3, "CAL_ACC0_ZSCALE": 0.98},
    }
    return history(root, (zeros + refused, [composition(first, told)]))


def test_zeros_are_enough_for_an_autopilots_gyroscope(tmp_path: Path) -> None:
    constants = constants_of(without_scales(tmp_path), "v")
    triad = constants.triads[Sensor.GYROSCOPE]
    assert triad.scale_nominal
    np.testing.assert_array_equal(triad.scale, np.eye(3))
    assert np.isnan(triad.scale_sd).all()
    assert np.isfinite(triad.zero_sd).all()
    for to, name in (("px4", "CAL_GYRO1_XOFF\t0.03\t"), ("json", '"zero": [')):
        export = fieldcal.export(constants, to)
        assert name in export.text
        assert any("only its zeros are known" in told for told in export.warnings)


def test_zeros_are_not_enough_where_no_autopilot_tells_what_the_scale_is(tmp_path: Path) -> None:
    first = lead("v", "f1", 1) | {"unit_id": "b/12"}
    zeros = [row for row in gyroscope(first, 0.03) if row["parameter"] == "zero"]
    told = origin(12)
    told["loaded"] = {}
    root = history(tmp_path, (zeros, [composition(first, told)]))
    with pytest.raises(fieldcal.FieldcalError, match="has all its axes calibrated"):
        constants_of(root, "v")


def test_what_flies_is_told_without_an_estimate_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = without_scales(tmp_path)
    rows = fieldcal.compare(fieldcal.Warehouse(root).what_flies("v"))
    own = {(row.sensor, row.parameter, row.axis): row for row in rows}
    assert own["accelerometer", "zero", "x"].flies_with == pytest.approx(0.3)
    assert own["accelerometer", "scale", "z"].flies_with == pytest.approx(0.98)
    assert np.isnan(own["accelerometer", "scale", "z"].estimate)
    assert own["gyroscope", "zero", "x"].estimate == pytest.approx(0.03)
    assert ("gyroscope", "scale", "x") not in own
    assert run(["compare", "v", "--warehouse", str(root)]) == 0
    assert "Not estimated: accelerometer" in capsys.readouterr().out
    assert run(["compare", "v", "--warehouse", str(root), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {row["estimate"] for row in told if row["sensor"] == "accelerometer"} == {None}


def test_the_vehicles_page_shows_the_same_table(tmp_path: Path) -> None:
    page = write_vehicle_report(two_units(tmp_path), "v").read_text()
    assert "What the autopilot flew with" in page
    assert "CAL_GYRO1_XOFF" in page
    first = lead("v", "f1", 1)
    plain = history(tmp_path / "other", (gyroscope(first, 0.1), [composition(first, origin(None))]))
    assert "What the autopilot flew with" not in write_vehicle_report(plain, "v").read_text()
