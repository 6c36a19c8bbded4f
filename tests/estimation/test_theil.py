"""Theil's coefficient against Eq. 16 written out, and what it says of attitudes."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import random_attitudes, rms

from fieldcal.estimation.theil import theil, theil_attitude
from fieldcal.geometry.rotation import from_rotation_vector, multiply


@pytest.fixture
def outputs() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    z = rng.normal(size=(400, 3)) + np.array([0.0, 1.0, -2.0])
    return z, 1.1 * z + 0.2 + 0.3 * rng.normal(size=z.shape)


def equation_16(z: np.ndarray, y: np.ndarray) -> float:
    """√(mean (z−y)²) / (√(mean y²) + √(mean z²)) over all samples and channels, one by one."""
    error = measured = model = 0.0
    for a, b in zip(z.ravel().tolist(), y.ravel().tolist(), strict=True):
        error, measured, model = error + (a - b) ** 2, measured + a * a, model + b * b
    return error**0.5 / (measured**0.5 + model**0.5)


def test_coefficient_is_equation_16(outputs: tuple[np.ndarray, np.ndarray]) -> None:
    z, y = outputs
    fit = theil(z, y)
    assert fit.tic == pytest.approx(equation_16(z, y), rel=1e-12)
    assert fit.n_samples == 400
    assert fit.rms == pytest.approx(rms(np.linalg.norm(z - y, axis=1)), rel=1e-12)


def test_parts_sum_to_one_and_are_their_definitions(outputs: tuple[np.ndarray, np.ndarray]) -> None:
    z, y = outputs
    fit = theil(z, y)
    assert fit.bias + fit.variance + fit.covariance == pytest.approx(1.0, abs=1e-12)
    mse = np.sum(np.mean((z - y) ** 2, axis=0))
    correlation = np.array([np.corrcoef(z[:, i], y[:, i])[0, 1] for i in range(3)])
    assert fit.bias == pytest.approx(np.sum((z.mean(0) - y.mean(0)) ** 2) / mse)
    assert fit.variance == pytest.approx(np.sum((z.std(0) - y.std(0)) ** 2) / mse)
    assert fit.covariance == pytest.approx(np.sum(2 * (1 - correlation) * z.std(0) * y.std(0)) / mse)


def test_each_part_alone() -> None:
    z = np.random.default_rng(1).normal(size=(1000, 1))
    centred = z - z.mean()
    assert theil(centred, centred + 0.5).bias == pytest.approx(1.0)
    assert theil(centred, 1.5 * centred).variance == pytest.approx(1.0)


def test_between_perfect_and_worthless(outputs: tuple[np.ndarray, np.ndarray]) -> None:
    z, _ = outputs
    perfect = theil(z, z)
    assert perfect.tic == 0.0
    assert np.isnan([perfect.bias, perfect.variance, perfect.covariance]).all()
    assert theil(z, -z).tic == pytest.approx(1.0)
    assert theil(z, np.zeros_like(z)).tic == pytest.approx(1.0)
    assert theil(np.zeros_like(z), np.zeros_like(z)).tic == 0.0


def test_units_and_order_of_samples_do_not_matter(outputs: tuple[np.ndarray, np.ndarray]) -> None:
    z, y = outputs
    order = np.random.default_rng(2).permutation(len(z))
    for unit in (1e3, 1e-6):
        a, b = theil(z, y), theil(unit * z[order][:, ::-1], unit * y[order][:, ::-1])
        np.testing.assert_allclose(
            [a.tic, a.bias, a.variance, a.covariance], [b.tic, b.bias, b.variance, b.covariance], rtol=1e-9
        )


def test_shapes_are_checked() -> None:
    for z, y in (((3, 2), (3, 3)), ((0, 3), (0, 3)), ((3,), (3,))):
        with pytest.raises(ValueError, match="same"):
            theil(np.ones(z), np.ones(y))


@pytest.mark.parametrize("degrees", [0.5, 8.1, 33.6])
def test_attitude_coefficient_flatters(degrees: float) -> None:
    """Unit quaternions an angle α apart are 2 sin(α/4) apart: TIC ≈ α/4, so the paper's 0.0352 means 8.1°."""
    rng = np.random.default_rng(3)
    q = random_attitudes(rng, 4000)
    alpha = np.radians(degrees)
    axis = rng.normal(size=(4000, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    signs = rng.choice([-1.0, 1.0], (4000, 1))
    fit = theil_attitude(q, signs * multiply(q, from_rotation_vector(alpha * axis)))
    assert fit.tic == pytest.approx(alpha / 4, rel=0.01)
    assert fit.rms == pytest.approx(degrees, rel=1e-9)
