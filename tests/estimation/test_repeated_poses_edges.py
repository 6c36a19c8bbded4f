"""Repeated poses of turns about one axis, row by row, on either side of every limit."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.clock_sync.repeated_poses import find_repeats
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply

DT = 1.0 / 128.0
LEAST_TURN = np.radians(0.2)
BEFORE_S, AFTER_S = 6 * DT, 7 * DT
"""The stamps next to 0.05 s before a run, which is not reached, and after it, which is."""


def about_z(angle: Array) -> Array:
    return np.asarray(from_rotation_vector(np.outer(angle, [0.0, 0.0, 1.0])))


def stopped(
    steps: Array, at: int, rows: int, jump: float | None = None, dt: float = DT
) -> tuple[Array, Array, np.ndarray]:
    """Stamps and attitudes of turns by `steps` (n,), with the pose before step `at` in `rows` rows; `jump` is what
    comes after them instead. And which rows are repeats. One pose is nearly another, so that none looks rounded."""
    steps = np.insert(np.r_[0.3, steps], at + 1, np.zeros(rows - 1))
    if jump is not None:
        steps[at + rows] = jump
    again = np.zeros(len(steps), dtype=bool)
    again[at + 1 : at + rows] = True
    nearly = [1e-3, 1e-5 - 1e-3]
    if at:
        steps, again = np.r_[steps[0], nearly, steps[1:]], np.r_[False, False, again]
    else:
        steps, again = np.r_[steps, nearly], np.r_[again, False, False]
    return dt * np.arange(len(steps)), about_z(np.cumsum(steps)), again


@pytest.mark.parametrize(
    ("held", "rows", "frozen"),
    [(1, 4, False), (1, 5, True), (2, 5, False), (2, 6, True), (3, 8, False), (3, 9, True)],
)
def test_a_run_is_frozen_from_five_rows_and_three_times_the_usual_on(held: int, rows: int, frozen: bool) -> None:
    """A turn of 1 rad/s, of which each pose comes in as many rows as usual, and one in more."""
    poses = np.repeat(np.arange(200), np.where(np.arange(200) == 100, rows, held))
    row = np.arange(len(poses))
    logged = row[np.searchsorted(poses, poses)]  # the pose of the first of its rows
    in_run = row - logged
    found = find_repeats(DT * row, about_z(0.3 + 1.0 * DT * logged))
    assert found.rows_a_pose == held
    expected = (poses == 100) & (in_run > 0) & frozen
    np.testing.assert_array_equal(found.frozen, expected)
    np.testing.assert_array_equal(found.held, (in_run % held > 0) & ~expected)
    assert not found.default.any()


@pytest.mark.parametrize("share", [0.97, 1.03])
def test_a_pose_is_frozen_that_is_left_by_more_than_twice_the_pace_and_a_fifth_of_a_degree(share: float) -> None:
    steps = np.full(300, 0.4 * DT)
    steps[130:150], steps[150:170] = 0.3 * DT, 0.1 * DT
    limit = 2.0 * 0.3 * DT + LEAST_TURN
    t, q, again = stopped(steps, 150, 8, share * limit)
    for length in (1.0, 2.0):  # of quaternions as they are logged
        np.testing.assert_array_equal(find_repeats(t, length * q).frozen, again & (share > 1.0))


@pytest.mark.parametrize("share", [0.99, 1.01])
@pytest.mark.parametrize(
    ("dt", "before", "stretch_s"),
    [(DT, True, BEFORE_S), (DT, False, AFTER_S), (0.125, True, 0.125), (0.125, False, 0.125)],
)
def test_a_pose_is_frozen_at_which_no_vehicle_comes_to_rest_so_fast(
    share: float, dt: float, before: bool, stretch_s: float
) -> None:
    """Braked by 10 rad/s² over the time in which the pace was measured, and then over a fifth of a degree."""
    limit = 0.5 * 10.0 * stretch_s + np.sqrt(2.0 * 10.0 * LEAST_TURN)
    steps = np.full(300, 1.0 * dt)
    steps[130:150], steps[150:170] = np.array([share * limit, 0.1][:: 1 if before else -1]) * dt
    t, q, again = stopped(steps, 150, 8, dt=dt)
    np.testing.assert_array_equal(find_repeats(t, q).frozen, again & (share > 1.0))


@pytest.mark.parametrize(
    ("short_share", "into", "out", "frozen"),
    [(0.21, 1.5, 1.5, True), (0.19, 1.5, 1.5, False), (0.21, 1.5, 0.7, False), (0.21, 0.7, 1.5, False)],
)
def test_a_pose_is_frozen_between_two_steps_longer_than_the_shortest_fifth(
    short_share: float, into: float, out: float, frozen: bool
) -> None:
    """Steps of a milliradian or two, at a pace that any vehicle stops from."""
    steps = np.full(2000, 2e-3)
    steps[: round(2000 * short_share)] = 1e-3
    steps[1499], steps[1500] = 1e-3 * into, 1e-3 * out
    t, q, again = stopped(steps, 1500, 8)
    np.testing.assert_array_equal(find_repeats(t, q).frozen, again & frozen)


@pytest.mark.parametrize(("short_share", "frozen"), [(0.52, True), (0.48, False)])
def test_the_last_pose_is_frozen_after_a_step_longer_than_half_of_all(short_share: float, frozen: bool) -> None:
    """The first is not, which nothing came before."""
    steps = np.full(2000, 2e-3)
    steps[: round(2000 * short_share)] = 1e-3
    steps[-1] = 1.5e-3
    t, q, again = stopped(steps, 2000, 8)
    np.testing.assert_array_equal(find_repeats(t, q).frozen, again & frozen)
    steps[0] = 1.5e-3
    t, q, _ = stopped(steps, 0, 8)
    assert not find_repeats(t, q).frozen.any()


PERIOD = 16


@pytest.mark.parametrize(
    ("step", "periods", "in_each", "tilt", "made_up"),
    [
        (0.03, 10, 1, 1.03 * (5.0 * 0.03 + LEAST_TURN), True),
        (0.03, 10, 1, 0.97 * (5.0 * 0.03 + LEAST_TURN), False),
        (0.001, 10, 1, np.radians(5.1), True),
        (0.001, 10, 1, np.radians(4.9), False),
        (0.001, 9, 1, np.radians(30.0), False),
        (0.001, 2, 5, np.radians(30.0), True),
    ],
    ids=["five steps", "less", "five degrees", "less than five degrees", "nine rows", "two runs of five rows"],
)
def test_a_value_of_ten_rows_is_made_up_that_is_reached_by_a_jump(
    step: float, periods: int, in_each: int, tilt: float, made_up: bool
) -> None:
    """Back and forth about one axis; in some periods some rows are the same value, tilted by that much."""
    n = 12 * PERIOD
    phase = np.arange(n) % PERIOD
    rng = np.random.default_rng(1)
    q = about_z(0.3 + step * np.minimum(phase, PERIOD - phase))
    q = multiply(q, from_rotation_vector(1e-7 * rng.normal(size=(n, 3))))
    tilted = multiply(about_z(np.array([0.3 + 4.0 * step])), from_rotation_vector(np.array([[tilt, 0.0, 0.0]])))
    rows = (phase >= 4) & (phase < 4 + in_each) & (np.arange(n) < PERIOD * periods)
    q[rows] = tilted
    found = find_repeats(DT * np.arange(n), q)
    np.testing.assert_array_equal(found.default, rows & made_up)
    assert not found.frozen.any()


@pytest.mark.parametrize("rows", [10, 30])
def test_a_value_that_comes_once_is_not_made_up_unless_it_is_the_identity(rows: int) -> None:
    steps = np.full(200, 1.0 * DT)
    t, q, again = stopped(steps, 100, rows)
    first = int(np.flatnonzero(again)[0]) - 1
    for value, made_up in ((np.array([0.6, 0.0, 0.8, 0.0]), False), (np.array([0.0, 0.0, 0.0, -1.0]), True)):
        q[first : first + rows] = value
        found = find_repeats(t, q)
        np.testing.assert_array_equal(np.flatnonzero(found.default), np.arange(first, first + rows) if made_up else [])
    q = about_z(1.0 + 1.0 * t)
    q[:rows] = [0.0, 0.0, 0.0, 1.0]  # to begin with, and only left by a jump
    np.testing.assert_array_equal(np.flatnonzero(find_repeats(t, q).default), np.arange(rows))


def test_of_fewer_than_five_rows_nothing_is_said() -> None:
    for n, held in ((4, 1), (5, 5)):
        found = find_repeats(DT * np.arange(n), about_z(np.full(n, 0.3)))
        assert found.rows_a_pose == held
        np.testing.assert_array_equal(found.held, (np.arange(n) > 0) & (held > 1))
