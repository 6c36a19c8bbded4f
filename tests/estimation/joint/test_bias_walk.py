"""A gyroscope's bias walk: against the likelihood written out, the walk that was simulated, gaps and short records."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import minimize

from fieldcal.estimation.joint.bias_walk import COEFFICIENTS, bias_walk

WALK = 2e-3  # rad/s/√s
NOISE = 0.0133  # rad/√s, of the rate
STEP_S = 0.08
GRID = 0.025  # neighbouring walks of the search, relative


def rates(seed: int, n: int, step_s: float, *, walk: float = WALK, noise: float = NOISE) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    walked = np.cumsum(rng.normal(size=(n, 3)), axis=0) * walk * np.sqrt(step_s)
    return walked + rng.normal(size=(n, 3)) * noise / np.sqrt(step_s) + rng.normal(size=3)


def test_it_is_the_maximum_of_the_likelihood_written_out() -> None:
    """So few steps, of half the shortest period, that every coefficient counts: dense covariance, contrasts free of the
    mean."""
    n, step_s = COEFFICIENTS + 1, 2.0
    own = null_space(np.ones((1, n)))
    covariance = np.minimum.outer(np.arange(n), np.arange(n)) * step_s
    for seed in range(5):
        y = own.T @ rates(seed, n, step_s, walk=5e-3)

        def minus_two_log_likelihood(logarithms: NDArray[np.float64], y: NDArray[np.float64] = y) -> float:
            walk, noise = np.exp(logarithms)
            v = own.T @ (walk**2 * covariance + noise**2 * np.eye(n)) @ own
            return float(3.0 * np.linalg.slogdet(v)[1] + np.sum(y * np.linalg.solve(v, y)))

        best = minimize(minus_two_log_likelihood, np.log([5e-3, NOISE]), method="Nelder-Mead", options={"xatol": 1e-4})
        found = bias_walk(own @ y, np.full(n, step_s), np.ones(n, dtype=bool))
        assert abs(found / np.exp(best.x[0]) - 1.0) < GRID


def test_forty_seconds_of_a_noisy_gyroscope_show_it_without_bias() -> None:
    n = 500
    every = np.full(n, STEP_S), np.ones(n, dtype=bool)
    square = [bias_walk(rates(seed, n, STEP_S), *every) ** 2 for seed in range(200)]
    # Ten degrees of freedom or so: each of 200 is off by about half.
    assert abs(np.mean(square) / WALK**2 - 1.0) < 4.0 * 0.5 / np.sqrt(200)
    none = [bias_walk(rates(seed, n, STEP_S, walk=0.0), *every) for seed in range(200)]
    assert np.mean(np.array(none) == 0.0) > 0.4
    assert np.percentile(none, 95) < 1.2 * WALK


def test_segments_have_means_of_their_own() -> None:
    n = 4000
    rate, joined = rates(3, n, STEP_S), np.ones(n, dtype=bool)
    whole = bias_walk(rate, np.full(n, STEP_S), joined)
    rate[1500:] += 0.1
    rate[1499], joined[1499] = 1e3, False  # between segments there is no rate
    parted = bias_walk(rate, np.where(joined, STEP_S, 1.0), joined)
    assert abs(parted / whole - 1.0) < 0.2
    assert abs(whole / WALK - 1.0) < 0.2


def test_units_and_axes_do_not_matter() -> None:
    n = 800
    rate, every = rates(4, n, STEP_S), (np.full(n, STEP_S), np.ones(n, dtype=bool))
    assert np.isclose(bias_walk(rate[:, ::-1] * -1e3, *every), 1e3 * bias_walk(rate, *every), rtol=1e-9)


def test_too_little_says_nothing() -> None:
    for n in (1, 2, 20):
        assert bias_walk(rates(5, n, STEP_S), np.full(n, STEP_S), np.ones(n, dtype=bool)) == 0.0
    assert bias_walk(np.zeros((300, 3)), np.full(300, STEP_S), np.ones(300, dtype=bool)) == 0.0
    assert bias_walk(rates(6, 3, STEP_S), np.full(3, STEP_S), np.zeros(3, dtype=bool)) == 0.0


def waves(n: int, *strengths: float) -> NDArray[np.float64]:
    """Rates whose slow cosine coefficients are so strong, from the first on: in phase with none of the others."""
    k = np.arange(1, len(strengths) + 1)
    shape = np.cos(np.pi * k * (np.arange(n)[:, None] + 0.5) / n) * np.sqrt(2.0 / n)
    return np.repeat((shape @ np.array(strengths))[:, None], 3, axis=1)


def test_two_coefficients_of_a_period_of_four_seconds_and_more_are_enough() -> None:
    """The k-th has the period 2 n Δt / k: of 50 steps of 0.08 s the second one's is 4 s, of 49 steps it is shorter."""
    for n, told in ((50, True), (49, False)):
        assert (bias_walk(waves(n, 1.0, 0.5), np.full(n, STEP_S), np.ones(n, dtype=bool)) > 0.0) == told


def test_twelve_coefficients_count_and_no_more() -> None:
    """A walk in the first twelve is told whatever is in the thirteenth, and is none if the twelfth stands out."""
    n = 4000
    walk = [1.0 / k for k in range(1, 13)]
    given = np.full(n, STEP_S), np.ones(n, dtype=bool)
    plain = bias_walk(waves(n, *walk), *given)
    assert plain > 0.0
    assert np.isclose(bias_walk(waves(n, *walk, 30.0), *given), plain)
    assert bias_walk(waves(n, *walk[:11], 30.0), *given) == 0.0


def test_exact_coefficients_of_a_walk_tell_it() -> None:
    """A walk of unit density has the variance Δt/(4 sin²(πk/2n)) in its k-th coefficient: without white noise, to half
    a step of the search."""
    n = 300
    k = np.arange(1, 13)
    strengths = 0.5 * WALK * np.sqrt(STEP_S) / np.sin(0.5 * np.pi * k / n)
    found = bias_walk(waves(n, *strengths), np.full(n, STEP_S), np.ones(n, dtype=bool))
    assert np.isclose(found, WALK, rtol=GRID)
