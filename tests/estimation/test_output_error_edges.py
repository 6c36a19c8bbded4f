"""Output error's parts by definition, and its covariance with weights and several stretches written out."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import constants, logged, random_attitudes, turning_rates
from scipy.spatial.transform import Rotation

from fieldcal.estimation.gyroscope import output_error
from fieldcal.estimation.gyroscope.equation_error import GyroFit
from fieldcal.estimation.gyroscope.output_error import (
    attitude_error_median,
    fit_output_error,
    random_walk,
    shooting_segments,
    suitable_stretch_s,
    walk_information,
)
from fieldcal.estimation.statistics import huber_inflation, huber_weights, least_squares_covariance, robust_sigma
from fieldcal.geometry.rotation import from_rotation_vector, multiply, propagate

SCALE, BIAS = constants("gyroscope")
STEP_S = 0.02


@pytest.fixture(scope="module")
def flight() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, noisy attitudes and counts of 24 s of turning."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 24.0, STEP_S)
    rate = turning_rates(t, rng)
    q = propagate(t, rate, random_attitudes(rng, 1)[0])
    return t, multiply(q, from_rotation_vector(0.01 * rng.normal(size=(len(t), 3)))), logged(rate, SCALE, BIAS)


START = GyroFit(SCALE, BIAS, np.zeros((6, 6)), np.zeros((6, 6)), 0.0, 0)


@pytest.mark.parametrize("initial_attitude", ["estimated", "fixed"])
@pytest.mark.parametrize("robust", [False, True])
def test_covariance_is_that_of_the_residuals_by_finite_differences(
    flight: tuple[np.ndarray, np.ndarray, np.ndarray], initial_attitude: str, robust: bool
) -> None:
    """Residuals at constants moved a little, initial attitudes estimated anew: J, its weights, what the walk adds."""
    t, q, counts = flight
    trust = np.random.default_rng(1).uniform(0.05, 1.0, len(t))
    found = fit_output_error(
        t, q, counts, START, stretch_s=9.0, weights=trust, robust=robust, initial_attitude=initial_attitude
    )
    stretch = shooting_segments(t, np.zeros(len(t)), 9.0)
    theta, fixed = np.r_[found.scale, found.bias], initial_attitude == "fixed"

    def residual(moved: np.ndarray, weight: np.ndarray) -> np.ndarray:
        rate = moved[:3] * counts + moved[3:]
        return output_error.attitude_error(t, q, rate, stretch, weight, fixed=fixed)[0]

    plain = residual(theta, trust)
    # Robust weights are those of the round before: its residuals are the last ones, but for a hundredth of their sd.
    length = np.linalg.norm(plain, axis=1)
    huber = huber_weights(length, robust_sigma(length)) if robust else np.ones(len(t))
    weight = trust * huber
    steps = 1e-4 * np.abs(theta)
    j = np.stack(
        [(residual(theta + h, weight) - residual(theta - h, weight)) / (-2 * h.sum()) for h in np.diag(steps)], axis=2
    )
    root, left = np.sqrt(weight)[:, None], plain
    if not fixed:
        for k in range(3):
            own = stretch == k
            left = left - np.where(own[:, None], np.average(plain[own], axis=0, weights=weight[own]), 0.0)
    nuisance = 0 if fixed else 9
    white, coloured = least_squares_covariance(j * root[:, :, None], left * root, nuisance=nuisance)
    expected = coloured * huber_inflation(huber)
    if not fixed:
        walk, share = random_walk(t, plain, stretch, weight)
        first = np.r_[True, np.diff(stretch) != 0]
        dt = np.where(first[1:], 0.0, np.diff(t))
        information = walk_information(j * weight[:, None, None], dt, first, walk)
        scaled = np.einsum("ncp,n,ncq->pq", j * theta, weight, j * theta)
        inverse = np.linalg.inv(scaled) * np.outer(theta, theta)
        expected = (1.0 - share) * expected + inverse @ information @ inverse
    for claimed, truth in ((found.covariance_white, white), (found.covariance, expected)):
        sd = np.sqrt(np.diagonal(truth))
        np.testing.assert_allclose(claimed / np.outer(sd, sd), truth / np.outer(sd, sd), atol=0.05)
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean(np.sum(plain**2, axis=1))), rel=1e-3)
    assert found.n_samples == len(t)


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("stretches", [40, 41])
def test_a_random_walk_is_told_from_stationary_noise(noise: float, stretches: int) -> None:
    """Forty stretches of 12 s: the walk's density comes back, and its share is q L/6 over the variance there is."""
    rng = np.random.default_rng(2)
    n, step, density = 1200, 0.01, 1e-4
    t = np.arange(stretches * n) * step
    stretch = np.repeat(np.arange(stretches), n)
    walk = np.cumsum(np.sqrt(density * step) * rng.normal(size=(stretches, n, 3)), axis=1)
    residual = (walk - walk.mean(axis=1, keepdims=True)).reshape(-1, 3) + noise * rng.normal(size=(len(t), 3))
    weight = np.where(np.arange(len(t)) % 2 == 0, 1.0, 0.5)
    found, share = random_walk(t, residual, stretch, weight)
    assert found == pytest.approx(density, rel=0.15)
    variance = np.average(np.mean(residual**2, axis=1), weights=weight)
    assert share == pytest.approx(min(found * 12.0 / 6.0 / variance, 1.0), rel=1e-9)
    assert (share > 0.8) == (noise == 0.0)


def test_the_walk_by_hand() -> None:
    """A residual that steps by one from block to block: means half a stretch apart differ by 6, neighbours by 1."""
    t = np.arange(240) * 0.5
    residual = np.repeat(np.arange(12.0), 10)[:, None] * np.ones(3)
    found, share = random_walk(t, np.vstack([residual, residual]), np.repeat([0, 1], 120), np.ones(240))
    assert found == pytest.approx((36.0 - 1.0) / (5 * 10 * 0.5))
    variance = np.mean(np.arange(12.0) ** 2)
    assert share == pytest.approx(min(found * 120 * 0.5 / 6.0 / variance, 1.0))
    assert share == pytest.approx(0.3320158, rel=1e-6)
    weight = np.ones(240)
    weight[5:10] = 0.0
    spoiled = np.vstack([residual, residual])
    spoiled[5:10] = 99.0
    assert random_walk(t, spoiled, np.repeat([0, 1], 120), weight)[0] == pytest.approx(found)
    falling = np.repeat([1.0, -1.0] * 6, 10)[:, None] * np.ones(3)
    assert random_walk(t[:120], falling, np.zeros(120), np.ones(120)) == (0.0, 0.0)


def test_a_walk_is_all_of_the_residual_at_most() -> None:
    """One step half-way: means half a stretch apart differ by 1, one in eleven neighbours too. A walk of that density
    would have 16/11 of the variance there is."""
    residual = np.repeat([-0.5, 0.5], 60)[:, None] * np.ones(3)
    found, share = random_walk(np.arange(120) * 0.5, residual, np.zeros(120), np.ones(120))
    assert found * 120 * 0.5 / 6.0 / 0.25 == pytest.approx(16.0 / 11.0)
    assert share == 1.0


@pytest.mark.parametrize(("short", "told"), [(6, False), (7, True)])
def test_a_stretch_needs_more_than_half_the_blocks(short: int, told: bool) -> None:
    """Blocks are twelfths of the typical stretch; of one with six there is no pair half a stretch apart."""
    stretch = np.repeat([0, 1, 2, 3], [10 * short, 120, 120, 120])
    residual = np.zeros((len(stretch), 3))
    residual[: 10 * short] = np.repeat(np.arange(float(short)), 10)[:, None]
    found, _ = random_walk(np.arange(len(stretch)) * 1.0, residual, stretch, np.ones(len(stretch)))
    assert (found > 0.0) == told


def test_a_short_stretch_is_looked_at_row_by_row() -> None:
    """Of 13 rows, steps of one: six rows apart differ by 6, neighbours by 1."""
    residual = np.arange(13.0)[:, None] * np.ones(3)
    found, _ = random_walk(np.arange(13.0) * 0.5, residual, np.zeros(13), np.ones(13))
    assert found == pytest.approx((36.0 - 1.0) / (5 * 0.5))


def test_nothing_to_compare_is_no_walk() -> None:
    rng = np.random.default_rng(3)
    assert random_walk(np.arange(6.0), rng.normal(size=(6, 3)), np.zeros(6), np.ones(6)) == (0.0, 0.0)


def test_stretches_by_hand() -> None:
    t = np.arange(13.0)
    one = np.zeros(13)
    assert shooting_segments(t, one, 12.0).tolist() == [0] * 13
    assert shooting_segments(t, one, 11.9).tolist() == [0] * 6 + [1] * 7
    assert shooting_segments(t, one, 4.0).tolist() == [0] * 4 + [1] * 4 + [2] * 5
    assert shooting_segments(t, np.repeat([5, 2, 9], [1, 11, 1]), 5.0).tolist() == [0] + [1] * 5 + [2] * 6 + [3]


def test_suitable_stretches_by_hand() -> None:
    assert suitable_stretch_s(0.1, 0.01, 0.02) == pytest.approx(6.0 * 0.02**2 / (0.1**2 * 0.01))
    assert suitable_stretch_s(0.1, 0.01, 0.01) == pytest.approx(6.0)
    assert suitable_stretch_s(0.1, 0.01, 0.009) == 5.0
    assert suitable_stretch_s(0.01, 0.01, 0.0057) == pytest.approx(194.94)
    assert suitable_stretch_s(0.01, 0.01, 0.006) == 200.0


def test_starts_are_weighted_means_or_the_first_attitude() -> None:
    rng = np.random.default_rng(4)
    relative = random_attitudes(rng, 20)
    true = random_attitudes(rng, 2)
    stretch = np.repeat([0, 1], [8, 12])
    q = multiply(true[stretch], relative)
    q[3], weight = random_attitudes(rng, 1)[0], np.ones(20)
    weight[3] = 0.0
    found = output_error.start_stretches(relative, q, stretch, weight, fixed=False)
    expected = multiply(true[stretch], relative)
    np.testing.assert_allclose(np.abs(np.sum(found * expected, axis=1)), 1.0, atol=1e-12)
    fixed = output_error.start_stretches(relative, q, stretch, weight, fixed=True)
    for a, b in ((0, 8), (8, 20)):
        np.testing.assert_allclose(fixed[a:b], multiply(q[a], relative[a:b]), atol=1e-12)


def test_the_median_error_is_that_of_angles() -> None:
    """Attitudes that stand, rates that do not: within a stretch of 4 s the error grows from its best start."""
    t = np.arange(0.0, 8.0, 0.01)
    q = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    rate = np.tile([0.0, 0.05, 0.0], (len(t), 1))
    found = attitude_error_median(t, q, rate, np.zeros(len(t)), 4.0, np.ones(len(t)))
    assert found == pytest.approx(0.05 * 1.0, rel=0.01)  # of |τ| over ± 2 s
    assert attitude_error_median(t, q, rate, np.zeros(len(t)), 8.0, np.ones(len(t))) == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("wrong", ["q", "rate", "short"])
def test_each_shape_is_checked(flight: tuple[np.ndarray, np.ndarray, np.ndarray], wrong: str) -> None:
    t, q, counts = flight
    arrays = {"q": (t, q[:, :3], counts), "rate": (t, q, counts[:-1]), "short": (t[:9], q[:9], counts[:9])}[wrong]
    with pytest.raises(ValueError, match="n ≥ 10 wanted"):
        fit_output_error(*arrays, START)


def test_error_and_model_are_scipys(flight: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    t, q, counts = flight
    stretch = shooting_segments(t, np.zeros(len(t)), 9.0)
    residual, model = output_error.attitude_error(t, q, SCALE * counts + BIAS, stretch, np.ones(len(t)), fixed=False)
    expected = (Rotation.from_quat(q) * Rotation.from_quat(model).inv()).as_rotvec()
    np.testing.assert_allclose(residual, expected, atol=1e-9)
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(0.01, rel=0.05)
