"""Standard errors against direct sums, closed forms and the scatter over many seeds."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import autoregressive, rms
from scipy import signal

from fieldcal.estimation import statistics

HONEST = (0.8, 1.25)


def test_robust_sigma_is_that_of_a_normal_distribution() -> None:
    x = 3.0 * np.random.default_rng(0).normal(size=200_000)
    assert statistics.robust_sigma(x) == pytest.approx(3.0, rel=0.01)
    x[::10] = 1e6
    assert statistics.robust_sigma(x) < 4.0


def test_huber_weights_clip_beyond_1_345_sigma() -> None:
    residual = np.array([[-1.0, 2.69], [1.345, -13.45]])
    np.testing.assert_allclose(statistics.huber_weights(residual, 1.0), [[1.0, 0.5], [1.0, 0.1]])
    np.testing.assert_array_equal(statistics.huber_weights(residual, 0.0), np.ones((2, 2)))


def test_white_noise_sigma_sees_noise_not_motion() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(20000) / 185.0
    sigma = np.array([0.1, 2.0, 30.0])
    x = 500.0 * np.sin(2 * np.pi * 0.5 * t)[:, None] + sigma * rng.normal(size=(len(t), 3))
    np.testing.assert_allclose(statistics.white_noise_sigma(x)[1:], sigma[1:], rtol=0.03)
    quiet = statistics.white_noise_sigma(x - 500.0 * np.sin(2 * np.pi * 0.5 * t)[:, None])
    np.testing.assert_allclose(quiet, sigma, rtol=0.03)


@pytest.mark.parametrize("n", [40, 41])
def test_coloured_information_is_the_double_sum(n: int) -> None:
    rng = np.random.default_rng(n)
    s, r = rng.normal(size=(n, 2, 3)), autoregressive(rng, (n, 2), 0.6)
    lags = n // 10
    expected = np.zeros((3, 3))
    for channel in range(2):
        for i in range(n):
            for j in range(n):
                lag = abs(i - j)
                if lag > lags:
                    continue
                taper = 1.0 - lag / (lags + 1)
                biased = sum(r[k, channel] * r[k + lag, channel] for k in range(n - lag)) / n
                expected += taper * biased * np.outer(s[i, channel], s[j, channel])
    np.testing.assert_allclose(statistics.coloured_information(s, r), expected, rtol=1e-10, atol=1e-10)


def test_white_covariance_is_the_textbooks() -> None:
    rng = np.random.default_rng(3)
    s, r = rng.normal(size=(50, 1, 4)), rng.normal(size=(50, 1))
    white, _ = statistics.least_squares_covariance(s, r)
    expected = np.sum(r**2) / (50 - 4) * np.linalg.inv(s[:, 0].T @ s[:, 0])
    np.testing.assert_allclose(white, expected, rtol=1e-9)


def test_covariances_follow_the_units_of_parameters_and_residuals() -> None:
    rng = np.random.default_rng(4)
    s, r = rng.normal(size=(300, 2, 3)), autoregressive(rng, (300, 2), 0.5)
    unit = np.array([1e-4, 1.0, 1e6])
    for plain, scaled in zip(
        statistics.least_squares_covariance(s, r), statistics.least_squares_covariance(s / unit, 7.0 * r), strict=True
    ):
        np.testing.assert_allclose(scaled / np.outer(unit, unit), 49.0 * plain, rtol=1e-8)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_claimed_sd_of_a_line_in_coloured_noise_is_honest(correlation: float) -> None:
    """300 seeds of a slow regression; the taper of N/10 lags costs some of the correlation, hence 0.8 … 1.25."""
    n = 1500
    phase = np.linspace(0.0, 6 * np.pi, n)
    s = np.stack([np.sin(phase), np.ones(n)], axis=1)
    ratios, white_ratios = [], []
    for seed in range(300):
        noise = autoregressive(np.random.default_rng(seed), (n,), correlation)
        theta = np.linalg.lstsq(s, noise, rcond=None)[0]
        white, coloured = statistics.least_squares_covariance(s[:, None, :], (noise - s @ theta)[:, None])
        ratios.append(theta / np.sqrt(np.diagonal(coloured)))
        white_ratios.append(theta / np.sqrt(np.diagonal(white)))
    assert HONEST[0] < rms(ratios) < HONEST[1]
    if correlation == 0.9:
        assert rms(white_ratios) > 3.0  # what publishing the plain bound would mean


def test_rest_says_nothing_of_the_errors_in_motion() -> None:
    """A tenth of the record moves: there the slope is told, and there the noise is ten times that at rest."""
    n, window = 2000, 100
    moving = (np.arange(n) > 900) & (np.arange(n) < 1100)
    s = np.where(moving, np.sin(np.arange(n) / 5.0), 0.0)
    ratios, averaged = [], []
    for seed in range(200):
        noise = autoregressive(np.random.default_rng(seed), (n,), 0.5) * np.where(moving, 1.0, 0.1)
        theta = s @ noise / (s @ s)
        r = (noise - s * theta)[:, None]
        for found, options in ((ratios, {"steady_over": window}), (averaged, {})):
            _, coloured = statistics.least_squares_covariance(s[:, None, None], r, **options)
            found.append(theta / np.sqrt(coloured[0, 0]))
    assert HONEST[0] < rms(ratios) < HONEST[1]
    assert rms(averaged) > 2.0


def test_noise_of_one_size_is_the_same_over_any_window() -> None:
    rng = np.random.default_rng(5)
    s, size = rng.normal(size=(200, 2, 2)), rng.choice([-1.0, 1.0], size=(200, 2))
    plain = statistics.least_squares_covariance(s, size)[1]
    for window in (1, 7, 1000):
        np.testing.assert_allclose(
            statistics.least_squares_covariance(s, size, steady_over=window)[1], plain, rtol=1e-12
        )
    np.testing.assert_array_equal(statistics.least_squares_covariance(s, 0.0 * size, steady_over=7)[1], 0.0)


def test_claimed_sd_under_huber_weights_is_honest() -> None:
    """A mean in contaminated noise by iterated weights: 500 seeds, covariance with the inflation it needs."""
    ratios = []
    for seed in range(500):
        rng = np.random.default_rng(seed)
        x = rng.normal(size=400) * np.where(rng.uniform(size=400) < 0.1, 8.0, 1.0)
        mean = float(np.median(x))
        for _ in range(20):
            weight = statistics.huber_weights(x - mean, statistics.robust_sigma(x - mean))
            mean = float(np.average(x, weights=weight))
        root = np.sqrt(weight)
        _, coloured = statistics.least_squares_covariance(root[:, None, None], ((x - mean) * root)[:, None])
        ratios.append(mean / np.sqrt(coloured[0, 0] * statistics.huber_inflation(weight)))
    assert HONEST[0] < rms(ratios) < HONEST[1]


def test_no_inflation_without_clipping() -> None:
    assert statistics.huber_inflation(np.ones(10)) == 1.0


@pytest.mark.parametrize("duration_s", [40.0, 300.0])
def test_variance_by_blocks_is_that_over_many_records(duration_s: float) -> None:
    """Terms that remember for half a second, strong in one third of the record: the variance of their sum, mean taken
    out, over 400 records; independent terms would claim a tenth of it."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, duration_s, 0.1)
    loud = np.where(t < duration_s / 3, 3.0, 0.3)[:, None]
    slope = np.linspace(-1.0, 1.0, len(t))[:, None]
    pulls = [autoregressive(rng, (len(t), 1), 0.8) * loud * slope for _ in range(400)]
    claimed = np.mean([statistics.variance_by_blocks(pull, t) for pull in pulls])
    assert claimed == pytest.approx(np.var([pull.sum() for pull in pulls]), rel=0.2)
    assert claimed > 5.0 * np.mean([np.sum(pull**2) for pull in pulls])


def test_variance_by_blocks_needs_some_and_follows_units() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 40.0, 0.1)
    pull = rng.normal(size=(len(t), 2))
    assert not statistics.variance_by_blocks(pull[:100], t[:100]).any()
    shifted = statistics.variance_by_blocks(pull + 5.0, t)
    np.testing.assert_allclose(shifted, statistics.variance_by_blocks(pull, t), rtol=1e-9)
    np.testing.assert_allclose(statistics.variance_by_blocks(-3.0 * pull, t + 7.0), 9.0 * shifted, rtol=1e-9)


@pytest.mark.parametrize(("n", "length"), [(1000, 256), (1000, 255), (100, 100), (300, 7)])
def test_the_power_density_is_welchs(n: int, length: int) -> None:
    x = np.random.default_rng(1).normal(size=(n, 3)) + np.linspace(0.0, 5.0, n)[:, None]
    frequency, density = statistics.power_density(x, 0.01, length)
    at, expected = signal.welch(x, 100.0, nperseg=length, axis=0)
    np.testing.assert_allclose(frequency, at)
    np.testing.assert_allclose(density, expected, atol=1e-12 * expected.max())


def test_the_density_at_low_frequency_is_that_of_the_tapered_sum() -> None:
    """Of a first-order process near (1 + φ)/(1 − φ); columns that stand together share one; bounded on either side."""
    rng = np.random.default_rng(8)
    x = autoregressive(rng, (4000, 4), 0.5)
    lags = 60
    taper = 1.0 - np.arange(1, lags + 1) / (lags + 1)
    of_lag = np.array(
        [[np.sum(x[k:, i : i + 2] * x[: len(x) - k, i : i + 2]) for i in (0, 2)] for k in range(lags + 1)]
    )
    expected = 1.0 + 2.0 * taper @ of_lag[1:] / of_lag[0]
    found = statistics.low_frequency_density(x, lags, together=2, largest=400.0)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(found, 3.0, rtol=0.2)
    np.testing.assert_array_equal(statistics.low_frequency_density(x, lags, together=2, largest=2.0), [2.0, 2.0])
    alternating = x[:, :1] * np.where(np.arange(len(x)) % 2 == 0, 1.0, -1.0)[:, None]
    np.testing.assert_array_equal(statistics.low_frequency_density(alternating, lags, together=1, largest=9.0), [1.0])
