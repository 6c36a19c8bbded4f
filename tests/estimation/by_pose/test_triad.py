"""A triad in other axes, square or not: covariances against finite differences of SciPy's rotations and of a Cholesky
factor, the estimate with elements at zero against Lagrange's equations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldcal.estimation.by_pose.triad import TriadByPose, axis_sigma, body_axes
from fieldcal.geometry.rotation import Array

MATRIX = np.array([[1.05, 0.03, -0.01], [0.02, 0.95, -0.02], [0.04, -0.05, 1.1]])
BIAS = np.array([0.12, -0.08, 0.2])
LOWER = ((1, 0), (2, 0), (2, 1))
STEP = 1e-5
SMALL = 1e-6  # what central differences over STEP and over a millionth of a matrix element leave, relative


def triad(seed: int = 1) -> TriadByPose:
    root = 0.01 * np.random.default_rng(seed).normal(size=(12, 12))
    return TriadByPose(MATRIX, BIAS, root @ root.T, 0.0, 0.0, 0.0, np.ones(1), 1.0)


def slopes(of: Callable[[Array], Array], at: Array) -> Array:
    """∂of/∂x, (·, n), by central differences."""
    return np.stack([(of(at + e) - of(at - e)) / (2.0 * STEP) for e in STEP * np.eye(len(at))], axis=1)


def numbers(of: TriadByPose) -> Array:
    return np.r_[of.matrix.ravel(), of.bias]


def close(found: Array, expected: Array) -> None:
    np.testing.assert_allclose(found, expected, atol=SMALL * np.abs(expected).max())


def test_a_turn_and_its_uncertainty_are_carried_along() -> None:
    """New = exp(φ) R old, with old and φ uncertain."""
    own, rotation = triad(), Rotation.from_rotvec([0.3, -0.5, 0.2])
    root = 0.01 * np.random.default_rng(2).normal(size=(3, 3))
    turned = own.turned(rotation.as_matrix(), root @ root.T)

    def of(x: Array) -> Array:
        new = (Rotation.from_rotvec(x[12:]) * rotation).as_matrix()
        return np.r_[(new @ x[:9].reshape(3, 3)).ravel(), new @ x[9:12]]

    at = np.r_[numbers(own), np.zeros(3)]
    np.testing.assert_allclose(numbers(turned), of(at), rtol=1e-12)
    jacobian = slopes(of, at)
    by_turn = jacobian[:, 12:] @ root @ root.T @ jacobian[:, 12:].T
    close(turned.covariance, jacobian[:, :12] @ own.covariance @ jacobian[:, :12].T + by_turn)


def by_cholesky(matrix: Array) -> Array:
    """L lower triangular with LᵀL = MᵀM and a positive diagonal: M's columns keep their lengths and angles."""
    turned = np.linalg.cholesky((matrix.T @ matrix)[::-1, ::-1])
    return np.asarray(turned.T[::-1, ::-1])


@pytest.mark.parametrize("polarity", [(1.0, 1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, -1.0, 1.0)])
def test_body_axes_are_those_of_a_cholesky_factor_with_its_covariance(polarity: tuple[float, float, float]) -> None:
    own, sign = triad(), np.array(polarity)
    found, rotation, turning = body_axes(own, sign)

    def of(x: Array) -> Array:
        lower = sign[:, None] * by_cholesky(x[:9].reshape(3, 3))
        turn = lower @ np.linalg.inv(x[:9].reshape(3, 3))
        return np.r_[lower.ravel(), turn @ x[9:]]

    def turn_of(x: Array) -> Array:
        lower = sign[:, None] * by_cholesky(x[:9].reshape(3, 3))
        turn = lower @ np.linalg.inv(x[:9].reshape(3, 3))
        return np.asarray(Rotation.from_matrix(turn @ rotation.T).as_rotvec())

    at = numbers(own)
    np.testing.assert_allclose(numbers(found), of(at), atol=1e-12)
    np.testing.assert_allclose(rotation @ MATRIX, found.matrix, atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(np.prod(sign))
    assert np.sign(np.diagonal(found.matrix)).tolist() == list(polarity)
    jacobian, turns = slopes(of, at), slopes(turn_of, at)
    close(found.covariance, jacobian @ own.covariance @ jacobian.T)
    close(turning, turns @ own.covariance @ turns.T)


@pytest.mark.parametrize("elements", [LOWER, ((0, 1), (1, 0), (2, 1), (1, 2)), ((2, 0),)])
def test_elements_at_zero_by_lagrange_s_equations(elements: tuple[tuple[int, int], ...]) -> None:
    """The least (v − v₀)ᵀC⁻¹(v − v₀) with these elements zero: it knows of no centre of the readings."""
    own, at = triad(), [3 * i + j for i, j in elements]
    square = own.square([2.0, -3.0, 1.0], elements)
    n = len(at)
    pick = np.eye(12)[at]
    information = np.linalg.inv(own.covariance)
    both = np.block([[information, pick.T], [pick, np.zeros((n, n))]])
    expected = np.linalg.solve(both, np.r_[information @ numbers(own), np.zeros(n)])[:12]
    np.testing.assert_allclose(numbers(square), expected, atol=1e-8)
    assert not square.matrix.ravel()[at].any()


def test_what_the_elements_may_be_stays_in_the_sd() -> None:
    """Of the other elements, and of what is calibrated at the mean reading; the elements themselves are known."""
    own, centre = triad(), np.array([2.0, -3.0, 1.0])
    square = own.square(centre, LOWER)
    others = [k for k in range(9) if (k // 3, k % 3) not in LOWER]
    kept = np.ix_(others, others)
    np.testing.assert_allclose(square.covariance[kept], own.covariance[kept], rtol=1e-9)
    at_centre = np.hstack([np.kron(np.eye(3), centre), np.eye(3)])
    expected = at_centre @ own.covariance @ at_centre.T
    np.testing.assert_allclose(at_centre @ square.covariance @ at_centre.T, expected, rtol=1e-9)
    known = [3 * i + j for i, j in LOWER]
    assert np.abs(square.covariance[known]).max() < 1e-12
    np.testing.assert_allclose(square.covariance, square.covariance.T, atol=1e-15)


def test_the_test_of_elements_is_their_square_over_their_covariance() -> None:
    own, at = triad(), [3, 6, 7]
    value = MATRIX.ravel()[at]
    expected = value @ np.linalg.inv(own.covariance[np.ix_(at, at)]) @ value
    assert own.cross_test(LOWER) == pytest.approx(expected, rel=1e-9)


def test_sd_are_told_of_elements_that_are_there() -> None:
    own = triad()
    assert own.cross_sd is not None
    np.testing.assert_allclose(own.cross_sd.ravel() ** 2, np.diagonal(own.covariance)[:9], rtol=1e-12)
    every = [(i, j) for i in range(3) for j in range(3) if i != j]
    assert own.square(np.zeros(3), tuple(every)).cross_sd is None
    at = np.r_[0, 4, 8, 9:12]
    assert own.diagonal_covariance.tolist() == own.covariance[np.ix_(at, at)].tolist()


def test_an_axis_has_an_sd_of_its_own_and_never_none() -> None:
    """Three in four of |x| ≤ 1.15 sd: by counting, the median of |x| is 0.6745 sd."""
    x = np.linspace(-1.0, 1.0, 10001)[:, None] * [2.0, 0.02, 0.0]
    assert axis_sigma(x) == pytest.approx([1.4826, 0.014826, 1e-12])
