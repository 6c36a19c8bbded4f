"""The gyroscope's equations: six kinds of tests."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import Array, finely_integrated, rms

from fieldcal.geometry.rotation import from_rotation_vector, multiply
from fieldcal.onboard import RateEquations, RatesFit
from fieldcal.onboard import rates as equations
from fieldcal.reason_codes import ReasonCode

SCALE, BIAS = np.array([-2.2e-4, 2.9e-4, 3.8e-4]), np.array([7.0, -9.6, -11.7])
SIGNS = (-1.0, 1.0, 1.0)
ATTITUDE_SD, RATE_SD = 0.01, 0.02
BLOCK = 20
BY_BLOCKS = 1e-3
"""A tenth of a second's rotation is taken for straight."""


def flown(seed: int, n: int = 6000, interval_s: float = 0.005) -> tuple[Array, Array, Array]:
    """Stamps, µs, attitudes and counts without noise."""
    t = interval_s * np.arange(n)
    q, rate = finely_integrated(t, np.random.default_rng(seed), refinement=2)
    return np.rint(t * 1e6), q, (rate - BIAS) / SCALE


def with_noise(q: Array, counts: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    turned = multiply(q, from_rotation_vector(ATTITUDE_SD * rng.normal(size=(len(q), 3))))
    return turned, counts + RATE_SD * rng.normal(size=counts.shape) / SCALE


def solve(t: Array, q: Array, counts: Array, **how: float) -> RatesFit:
    own = RateEquations(BLOCK, **how)
    own.feed(t, q, counts)
    return own.solve(SIGNS)


def test_exact_without_noise() -> None:
    fit = solve(*flown(1))
    assert fit.reason_code == (None, None, None)
    np.testing.assert_allclose(fit.scale, SCALE, rtol=BY_BLOCKS)
    np.testing.assert_allclose(fit.bias, BIAS, rtol=2 * BY_BLOCKS)
    coarse = np.abs(solve(*flown(1)).scale / SCALE - 1).max()
    shorter = RateEquations(BLOCK // 2)
    shorter.feed(*flown(1))
    assert np.abs(shorter.solve(SIGNS).scale / SCALE - 1).max() < 0.5 * coarse


def test_one_fault_moves_one_parameter() -> None:
    t, q, counts = flown(2)
    before, after = solve(t, q, counts), solve(t, q, counts + np.array([0.0, 500.0, 0.0]))
    np.testing.assert_allclose(after.scale, before.scale, rtol=1e-9)
    np.testing.assert_allclose(after.bias - before.bias, [0.0, -500.0 * before.scale[1], 0.0], atol=1e-9)


def test_errors_are_as_large_as_claimed() -> None:
    ratios = []
    for seed in range(25):
        t, q, counts = flown(10 + seed)
        clean = solve(t, q, counts)  # what blocks do, which noise did not
        fit = solve(t, *with_noise(q, counts, np.random.default_rng(seed)))
        ratios.append((fit.scale - clean.scale) / fit.scale_sd)
        ratios.append((fit.bias - clean.bias) / fit.bias_sd)
    assert 0.8 < rms(ratios) < 1.2
    assert np.abs(np.mean(ratios, axis=0)).max() < 4.0 / np.sqrt(len(ratios))


def test_it_is_recursive_least_squares_with_forgetting() -> None:
    """Oracle: the textbook's recursion of estimate and covariance."""
    t, q, counts = flown(3)
    q, counts = with_noise(q, counts, np.random.default_rng(3))
    forgetting = 0.98
    own = RateEquations(BLOCK, forgetting)
    own.feed(t, q, counts)
    own.noise.n_differences = 0  # the recursion knows no noise of its regressors
    fit = own.solve(SIGNS)
    shape = (-1, BLOCK)
    x, y, usable = equations.equations_of_blocks(
        (t * 1e-6).reshape(shape), q.reshape(*shape, 4), (counts - counts[0]).reshape(*shape, 3)
    )
    assert usable.all()
    for i in range(3):
        theta, p = np.zeros(2), np.diag([1.0, 1e12])
        for regressor, target in zip(np.column_stack([x[:, i], np.ones(len(x))]), y[:, i], strict=True):
            gain = p @ regressor / (forgetting + regressor @ p @ regressor)
            theta = theta + gain * (target - regressor @ theta)
            p = (p - np.outer(gain, regressor @ p)) / forgetting
        np.testing.assert_allclose(fit.scale[i], theta[0], rtol=1e-5)
        np.testing.assert_allclose(fit.bias[i], theta[1] - theta[0] * counts[0, i], rtol=1e-5)


def test_pieces_centres_signs_and_axes_do_not_matter() -> None:
    t, q, counts = flown(4)
    q, counts = with_noise(q, counts, np.random.default_rng(4))
    whole = solve(t, q, counts)
    pieces = RateEquations(BLOCK)
    flipped = q * np.where(np.arange(len(q)) % 7 == 0, -1.0, 1.0)[:, None]
    for a, b in ((0, 1), (1, 30), (30, 31), (31, 3000), (3000, 6000)):
        pieces.feed(t[a:b], flipped[a:b], counts[a:b])
    np.testing.assert_allclose(pieces.solve(SIGNS).scale, whole.scale, rtol=1e-10)
    merged = RateEquations(BLOCK, centre=(900.0, -70.0, 3.0))
    for a, b in ((0, 2000), (2000, 6000)):
        own = RateEquations(BLOCK, centre=counts[b - 1])
        own.feed(t[a:b], q[a:b], counts[a:b])
        merged.merge(own)
    again = merged.solve(SIGNS)
    np.testing.assert_allclose(again.scale, whole.scale, rtol=1e-6)
    np.testing.assert_allclose(again.scale_sd, whole.scale_sd, rtol=0.01)  # one pair of neighbours is missing


def test_a_gap_begins_a_new_block() -> None:
    t, q, counts = flown(5)
    late = t + np.where(np.arange(len(t)) >= 3007, 5e6, 0.0)
    own, halves = RateEquations(BLOCK), RateEquations(BLOCK)
    own.feed(late, q, counts)
    halves.feed(t[:3007], q[:3007], counts[:3007])
    halves.gap()
    halves.feed(late[3007:], q[3007:], counts[3007:])
    np.testing.assert_array_equal(own.values, halves.values)
    broken = counts.copy()
    broken[3007] = np.nan
    lacking = RateEquations(BLOCK)
    lacking.feed(t, q, broken)
    assert lacking.n_samples == len(t) - 1
    assert lacking.values[equations.WEIGHT] == 3007 // BLOCK + (len(t) - 3008) // BLOCK


def test_refusals() -> None:
    t, q, counts = flown(6)
    assert RateEquations(BLOCK).solve().reason_code == (ReasonCode.TOO_FEW_SAMPLES,) * 3
    still = counts.copy()
    still[:, 1] = 5.0
    assert solve(t, q, still).reason_code == (None, ReasonCode.GYRO_NOT_EXCITED, None)
    contrary = RateEquations(BLOCK)
    contrary.feed(t, q, counts)
    assert contrary.solve((1.0, 1.0, 1.0)).reason_code == (ReasonCode.POLARITY_CONTRADICTION, None, None)
    uncertain = contrary.solve(SIGNS, max_scale_sd=1e-9)
    assert set(uncertain.reason_code) == {ReasonCode.SCALE_UNCERTAIN}
    spoilt = RateEquations(BLOCK)
    spoilt.feed(t, multiply(q, from_rotation_vector(0.5 * np.random.default_rng(6).normal(size=(len(q), 3)))), counts)
    assert ReasonCode.GYRO_CONTRADICTS_ATTITUDE in spoilt.solve(SIGNS, max_scale_sd=1.0).reason_code
    with pytest.raises(ValueError, match="3 to 256"):
        RateEquations(2)
    with pytest.raises(ValueError, match="nothing was forgotten"):
        RateEquations(20).merge(RateEquations(20, 0.9))
