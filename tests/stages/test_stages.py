"""The chain of stages on recordings that are awkward: wrong polarity at every dip, planar motion, gaps, slow sensors,
translation, other time origins. What comes out with status ok must be right."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import polars as pl
import pytest
from numerics_support import constants, logged, rms
from scipy.spatial.transform import Rotation

from fieldcal.config.stage_settings import ManoeuvreSettings, taken_from
from fieldcal.geometry.rotation import from_euler
from fieldcal.names import SENSORS, Sensor
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import NOISE_VARIANCE, Experiment, SimulatedFlight, simulate
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.preparation import find_manoeuvre
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import AXES, columns_of, triad

WRONG = 0.05  # no accepted scale may be further off
GOOD = {"magnetometer": 0.02, "accelerometer": 0.02, "gyroscope": 0.03}
STAGE = {"magnetometer": "magnetometer", "accelerometer": "accelerometer_pass2", "gyroscope": "gyro_output"}

GYRO = triad("gyroscope")

Results = dict[str, StageResult]


def scale_rows(results: Results, sensor: str) -> pl.DataFrame:
    """Scale rows of a sensor's last word, accepted ones only; all methods."""
    table = results[STAGE[sensor]].tables.get("calibration")
    if table is None:
        return pl.DataFrame(schema={"method": pl.String, "axis": pl.String, "value": pl.Float64, "sd": pl.Float64})
    return table.filter(parameter="scale", status="ok").select("method", "axis", "value", "sd")


def relative_errors(results: Results, sensor: str) -> dict[tuple[str, str], float]:
    """(method, axis) → relative error of every accepted scale."""
    truth = dict(zip(AXES, constants(sensor)[0], strict=True))
    return {(m, a): v / truth[a] - 1.0 for m, a, v, _ in scale_rows(results, sensor).iter_rows()}


def run(recording: SimulatedFlight, tables: dict[str, pl.DataFrame] | None = None, **changes: Any) -> Results:
    return run_flight(tables or signals(recording), settings(recording.experiment, **changes))


@cache
def flight(dip_rad: float = 0.0) -> SimulatedFlight:
    return simulate(seed=21, dip_rad=dip_rad, vps=False)


# polarity ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("dip_rad", [0.0, 0.5, 1.1])
def test_wrong_polarity_never_passes_as_a_wrong_scale(dip_rad: float, sensor: str, axis: int) -> None:
    """One axis of one sensor declared the wrong way round: refused by axis or altogether, or right in spite of it."""
    polarity = settings(flight(dip_rad).experiment).polarity
    wrong = {**polarity, sensor: [-p if i == axis else p for i, p in enumerate(polarity[sensor])]}
    results = run(flight(dip_rad), polarity=wrong)
    errors = relative_errors(results, "gyroscope")
    accepted = {a for m, a in errors if m == "output_error"}
    assert accepted != set(AXES)
    assert all(abs(error) < WRONG for error in errors.values()), errors


# geometry ------------------------------------------------------------------------------------------------------------


def turned_like(recording: SimulatedFlight, euler: np.ndarray, rate: np.ndarray) -> SimulatedFlight:
    """The recording with other attitudes (bank, pitch, heading (n, 3)) and body rates, and white noise of Table 1."""
    rng, body = np.random.default_rng(0), Rotation.from_quat(from_euler(euler)).inv()
    true = {
        "magnetometer": body.apply([1.0, 0.0, 0.0]),
        "accelerometer": body.apply([0.0, 0.0, 9.81]),
        "gyroscope": rate,
    }
    counts = {
        name: np.rint(
            logged(true[name] + np.sqrt(NOISE_VARIANCE[name]) * rng.normal(size=rate.shape), *constants(name))
        )
        for name in SENSORS
    }
    return replace(recording, counts=counts)


@pytest.mark.parametrize("about", range(3))
def test_rotation_about_one_axis_calibrates_nothing_wrongly(about: int) -> None:
    """Planar motion: no triad sees enough of its sphere, and a gyroscope axis that did not turn is never accepted."""
    t = flight().t
    angle = 0.9 * np.sin(2 * np.pi * 0.3 * t)
    euler, rate = np.zeros((2, len(t), 3))
    euler[:, about], rate[:, about] = angle, 0.9 * 2 * np.pi * 0.3 * np.cos(2 * np.pi * 0.3 * t)
    results = run(turned_like(flight(), euler, rate))
    for sensor in ("magnetometer", "accelerometer"):
        assert results[STAGE[sensor]].status == "refused", sensor
        assert results[STAGE[sensor]].reason_code
        assert results[STAGE[sensor]].measured
    assert {a for _, a in relative_errors(results, "gyroscope")} <= {AXES[about]}


def test_small_angles_are_refused_with_the_condition_number() -> None:
    small = simulate(seed=3, peak_rad=(0.25, 0.35), vps=False)
    results = run(small)
    for sensor in ("magnetometer", "accelerometer"):
        assert results[STAGE[sensor]].status == "refused"
        assert not relative_errors(results, sensor)
    assert not relative_errors(results, "gyroscope")


def test_what_only_shakes_lies_still() -> None:
    """Half of a minute at rest on something that hums: loud beside the other half, and no motion that tells a scale."""
    t = np.arange(15_000) / 250.0
    hum = np.where(t < 30.0, 2e-3 * np.sin(2.0 * np.pi * 3.0 * t), 0.0)
    noise = np.random.default_rng(0).normal(0.0, 2e-4, (len(t), 3))
    one = {Sensor.GYROSCOPE: (1.0, 1.0, 1.0)}
    chosen = settings(flight().experiment, nominal_scale=dict.fromkeys(SENSORS) | one)
    for size, expected in ((1.0, "refused"), (200.0, "ok")):
        imu = pl.DataFrame({"t_ns": np.rint(t * 1e9).astype(np.int64)} | columns_of(size * hum[:, None] + noise, GYRO))
        found = find_manoeuvre({"imu": imu}, taken_from(chosen, ManoeuvreSettings))
        assert found.measured["excited_s"] == pytest.approx(30.0, abs=1.0)
        assert found.status == expected
    assert found.reason_code is None


# time ----------------------------------------------------------------------------------------------------------------


def test_a_gap_splits_and_costs_little() -> None:
    """Three seconds lost in the middle, and one sample in fifty."""
    recording = simulate(seed=21, lost_share=0.02, vps=False)
    middle = (recording.t > 18.0) & (recording.t < 21.0)
    tables = {name: table.filter(~middle) for name, table in signals(recording).items()}
    results = run(recording, tables)
    segments = results["manoeuvre"].tables["segments"].filter("used")
    assert len(segments) == 2
    assert set(results["smoothing"].tables["samples"]["segment"].unique()) == set(segments["segment"])
    for sensor, tolerance in GOOD.items():
        errors = relative_errors(results, sensor)
        assert len(errors) >= 3
        assert rms(list(errors.values())) < tolerance, sensor


def test_time_origin_does_not_matter() -> None:
    """Stamps of today's epoch, in nanoseconds, to the last digit."""
    tables = {name: t.with_columns(pl.col("t_ns") + 1_760_000_000_123_456_789) for name, t in signals(flight()).items()}
    here, there = run(flight()), run(flight(), tables)
    for sensor in SENSORS:
        assert scale_rows(here, sensor).equals(scale_rows(there, sensor)), sensor


def test_a_slow_magnetometer_is_enough() -> None:
    """Every eighth sample of the magnetometer, 23 Hz, on stamps of its own."""
    tables = signals(flight())
    tables["magnetometer"] = tables["magnetometer"].gather_every(8)
    results = run(flight(), tables)
    for sensor in SENSORS:
        errors = relative_errors(results, sensor)
        assert {a for _, a in errors} == set(AXES), sensor
        assert rms(list(errors.values())) < 3 * GOOD[sensor], sensor


# other accelerations, temperature ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_translation_is_refused_or_survived(seed: int) -> None:
    """0.3 m/s² rms below 2 Hz and a lever arm of 6 cm: a serial method may refuse; what it accepts is near the truth,
    and the magnetometer does not suffer."""
    results = run(simulate(seed=seed, translation_rms_mps2=0.3, lever_arm_m=(0.05, 0.02, -0.03), vps=False))
    for sensor in SENSORS:
        rows, truth = scale_rows(results, sensor), dict(zip(AXES, constants(sensor)[0], strict=True))
        for _, axis, value, sd in rows.iter_rows():
            assert abs(value - truth[axis]) < max(5 * sd, WRONG * abs(truth[axis])), (sensor, axis)
    assert len(relative_errors(results, "magnetometer")) == 3


def test_temperature_is_written_beside_the_constants() -> None:
    recording = simulate(Experiment(seed=1, temperature_degc=(20.0, 30.0), vps=False))
    results = run(recording)
    for sensor in SENSORS:
        temperatures = results[STAGE[sensor]].tables["calibration"]["temperature_degc"]
        assert temperatures.to_list() == pytest.approx([25.0] * len(temperatures), abs=0.1)


def test_zero_and_zero_bias_say_the_same_as_scale_and_bias() -> None:
    """zero = −b/λ; zero_bias = λ d0 + b at mid-scale of unsigned words, with a smaller sd than the bias's own."""
    for sensor in SENSORS:
        rows = run(flight())[STAGE[sensor]].tables["calibration"]
        rows = rows.filter(pl.col("method") == rows["method"].to_list()[-1])
        value = {(p, a): v for p, a, v in rows.select("parameter", "axis", "value").iter_rows()}
        sd = {(p, a): v for p, a, v in rows.select("parameter", "axis", "sd").iter_rows()}
        for a in AXES:
            assert value["zero", a] == pytest.approx(-value["bias", a] / value["scale", a])
            assert value["zero_bias", a] == pytest.approx(32768.0 * value["scale", a] + value["bias", a], abs=1e-9)
            assert sd["zero_bias", a] < 0.5 * sd["bias", a]
