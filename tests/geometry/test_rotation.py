"""Quaternion algebra against SciPy's rotations and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import AXES, MICRODEGREE_RAD, ROUNDING, angle, finely_integrated, random_attitudes
from scipy.spatial.transform import Rotation, Slerp

from fieldcal.geometry import rotation

SAMPLES = 500


@pytest.fixture
def q() -> np.ndarray:
    return random_attitudes(np.random.default_rng(1), SAMPLES)


@pytest.fixture
def p() -> np.ndarray:
    return random_attitudes(np.random.default_rng(2), SAMPLES)


def test_matrix_is_the_transpose_of_scipy_body_to_inertial(q: np.ndarray) -> None:
    np.testing.assert_allclose(
        rotation.body_from_inertial(q), Rotation.from_quat(q).as_matrix().transpose(0, 2, 1), atol=ROUNDING
    )


def test_matrix_is_the_papers_formula(q: np.ndarray) -> None:
    e, d = q[0, :3], q[0, 3]
    a = (d**2 - e @ e) * np.eye(3) + 2 * np.outer(e, e) - 2 * d * rotation.skew(e)
    np.testing.assert_allclose(rotation.body_from_inertial(q[0]), a, atol=ROUNDING)


def test_skew_is_the_cross_product(q: np.ndarray) -> None:
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", rotation.skew(q[:, :3]), q[:, 1:]), np.cross(q[:, :3], q[:, 1:]), atol=ROUNDING
    )


def test_product_and_inverse_are_scipys(p: np.ndarray, q: np.ndarray) -> None:
    product = (Rotation.from_quat(p) * Rotation.from_quat(q)).as_quat()
    assert angle(rotation.multiply(p, q), product).max() < ROUNDING
    assert angle(rotation.conjugate(q), Rotation.from_quat(q).inv().as_quat()).max() < ROUNDING
    np.testing.assert_allclose(rotation.multiply(p[0], q), [rotation.multiply(p[0], each) for each in q])


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-6, 0.1, 3.0, np.pi - 1e-9])
def test_rotation_vectors_there_and_back(length: float) -> None:
    v = length * np.random.default_rng(3).normal(size=(SAMPLES, 3))
    v *= length / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300)
    q = rotation.from_rotation_vector(v)
    assert angle(q, Rotation.from_rotvec(v).as_quat()).max() < ROUNDING
    np.testing.assert_allclose(rotation.to_rotation_vector(q), v, rtol=1e-9, atol=1e-15)


def test_rotation_vector_takes_the_shorter_way_whatever_the_sign(q: np.ndarray) -> None:
    expected = Rotation.from_quat(q).as_rotvec()
    np.testing.assert_allclose(rotation.to_rotation_vector(q), expected, atol=1e-9)
    np.testing.assert_allclose(rotation.to_rotation_vector(-q), expected, atol=1e-9)


@pytest.mark.parametrize("axis", AXES.tolist())
def test_matrix_at_180_degrees(axis: list[float]) -> None:
    expected = np.array([*axis, 0.0])
    assert angle(rotation.from_matrix(rotation.body_from_inertial(expected)), expected) < MICRODEGREE_RAD


def test_matrix_there_and_back(q: np.ndarray) -> None:
    back = np.array([rotation.from_matrix(a) for a in rotation.body_from_inertial(q)])
    assert angle(back, q).max() < ROUNDING
    assert (back[:, 3] >= 0).all()


def test_many_matrices_at_once(q: np.ndarray) -> None:
    """Every branch of Shepperd's choice, half turns too: along SciPy's quaternion, the largest component positive."""
    matrices = rotation.body_from_inertial(np.vstack([q, np.eye(4)]))
    parallel = rotation.parallel_to_quaternion(matrices)
    expected = Rotation.from_matrix(matrices.transpose(0, 2, 1)).as_quat()
    assert angle(parallel / np.linalg.norm(parallel, axis=1, keepdims=True), expected).max() < ROUNDING
    assert (np.max(parallel, axis=1) >= np.max(-parallel, axis=1)).all()
    assert (np.linalg.norm(parallel, axis=1) > 1.0).all()


def test_euler_angles_are_the_321_sequence(q: np.ndarray) -> None:
    heading_pitch_bank = Rotation.from_quat(q).as_euler("ZYX")
    np.testing.assert_allclose(rotation.euler_angles(q), heading_pitch_bank[:, ::-1], atol=1e-9)
    assert angle(rotation.from_euler(heading_pitch_bank[:, ::-1]), q).max() < ROUNDING


def test_one_hemisphere_along_the_record() -> None:
    rng = np.random.default_rng(4)
    smooth, _ = finely_integrated(np.arange(0.0, 20.0, 0.05), rng, refinement=2)
    flipped = smooth * rng.choice([-1.0, 1.0], size=(len(smooth), 1))
    joined = rotation.continuous(flipped)
    assert (np.sum(joined[1:] * joined[:-1], axis=1) > 0).all()
    np.testing.assert_array_equal(np.abs(joined), np.abs(flipped))
    np.testing.assert_array_equal(joined[0], flipped[0])


def test_kinematics_invert_each_other(q: np.ndarray) -> None:
    rate = np.random.default_rng(5).normal(size=(SAMPLES, 3))
    q_dot = 0.5 * np.einsum("nij,nj->ni", rotation.rate_matrix(q), rate)
    np.testing.assert_allclose(rotation.body_rate(q, q_dot), rate, atol=ROUNDING)


def test_kinematics_are_those_of_body_rates(q: np.ndarray) -> None:
    """Turning by ω dt about body axes is SciPy's product on the right: q̇ is its derivative."""
    rate, dt = np.random.default_rng(6).normal(size=(SAMPLES, 3)), 1e-5
    later = (Rotation.from_quat(q) * Rotation.from_rotvec(rate * dt)).as_quat()
    earlier = (Rotation.from_quat(q) * Rotation.from_rotvec(-rate * dt)).as_quat()
    later, earlier = (x * np.sign(np.sum(x * q, axis=1, keepdims=True)) for x in (later, earlier))
    q_dot = 0.5 * np.einsum("nij,nj->ni", rotation.rate_matrix(q), rate)
    np.testing.assert_allclose((later - earlier) / (2 * dt), q_dot, atol=1e-9)


def test_angle_between_is_scipys_magnitude(p: np.ndarray, q: np.ndarray) -> None:
    expected = (Rotation.from_quat(p).inv() * Rotation.from_quat(q)).magnitude()
    np.testing.assert_allclose(rotation.angle_between(p, q), expected, atol=1e-9)


def test_mean_is_scipys(q: np.ndarray) -> None:
    near = rotation.multiply(q[0], rotation.from_rotation_vector(0.3 * np.random.default_rng(7).normal(size=(50, 3))))
    weights = np.random.default_rng(8).uniform(0.1, 1.0, 50)
    signs = np.random.default_rng(9).choice([-1.0, 1.0], size=(50, 1))
    expected = Rotation.from_quat(near).mean(weights=weights).as_quat()
    assert angle(rotation.mean_quaternion(signs * near, weights), expected) < 1e-9


@pytest.mark.parametrize("n", [0, 1, 2, 3, 10, 101])
def test_running_product_is_one_product_after_another(n: int) -> None:
    steps = random_attitudes(np.random.default_rng(n), n)
    running, expected = np.array([0.0, 0.0, 0.0, 1.0]), []
    for step in steps:
        running = rotation.multiply(running, step)
        expected.append(running)
    np.testing.assert_allclose(rotation.cumulative_product(steps), np.reshape(expected, (n, 4)), atol=ROUNDING)


def test_constant_rate_is_integrated_exactly() -> None:
    t = np.sort(np.random.default_rng(10).uniform(0.0, 10.0, 300))
    rate, start = np.array([0.4, -1.1, 0.7]), Rotation.from_rotvec([1.0, 0.5, -2.0])
    expected = (start * Rotation.from_rotvec(rate * (t - t[0])[:, None])).as_quat()
    q = rotation.propagate(t, np.tile(rate, (len(t), 1)), start.as_quat())
    assert angle(q, expected).max() < 1e-11


def test_integration_error_falls_with_the_square_of_the_step() -> None:
    """Rates are taken as linear between samples: halving the step must quarter the error at least."""
    errors = []
    for step in (0.04, 0.02, 0.01):
        t = np.arange(0.0, 8.0 + step / 2, step)
        truth, rate = finely_integrated(t, np.random.default_rng(11), refinement=40)
        errors.append(angle(rotation.propagate(t, rate, truth[0]), truth).max())
    assert errors[0] / errors[1] > 3.5
    assert errors[1] / errors[2] > 3.5


def test_integration_does_not_depend_on_the_time_origin() -> None:
    t = np.arange(0.0, 5.0, 0.01)
    truth, rate = finely_integrated(t, np.random.default_rng(12), refinement=1)
    np.testing.assert_allclose(rotation.propagate(t + 4096.0, rate, truth[0]), truth, atol=1e-10)


def test_slerp_is_scipys(q: np.ndarray) -> None:
    t = np.cumsum(np.random.default_rng(13).uniform(0.01, 0.1, SAMPLES))
    at = np.random.default_rng(14).uniform(t[0], t[-1], SAMPLES)
    signs = np.random.default_rng(15).choice([-1.0, 1.0], size=(SAMPLES, 1))
    expected = Slerp(t, Rotation.from_quat(q))(at).as_quat()
    assert angle(rotation.slerp(t, signs * q, at), expected).max() < 1e-9


def test_slerp_holds_the_ends() -> None:
    q = random_attitudes(np.random.default_rng(16), 3)
    out = rotation.slerp([0.0, 1.0, 2.0], q, [-5.0, 0.0, 1.0, 2.0, 9.0])
    assert angle(out, q[[0, 0, 1, 2, 2]]).max() < ROUNDING
