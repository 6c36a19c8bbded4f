"""Where knots are: at epochs that readings surround at every lag, evenly between epochs that are further apart."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.by_velocity.problem import Epochs, place_knots
from fieldcal.estimation.joint.problem import Readings


def readings(t: np.ndarray, segment: np.ndarray) -> Readings:
    nothing = np.zeros((len(t), 3))
    return Readings(t, segment, nothing, nothing, None, -9.81, np.zeros(3), np.zeros((2, len(t), 3)))


def epochs(t: list[float]) -> Epochs:
    return Epochs(np.array(t), np.zeros((len(t), 3)), np.ones(len(t)))


T = np.arange(1025) / 64.0  # 16 s; times here are exact in binary
ONE = np.zeros(len(T), dtype=np.int64)
FIRST_S, LAST_S = 0.6, 16.0 - 0.2
"""A lag may be from −0.2 to 0.6 s: that long after the first reading an epoch may be of before it."""


def test_epochs_count_that_readings_surround_at_every_lag() -> None:
    times = [FIRST_S - 0.01, FIRST_S, 1.0, LAST_S - 0.2, LAST_S, LAST_S + 0.01]
    found = place_knots(readings(T, ONE), epochs(times))
    np.testing.assert_array_equal(found.epoch[found.epoch >= 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(found.offset[found.epoch >= 0], times[1:5])


@pytest.mark.parametrize(("apart_s", "taken"), [(0.07, [0, 2, 4]), (0.078125, [0, 2, 4]), (0.085, [0, 1, 2, 3, 4])])
def test_epochs_that_follow_too_closely_are_thinned(apart_s: float, taken: list[int]) -> None:
    found = place_knots(readings(T, ONE), epochs([2.0 + apart_s * k for k in range(5)]))
    np.testing.assert_array_equal(found.epoch, taken)
    assert found.joined.all()


@pytest.mark.parametrize(
    ("apart_s", "parts"), [(0.125, 1), (0.25, 1), (0.375, 2), (0.5, 2), (0.75, 3), (5.0, 20)], ids=str
)
def test_between_epochs_further_apart_there_are_knots_evenly(apart_s: float, parts: int) -> None:
    found = place_knots(readings(T, ONE), epochs([2.0, 2.0 + apart_s, 2.0 + 2.0 * apart_s]))
    np.testing.assert_allclose(found.offset, 2.0 + apart_s * np.arange(2 * parts + 1) / parts)
    expected = np.full(2 * parts + 1, -1)
    expected[::parts] = [0, 1, 2]
    np.testing.assert_array_equal(found.epoch, expected)
    assert found.joined.all()
    np.testing.assert_allclose(found.interval_s, apart_s / parts)


def test_over_more_than_five_seconds_nothing_leads() -> None:
    found = place_knots(readings(T, ONE), epochs([2.0, 2.25, 7.375, 7.625]))
    np.testing.assert_array_equal(found.offset, [2.0, 2.25, 7.375, 7.625])
    np.testing.assert_array_equal(found.epoch, [0, 1, 2, 3])
    np.testing.assert_array_equal(found.joined, [True, False, True])
    np.testing.assert_array_equal(found.interval_s, [0.25, 1.0, 0.25])


def test_from_one_stretch_of_readings_to_the_next_nothing_leads() -> None:
    segment = np.where(T < 8.0, 0, 1)
    times = [6.0, 6.25, 7.5, 7.9, 8.25, 8.75, 9.0]  # the first stretch ends at 8 less a sample
    found = place_knots(readings(T, segment), epochs(times))
    own = found.epoch >= 0
    np.testing.assert_array_equal(found.epoch[own], [0, 1, 2, 5, 6])
    at = int(np.flatnonzero(found.epoch == 5)[0])
    assert not found.joined[at - 1]
    assert found.joined.sum() == len(found.joined) - 1
