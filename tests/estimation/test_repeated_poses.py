"""Repeated poses: frozen, made up and held ones are found row by row; rest, rounding and healthy flights have none."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.clock_sync.repeated_poses import find_repeats
from fieldcal.geometry.rotation import from_rotation_vector, multiply
from fieldcal.simulation.experiment import Experiment, Motion

NOISE_RAD = 3e-5
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
Poses = tuple[np.ndarray, np.ndarray]


def flown(rate_hz: float = 120.0, *, seed: int = 0, noise: float = 1.0, duration_s: float = 40.0) -> Poses:
    """Stamps and attitudes of a flight that rests at both ends."""
    rng = np.random.default_rng(seed)
    motion = Motion(Experiment(seed=seed, duration_s=duration_s, tremor_rad=0.0, sets=3), rng)
    t = np.arange(0.0, duration_s, 1.0 / rate_hz)
    q = multiply(motion.attitude(t), from_rotation_vector(noise * NOISE_RAD * rng.normal(size=(len(t), 3))))
    return t, q


def spoilt(poses: Poses, rows: np.ndarray) -> Poses:
    """Every row of `rows` repeats the last that is not among them."""
    t, q = poses
    source = np.maximum.accumulate(np.where(rows, -1, np.arange(len(t))))
    return t, q[source]


def in_motion(t: np.ndarray, q: np.ndarray, length_s: float) -> list[float]:
    """When stretches of this length begin, 3 s apart, into and out of which the vehicle turns by 0.6 rad/s and more."""
    n = round(0.05 / (t[1] - t[0])) + 1
    speed = np.r_[np.zeros(n), 2 * np.arccos(np.clip(np.abs(np.sum(q[n:] * q[:-n], axis=1)), 0, 1)) / (t[n] - t[0])]
    starts: list[float] = []
    for start in t[(t > 5.0) & (t < 35.0)]:
        there = min(np.interp([start - 0.06, start, start + length_s + 0.1, start + length_s + 0.2], t, speed))
        if there > 0.6 and (not starts or start > starts[-1] + 3.0):
            starts.append(float(start))
    return starts


def stretches(t: np.ndarray, starts: list[float], length_s: float) -> np.ndarray:
    return np.any([(t > start) & (t < start + length_s) for start in starts], axis=0)


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 120.0, 350.0])
@pytest.mark.parametrize("decimals", [None, 4, 3])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_healthy_flight_has_none(rate_hz: float, decimals: int | None, noise: float) -> None:
    """Rest without any noise and rounded poses repeat themselves rightly."""
    t, q = flown(rate_hz, noise=noise)
    if decimals is not None:
        q = np.round(q, decimals)
    found = find_repeats(t, q)
    assert not found.frozen.any()
    assert not found.default.any()
    assert found.rows_a_pose == 1
    assert not found.held.any()


@pytest.mark.parametrize("rate_hz", [20.0, 120.0, 350.0])
def test_the_last_pose_repeated_in_motion_is_frozen(rate_hz: float) -> None:
    t, q = flown(rate_hz)
    starts = in_motion(t, q, 0.4)
    assert len(starts) >= 4
    rows = stretches(t, starts, 0.4)
    found = find_repeats(*spoilt((t, q), rows))
    np.testing.assert_array_equal(found.frozen, rows)
    assert not found.default.any()


def test_a_tracker_that_is_lost_for_good_is_frozen_to_the_end() -> None:
    poses = flown()
    rows = poses[0] > in_motion(poses[0], poses[1], 0.4)[3]
    np.testing.assert_array_equal(find_repeats(*spoilt(poses, rows)).frozen, rows)


@pytest.mark.parametrize("rate_hz", [20.0, 120.0])
@pytest.mark.parametrize("value", [IDENTITY, -IDENTITY, np.array([0.6, 0.0, 0.8, 0.0])])
def test_a_pose_made_up_again_and_again_is_none(rate_hz: float, value: np.ndarray) -> None:
    t, q = flown(rate_hz)
    turned = multiply(np.array([0.5, 0.5, 0.5, 0.5]), q)  # far from either value
    rows = stretches(t, [8.0, 14.0, 22.0], 0.4)
    made_up = np.where(rows[:, None], value, turned)
    found = find_repeats(t, made_up)
    np.testing.assert_array_equal(found.default, rows)
    assert not found.frozen.any()


def test_a_vehicle_that_rests_level_to_the_north_does_so() -> None:
    """Exact identity for two seconds, left at the pace of the flight."""
    t, q = flown(noise=0.0)
    resting = np.abs(q[0] - q).max(axis=1) == 0.0
    assert resting[:100].all()
    found = find_repeats(t, q)
    assert not (found.default | found.frozen).any()


@pytest.mark.parametrize("every", [2, 3])
def test_rows_that_hold_each_pose_are_counted(every: int) -> None:
    """Of a tracker slower than its log the first row of each pose is kept, of rest one in as many."""
    t, q = flown(360.0)
    rows = np.arange(len(t)) % every > 0
    found = find_repeats(*spoilt((t, q), rows))
    assert found.rows_a_pose == every
    np.testing.assert_array_equal(found.held, rows)
    assert not (found.frozen | found.default).any()


def test_what_is_no_number_is_not_judged() -> None:
    t, q = flown()
    q[100:140] = np.nan
    q[200] = 0.0
    found = find_repeats(t, q)
    assert not (found.frozen | found.default)[np.r_[0:99, 141:199, 202 : len(t)]].any()
    for n in range(6):
        assert len(find_repeats(t[:n], q[:n]).frozen) == n
