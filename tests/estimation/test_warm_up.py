"""The gyroscope's zero against temperature within one flight."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from numerics_support import ROUNDING

from fieldcal.config.stage_settings import WarmUpSettings, taken_from
from fieldcal.errors import UnusableFlight
from fieldcal.estimation.warm_up import SCALE_PER_DEGC_SD, fit_resting_accelerometer, fit_warm_up, rest_windows
from fieldcal.names import Sensor
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SCALE, Experiment, simulate
from fieldcal.stages.beside.warm_up import find_warm_up
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import triad_rows
from fieldcal.stages.tables import calibration_rows

RATE_HZ = 100.0
SLOPE = np.array([4.0, -7.0, 0.5])
ZERO = np.array([31000.0, 33000.0, 32000.0])
ACCELEROMETER_SLOPE = np.array([6e-3, -4e-3, 5e-3])
"""m/s² per °C"""
HONEST = (0.8, 1.25)
PER_DEGC = (1e-3, -2e-3, 5e-4)


def warming(seed: int, minutes: float = 2.0, noise: float = 30.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A log at rest that warms from 15 to 35 °C."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(60.0 * minutes * RATE_HZ)) / RATE_HZ
    warm = 15.0 + 20.0 * (1.0 - np.exp(-3.0 * t / t[-1]))
    return t, ZERO + np.outer(warm - 25.0, SLOPE) + noise * rng.normal(size=(len(t), 3)), warm


def test_with_hardly_any_noise_the_slope_comes_back() -> None:
    t, logged, warm = warming(0, noise=0.1)
    found = fit_warm_up(t, logged, warm)
    assert found.n_windows == 60
    assert found.zero_per_degc == pytest.approx(SLOPE, rel=1e-3)
    assert found.zero == pytest.approx(ZERO + SLOPE * (found.temperature_degc - 25.0), rel=1e-6)


def test_standard_deviations_are_honest() -> None:
    errors = []
    for seed in range(100):
        found = fit_warm_up(*warming(seed))
        errors.append((found.zero_per_degc - SLOPE) / found.sd)
    assert HONEST[0] < np.sqrt(np.mean(np.square(errors))) < HONEST[1]


def test_turning_is_not_rest_and_slow_turning_is_outlying() -> None:
    t, logged, warm = warming(1, minutes=4.0)
    fast = (t > 60.0) & (t < 100.0)
    turned = logged.copy()
    turned[fast, 2] += 3000.0 * np.sin(2.0 * np.pi * 0.7 * t[fast])
    middles, _ = rest_windows(t, turned)
    assert not ((middles > 62.0) & (middles < 98.0)).any()
    assert len(middles) > 80
    turned[(t > 150.0) & (t < 156.0), 0] += 2000.0  # a steady turn of three windows
    found = fit_warm_up(t, turned, warm)
    clean = fit_warm_up(t, logged, warm)
    assert np.abs(found.zero_per_degc - SLOPE).max() < 5.0 * clean.sd.max()


def test_units_do_not_matter() -> None:
    t, logged, warm = warming(2)
    one, other = fit_warm_up(t, logged, warm), fit_warm_up(t + 1e4, 1e-4 * logged, warm)
    assert 1e4 * other.zero_per_degc == pytest.approx(one.zero_per_degc, rel=1e-6)
    assert 1e4 * other.sd == pytest.approx(one.sd, rel=1e-6)
    assert other.temperature_degc == pytest.approx(one.temperature_degc, rel=ROUNDING)


def test_refusals() -> None:
    t, logged, warm = warming(3)
    with pytest.raises(UnusableFlight) as steady:
        fit_warm_up(t, logged, np.full(len(t), 21.0))
    assert steady.value.reason_code == "temperature_steady"
    with pytest.raises(UnusableFlight) as short:
        fit_warm_up(t[:1000], logged[:1000], warm[:1000])
    assert short.value.reason_code == "too_little_rest"
    assert short.value.measured["rest_windows"] == 5


def resting(seed: int, tilt: float = 0.0, minutes: float = 2.0) -> tuple[np.ndarray, ...]:
    """(t, rate, acceleration, temperature, gravity), counts and m/s², flat on the ground; scale and zero move with
    temperature. `tilt`: it is put down again half-way, so much off, rad."""
    rng = np.random.default_rng([seed, 7])
    t, rate, warm = warming(seed, minutes)
    gravity = np.tile([0.3, -0.2, 9.8], (len(t), 1))
    later = t > 0.5 * t[-1]
    gravity[later, 0] += 9.8 * tilt
    scale = 1.0 + np.outer(warm - 25.0, SCALE_PER_DEGC_SD * rng.normal(size=3))
    acceleration = scale * gravity + np.outer(warm - 25.0, ACCELEROMETER_SLOPE) + 0.03 * rng.normal(size=(len(t), 3))
    if tilt:
        moving = np.abs(t - 0.5 * t[-1]) < 3.0
        rate[moving] += 3000.0 * np.sin(4.0 * t[moving])[:, None]
    return t, rate, acceleration, warm, gravity


def test_a_resting_accelerometer_is_honest_along_and_across_gravity() -> None:
    """Across gravity the zero shows; along it the scale's own slope does as well, which the sd has to hold."""
    ratios = []
    for seed in range(60):
        found = fit_resting_accelerometer(*resting(seed))
        ratios.append((found.zero_per_degc - ACCELEROMETER_SLOPE) / found.sd)
        assert found.sd[2] > 10.0 * found.sd[:2].max()
    for axis in range(3):
        assert HONEST[0] < np.sqrt(np.mean(np.square(ratios), axis=0))[axis] < HONEST[1]


def test_an_accelerometer_that_was_moved_counts_from_one_rest_alone() -> None:
    found = fit_resting_accelerometer(*resting(1, tilt=0.1, minutes=4.0))
    assert found.n_windows < 65  # of 117
    assert abs(found.zero_per_degc[0] - ACCELEROMETER_SLOPE[0]) < 4.0 * found.sd[0]
    with pytest.raises(UnusableFlight) as short:
        fit_resting_accelerometer(*(x[:1000] for x in resting(2)))
    assert short.value.reason_code == "too_little_rest"
    t, rate, acceleration, _, gravity = resting(3)
    with pytest.raises(UnusableFlight) as steady:
        fit_resting_accelerometer(t, rate, acceleration, np.full(len(t), 21.0), gravity)
    assert steady.value.reason_code == "temperature_steady"


def test_the_stage_tells_of_a_resting_accelerometer() -> None:
    t, rate, acceleration, warm, _ = resting(4)
    t_ns = np.rint(1e9 * t).astype(np.int64)
    triads = {"gyroscope": rate, "accelerometer": acceleration}
    imu = pl.DataFrame({"t_ns": t_ns, **{f"{n}_{a}": x[:, i] for n, x in triads.items() for i, a in enumerate("xyz")}})
    known = triad_rows(
        "accelerometer",
        "ellipsoid_robust",
        np.eye(3),
        np.zeros(3),
        np.eye(6) * 1e-6,
        unit="m/s^2",
        logged_unit="m/s^2",
        reference_reading=np.zeros(3),
        temperature_degc=25.0,
    )
    tables = {
        "imu": imu,
        "temperature": pl.DataFrame({"t_ns": t_ns, "temperature_degc": warm}),
        "accelerometer": calibration_rows(known),
    }
    units = {Sensor.GYROSCOPE: "counts", Sensor.ACCELEROMETER: "m/s^2"}
    s = WarmUpSettings(units=units, manoeuvre_max_gap_s=0.1)
    rows = find_warm_up(tables, s).tables["calibration"].filter(sensor="accelerometer")
    assert rows["unit"].unique().to_list() == ["(m/s^2)/degC"]
    assert np.abs((rows["value"].to_numpy() - ACCELEROMETER_SLOPE) / rows["sd"].to_numpy()).max() < 3.5
    del tables["accelerometer"]
    assert set(find_warm_up(tables, s).tables["calibration"]["sensor"]) == {"gyroscope"}


def test_a_simulated_flight_tells_its_slope() -> None:
    """The paper's manoeuvre, with rests between the doublets and tremor throughout: the stage's rows."""
    errors = []
    for seed in range(12):
        experiment = Experiment(
            seed=seed,
            duration_s=90.0,
            temperature_degc=(10.0, 30.0),
            bias_per_degc={"gyroscope": PER_DEGC},
            vps=False,
            band_limit=False,
        )
        result = find_warm_up(signals(simulate(experiment)), taken_from(settings(experiment), WarmUpSettings))
        rows = result.tables["calibration"]
        assert rows["unit"].unique().to_list() == ["counts/degC"]
        errors += list((rows["value"].to_numpy() + np.array(PER_DEGC) / np.array(SCALE["gyroscope"])) / rows["sd"])
    assert np.sqrt(np.mean(np.square(errors))) < HONEST[1]
    steady = Experiment(seed=1, duration_s=25.0)
    result = run_flight(signals(simulate(steady)), settings(steady))["warm_up"]
    assert (result.status, result.tables) == ("absent", {})
