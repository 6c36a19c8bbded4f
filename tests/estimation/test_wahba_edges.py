"""Attitude from vectors at its edges: near-collinear references, fit statistic written out, small-angle formulas."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import MICRODEGREE_RAD, angle, random_attitudes
from scipy.spatial.transform import Rotation

from fieldcal.estimation import wahba
from fieldcal.geometry.rotation import from_euler

DOWN = np.array([0.0, 0.0, 1.0])
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def sensed(q: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return np.stack([Rotation.from_quat(q).inv().apply(r) for r in reference], axis=1)


@pytest.mark.parametrize("method", [*sorted(wahba.METHODS), "euler"])
def test_a_milliradian_apart_is_collinear_and_a_little_more_is_not(method: str) -> None:
    observed = sensed(random_attitudes(np.random.default_rng(0), 5), LEVEL)
    for apart, refused in ((0.97e-3, True), (1.05e-3, False)):
        reference = np.array([[0.5 * np.sin(apart), 0.0, 0.5 * np.cos(apart)], 20.0 * DOWN])
        if refused:
            with pytest.raises(ValueError, match="collinear"):
                wahba.attitudes(observed, reference, [0.1, 0.1], method=method)
        else:
            assert np.isfinite(wahba.attitudes(observed, reference, [0.1, 0.1], method=method).q).all()


@pytest.mark.parametrize("k", [2, 3])
def test_taste_is_the_weighted_square_misfit_and_sd_the_root_of_the_trace(k: int) -> None:
    """Σ |b − A r|²/σ² at the attitude that is returned, and √tr of Shuster's covariance."""
    rng = np.random.default_rng(1)
    reference = np.array([[1.0, 0.0, 0.2], [0.0, 0.3, 1.0], [-0.5, 1.0, 0.0]])[:k]
    sigma = np.array([0.05, 0.02, 0.2])[:k]
    observed = sensed(random_attitudes(rng, 60), reference) + 0.1 * rng.normal(size=(60, k, 3))
    for method in sorted(wahba.METHODS):
        found = wahba.attitudes(3.0 * observed, 0.5 * reference, sigma, method=method)
        unit = observed / np.linalg.norm(observed, axis=2, keepdims=True)
        normal = reference / np.linalg.norm(reference, axis=1, keepdims=True)
        misfit = np.sum((unit - sensed(found.q, normal)) ** 2, axis=2) / sigma**2
        np.testing.assert_allclose(found.taste, misfit.sum(axis=1), rtol=1e-9, atol=1e-9)
        across = np.eye(3) - np.einsum("nki,nkj->nkij", unit, unit)
        information = np.sum(across / sigma[:, None, None] ** 2, axis=1)
        covariance = np.linalg.inv(information)
        np.testing.assert_allclose(wahba.attitude_covariance(unit, sigma), covariance, rtol=1e-9)
        np.testing.assert_allclose(found.sd, np.sqrt(np.trace(covariance, axis1=1, axis2=2)), rtol=1e-9)


def test_between_equally_good_vectors_triad_trusts_the_first() -> None:
    rng = np.random.default_rng(2)
    observed = sensed(random_attitudes(rng, 40), LEVEL) + 0.1 * rng.normal(size=(40, 2, 3))
    found = wahba.attitudes(observed, LEVEL, [0.1, 0.1], method="triad")
    unit = observed[:, 0] / np.linalg.norm(observed[:, 0], axis=1, keepdims=True)
    np.testing.assert_allclose(sensed(found.q, LEVEL)[:, 0], unit, atol=1e-12)


@pytest.mark.parametrize("declination", [0.0, 0.3])
def test_small_angle_formulas_are_exact_where_one_angle_turns(declination: float) -> None:
    """Level and facing any way; banked or pitched with the field straight ahead: Eq. 2 and 4 have no error there."""
    turns = np.radians([-80.0, -20.0, 0.0, 35.0, 80.0])
    none = np.zeros(5)
    for euler in (np.c_[none, none, 2.0 * turns], np.c_[turns, none, none]):
        q = from_euler(euler)
        field = np.array([[np.cos(declination), np.sin(declination), 0.0], DOWN])
        lengths = np.array([40.0, 9.81])[:, None]
        found = wahba.attitudes(lengths * sensed(q, field), field, [0.1, 0.1], method="euler", declination=declination)
        if euler[:, 0].any():
            np.testing.assert_allclose(Rotation.from_quat(found.q).as_euler("ZYX")[:, 2], turns, atol=1e-9)
        else:
            assert angle(found.q, q).max() < MICRODEGREE_RAD


def test_accelerations_longer_than_gravity_are_straight_up_or_down() -> None:
    """A jolt along an axis is longer than the median: bank and pitch stop at 90°, and nothing is NaN."""
    level = np.tile([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], (11, 1, 1))
    level[1, 1], level[2, 1] = [0.0, 1.04, 0.2], [0.0, -1.04, 0.2]
    level[3, 1], level[4, 1] = [1.04, 0.0, 0.2], [-1.04, 0.0, 0.2]
    found = Rotation.from_quat(wahba.attitudes(level, LEVEL, [0.1, 0.1], method="euler").q)
    down = found.inv().apply(DOWN)
    np.testing.assert_allclose(down[1:3], [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], atol=1e-7)
    np.testing.assert_allclose(down[3:5], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], atol=1e-7)


@pytest.mark.parametrize("n", [1, 4095, 4096, 4097, 8192])
def test_every_sample_of_every_chunk_is_solved(n: int) -> None:
    q = random_attitudes(np.random.default_rng(3), n)
    assert angle(wahba.attitudes(sensed(q, LEVEL), LEVEL, [0.1, 0.2]).q, q).max() < MICRODEGREE_RAD


def test_a_matrix_that_is_a_rotation_but_for_its_length_becomes_a_unit_quaternion() -> None:
    q = random_attitudes(np.random.default_rng(4), 20)
    for method in sorted(wahba.METHODS):
        found = wahba.attitudes(sensed(q, LEVEL), LEVEL, [0.1, 0.2], method=method).q
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-12)


def test_what_shapes_are_wanted_is_said_of_two_vectors_too() -> None:
    observed = np.tile(np.eye(3)[:2], (5, 1, 1))
    with pytest.raises(ValueError, match=r"reference must be \(2, 3\) and sigma positive \(2,\)"):
        wahba.attitudes(observed, np.eye(3)[:2], np.ones(3))
