"""Algebraic fits under noise, where each has a minimum of its own: against general solvers of the same problem."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import directions
from scipy import linalg

from fieldcal.errors import UnusableFlight
from fieldcal.estimation import quadric

BIAS = np.array([0.1, -0.2, 0.05])
CROSS = np.array([[0.9, 0.02, -0.01], [0.02, 1.1, 0.03], [-0.01, 0.03, 1.0]])


@pytest.fixture(scope="module")
def noisy() -> np.ndarray:
    """Readings (n, 3) of an ellipsoid with cross terms, 5 % of noise on each."""
    rng = np.random.default_rng(0)
    return (directions(rng, 300) - BIAS) @ np.linalg.inv(CROSS).T + 0.05 * rng.normal(size=(300, 3))


def regressors(x: np.ndarray, full: bool) -> np.ndarray:
    """What the coefficients of the quadric are multiplied with, (n, 7) or (n, 10): squares, products, lines, 1."""
    products = [2 * x[:, 1] * x[:, 2], 2 * x[:, 0] * x[:, 2], 2 * x[:, 0] * x[:, 1]] if full else []
    return np.column_stack([x * x, *products, 2 * x, np.ones(len(x))])


def check_same_surface(triad: quadric.Triad, theta: np.ndarray, full: bool) -> None:
    """‖Λx + b‖² − 1 has the coefficients theta, up to their common factor."""
    scale, bias = triad
    q = scale.T @ scale
    own = [*np.diagonal(q), *((q[1, 2], q[0, 2], q[0, 1]) if full else ()), *(scale.T @ bias), bias @ bias - 1.0]
    np.testing.assert_allclose(np.array(own) / own[0], theta / theta[0], rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("full", [False, True])
def test_li_and_griffiths_is_the_constrained_least_squares(noisy: np.ndarray, full: bool) -> None:
    """Least ‖Dθ‖ under 4J − I² = 1 (Li and Griffiths 2004, Eq. 7): the one positive eigenvalue of DᵀD θ = μ C θ."""
    d = regressors(noisy, full)
    constraint = np.zeros((d.shape[1], d.shape[1]))
    constraint[:3, :3] = [[-1, 1, 1], [1, -1, 1], [1, 1, -1]]
    if full:
        constraint[range(3, 6), range(3, 6)] = -4.0
    values, vectors = linalg.eig(constraint, d.T @ d)
    theta = vectors[:, np.argmax(values.real)].real
    assert (values.real > 1e-12).sum() == 1
    check_same_surface(quadric.li_griffiths(noisy, full=full), theta, full)
    if not full:
        check_same_surface(quadric.li_griffiths(noisy), theta, full)


def test_total_least_squares_is_the_least_eigenvalue_of_the_scaled_regressors(noisy: np.ndarray) -> None:
    d = regressors(noisy, False)
    norms = np.sqrt((d**2).sum(axis=0))
    theta = np.linalg.eigh((d / norms).T @ (d / norms))[1][:, 0] / norms
    check_same_surface(quadric.total_least_squares(noisy), theta, False)


def test_the_first_step_is_least_squares_on_the_square_of_x(noisy: np.ndarray) -> None:
    """Coefficient of x² set to 1, the other six solved for by the normal equations."""
    d = regressors(noisy, False)
    others = np.linalg.solve(d[:, 1:].T @ d[:, 1:], -d[:, 1:].T @ d[:, 0])
    check_same_surface(quadric.first_step(noisy), np.r_[1.0, others], False)


def test_the_sphere_is_least_squares_on_the_squared_length(noisy: np.ndarray) -> None:
    """|x − c|² = r²: with its linear form's centre, the radius that leaves no mean error."""
    scale, bias = quadric.sphere(noisy)
    centre, radius = -bias / scale[0, 0], 1.0 / scale[0, 0]
    error = np.sum((noisy - centre) ** 2, axis=1) - radius**2
    assert abs(error.mean()) < 1e-12
    np.testing.assert_allclose(error @ (noisy - noisy.mean(axis=0)), 0.0, atol=1e-10)
    np.testing.assert_array_equal(scale, scale[0, 0] * np.eye(3))


@pytest.mark.parametrize("factor", [1.0, -2.5])
def test_a_quadric_with_every_coefficient_different(factor: float) -> None:
    """θ and any multiple of it, negative ones too, are one surface; Λ is the symmetric root."""
    q = CROSS @ CROSS
    theta = np.r_[np.diagonal(q), q[1, 2], q[0, 2], q[0, 1], CROSS @ BIAS]
    scale, bias = quadric.triad_of_quadric(factor * theta, factor * float(BIAS @ BIAS - 1.0))
    np.testing.assert_allclose(scale, CROSS, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(bias, BIAS, rtol=1e-12)


def test_a_quadric_without_real_points_is_refused() -> None:
    """x² + y² + z² + offset = 0: a sphere while the offset is negative, a point at 0, nothing beyond."""
    unit = np.r_[np.ones(3), np.zeros(6)]
    assert quadric.triad_of_quadric(unit, -0.25)[0][0, 0] == pytest.approx(2.0)
    for offset in (0.0, 0.5):
        with pytest.raises(UnusableFlight, match="no real points") as refused:
            quadric.triad_of_quadric(unit, offset)
        assert refused.value.reason_code == "ellipsoid_degenerate"


def test_a_cylinder_is_refused_and_a_long_ellipsoid_is_not() -> None:
    flat = np.r_[1.0, 1.0, 0.0, np.zeros(6)]
    with pytest.raises(UnusableFlight, match="plane or an open surface") as refused:
        quadric.triad_of_quadric(flat, -1.0)
    assert refused.value.measured["quadric_eigenvalues"] == [0.0, 1.0, 1.0]
    for size in (0.25, 1.0, 4.0):
        for flat in (0.9e-12, 1e-12):
            with pytest.raises(UnusableFlight, match="plane or an open surface"):
                quadric.triad_of_quadric(np.r_[size, size, size * flat, np.zeros(6)], -size)
        scale, _ = quadric.triad_of_quadric(np.r_[size, size, size * 1.05e-12, np.zeros(6)], -size)
        np.testing.assert_allclose(np.diagonal(scale), [1.0, 1.0, np.sqrt(1.05e-12)])


def test_readings_in_a_plane_have_no_sphere_and_a_stuck_axis_no_ellipsoid() -> None:
    x = directions(np.random.default_rng(1), 50)
    x[:, 1] = 0.0
    for fit in (quadric.sphere, quadric.li_griffiths, quadric.total_least_squares):
        with pytest.raises(UnusableFlight) as refused:
            fit(x)
        assert refused.value.reason_code == "ellipsoid_degenerate"
