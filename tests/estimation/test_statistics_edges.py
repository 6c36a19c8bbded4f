"""Standard errors at their edges: short records, nothing to divide by, caps, blocks, each against its definition."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import autoregressive

from fieldcal.estimation import statistics


def tapered_autocorrelation(r: np.ndarray) -> np.ndarray:
    """Biased autocorrelation of one channel (n,) times the triangular taper, at lags 0, 1, …, n/10, by loops."""
    n = len(r)
    lags = max(1, n // 10)
    return np.array([(1.0 - lag / (lags + 1)) * np.dot(r[: n - lag], r[lag:]) / n for lag in range(lags + 1)])


def independent(r: np.ndarray) -> float:
    """n over the sum of the tapered autocorrelation over lags of both signs, in units of the variance; n at most."""
    tapered = tapered_autocorrelation(r)
    return len(r) / max(1.0, (2.0 * tapered.sum() - tapered[0]) / tapered[0])


@pytest.mark.parametrize("n", [5, 9, 19, 24, 25, 47, 48, 200])
def test_coloured_information_is_the_double_sum_at_every_length(n: int) -> None:
    """Lengths at which the transform is just long enough, of even and of odd size, and fewer than ten samples."""
    rng = np.random.default_rng(n)
    s, r = rng.normal(size=(n, 1, 2)), 1.0 + autoregressive(rng, (n, 1), 0.6)
    tapered = tapered_autocorrelation(r[:, 0])
    expected = np.zeros((2, 2))
    for i in range(n):
        for j in range(n):
            if abs(i - j) < len(tapered):
                expected += tapered[abs(i - j)] * np.outer(s[i, 0], s[j, 0])
    np.testing.assert_allclose(statistics.coloured_information(s, r), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_independent_samples_are_n_over_the_sum_of_correlations(correlation: float) -> None:
    r = autoregressive(np.random.default_rng(1), (400,), correlation)
    assert statistics.independent_samples(r) == pytest.approx(independent(r), rel=1e-9)
    assert statistics.independent_samples(1e-3 * r) == pytest.approx(independent(r), rel=1e-9)


def test_no_residual_is_worth_more_than_its_samples() -> None:
    assert statistics.independent_samples(np.resize([1.0, -1.0], 100)) == 100.0
    assert statistics.independent_samples(np.zeros(30)) == 30.0


@pytest.mark.parametrize("nuisance", [0, 4])
@pytest.mark.parametrize("n", [60, 600])
def test_parameters_take_their_freedom_from_the_independent_samples(n: int, nuisance: int) -> None:
    """M⁻¹ [ΣΣ Sᵀ𝓡S] M⁻¹ times n_e/(n_e − p), p counting what was eliminated beforehand; four times at most."""
    rng = np.random.default_rng(2)
    s, r = rng.normal(size=(n, 1, 3)), autoregressive(rng, (n,), 0.5)
    inverse = np.linalg.inv(s[:, 0].T @ s[:, 0])
    own = independent(r)
    freedom = own / (own - 3 - nuisance)
    assert 1.0 < freedom < 4.0
    expected = freedom * inverse @ statistics.coloured_information(s, r[:, None]) @ inverse
    _, coloured = statistics.least_squares_covariance(s, r[:, None], nuisance=nuisance)
    np.testing.assert_allclose(coloured, expected, rtol=1e-8)


@pytest.mark.parametrize("nuisance", [0, 1000])
def test_freedom_is_capped_at_four(nuisance: int) -> None:
    """A residual that stands is worth some ten samples: sixty parameters would leave less than none."""
    rng = np.random.default_rng(3)
    s, r = rng.normal(size=(200, 1, 60)), 1.0 + 0.01 * rng.normal(size=200)
    assert independent(r) < 60
    inverse = np.linalg.inv(s[:, 0].T @ s[:, 0])
    expected = 4.0 * inverse @ statistics.coloured_information(s, r[:, None]) @ inverse
    _, coloured = statistics.least_squares_covariance(s, r[:, None], nuisance=nuisance)
    np.testing.assert_allclose(coloured, expected, rtol=1e-6)


def test_two_channels_share_the_parameters() -> None:
    """Of two alike channels each gives half the parameters: n_e/(n_e − p/2)."""
    rng = np.random.default_rng(4)
    half, r = rng.normal(size=(100, 1, 20)), autoregressive(rng, (100,), 0.3)
    s, both = np.concatenate([half, rng.normal(size=half.shape)], axis=1), np.stack([r, r], axis=1)
    flat = s.reshape(-1, 20)
    inverse = np.linalg.inv(flat.T @ flat)
    own = independent(r)
    expected = own / (own - 10) * inverse @ statistics.coloured_information(s, both) @ inverse
    white, coloured = statistics.least_squares_covariance(s, both)
    np.testing.assert_allclose(coloured, expected, rtol=1e-8)
    np.testing.assert_allclose(white, 2 * r @ r / (200 - 20) * inverse, rtol=1e-8)


def test_a_parameter_that_does_nothing_and_as_many_parameters_as_samples_stay_finite() -> None:
    rng = np.random.default_rng(5)
    s, r = rng.normal(size=(4, 1, 4)), rng.normal(size=(4, 1))
    white, _ = statistics.least_squares_covariance(s, r)
    np.testing.assert_allclose(white, np.sum(r**2) * np.linalg.inv(s[:, 0].T @ s[:, 0]), rtol=1e-6)
    s = rng.normal(size=(50, 1, 3))
    s[:, :, 1] = 0.0
    r = rng.normal(size=(50, 1))
    kept = np.ix_([0, 2], [0, 2])
    for found in statistics.least_squares_covariance(s, r):
        assert (found[1] == 0.0).all()
    white, _ = statistics.least_squares_covariance(s, r)
    flat = s[:, 0][:, [0, 2]]
    np.testing.assert_allclose(white[kept], np.sum(r**2) / 47 * np.linalg.inv(flat.T @ flat), rtol=1e-9)


def test_huber_inflation_is_the_square_of_the_mean_weight_over_the_share_that_is_whole() -> None:
    assert statistics.huber_inflation([1.0, 1.0, 0.5, 0.3]) == pytest.approx((0.7 / 0.5) ** 2)
    assert statistics.huber_inflation([0.999, 0.4, 0.2, 0.2, 0.2]) == pytest.approx((1.999 / 5 / 0.1) ** 2)
    assert statistics.huber_inflation([0.5] * 19 + [1.0]) == pytest.approx((10.5 / 20 / 0.1) ** 2)


def test_huber_weights_of_zeros_are_one() -> None:
    np.testing.assert_array_equal(statistics.huber_weights([0.0, 0.0], 1e-9), [1.0, 1.0])
    np.testing.assert_array_equal(statistics.huber_weights([0.0, 3.0], 0.0), [1.0, 1.0])
    np.testing.assert_allclose(statistics.huber_weights([2.69e-6], 1e-6), [0.5])


@pytest.mark.parametrize("duration_s", [12.0, 23.875, 40.0, 80.0, 320.0])
def test_variance_by_blocks_is_that_of_the_sums(duration_s: float) -> None:
    """Blocks of a twentieth of the record but no shorter than two seconds; a last stamp on an edge has its own."""
    t = 5.0 + np.arange(16 * duration_s + 1) / 16.0
    pull = np.random.default_rng(6).normal(size=(len(t), 2))
    length = 2.0 if duration_s < 40.0 else duration_s / 20.0
    number = ((t - 5.0) // length).astype(int)
    sums = np.array([pull[number == b].sum(axis=0) for b in range(number.max() + 1)])
    expected = len(sums) * sums.var(axis=0, ddof=1)
    np.testing.assert_allclose(statistics.variance_by_blocks(pull, t), expected, rtol=1e-9)


def test_five_blocks_are_too_few_to_judge_by_and_six_are_not() -> None:
    t = np.arange(0.0, 20.0, 0.1)
    pull = np.random.default_rng(7).normal(size=(200, 3))
    np.testing.assert_array_equal(statistics.variance_by_blocks(pull[:100], t[:100]), np.zeros(3))
    assert (statistics.variance_by_blocks(pull[:120], t[:120]) > 0.0).all()
