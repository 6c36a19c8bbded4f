"""Exports as texts: read by the languages' own readers, unknown things are said to be unknown."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from fieldcal.exports import AUTOPILOTS, PROGRAMS
from fieldcal.exports.autopilots.loading import Request
from fieldcal.exports.calibration import Constants, Triad, written
from fieldcal.names import Sensor


def triad(**changes: object) -> Triad:
    """A plain triad; the zero's bends are left to their defaults."""
    plain = Triad(
        scale=np.diag([0.25, 1e-5, 1.5e-5]),
        zero=np.array([1e-5, 2e22, -3.5]),
        scale_per_degc=np.zeros((3, 3)),
        zero_per_degc=np.zeros(3),
        scale_sd=np.full(3, np.nan),
        zero_sd=np.ones(3),
        unit="rad/s",
        logged_unit="counts",
        temperature_degc=20.0,
        flown_degc=None,
        why=(),
    )
    return replace(plain, **changes)


def constants(as_of: str = "", vehicle_id: str = "v", **changes: object) -> Constants:
    return Constants(vehicle_id, "i", {Sensor.GYROSCOPE: triad(**changes)}, as_of)


def test_numbers_of_yaml_are_numbers() -> None:
    """YAML 1.1 takes 1e-05 for text and 1.0e-05 for a number."""
    told = yaml.safe_load(PROGRAMS["ros"](constants()).text)["/**"]["ros__parameters"]["fieldcal"]["gyroscope"]
    assert told["zero"] == [1e-5, 2e22, -3.5]
    assert told["scale"] == np.diag([0.25, 1e-5, 1.5e-5]).ravel().tolist()
    assert all(np.isnan(v) for v in told["scale_sd"])


def test_kalibr_gets_matrices_of_its_sizes() -> None:
    """An IMU of Kalibr: T_i_b is 4 × 4, A and C_gyro_i are 3 × 3."""
    imu = yaml.safe_load(PROGRAMS["kalibr"](constants()).text)
    assert imu["T_i_b"] == np.eye(4).tolist()
    assert imu["gyroscopes"]["A"] == np.zeros((3, 3)).tolist()
    assert imu["gyroscopes"]["C_gyro_i"] == np.eye(3).tolist()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, False),
        ({"zero_per_degc": np.array([0.0, 1.0, 0.0])}, True),
        ({"scale_per_degc": np.diag([0.0, 0.0, 1.0])}, True),
    ],
)
def test_kalibr_is_told_of_temperature_when_there_is_some(changes: dict[str, np.ndarray], told: bool) -> None:
    assert (
        any("knows no temperature" in warning for warning in PROGRAMS["kalibr"](constants(**changes)).warnings) == told
    )


@pytest.mark.parametrize("as_of", ["", "2026-05-04T12:00:00+00:00"])
def test_when_is_said_or_said_to_be_unknown(as_of: str) -> None:
    for form in ("c", "kalibr"):
        assert f"as of {as_of or 'unknown'}" in PROGRAMS[form](constants(as_of)).text, form
    for form, write in AUTOPILOTS.items():
        text = write(constants(as_of, logged_unit="rad/s"), Request(logged_raw=True)).text
        assert f"as of {as_of or 'unknown'}" in text, form
    assert json.loads(PROGRAMS["json"](constants(as_of)).text)["as_of"] == (as_of or None)


def test_ids_beyond_ascii() -> None:
    """JSON holds them as they are; C source is plain ASCII."""
    c = constants(vehicle_id="Möwe")
    assert '"Möwe"' in PROGRAMS["json"](c).text
    assert PROGRAMS["c"](c).text.isascii()


def test_json_has_no_nan() -> None:
    assert json.loads(PROGRAMS["json"](constants()).text)["sensors"]["gyroscope"]["scale_sd"] == [None] * 3
    with pytest.raises(ValueError, match="not JSON compliant"):
        PROGRAMS["json"](constants(temperature_degc=np.nan))


def test_what_is_handed_out_names_each_number_by_its_axes() -> None:
    """Row first: scale_xy is what y's reading adds to x. Of independent axes there are three."""
    full = np.arange(1.0, 10.0).reshape(3, 3)
    zero = {"zero_x": 1e-5, "zero_y": 2e22, "zero_z": -3.5}
    for scale, named in (
        (full, dict(zip(("x", "xy", "xz", "yx", "y", "yz", "zx", "zy", "z"), full.ravel(), strict=True))),
        (np.diag([1.0, 2.0, 3.0]), {"x": 1.0, "y": 2.0, "z": 3.0}),
    ):
        found = written(constants(scale=scale), {Sensor.GYROSCOPE: ("zero", "scale")})
        assert {w.name: w.value for w in found} == zero | {f"scale_{axes}": value for axes, value in named.items()}
        assert len(found) == 3 + len(named)
        assert {(w.sensor, w.unit_id) for w in found} == {("gyroscope", "")}


def test_a_zero_without_bends_is_a_line_over_temperature() -> None:
    sloped = triad(zero_per_degc=np.array([1.0, 2.0, 3.0]), scale=np.eye(3), zero=np.zeros(3))
    found = sloped.apply(np.zeros((2, 3)), np.array([21.0, 30.0]))
    np.testing.assert_array_equal(found, [[-1.0, -2.0, -3.0], [-10.0, -20.0, -30.0]])
    assert sloped.zero_per_degc2.tolist() == sloped.zero_per_degc3.tolist() == [0.0, 0.0, 0.0]
