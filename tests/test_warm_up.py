"""The gyroscope's zero against temperature within one flight."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import ROUNDING

from fieldcal.errors import UnusableFlight
from fieldcal.pipeline import run_flight
from fieldcal.simulate import SCALE, Experiment, simulate
from fieldcal.simulate_logs import settings, signals
from fieldcal.stages.warm_up import find_warm_up
from fieldcal.warm_up import fit_warm_up, rest_windows

RATE_HZ = 100.0
SLOPE = np.array([4.0, -7.0, 0.5])
ZERO = np.array([31000.0, 33000.0, 32000.0])
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


def test_a_simulated_flight_tells_its_slope() -> None:
    """The paper's manoeuvre, with rests between the doublets and tremor throughout: the stage's rows."""
    errors = []
    for seed in range(12):
        experiment = Experiment(
            seed=seed, duration_s=90.0, temperature_degc=(10.0, 30.0), bias_per_degc={"gyroscope": PER_DEGC}, vps=False,
            band_limit=False,
        )
        result = find_warm_up(signals(simulate(experiment)), settings(experiment))
        rows = result.tables["calibration"]
        assert rows["unit"].unique().to_list() == ["counts/degC"]
        errors += list((rows["value"].to_numpy() + np.array(PER_DEGC) / np.array(SCALE["gyroscope"])) / rows["sd"])
    assert np.sqrt(np.mean(np.square(errors))) < HONEST[1]
    steady = Experiment(seed=1, duration_s=25.0)
    result = run_flight(signals(simulate(steady)), settings(steady))["warm_up"]
    assert (result.status, result.tables) == ("absent", {})
