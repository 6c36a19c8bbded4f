"""Reweighting against least squares where nothing is wrong, the truth where something is, and its fixed point."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from numerics_support import ROUNDING
from scipy.optimize import minimize

from fieldcal.estimation.robust import reweighted, reweighted_rounds
from fieldcal.estimation.statistics import HUBER, huber_weights, robust_sigma

Array = np.ndarray
TRUE = np.array([2.0, -0.5])


@pytest.fixture
def line() -> tuple[Array, Array]:
    rng = np.random.default_rng(7)
    x = np.column_stack([np.ones(200), rng.uniform(-1.0, 1.0, 200)])
    return x, x @ TRUE + 0.01 * rng.normal(size=200)


def regression(x: Array, y: Array):  # type: ignore[no-untyped-def]
    def solve(weight: Array) -> tuple[Array, Array]:
        root = np.sqrt(weight)
        beta = np.linalg.lstsq(x * root[:, None], y * root, rcond=None)[0]
        return beta, y - x @ beta

    return solve


def test_the_first_round_is_least_squares(line: tuple[Array, Array]) -> None:
    x, y = line
    beta, weight = reweighted(regression(x, y), len(y), rounds=1)
    np.testing.assert_allclose(beta, np.linalg.lstsq(x, y, rcond=None)[0], atol=ROUNDING)
    residual = y - x @ beta
    np.testing.assert_array_equal(weight, huber_weights(residual, robust_sigma(residual)))


def test_outliers_do_not_draw_the_line_off(line: tuple[Array, Array]) -> None:
    x, y = line
    spoiled = y.copy()
    spoiled[::10] += 5.0
    plain = np.linalg.lstsq(x, spoiled, rcond=None)[0]
    beta, weight = reweighted(regression(x, spoiled), len(y), rounds=30)
    assert np.abs(plain - TRUE).max() > 0.3
    assert np.abs(beta - TRUE).max() < 0.01
    assert weight[::10].max() < 0.01


def test_it_settles_where_hubers_loss_is_least(line: tuple[Array, Array]) -> None:
    x, y = line
    spoiled = y.copy()
    spoiled[::10] += 0.5
    beta, _ = reweighted(regression(x, spoiled), len(y), rounds=200)
    limit = HUBER * robust_sigma(spoiled - x @ beta)

    def loss(b: Array) -> float:
        r = np.abs(spoiled - x @ b)
        return float(np.sum(np.where(r <= limit, 0.5 * r**2, limit * (r - 0.5 * limit))))

    best = minimize(loss, beta + 0.1, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14}).x
    np.testing.assert_allclose(beta, best, atol=1e-6)


def test_rounds_go_on_where_the_last_one_ended(line: tuple[Array, Array]) -> None:
    x, y = line
    spoiled = y + np.where(np.arange(len(y)) % 7 == 0, 3.0, 0.0)
    third = list(islice(reweighted_rounds(regression(x, spoiled), len(y)), 3))[-1]
    beta, weight = reweighted(regression(x, spoiled), len(y), rounds=3)
    np.testing.assert_array_equal(beta, third[0])
    np.testing.assert_array_equal(weight, third[1])
