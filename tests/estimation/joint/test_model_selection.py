"""Optional terms of the joint estimate: exact without noise, let in where needed, kept out where they are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from test_joint import own_start, readings, truth

from fieldcal.estimation.joint import initialise
from fieldcal.estimation.joint.fit import JointFit, fit_joint
from fieldcal.estimation.joint.model_selection import SCORE_CHI2, add_terms, with_zeros
from fieldcal.estimation.joint.problem import TERMS, Model, State
from fieldcal.names import SENSORS
from fieldcal.simulation.experiment import NOISE_VARIANCE, SimulatedFlight, simulate

# Axes off by up to 1.7°; the accelerometer's first axis is the body's.
MIXED = {
    "gyroscope": np.array([[0, 0.02, -0.02], [0.015, 0, 0.02], [-0.02, 0.02, 0]]),
    "magnetometer": np.array([[0, 0.02, -0.01], [0.01, 0, 0.03], [-0.02, 0.01, 0]]),
    "accelerometer": np.array([[0, 0, 0], [0.006, 0, 0], [-0.004, 0.005, 0]]),
}
DELAY_S = 0.008
# Readings averaged over three samples, a delay from rates smoothed over 60 ms.
DISCRETISATION = 1.5e-3
# Zeros, of some 6000 counts that field, gravity or turning move: the delay is taken to first order, 8 ms at 3 rad/s.
ZERO_COUNTS = 12.0
MOVING = {"translation_rms_mps2": 0.3, "lever_arm_m": (0.05, 0.02, -0.03)}


def crossed(r: SimulatedFlight, *names: str) -> dict[str, np.ndarray]:
    """Counts of triads whose true model is z = (I + E)(Λ c + b)."""
    out = dict(r.counts)
    for name in names:
        scale, bias = truth(r, name)
        out[name] = (np.linalg.solve(np.eye(3) + MIXED[name], (r.counts[name] * scale + bias).T).T - bias) / scale
    return out


def late(r: SimulatedFlight, name: str) -> dict[str, np.ndarray]:
    return {**r.counts, name: np.column_stack([np.interp(r.t - DELAY_S, r.t, x) for x in r.counts[name].T])}


def prepared(r: SimulatedFlight, counts: dict[str, np.ndarray], **changes: Any) -> tuple[Model, State]:
    segment = np.zeros(len(r.t), dtype=np.int64)
    given = readings(r, **counts, turning=initialise.turning(r.t, segment, counts["gyroscope"]), **changes)
    return initialise.prepare(given, own_start(given, r.experiment))


def fitted(r: SimulatedFlight, counts: dict[str, np.ndarray], **changes: Any) -> JointFit:
    return fit_joint(*prepared(r, counts, **changes))


def kept(fit: JointFit) -> tuple[JointFit, set[str]]:
    fit, tests = add_terms(fit)
    return fit, {test.name for test in tests if test.kept}


OF_OTHER_RECORDS = ("gyroscope_temperature", "gyroscope_g_sensitivity")
"""Terms of a record with a temperature, or with a VPS."""


def test_matrices_and_delays_are_recovered_all_at_once() -> None:
    """With a thirtieth of the paper's noise: noise levels at their floors would never settle."""
    r = simulate(seed=1, noise=False, quantisation=False, band_limit=False)
    counts, rng = crossed(r, *SENSORS), np.random.default_rng(1)
    for name in SENSORS:
        sigma = np.sqrt(NOISE_VARIANCE[name]) / np.abs(truth(r, name)[0]) / 30.0
        counts[name] = counts[name] + sigma * rng.normal(size=counts[name].shape)
    counts["magnetometer"] = np.column_stack([np.interp(r.t - DELAY_S, r.t, x) for x in counts["magnetometer"].T])
    model, start = prepared(r, counts)
    fit = fit_joint(model, with_zeros(start, [name for name in TERMS if name not in OF_OTHER_RECORDS]))
    for name in SENSORS:
        scale, bias = truth(r, name)
        true = (np.eye(3) + MIXED[name]) @ np.diag(scale)
        matrix, offset, _ = fit.full_constants(name)
        assert np.abs((matrix - true) / scale[:, None]).max() < DISCRETISATION, name
        at_middle = (matrix - true) @ np.full(3, 32768.0) + offset - (np.eye(3) + MIXED[name]) @ bias
        assert np.abs(at_middle / scale).max() < ZERO_COUNTS, name
    assert fit.state.values["magnetometer_delay"][0] == pytest.approx(DELAY_S, abs=2e-4)
    assert abs(fit.state.values["accelerometer_delay"][0]) < 2e-4


def test_clean_flights_keep_diagonal_matrices() -> None:
    for seed in (21, 22, 23, 24):
        r = simulate(seed=seed, **(MOVING if seed % 2 else {}))
        fit = fitted(r, r.counts)
        assert kept(fit)[0] is fit


def test_a_term_that_is_there_is_let_in_and_its_sd_is_honest() -> None:
    r = simulate(seed=5100)
    fit, names = kept(fitted(r, crossed(r, "magnetometer")))
    assert names == {"magnetometer_cross"}
    matrix, _, covariance = fit.full_constants("magnetometer")
    true = (np.eye(3) + MIXED["magnetometer"]) @ np.diag(truth(r, "magnetometer")[0])
    normal = (matrix - true).ravel() / np.sqrt(np.diagonal(covariance)[:9])
    assert np.sqrt(np.mean(normal**2)) < 2.0


def test_a_delay_is_found() -> None:
    r = simulate(seed=5101)
    fit, names = kept(fitted(r, late(r, "magnetometer")))
    assert names == {"magnetometer_delay"}
    sd = float(np.sqrt(fit.covariance[fit.layout["magnetometer_delay"], fit.layout["magnetometer_delay"]][0, 0]))
    assert abs(fit.state.values["magnetometer_delay"][0] - DELAY_S) < 4.0 * sd


def test_a_zero_that_goes_with_temperature_is_found() -> None:
    slope = 0.02  # rad/s per °C, over 10 °C
    r = simulate(seed=6, temperature_degc=(20.0, 30.0), bias_per_degc={"gyroscope": (slope, -slope, 0.0)})
    warmth = r.temperature - r.temperature.mean()
    fit, names = kept(fitted(r, r.counts, warmth=warmth))
    assert names == {"gyroscope_temperature"}
    scale, _ = truth(r, "gyroscope")
    zero_per_degc = -fit.state.values["gyroscope_temperature"] * fit.model.triads["gyroscope"].spread
    sd = np.sqrt(np.diagonal(fit.covariance)[fit.layout["gyroscope_temperature"]])
    off = (zero_per_degc + np.array([slope, -slope, 0.0]) / scale) / (sd * fit.model.triads["gyroscope"].spread)
    assert np.abs(off).max() < 4.0


def test_terms_that_the_record_cannot_show_are_not_tried() -> None:
    r = simulate(seed=7, duration_s=20.0, sets=1)
    fit, tests = add_terms(fitted(r, r.counts, warmth=np.zeros(len(r.t))))
    assert "gyroscope_temperature" not in {test.name for test in tests}
    still = replace(fit, path=replace(fit.path, rate=fit.path.rate * 1e-3))
    assert not any(test.name.endswith("_delay") for test in add_terms(still)[1])


def test_every_term_has_a_limit_that_chance_exceeds_once_in_a_thousand() -> None:
    for size in TERMS.values():
        assert chi2.sf(SCORE_CHI2[size], size) == pytest.approx(1e-3, rel=0.03), size
