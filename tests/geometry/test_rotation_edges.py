"""Rotations of any shape, at half turns, at the poles and in short records; interpolation through rates; the scan."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numerics_support import ROUNDING, angle, random_attitudes
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from fieldcal.geometry import rotation
from fieldcal.geometry.sensor_model import default_reference_reading

RNG = np.random.default_rng(21)
ATTITUDES = random_attitudes(RNG, 30).reshape(2, 5, 3, 4)
VECTORS = RNG.normal(size=(2, 5, 3, 3))


@pytest.mark.parametrize(
    ("function", "values"),
    [
        (rotation.skew, VECTORS),
        (rotation.conjugate, ATTITUDES),
        (rotation.normalise, 3.0 * ATTITUDES),
        (rotation.from_rotation_vector, VECTORS),
        (rotation.to_rotation_vector, ATTITUDES),
        (rotation.body_from_inertial, ATTITUDES),
        (lambda q: rotation.parallel_to_quaternion(rotation.body_from_inertial(q)), ATTITUDES),
        (rotation.rate_matrix, ATTITUDES),
        (rotation.euler_angles, ATTITUDES),
        (rotation.from_euler, VECTORS),
        (lambda q: rotation.angle_between(q, q[..., ::-1]), ATTITUDES),
        (lambda q: rotation.body_rate(q, q[..., ::-1]), ATTITUDES),
    ],
)
def test_leading_axes_are_only_carried_along(function: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> None:
    one_by_one = [[[function(v) for v in row] for row in block] for block in values]
    np.testing.assert_allclose(function(values), np.array(one_by_one), rtol=0, atol=ROUNDING)


def test_products_broadcast() -> None:
    p, q = ATTITUDES[0, :, 0], ATTITUDES[1, 0]
    table = rotation.multiply(p[:, None], q)
    assert table.shape == (5, 3, 4)
    for i in range(5):
        wanted = (Rotation.from_quat(p[i]) * Rotation.from_quat(q)).as_quat()
        assert angle(table[i], wanted).max() < ROUNDING
        np.testing.assert_array_equal(table[i], rotation.multiply(p[i], q))


def test_unit_length() -> None:
    q = RNG.normal(size=(50, 4))
    np.testing.assert_allclose(rotation.normalise(q), q / np.linalg.norm(q, axis=1)[:, None], rtol=1e-14)


def test_identity_turns_nothing_and_stays_so() -> None:
    q = ATTITUDES[0, 0]
    np.testing.assert_array_equal(rotation.multiply(rotation.IDENTITY, q), q)
    with pytest.raises(ValueError, match="read-only"):
        rotation.IDENTITY[0] = 1.0


@pytest.mark.parametrize("axis", range(3))
def test_a_half_turn_has_its_axis_for_a_quaternion(axis: int) -> None:
    q = rotation.from_matrix(np.diag(2.0 * np.eye(3)[axis] - 1.0))
    np.testing.assert_array_equal(q, np.eye(4)[axis])


def test_neighbours_share_a_hemisphere_from_two_on() -> None:
    q = ATTITUDES[0, 0, 0]
    np.testing.assert_array_equal(rotation.continuous([q, -q]), [q, q])
    np.testing.assert_array_equal(rotation.continuous([q, -q, -q, q]), [q, q, q, q])
    np.testing.assert_array_equal(rotation.continuous([q]), [q])
    assert rotation.continuous(np.empty((0, 4))).shape == (0, 4)
    np.testing.assert_array_equal(rotation.continuous(np.eye(4)), np.eye(4))


@pytest.mark.parametrize("q", [*ATTITUDES[0, 0], *-ATTITUDES[1, 0]])
def test_a_mean_has_its_scalar_part_positive(q: np.ndarray) -> None:
    mean = rotation.mean_quaternion([q, -q, q])
    np.testing.assert_allclose(mean, q if q[3] > 0 else -q, atol=ROUNDING)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_of_a_linear_rate_is_that_of_the_differential_equation(seed: int) -> None:
    """Rates of 2 rad/s that swing round over 20 ms: the cross term is right to one in a hundred."""
    duration_s = 0.02
    first, last = 2.0 * np.random.default_rng(seed).normal(size=(2, 3))

    def turning(t: float, q: np.ndarray) -> np.ndarray:
        return 0.5 * rotation.rate_matrix(q) @ (first + (last - first) * t / duration_s)

    truth = solve_ivp(turning, (0.0, duration_s), [0.0, 0.0, 0.0, 1.0], rtol=1e-13, atol=1e-15).y[:, -1]
    cross_term = Rotation.from_quat(truth).as_rotvec() - 0.5 * duration_s * (first + last)
    (step,) = rotation.rotation_steps([5.0, 5.0 + duration_s], [first, last])
    error = step - 0.5 * duration_s * (first + last) - cross_term
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(cross_term)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 100, 101, 10_000])
def test_a_running_product_takes_two_root_n_steps(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What makes it fast; one quaternion after the other would take n."""
    steps = rotation.from_rotation_vector(0.01 * np.random.default_rng(n).normal(size=(n, 3)))
    calls, multiply = [0], rotation.multiply

    def counted(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        calls[0] += 1
        return multiply(p, q)

    monkeypatch.setattr(rotation, "multiply", counted)
    running = rotation.cumulative_product(steps)
    assert calls[0] <= 2.0 * np.sqrt(n) + 2.0
    assert running.shape == (n, 4)
    turned = Rotation.identity()
    for k in range(min(n, 200)):
        turned = turned * Rotation.from_quat(steps[k])
        assert angle(running[k], turned.as_quat()) < ROUNDING


def test_cubic_interpolation_is_exact_for_a_cubic_angle() -> None:
    """Turning about one axis by θ(t) of third degree, from any attitude, at uneven stamps."""
    cubic = np.polynomial.Polynomial([0.2, -1.0, 3.0, -1.5])
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    t = np.array([10.0, 10.1, 10.35, 10.4, 11.0])
    at = np.linspace(10.0, 11.0, 201)
    start = Rotation.from_quat(ATTITUDES[0, 0, 0])

    def attitude(times: np.ndarray) -> np.ndarray:
        return (start * Rotation.from_rotvec(cubic(times - 10.0)[:, None] * axis)).as_quat()

    rate = cubic.deriv()(t - 10.0)[:, None] * axis
    signs = np.array([1.0, -1.0, -1.0, 1.0, -1.0])[:, None]
    assert angle(rotation.hermite(t, signs * attitude(t), rate, at), attitude(at)).max() < 1e-12
    # Held at the ends.
    outside = rotation.hermite(t, attitude(t), rate, [9.0, 12.0])
    assert angle(outside, attitude(t[[0, -1]])).max() < 1e-12


def test_cubic_interpolation_errs_less_than_slerp() -> None:
    """A swing of 3 Hz at 10 ms: spherical interpolation cuts (ωT)² / 12 · ¾ short at most, the cubic (ωT)⁴ / 384."""
    t = np.arange(0.0, 1.0, 0.01)
    at = t[:-1] + 0.005
    w, size, axis = 2 * np.pi * 3.0, 0.5, np.array([0.0, 0.6, 0.8])
    truth = Rotation.from_rotvec(size * np.sin(w * at)[:, None] * axis).as_quat()
    q = Rotation.from_rotvec(size * np.sin(w * t)[:, None] * axis).as_quat()
    rate = size * w * np.cos(w * t)[:, None] * axis
    cubic, spherical = (
        angle(found, truth).max() for found in (rotation.hermite(t, q, rate, at), rotation.slerp(t, q, at))
    )
    assert cubic < 1.1 * size * (w * 0.01) ** 4 / 384
    assert spherical > 50 * cubic


def test_without_rates_cubic_interpolation_is_spherical() -> None:
    t = np.cumsum(RNG.uniform(0.1, 0.3, 30))
    q = ATTITUDES.reshape(-1, 4)
    at = RNG.uniform(t[0], t[-1], 100)
    found = rotation.hermite(t, q, np.full((30, 3), np.nan), at)
    assert angle(found, rotation.slerp(t, q, at)).max() < ROUNDING


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_pitch_at_the_poles(sign: float) -> None:
    """Rounding may leave a quaternion a little longer than one."""
    q = np.array([0.0, sign * np.sqrt(0.5), 0.0, np.sqrt(0.5)]) * (1.0 + 1e-9)
    assert rotation.euler_angles(q)[1] == sign * np.pi / 2


@pytest.mark.parametrize(
    ("low", "middle", "unsigned"),
    [
        (0, 32_768, True),
        (1, 16_385, True),
        (0, 16_384, False),
        (0, 16_383, False),
        (-1, 32_768, False),
        (-1, 0, False),
        (0, 17_000, True),
    ],
)
def test_words_are_unsigned_when_none_is_negative_and_most_are_large(low: int, middle: int, unsigned: bool) -> None:
    """16-bit converters count from 0 with zero at 2¹⁵, or about 0."""
    logged = np.full((9, 3), float(middle))
    logged[4, 1], logged[5] = low, np.nan
    wanted = np.full(3, 32_768.0) if unsigned else np.zeros(3)
    np.testing.assert_array_equal(default_reference_reading(logged, "counts"), wanted)
    np.testing.assert_array_equal(default_reference_reading(logged, "rad/s"), np.zeros(3))
