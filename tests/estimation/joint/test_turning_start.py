"""The gyroscope's start from how fast the field or gravity turns: exact, past a magnet, in counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from test_initialise import BIAS, CONSTANTS, FIELD_NED, SCALE, flown

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.joint.turning_start import gyroscope_by_turning
from fieldcal.geometry.rotation import body_from_inertial, propagate
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import simulate
from fieldcal.stages.pipeline import run_flight

LOW_PASSED = 2e-3  # of a scale: a derivative of readings at 128 Hz
PUBLISHED_SD = 4.0


@pytest.mark.parametrize("parts", [1, 2])
def test_the_constants_are_the_true_ones(parts: int) -> None:
    r, _ = flown(parts=parts)
    scale, bias = gyroscope_by_turning(r, CONSTANTS)
    np.testing.assert_allclose(scale, SCALE["gyroscope"], rtol=LOW_PASSED)
    np.testing.assert_allclose(bias, BIAS["gyroscope"], atol=LOW_PASSED)


def test_neither_holes_nor_a_unit_of_the_field_nor_the_accelerometer_matter() -> None:
    r, _ = flown()
    holed = np.array(r.magnetometer)
    holed[300::2] = np.nan
    scale, bias = gyroscope_by_turning(replace(r, magnetometer=holed, accelerometer=None), CONSTANTS)
    np.testing.assert_allclose(scale, SCALE["gyroscope"], rtol=LOW_PASSED)
    np.testing.assert_allclose(bias, BIAS["gyroscope"], atol=LOW_PASSED)
    k = 1e-4  # the field in another unit
    other = replace(r, field_ned=r.field_ned * k)
    again = gyroscope_by_turning(other, {"magnetometer": (SCALE["magnetometer"] * k, BIAS["magnetometer"] * k)})
    np.testing.assert_allclose(again[0], gyroscope_by_turning(r, CONSTANTS)[0], rtol=1e-9)


def test_a_passing_magnet_draws_it_off_little() -> None:
    """Over a tenth of the record the field is half as large again, and turns by itself."""
    r, _ = flown()
    spoiled = np.array(r.magnetometer)
    at = slice(900, 1156)
    swing = np.linalg.norm(FIELD_NED) * np.sin(np.arange(256) / 8.0)[:, None]
    spoiled[at] += 0.5 * swing / SCALE["magnetometer"]
    scale, bias = gyroscope_by_turning(replace(r, magnetometer=spoiled), CONSTANTS)
    np.testing.assert_allclose(scale, SCALE["gyroscope"], rtol=0.02)
    np.testing.assert_allclose(bias, BIAS["gyroscope"], atol=0.02)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("unknown", [True, False])
def test_without_a_magnetometer_gravity_tells_it(sign: float, unknown: bool) -> None:
    """Whether there is none, or it has no constants."""
    r, _ = flown(sign=sign)
    given = r if unknown else replace(r, magnetometer=None)
    start = {**CONSTANTS, "magnetometer": None} if unknown else CONSTANTS
    scale, bias = gyroscope_by_turning(given, start)
    np.testing.assert_allclose(scale, SCALE["gyroscope"], rtol=LOW_PASSED)
    np.testing.assert_allclose(bias, BIAS["gyroscope"], atol=LOW_PASSED)


def test_without_a_vector_or_about_one_axis_there_is_no_start() -> None:
    r, _ = flown()
    rate = np.outer(np.sin(r.t), [0.0, 0.0, 1.0])
    turn = body_from_inertial(propagate(r.t, rate, [0.0, 0.0, 0.0, 1.0]))
    level = replace(
        r,
        gyroscope=(rate - BIAS["gyroscope"]) / SCALE["gyroscope"],
        magnetometer=(turn @ FIELD_NED - BIAS["magnetometer"]) / SCALE["magnetometer"],
    )
    for given, start in (
        (replace(r, magnetometer=None, accelerometer=None), CONSTANTS),
        (r, {"magnetometer": None, "accelerometer": None}),
        (level, CONSTANTS),
    ):
        with pytest.raises(UnusableFlight) as error:
            gyroscope_by_turning(given, start)
        assert error.value.reason_code == "no_start"


@pytest.mark.parametrize(("translation_mps2", "rung"), [(4.0, "turning_start"), (8.0, "field_alone")])
def test_counts_shaken_by_a_good_part_of_gravity_have_their_gyroscope(translation_mps2: float, rung: str) -> None:
    """Their attitudes contradict each other, and the joint estimate from them had no minimum."""
    flight = simulate(
        seed=1, dip_rad=np.radians(60.0), translation_rms_mps2=translation_mps2, temperature_degc=(25.0, 25.0)
    )
    results = run_flight(signals(flight), settings(flight.experiment, method="auto", use_vps=False))
    assert results["attitude"].reason_code == "vectors_contradict"
    assert results["joint"].measured["rung"] == rung
    rows = results["choice"].tables["calibration"].filter(parameter="scale", status="ok")
    rows = rows.filter(pl.col("axis").is_in(["x", "y", "z"]))
    assert rows.filter(sensor="gyroscope").height == 3
    truth = {name: dict(zip("xyz", flight.experiment.scale[name], strict=True)) for name in SCALE}
    for sensor, axis, value, sd in rows.select("sensor", "axis", "value", "sd").rows():
        assert abs(value - truth[sensor][axis]) < PUBLISHED_SD * sd, (sensor, axis)


def test_counts_without_a_magnetometer_have_their_gyroscope() -> None:
    """The joint estimate of such a log had no start."""
    flight = simulate(seed=3, translation_rms_mps2=0.1, temperature_degc=(25.0, 25.0))
    frames = {name: table for name, table in signals(flight).items() if name != "magnetometer"}
    results = run_flight(frames, settings(flight.experiment, method="auto", use_vps=False))
    assert results["joint"].measured["rung"] == "turning_start"
    rows = results["choice"].tables["calibration"].filter(parameter="scale", status="ok", sensor="gyroscope")
    found = dict(rows.filter(pl.col("axis").is_in(["x", "y", "z"])).select("axis", "value").rows())
    assert len(found) == 3
    sd = dict(rows.select("axis", "sd").rows())
    for axis, true in zip("xyz", flight.experiment.scale["gyroscope"], strict=True):
        assert abs(found[axis] - true) < PUBLISHED_SD * sd[axis], axis
