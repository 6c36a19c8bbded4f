"""Preintegration: its sensitivities against differences, its integrals against the simulator's motion."""

from __future__ import annotations

import numpy as np
import pytest
from velocity_support import epochs_of, readings_of, short_flight

from fieldcal.estimation.by_velocity.problem import place_knots
from fieldcal.estimation.by_velocity.strapdown import Grid, Integrated, grid_of, integrate
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
