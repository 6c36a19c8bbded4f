"""Preintegration: its sensitivities against differences, its integrals against the simulator's motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from velocity_support import epochs_of, readings_of, short_flight

from fieldcal.estimation.by_velocity.problem import Knots, place_knots
from fieldcal.estimation.by_velocity.strapdown import Grid, Integrated, grid_of, integrate
from fieldcal.estimation.joint.problem import Readings
from fieldcal.geometry.rotation import Array, from_matrix, multiply, to_rotation_vector

UNIT = np.r_[np.ones(3), np.zeros(3)]
STEP = 1e-5
LINEAR = 2e-3
"""Of a sensitivity, by a difference over STEP and trapezoids between samples."""


@pytest.fixture(scope="module")
def grid() -> Grid:
    flight = short_flight("lively", 3, duration_s=15.0)
    readings = readings_of(flight)
    return grid_of(readings, place_knots(readings, epochs_of(flight)), 0.1)


def at(grid: Grid, gyroscope: Array = UNIT, drift: Array | None = None, accelerometer: Array = UNIT) -> Integrated:
    return integrate(grid, gyroscope, np.zeros(3) if drift is None else drift, accelerometer, 1.0, 7.0)


def turn_between(path: Integrated) -> Array:
    return np.einsum("nji,njk->nik", path.turned[:-1], path.turned[1:])


@pytest.mark.parametrize("column", range(9))
def test_what_the_gyroscope_changes_is_what_a_difference_shows(grid: Grid, column: int) -> None:
    path, step = at(grid), STEP * np.eye(9)[column]
    moved = at(grid, UNIT + step[:6], step[6:])
    # In the axes at each interval's beginning, where knots are turned to.
    back = path.turned[:-1].transpose(0, 2, 1)
    turns = [
        from_matrix((after @ before.T).T) for before, after in zip(turn_between(path), turn_between(moved), strict=True)
    ]
    turned = np.array([to_rotation_vector(q) for q in turns]) / STEP
    predicted = (back @ path.turn_by_gyroscope)[:, :, column]
    assert np.max(np.abs(turned - predicted)) < LINEAR * np.max(np.abs(predicted)) + 1e-6
    pushed = (
        np.einsum("nji,nj->ni", moved.turned[:-1], moved.push) - np.einsum("nji,nj->ni", path.turned[:-1], path.push)
    ) / STEP
    predicted = (back @ path.push_by_gyroscope)[:, :, column]
    assert np.max(np.abs(pushed - predicted)) < 5 * LINEAR * np.max(np.abs(predicted)) + 1e-6


@pytest.mark.parametrize("column", range(6))
def test_what_the_accelerometer_changes_is_what_a_difference_shows(grid: Grid, column: int) -> None:
    path, step = at(grid), STEP * np.eye(6)[column]
    pushed = (at(grid, accelerometer=UNIT + step).push - path.push) / STEP
    assert np.allclose(pushed, path.push_by_accelerometer[:, :, column], atol=1e-8)


def test_true_readings_give_the_true_motion() -> None:
    quiet = {"noise": False, "gnss_arm_m": (0.0, 0.0, 0.0), "gnss_lag_s": 0.1, "rate_hz": 400.0, "duration_s": 12.0}
    perfect = dict.fromkeys(("magnetometer", "accelerometer", "gyroscope"), (1.0, 1.0, 1.0))
    none = dict.fromkeys(perfect, (0.0, 0.0, 0.0))
    flight = short_flight("lively", 5, scale=perfect, bias=none, **quiet)
    readings = readings_of(flight)
    knots = place_knots(readings, epochs_of(flight))
    own = grid_of(readings, knots, 0.1)
    path = at(own)
    start = np.column_stack([np.interp(own.t[own.knot], flight.t, c) for c in flight.q.T])
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    turn = np.stack([from_matrix(m.T) for m in turn_between(path)])
    off = to_rotation_vector(multiply(multiply(start[:-1], turn) * [-1, -1, -1, 1], start[1:]))
    assert np.degrees(np.abs(off)).max() < 0.01
    from fieldcal.geometry.rotation import body_from_inertial

    attitude = body_from_inertial(start).transpose(0, 2, 1)
    push = np.einsum("nij,nkj,nk->ni", attitude[:-1], path.turned[:-1].transpose(0, 2, 1).transpose(0, 2, 1), path.push)
    gravity = np.array([0.0, 0.0, flight.experiment.gravity_mps2])
    change = np.diff(flight.gnss_velocity[knots.epoch], axis=0)
    assert np.abs(push + gravity * np.diff(knots.offset)[:, None] - change).max() < 2e-3


T = np.arange(401) / 100.0
"""4 s; knots at 0.5, 1.5, 2.5 and 3.5 s on the IMU's clock."""
SCALE, ZERO = np.array([0.9, 1.1, 1.2]), np.array([0.02, -0.01, 0.03])


def integrated(gyroscope: Array, accelerometer: Array, magnetometer: Array | None, drift: Array) -> Integrated:
    lag_s = 0.25
    readings = Readings(
        T,
        np.zeros(len(T), dtype=np.int64),
        gyroscope,
        accelerometer,
        magnetometer,
        9.8,
        np.zeros(3),
        np.zeros((2, 401, 3)),
    )
    offset = np.array([0.5, 1.5, 2.5, 3.5]) + lag_s
    grid = grid_of(readings, Knots(offset, np.arange(4), np.array([True, True, True])), lag_s)
    return integrate(grid, np.r_[SCALE, ZERO], drift, np.r_[2.0 * SCALE, -ZERO], -1.0, 2.0)


def test_a_force_that_grows_evenly_in_closed_form() -> None:
    """Without turning: at the knots the force and its slope, over intervals its integral."""
    force, jerk = np.array([1.0, -2.0, 3.0]), np.array([0.5, 0.25, -1.0])
    at = np.array([0.5, 1.5, 2.5, 3.5])
    still = np.tile(-ZERO / SCALE, (len(T), 1))
    logged = (force + np.outer(T, jerk) + ZERO) / (2.0 * SCALE)
    found = integrated(still, logged, None, np.zeros(3))
    assert np.allclose(found.turned, np.eye(3))
    assert np.allclose(found.force[1:3], (force + np.outer(at, jerk))[1:3])
    assert np.allclose(found.jerk[1:3], jerk)
    assert np.allclose(found.push, force + np.outer(0.5 * (at[1:] + at[:-1]), jerk))
    assert not found.count.any()
    assert found.reading.shape == (3, 3)
    assert not found.reading.any()


def test_at_the_ends_of_the_record_means_are_of_what_there_is() -> None:
    """At the first and last knot: the force of the 0.03 s there, its slope 0.06 s further in."""
    t = np.arange(2001) / 1000.0
    first, jerk, snap = np.ones(3), np.array([0.5, 0.25, -1.0]), np.array([3.0, -2.0, 1.0])
    force = first + np.outer(t, jerk) + np.outer(t**2, 0.5 * snap)
    still, no_turns = np.zeros((len(t), 3)), np.zeros((2, len(t), 3))
    readings = Readings(t, np.zeros(len(t), dtype=np.int64), still, force, None, 9.8, np.zeros(3), no_turns)
    offset = np.array([0.5, 1.0, 1.5]) + 5e-4  # between samples
    grid = grid_of(readings, Knots(offset, np.arange(3), np.ones(2, dtype=bool)), 0.0)
    assert grid.magnetometer.shape == (0, 3)
    found = integrate(grid, UNIT, np.zeros(3), UNIT, -1.0, 1.0)
    a, b = np.maximum(offset - 0.03, offset[0]), np.minimum(offset + 0.03, offset[-1])
    mean = first + np.outer(0.5 * (a + b), jerk) + np.outer((b**3 - a**3) / (b - a), snap) / 6.0
    np.testing.assert_allclose(found.force, mean, atol=5e-5)
    np.testing.assert_allclose(found.jerk, jerk + np.outer(offset + np.array([0.06, 0.0, -0.06]), snap), atol=1e-3)


def test_a_reading_that_lacks_an_axis_is_none() -> None:
    """The gyroscope's is bridged by its neighbours; one of the magnetometer alone is its interval's mean."""
    rng = np.random.default_rng(3)
    gyroscope, magnetometer = np.outer(T, [0.1, 0.2, 0.3]), np.full((len(T), 3), np.nan)
    at = np.flatnonzero((T > 1.8) & (T < 1.9))
    magnetometer[at] = rng.normal(size=(len(at), 3))
    magnetometer[at[1:], rng.integers(0, 3, len(at) - 1)] = np.nan
    expected = integrated(gyroscope, gyroscope, magnetometer, np.zeros(3))
    lacking = gyroscope.copy()
    lacking[120, 1] = np.nan
    found = integrated(lacking, gyroscope, magnetometer, np.zeros(3))
    np.testing.assert_array_equal(found.count, [0.0, 1.0, 0.0])
    np.testing.assert_allclose(found.reading[1], magnetometer[at[0]])
    np.testing.assert_allclose(found.turned, expected.turned, atol=1e-12)


def test_a_rate_that_grows_evenly_in_closed_form() -> None:
    """About z, part of it the drift: rate ω at the knots and in the mean, the angle ∫ ω from the first knot on."""
    first, slope, drift = 0.3, 0.2, 0.05
    axis = np.array([0.0, 0.0, 1.0])
    logged = (np.outer(first + slope * T, axis) - ZERO) / SCALE
    magnetometer = np.where(((T > 1.6) & (T < 1.9) | (T > 2.6))[:, None], np.outer(T, [1.0, 2.0, 3.0]), np.nan)
    found = integrated(logged, np.zeros((len(T), 3)), magnetometer, drift * axis)

    def rate(t: Array) -> Array:
        return first + slope * t + drift * (t - 2.0)

    def angle(t: Array) -> Array:
        """Since the first knot."""
        return (first - 2.0 * drift) * (t - 0.5) + 0.5 * (slope + drift) * (t**2 - 0.25)

    at = np.array([0.5, 1.5, 2.5, 3.5])
    assert np.allclose(found.rate[1:3], np.outer(rate(at), axis)[1:3])
    assert np.allclose(found.rate_change[1:3], (slope + drift) * axis)
    assert np.allclose(found.rate_logged[1:3], ((np.outer(first + slope * at, axis) - ZERO) / SCALE)[1:3])
    turned = Rotation.from_rotvec(np.outer(angle(at), axis)).as_matrix()
    assert np.allclose(found.turned, turned, atol=1e-9)
    # No reading in the first interval; of the others those that are there, but none after the last knot.
    seen = [np.zeros(0), T[(T > 1.6) & (T < 1.9)], T[(T > 2.6) & (T < 3.5)]]
    assert np.array_equal(found.count, [len(own) for own in seen])
    for k, own in enumerate(seen[1:], 1):
        assert np.allclose(found.reading[k], own.mean() * np.array([1.0, 2.0, 3.0]))
        axes = Rotation.from_rotvec(np.outer(-angle(own), axis)).as_matrix().mean(axis=0)
        assert np.allclose(found.axes[k], axes, atol=1e-9)
        assert np.allclose(found.axes_rate[k], rate(own).mean() * axis)
        # By the gyroscope's zero about z: the time since the interval's knot.
        assert np.allclose(found.axes_by_gyroscope[k][2, 5], np.mean(own - at[k]))
    assert not found.axes[0].any()
