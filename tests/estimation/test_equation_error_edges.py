"""Equation error's covariance: where each number stands, what noise in the regressor adds, shapes one by one."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import constants, finely_integrated, logged

from fieldcal.estimation.gyroscope.equation_error import (
    GyroFit,
    fit_equation_error,
    from_centred,
    predicted_quaternion_rate,
)
from fieldcal.geometry.rotation import body_rate

SCALE, BIAS = constants("gyroscope")
TRUTH = np.r_[SCALE, BIAS]

Flight = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Attitudes, derivatives with white noise of another size on every axis, and counts, of 8 s of turning."""
    rng = np.random.default_rng(0)
    q, rate = finely_integrated(np.arange(0.0, 8.0, 0.01), rng, refinement=5)
    noisy = rate + [0.01, 0.03, 0.1] * rng.normal(size=rate.shape)
    return q, predicted_quaternion_rate(q, noisy), logged(rate, SCALE, BIAS)


def test_every_axis_has_its_own_covariance_and_none_with_another(flight: Flight) -> None:
    """One regression an axis of ω̂ = 2Ξᵀq̇ on (ω_d, 1): σ²(XᵀX)⁻¹, by NumPy."""
    q, q_dot, counts = flight
    fit = fit_equation_error(q, q_dot, counts)
    target, expected, squares = body_rate(q, q_dot), np.zeros((6, 6)), 0.0
    for i in range(3):
        x = np.column_stack([counts[:, i] * 1e-4, np.ones(len(q))])
        theta = np.linalg.lstsq(x, target[:, i], rcond=None)[0]
        residual = target[:, i] - x @ theta
        squares += residual @ residual
        own = residual @ residual / (len(q) - 2) * np.linalg.inv(x.T @ x)
        expected[np.ix_([i, 3 + i], [i, 3 + i])] = own * np.outer([1e-4, 1.0], [1e-4, 1.0])
    sd = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(fit.covariance_white / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-6)
    # White residuals: the coloured form is the same but for its own scatter.
    np.testing.assert_allclose(fit.covariance / np.outer(sd, sd), expected / np.outer(sd, sd), atol=0.5)
    assert (fit.covariance[expected == 0.0] == 0.0).all()
    assert fit.residual_rms == pytest.approx(np.sqrt(squares / len(q)), rel=1e-9)
    assert (fit.iterations, fit.n_samples) == (1, 800)


def test_the_scalar_equations_residual(flight: Flight) -> None:
    q, q_dot, counts = flight
    fit = fit_equation_error(q, q_dot, counts, equations="scalar")
    residual = q_dot[:, 3] + 0.5 * np.sum(q[:, :3] * (fit.scale * counts + fit.bias), axis=1)
    assert fit.residual_rms == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-9)


@pytest.mark.parametrize("share", [0.05, 0.15, 0.2, 0.3])
def test_noise_in_the_regressor_is_taken_off_its_variance(flight: Flight, share: float) -> None:
    """λ/(1 − s) with the share s of the variance that is noise, a fifth at most; its sd grows alike, and a quarter of
    what was put on is uncertain."""
    q, q_dot, counts = flight
    plain = fit_equation_error(q, q_dot, counts)
    share_of = np.array([share, 0.0, 0.5 * share])
    fit = fit_equation_error(q, q_dot, counts, noise_variance=share_of * counts.var(axis=0))
    taken = np.minimum(share_of, 0.2)
    stretch = 1.0 / (1.0 - taken)
    np.testing.assert_allclose(fit.scale, plain.scale * stretch, rtol=1e-9)
    zero = counts.mean(axis=0)
    np.testing.assert_allclose(fit.scale * zero + fit.bias, plain.scale * zero + plain.bias, rtol=1e-9, atol=1e-12)
    white = np.diagonal(plain.covariance_white)[:3] * stretch**2
    residual_change = (np.diagonal(fit.covariance_white)[:3] / white)[taken == 0.0]
    np.testing.assert_allclose(residual_change, 1.0, rtol=1e-9)
    own = np.diagonal(fit.covariance)[:3] - (0.25 * taken * fit.scale) ** 2
    assert (own > 0.0).all()
    np.testing.assert_allclose(own[taken == 0.0], np.diagonal(plain.covariance)[:3][taken == 0.0], rtol=1e-9)
    x, e = (counts - zero) / counts.std(axis=0), body_rate(q, q_dot)
    for i in range(3):
        left = e[:, i] - (fit.scale[i] * counts[:, i] + fit.bias[i])
        expected = left @ left / (len(q) - 2) / (x[:, i] @ x[:, i]) * stretch[i] ** 2 / counts[:, i].var()
        assert np.diagonal(fit.covariance_white)[i] == pytest.approx(expected, rel=1e-9)


def test_weights_are_those_of_weighted_least_squares(flight: Flight) -> None:
    """A record without outliers, trusted unevenly: NumPy's average and regression with the same weights, but for the
    few residuals that Huber's loss takes for outliers."""
    q, q_dot, counts = flight
    weights = np.where(np.arange(len(q)) % 2 == 0, 1.0, 1e-6)
    fit = fit_equation_error(q, q_dot, counts, weights=weights)
    half = fit_equation_error(q[::2], q_dot[::2], counts[::2], weights=np.ones(400))
    np.testing.assert_allclose(fit.scale, half.scale, rtol=1e-3)


@pytest.mark.parametrize("wrong", ["q", "q_dot", "rate", "short"])
def test_each_shape_is_checked(flight: Flight, wrong: str) -> None:
    q, q_dot, counts = flight
    arrays = {
        "q": (q[:, :3], q_dot, counts),
        "q_dot": (q, q_dot[:-1], counts),
        "rate": (q, q_dot, counts[:, :2]),
        "short": (q[:9], q_dot[:9], counts[:9]),
    }[wrong]
    with pytest.raises(ValueError, match="n ≥ 10 wanted"):
        fit_equation_error(*arrays)


def test_ten_samples_are_enough(flight: Flight) -> None:
    q, _, counts = flight
    exact = predicted_quaternion_rate(q, SCALE * counts + BIAS)
    part = slice(0, 100, 10)
    fit: GyroFit = fit_equation_error(q[part], exact[part], counts[part])
    np.testing.assert_allclose(np.r_[fit.scale, fit.bias], TRUTH, rtol=1e-6)


def test_from_centred_is_the_change_of_variables() -> None:
    rng = np.random.default_rng(1)
    centre, spread, theta, x = rng.normal(size=3), rng.uniform(0.5, 2.0, 3), rng.normal(size=6), rng.normal(size=3)
    constants_of = from_centred(centre, spread) @ theta
    np.testing.assert_allclose(
        constants_of[:3] * x + constants_of[3:], theta[:3] * (x - centre) / spread + theta[3:], rtol=1e-12
    )
