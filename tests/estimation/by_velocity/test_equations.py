"""The chain's normal equations against dense least squares over all unknowns at once."""

from __future__ import annotations

import numpy as np
import pytest
from rows_by_velocity import dense, drawn_rows

from fieldcal.estimation.by_velocity.equations import (
    ATTITUDE_PER_RAD2,
    GROUPS,
    PUSH,
    STATES,
    TURN,
    VELOCITY_PER_M2S2,
    Rows,
    field_at,
    noise_in_readings,
    predicted,
    pulls,
    solve,
)
from fieldcal.estimation.by_velocity.problem import State
from fieldcal.geometry.rotation import body_from_inertial, normalise

KNOTS, P = 6, 7


@pytest.mark.parametrize("seed", range(3))
def test_a_step_is_that_of_dense_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = drawn_rows(rng, KNOTS, P)
    weight = [rng.uniform(0.3, 1.0, one.residual.shape) for one in rows]
    signs = [rng.choice([-1.0, 1.0], one.residual.shape) for one in rows]
    prior = np.diag(rng.uniform(0.1, 1.0, P))
    pulled, score = rng.normal(size=P), rng.normal(size=P)
    found = solve(rows, weight, KNOTS, (prior, pulled), score, signs)

    a, b, group = dense(rows, weight, KNOTS)
    n = STATES * KNOTS
    known = np.zeros((n + P, n + P))
    known[:n, :n] = np.diag(np.tile([ATTITUDE_PER_RAD2] * 3 + [VELOCITY_PER_M2S2] * 3, KNOTS))
    without = a.T @ a + known
    known[n:, n:] = prior
    total = a.T @ a + known
    right = a.T @ b
    right[n:] += pulled + score
    step = np.linalg.solve(total, right)
    assert np.allclose(found.theta, step[n:], rtol=1e-8, atol=1e-9)
    assert np.allclose(found.knots.ravel(), step[:n], rtol=1e-7, atol=1e-8)
    assert np.allclose(found.covariance, np.linalg.inv(total)[n:, n:], rtol=1e-7, atol=1e-10)
    carried = np.linalg.solve(without[:n, :n], without[:n, n:])
    assert np.allclose(found.information, without[n:, n:] - without[n:, :n] @ carried, rtol=1e-8, atol=1e-8)
    assert np.allclose(found.followed.reshape(n, P), -carried, rtol=1e-7, atol=1e-8)
    gradient = (a.T @ b)[n:] - without[n:, :n] @ np.linalg.solve(without[:n, :n], (a.T @ b)[:n])
    assert np.allclose(found.pull, gradient + score, rtol=1e-7, atol=1e-7)

    flat_sign = np.concatenate([own.ravel() for own in signs])
    theta, knots = found.probes
    for kind in GROUPS:
        probe = np.linalg.solve(total, a.T @ np.where(group == kind, flat_sign, 0.0))
        assert np.allclose(theta[:, kind], probe[n:], rtol=1e-7, atol=1e-8)
        assert np.allclose(knots[..., kind].ravel(), probe[:n], rtol=1e-7, atol=1e-8)

    changed = np.concatenate([predicted(one, found.theta[:, None], found.knots[..., None]).ravel() for one in rows])
    root = np.concatenate([np.sqrt(w / one.variance).ravel() for one, w in zip(rows, weight, strict=True)])
    assert np.allclose(root * changed, a @ step, rtol=1e-7, atol=1e-7)
    each = [
        pulls(one, w, -one.residual * np.sqrt(w / one.variance), found.followed)
        for one, w in zip(rows, weight, strict=True)
    ]
    assert np.allclose(np.concatenate(each).sum(axis=0), gradient, rtol=1e-7, atol=1e-7)


def test_the_constants_units_do_not_matter() -> None:
    """In units a million times as large, and as small, the same step, covariance and probes."""
    rng = np.random.default_rng(6)
    rows = drawn_rows(rng, KNOTS, P)
    weight, signs = ([draw(one.residual.shape) for one in rows] for draw in (np.ones, np.ones))
    prior, pulled, nothing = np.diag(rng.uniform(0.1, 1.0, P)), rng.normal(size=P), np.zeros(P)
    unit = 10.0 ** np.linspace(-8.0, 8.0, P)
    plain = solve(rows, weight, KNOTS, (prior, pulled), nothing, signs)
    for one in rows:
        one.theta[:] *= unit
    found = solve(rows, weight, KNOTS, (prior * np.outer(unit, unit), pulled * unit), nothing, signs)
    np.testing.assert_allclose(found.theta * unit, plain.theta, rtol=1e-9)
    np.testing.assert_allclose(found.covariance * np.outer(unit, unit), plain.covariance, rtol=1e-9, atol=1e-12)
    assert found.probes[0].shape == (P, len(GROUPS))
    np.testing.assert_allclose(found.probes[1], plain.probes[1], atol=1e-9)


def test_noise_of_readings_is_counted_for_its_own_triad_and_not_where_jumps_are_the_starts_errors() -> None:
    rng = np.random.default_rng(5)
    n = 40
    q = normalise(rng.normal(size=(n + 1, 4)))
    variance = np.array([1.0, 0.8, 0.9, 1.1, 1.2, 1.3]) * np.ones((n, 6))
    jump = np.sqrt(variance) * rng.normal(size=(n, 6)) * [0.5, 0.6, 3.0, 0.4, 0.7, 0.8]
    axes = body_from_inertial(q[:n])
    turned = np.concatenate(
        [np.einsum("nji,nj->ni", axes, jump[:, part]) for part in (slice(0, 3), slice(3, 6))], axis=1
    )
    nothing = np.zeros((n, 6, STATES))
    links = Rows(turned, nothing, nothing, np.zeros((n, 6, 14)), np.arange(n), variance, (TURN,) * 3 + (PUSH,) * 3)
    values = {
        "gyroscope": np.array([0.9, 1.0, 1.1, 0.0, 0.0, 0.0]),
        "accelerometer": np.array([1.2, 1.0, 0.8, 0, 0, 0]),
    }
    state = State(q, np.zeros((n + 1, 3)), values)
    layout = {"gyroscope": slice(1, 7), "accelerometer": slice(8, 14)}
    found = noise_in_readings(links, state, layout, 0.25, 0.5)
    expected = np.zeros(14)
    squares = np.sum(jump**2 / variance, axis=0)
    expected[1:4] = 0.25 * squares[:3] / values["gyroscope"][:3]
    expected[3] = 0.0  # larger than its noise
    expected[8:11] = 0.5 * squares[3:] / values["accelerometer"][:3]
    assert squares[2] > n
    assert np.all(squares[[0, 1, 3, 4, 5]] < n)
    assert np.allclose(found, expected, rtol=1e-12)


def test_a_field_of_the_same_strength_with_a_larger_dip_and_declination() -> None:
    """Dip 60° and declination 130° that are 10° and 25° too small."""
    strength, dip, declination = 0.7, np.radians(60.0), np.radians(130.0)

    def field(dip: float, declination: float) -> np.ndarray:
        level = strength * np.cos(dip)
        return np.array([level * np.cos(declination), level * np.sin(declination), strength * np.sin(dip)])

    by = np.radians([10.0, 25.0])
    value, slopes = field_at(field(dip, declination), by)
    np.testing.assert_allclose(value, field(*(np.array([dip, declination]) + by)), atol=1e-12)
    for k, step in enumerate(1e-6 * np.eye(2)):
        ahead, behind = (field(*(np.array([dip, declination]) + by + sign * step)) for sign in (1.0, -1.0))
        np.testing.assert_allclose(slopes[:, k], (ahead - behind) / 2e-6, atol=1e-8)
