"""What a flight knows, as rows: it adds up over flights, and follows the constants of the raw sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest

from fieldcal.estimation.normal_equations import NormalEquations
from fieldcal.names import SENSORS
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SimulatedFlight, simulate
from fieldcal.stages.joint.information import equations_of, kept
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult

SCALE = {"gyroscope": (1.01, 0.99, 1.015), "accelerometer": (0.985, 1.01, 1.02), "magnetometer": (1.05, 0.97, 1.02)}
BIAS = {"gyroscope": (0.01, -0.02, 0.015), "accelerometer": (0.15, -0.2, 0.1), "magnetometer": (0.05, -0.1, 0.07)}
UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "norm"}
HALVES_AGREE_SD = 0.2
"""Rms over the parameters of what the halves of a flight together differ from the whole, over its sd."""


def flown(r: SimulatedFlight, span_s: tuple[float, float] = (0.0, 1e6), **changes: Any) -> dict[str, StageResult]:
    a_ns, b_ns = (int(1e9 * s) for s in span_s)
    frames = {name: frame.filter(pl.col("t_ns").is_between(a_ns, b_ns)) for name, frame in signals(r).items()}
    known = {
        "units": UNITS,
        "nominal_scale": dict.fromkeys(SENSORS, (1.0, 1.0, 1.0)),
        "polarity": dict.fromkeys(SENSORS, (1, 1, 1)),
    }
    return run_flight(
        frames, settings(r.experiment, method="joint", lever_arm_m=None, use_vps=False, **known, **changes)
    )


def found(results: dict[str, StageResult], stage: str = "composition") -> NormalEquations:
    own = equations_of(results[stage].tables["information"])
    return own.of([name for name in own.names if name[1] in ("gain", "zero")])


def simulated(seed: int, **changes: Any) -> SimulatedFlight:
    return simulate(seed=seed, dip_rad=1.0, scale=SCALE, bias=BIAS, quantisation=False, vps=False, **changes)


def test_two_halves_of_a_flight_together_say_what_the_whole_says() -> None:
    r = simulated(3, duration_s=70.0, sets=6, translation_rms_mps2=0.2)
    whole = found(flown(r))
    halves = [found(flown(r, span)).moved(whole.reference) for span in ((0.0, 35.0), (35.0, 70.0))]
    information = halves[0].information + halves[1].information
    together = np.linalg.solve(information, halves[0].right + halves[1].right)
    sd = np.sqrt(np.diagonal(np.linalg.inv(whole.information)))
    alone = np.linalg.solve(whole.information, whole.right)
    assert np.sqrt(np.mean(((together - alone) / sd) ** 2)) < HALVES_AGREE_SD
    ratio = np.sqrt(np.diagonal(np.linalg.inv(information))) / sd
    assert 0.7 < ratio.min() < ratio.max() < 1.4


def test_a_flight_whose_rows_are_refused_has_information() -> None:
    """Hardly banked or pitched: no scale of a vector sensor is told, the gyroscope's zero is."""
    results = flown(simulated(1, duration_s=30.0, sets=2, turned=(0.15, 0.15, 1.0), translation_rms_mps2=0.3))
    rows = results["composition"].tables["calibration"].filter(method="joint", parameter="scale")
    assert set(rows.filter(sensor="accelerometer")["status"]) == {"refused"}
    own = results["composition"].tables["information"]
    assert set(own["sensor"]) == set(SENSORS)
    assert own["information"].list.len().to_list() == list(range(1, own.height + 1))
    gyroscope = kept(own, {("gyroscope", "zero", axis) for axis in "xyz"})
    sd = np.sqrt(np.diagonal(np.linalg.inv(equations_of(gyroscope).information)))
    assert (sd < 0.01).all()  # rad/s, a third of what was known beforehand


@pytest.mark.parametrize("off_diagonal", [0.0, 0.02])
def test_of_a_raw_sensor_it_follows_the_constants(off_diagonal: float) -> None:
    """An autopilot had made logged = P raw + o of it: gain and zero are those of the composed rows, their sd too."""
    matrix = np.diag([1.1, 0.9, 1.05]) + off_diagonal * (np.ones((3, 3)) - np.eye(3))
    applied = {
        "applied_matrix": {**dict.fromkeys(SENSORS), "accelerometer": tuple(map(tuple, matrix.tolist()))},
        "applied_offset": {**dict.fromkeys(SENSORS), "accelerometer": (0.3, -0.2, 0.1)},
        "applied_known": {**dict.fromkeys(SENSORS), "accelerometer": True},
        "applied_offset_sd": {**dict.fromkeys(SENSORS), "accelerometer": (0.01, 0.02, 0.03)},
    }
    r = simulated(6, duration_s=30.0)
    results = flown(r, **applied)
    raw, rows = found(results), results["composition"].tables["calibration"]
    sd = np.sqrt(np.diagonal(np.linalg.inv(raw.information)))
    logged_sd = np.sqrt(np.diagonal(np.linalg.inv(found(results, "joint").information)))
    for k, (sensor, parameter, axis) in enumerate(raw.names):
        name = "scale" if parameter == "gain" else "zero"
        row = rows.filter(sensor=sensor, parameter=name, axis=axis, method="joint").row(0, named=True)
        assert raw.reference[k] == pytest.approx(1.0 / row["value"] if parameter == "gain" else row["value"], rel=1e-9)
        if (sensor, parameter) == ("accelerometer", "zero") and not off_diagonal:
            i = "xyz".index(axis)
            expected = np.hypot(logged_sd[k], applied["applied_offset_sd"]["accelerometer"][i]) / matrix[i, i]
            assert sd[k] == pytest.approx(expected, rel=1e-6)
    unknown = flown(r, **{**applied, "applied_known": {**dict.fromkeys(SENSORS), "accelerometer": False}})
    assert "accelerometer" not in unknown["composition"].tables["information"]["sensor"].to_list()
