"""Algebraic fits against the ellipsoid that the readings were made from; readings without one are refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from numerics_support import directions

from fieldcal.errors import UnusableFlight
from fieldcal.estimation import quadric

SCALE, BIAS = np.diag([0.9, 1.1, 1.0]), np.array([0.1, -0.2, 0.05])
CROSS = np.array([[0.9, 0.02, -0.01], [0.02, 1.1, 0.03], [-0.01, 0.03, 1.0]])
EXACT = 1e-9
AXIS_ALIGNED = pytest.mark.parametrize("fit", [quadric.li_griffiths, quadric.total_least_squares, quadric.first_step])
Fit = Callable[[np.ndarray], quadric.Triad]


def readings(scale: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """x (n, 3) with ‖scale x + bias‖ = 1."""
    return (directions(np.random.default_rng(3), 200) - bias) @ np.linalg.inv(scale).T


@AXIS_ALIGNED
def test_axis_aligned_ellipsoid(fit: Fit) -> None:
    scale, bias = fit(readings(SCALE, BIAS))
    np.testing.assert_allclose(scale, SCALE, atol=EXACT)
    np.testing.assert_allclose(bias, BIAS, atol=EXACT)


def test_cross_terms() -> None:
    scale, bias = quadric.li_griffiths(readings(CROSS, BIAS), full=True)
    np.testing.assert_allclose(scale, CROSS, atol=EXACT)
    np.testing.assert_allclose(bias, BIAS, atol=EXACT)


def test_sphere() -> None:
    scale, bias = quadric.sphere(readings(2.0 * np.eye(3), BIAS))
    np.testing.assert_allclose(scale, 2.0 * np.eye(3), atol=EXACT)
    np.testing.assert_allclose(bias, BIAS, atol=EXACT)


@pytest.mark.parametrize("fit", [quadric.li_griffiths, partial(quadric.li_griffiths, full=True), quadric.sphere])
def test_readings_in_a_plane_are_refused(fit: Fit) -> None:
    x = readings(SCALE, BIAS)
    x[:, 2] = 0.0
    with pytest.raises(UnusableFlight) as refused:
        fit(x)
    assert refused.value.reason_code == "ellipsoid_degenerate"


def test_an_open_quadric_is_no_ellipsoid() -> None:
    hyperboloid = np.array([1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(UnusableFlight, match="open surface"):
        quadric.triad_of_quadric(hyperboloid, -1.0)
