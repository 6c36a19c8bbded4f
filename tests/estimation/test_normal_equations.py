"""Normal equations without a prior: nothing that is done to them invents or loses information."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.normal_equations import NormalEquations, pseudo_inverse
from fieldcal.geometry.rotation import Array

NAMES = tuple(("gyroscope", "gain", str(k)) for k in range(5))
UNITS = np.array([1.0, 1e4, 1e-4, 10.0, 1e2])
RTOL = 1e-7


def made(rows: int, seed: int = 1) -> tuple[NormalEquations, Array, Array]:
    """Of `rows` observations H φ = y of five parameters in units of all sizes, and H and y."""
    rng = np.random.default_rng(seed)
    h, y, at = rng.normal(size=(rows, 5)) / UNITS, rng.normal(size=rows), rng.normal(size=5) * UNITS
    return NormalEquations(NAMES, at, h.T @ (y - h @ at), h.T @ h), h, y


def estimate(found: NormalEquations) -> Array:
    return np.asarray(found.reference + np.linalg.solve(found.information, found.right))


def test_of_some_parameters_is_the_marginal_of_the_estimate() -> None:
    found, _, _ = made(9)
    some = found.of([NAMES[3], NAMES[1]])
    np.testing.assert_allclose(estimate(some), estimate(found)[[3, 1]], rtol=RTOL)
    covariance = np.linalg.inv(found.information)[np.ix_([3, 1], [3, 1])]
    np.testing.assert_allclose(np.linalg.inv(some.information), covariance, rtol=RTOL)


def test_an_other_one_of_which_something_is_known_is_eliminated_whatever_else_is_not_known() -> None:
    """Two beside each other, one by itself, two of which nothing is known: 2 − 1²/2 is left of the first."""
    information = np.zeros((5, 5))
    information[:2, :2] = [[2.0, 1.0], [1.0, 2.0]]
    information[2, 2] = 3.0
    some = NormalEquations(NAMES, np.zeros(5), np.array([1.0, 4.0, 0.0, 0.0, 0.0]), information).of(NAMES[:1])
    assert (some.information[0, 0], some.right[0]) == (pytest.approx(1.5), pytest.approx(-1.0))


def test_what_is_known_only_beside_an_unknown_other_is_not_known() -> None:
    """Three observations of five parameters say nothing of two of them alone, exactly."""
    found, _, _ = made(3)
    some = found.of(NAMES[:2])
    assert not some.information.any()
    assert not some.right.any()
    one = found.of(NAMES[:3])  # the other two take two observations with them
    assert np.linalg.matrix_rank(one.information * np.outer(UNITS[:3], UNITS[:3]), hermitian=True) == 1


def test_another_parametrisation_tells_the_same() -> None:
    found, h, y = made(9)
    jacobian = np.random.default_rng(2).normal(size=(5, 5)) / UNITS
    other = found.as_function(NAMES, jacobian @ found.reference, jacobian)
    direct = np.linalg.lstsq(h, y, rcond=None)[0]
    np.testing.assert_allclose(estimate(found), direct, rtol=RTOL)
    np.testing.assert_allclose(estimate(other), jacobian @ direct, rtol=RTOL)


def test_about_another_point_the_estimate_is_the_same() -> None:
    found, _, _ = made(9)
    np.testing.assert_allclose(estimate(found.moved(found.reference + UNITS)), estimate(found), rtol=RTOL)


@pytest.mark.parametrize("rows", [2, 9])
def test_doubt_adds_to_the_covariance_of_what_is_known_and_to_nothing_else(rows: int) -> None:
    found, h, _ = made(rows)
    doubt = np.diag((0.3 * UNITS) ** 2)
    doubted = found.doubted(doubt)
    if rows == 9:
        np.testing.assert_allclose(
            np.linalg.inv(doubted.information), np.linalg.inv(found.information) + doubt, rtol=RTOL, atol=RTOL
        )
        np.testing.assert_allclose(estimate(doubted), estimate(found), rtol=RTOL)
    unseen = np.linalg.svd(h * UNITS)[2][rows:] * UNITS
    np.testing.assert_allclose(doubted.information @ unseen.T * UNITS[:, None], 0.0, atol=1e-10)
    # Of what the observations see, h φ, the variance is 1 plus that of the doubt.
    seen = h @ pseudo_inverse(doubted.information) @ h.T
    if rows == 2:
        np.testing.assert_allclose(seen, np.eye(2) + h @ doubt @ h.T, rtol=1e-6)


def test_by_their_triangle_they_are_the_same() -> None:
    found, _, _ = made(9)
    rows = found.triangle()
    assert [len(row) for row in rows] == [1, 2, 3, 4, 5]
    flat = np.concatenate(rows)
    again = NormalEquations.of_triangle(list(NAMES), found.reference, found.right, flat)
    np.testing.assert_array_equal(again.information, found.information)
    assert flat[4] == found.information[2, 1]
    assert (again.names, again.right is found.right) == (NAMES, True)


def test_what_may_be_rounding_of_a_difference_is_nothing() -> None:
    """Another parameter takes all but 1e-10 of what is known, or a little more or less."""
    for left, kept in ((1.05e-10, True), (0.95e-10, False)):
        information = np.array([[4.0, 2.0], [2.0, 1.0 / (1.0 - left)]])
        some = NormalEquations(NAMES[:2], np.zeros(2), np.array([1.0, 2.0]), information).of(NAMES[:1])
        assert bool(some.information.any()) == kept
        assert bool(some.right.any()) == kept
