"""What the joint estimate asks of recordings in physical units, rung by rung."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest

from fieldcal.estimation.joint.ladder import held, scales_held, tilt_rms
from fieldcal.estimation.joint.problem import PriorConstants
from fieldcal.geometry.rotation import from_rotation_vector
from fieldcal.names import Sensor
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SimulatedFlight, constants_at, simulate
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult

# The unit's scales are 1; what is left of the simulator's constants after the nominal ones.
OFF = {"gyroscope": (1.01, 0.985, 1.005), "accelerometer": (0.99, 1.012, 1.004), "magnetometer": (1.04, 1.06, 1.02)}
ZERO = {"gyroscope": (0.01, -0.02, 0.015), "accelerometer": (0.1, -0.15, 0.05), "magnetometer": (0.1, -0.05, 0.08)}


def physical(r: SimulatedFlight, off: dict[str, Any] = OFF, **changes: Any) -> dict[str, StageResult]:
    """A flight as a log in physical units: scale `off`, zero ZERO to be found."""
    frames = signals(r)
    for name in OFF:
        table = "magnetometer" if name == "magnetometer" else "imu"
        columns = [f"{name}_{axis}" for axis in "xyz"]
        scale, bias = constants_at(r.experiment, name, 25.0)
        true = frames[table].select(columns).to_numpy() * scale + bias
        logged = true / np.asarray(off[name]) + np.asarray(ZERO[name])
        frames[table] = frames[table].with_columns(
            **{c: pl.Series(np.ascontiguousarray(logged[:, i])) for i, c in enumerate(columns)}
        )
    units = {Sensor.GYROSCOPE: "rad/s", Sensor.ACCELEROMETER: "m/s^2", Sensor.MAGNETOMETER: "norm"}
    own = settings(
        r.experiment,
        method="joint",
        use_vps=False,
        lever_arm_m=None,
        units=units,
        nominal_scale=dict.fromkeys(units, (1.0, 1.0, 1.0)),
        polarity=dict.fromkeys(units, (1, 1, 1)),
        **changes,
    )
    return run_flight(frames, own)


def rows_of(results: dict[str, StageResult], sensor: str, parameter: str) -> pl.DataFrame:
    rows = results["joint"].tables["calibration"]
    return rows.filter(pl.col("axis").is_in(["x", "y", "z"]), sensor=sensor, parameter=parameter)


def test_every_motion_stands_on_the_first_rung_and_finds_what_is_off() -> None:
    r = simulate(seed=71, dip_rad=np.radians(60.0))
    results = physical(r)
    assert results["joint"].measured["rung"] == "free"
    for name in OFF:
        rows = rows_of(results, name, "scale")
        assert set(rows["status"]) == {"ok"}, name
        z = (rows["value"].to_numpy() - OFF[name]) / rows["sd"].to_numpy()
        assert np.abs(z).max() < 4.0, name


def test_a_level_log_holds_the_accelerometer_and_tells_the_gyroscope() -> None:
    level = {"turned": (0.0, 0.0, 1.0), "tremor_rad": 0.02, "dip_rad": np.radians(60.0), "translation_rms_mps2": 0.5}
    results = physical(simulate(seed=72, peak_rad=(1.3, 1.5), **level))
    assert results["joint"].measured["rung"] == "held"
    assert set(rows_of(results, "accelerometer", "scale")["reason_code"]) == {"held_at_nominal"}
    assert set(rows_of(results, "accelerometer", "zero")["status"]) == {"refused"}
    yaw = rows_of(results, "gyroscope", "scale").filter(axis="z")
    assert yaw["status"][0] == "ok"
    assert abs(yaw["value"][0] - OFF["gyroscope"][2]) < 4.0 * yaw["sd"][0]
    little = physical(simulate(seed=72, **level))  # its sd is 2.8 %, of 3 % beforehand
    assert rows_of(little, "gyroscope", "scale").filter(axis="z")["reason_code"][0] == "scale_uncertain"
    # A zero needs no turning: it is published beside scales that are refused.
    zeros = rows_of(results, "gyroscope", "zero")
    assert set(zeros["status"]) == {"ok"}
    z = (zeros["value"].to_numpy() - ZERO["gyroscope"]) / zeros["sd"].to_numpy()
    assert np.abs(z).max() < 4.0


def test_a_scale_that_no_sensor_of_this_unit_has_is_refused() -> None:
    r = simulate(seed=73, dip_rad=np.radians(60.0))
    results = physical(r, {**OFF, "gyroscope": (1.25, 0.985, 1.005)})
    assert set(rows_of(results, "gyroscope", "scale")["status"]) == {"refused"}
    assert set(rows_of(results, "gyroscope", "scale")["reason_code"]) == {"prior_contradicted"}


def test_held_constants_are_known_beyond_doubt() -> None:
    prior = PriorConstants(np.ones(3), np.zeros(3), np.diag(np.full(6, 0.03**2)))
    assert np.sqrt(np.diagonal(held(prior).covariance)).max() < 1e-6
    both = np.sqrt(np.diagonal(scales_held(prior).covariance))
    assert both[:3].max() < 1e-6
    assert both[3:] == pytest.approx(0.03)


def test_tilt_is_how_far_gravity_moves() -> None:
    """Banked by ±β as often one way as the other: sin β along y, cos β along z all the time."""
    bank = np.r_[np.full(50, 0.3), np.full(50, -0.3)]
    q = from_rotation_vector(np.column_stack([bank, np.zeros((100, 2))]))
    assert tilt_rms(q) == pytest.approx(np.sin(0.3) / np.sqrt(3.0))
    heading = from_rotation_vector(np.column_stack([np.zeros((100, 2)), np.linspace(0.0, 6.0, 100)]))
    assert tilt_rms(heading) == pytest.approx(0.0, abs=1e-12)
