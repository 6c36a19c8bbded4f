"""Selection with rates that are known exactly: each share, pad and least length from both sides."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from fieldcal.config.parameters import Parameters
from fieldcal.estimation import motion_selection
from fieldcal.estimation.motion_selection import contiguous, select, turned_within, windowed_rate

STEP_S = 0.01
STAMPS = np.arange(0.0, 800.0, STEP_S)


def turning(*pieces: tuple[float, float, float]) -> np.ndarray:
    """Rates (n, 3) about x of so much from one time to another, s; none elsewhere."""
    rate = np.zeros((len(STAMPS), 3))
    for begin, end, size in pieces:
        rate[(begin - 1e-9 <= STAMPS) & (end - 1e-9 > STAMPS), 0] = size
    return rate


def used(found: motion_selection.Selection) -> list[tuple[float, float]]:
    return [(float(STAMPS[s.start]), float(STAMPS[s.stop - 1])) for s in found.segments if s.used]


def test_running_means_are_centred_and_shorter_at_the_ends() -> None:
    x = np.random.default_rng(0).normal(size=(30, 2))
    for width in (1, 2, 5, 6):
        expected = [x[max(0, i - width // 2) : i + (width + 1) // 2].mean(axis=0) for i in range(30)]
        np.testing.assert_allclose(motion_selection._running_mean(x, width), expected, atol=1e-12)


def test_windowed_rate_is_the_rms_of_short_means() -> None:
    rng = np.random.default_rng(1)
    t, rate = np.arange(300) * 0.02, rng.normal(size=(300, 3)) + np.array([3.0, -2.0, 8.0])
    level, noise = windowed_rate(t, rate, 0.5)
    centred = rate - np.median(rate, axis=0)
    short = np.array([centred[max(0, i - 2) : i + 3].mean(axis=0) for i in range(300)])
    expected = [np.sqrt(np.mean(np.sum(short[max(0, i - 12) : i + 13] ** 2, axis=1))) for i in range(300)]
    np.testing.assert_allclose(level, expected, rtol=1e-9)
    step = np.diff(rate, axis=0)
    sigma = 1.4826 * np.median(np.abs(step - np.median(step, axis=0)), axis=0) / np.sqrt(2.0)
    assert noise == pytest.approx(np.sqrt(np.sum(sigma**2) / 5))
    assert windowed_rate(t, rate, 0.5, smooth_s=0.02)[1] == pytest.approx(np.sqrt(np.sum(sigma**2)))
    assert windowed_rate(t, rate, 0.5, smooth_s=0.0)[1] == pytest.approx(np.sqrt(np.sum(sigma**2)))
    alone, _ = windowed_rate(t, rate, 0.01, smooth_s=0.01)
    np.testing.assert_allclose(alone, np.linalg.norm(centred, axis=1), rtol=1e-9)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_turn_is_measured_across_the_halves_of_a_window(way: float) -> None:
    """.1 rad/s from 3 to 13 s: .2, .5 and .3 rad in halves of 5 s; .8 within the 10 s from the second half on."""
    rate = turning((3.0, 13.0, 0.1 * way))
    np.testing.assert_allclose(turned_within(STAMPS, rate), [0.8, 0.0, 0.0], atol=2e-3)
    there_and_back = turning((3.0, 8.0, 0.1 * way), (8.0, 13.0, -0.1 * way))
    np.testing.assert_allclose(turned_within(STAMPS, there_and_back), [0.5, 0.0, 0.0], atol=2e-3)


def test_pads_of_five_seconds_and_rest_of_a_minute() -> None:
    """A window is excited as soon as 0.15² of it turn: 0.045 s of its two seconds."""
    swaying = turning((200.0, 300.0, 0.05), (300.0, 330.0, 1.0), (330.0, 430.0, -0.05))
    ((begin, end),) = used(select(STAMPS, swaying))
    assert begin == pytest.approx(300.0 - 1.0 + 0.045 - 5.0, abs=0.1)
    assert end == pytest.approx(330.0 + 1.0 - 0.045 + 5.0, abs=0.1)
    ((begin, end),) = used(select(STAMPS, turning((300.0, 330.0, 1.0))))
    assert begin == pytest.approx(300.0 - 1.0 + 0.045 - 60.0, abs=0.1)
    assert end == pytest.approx(330.0 + 1.0 - 0.045 + 60.0, abs=0.1)
    ((begin, end),) = used(select(STAMPS, turning((300.0, 330.0, 1.0)), pad_s=2.0, rest_s=0.0))
    assert begin == pytest.approx(300.0 - 1.0 + 0.045 - 2.0, abs=0.1)


@pytest.mark.parametrize(("share", "excited"), [(0.147, False), (0.153, True)])
def test_what_turns_faster_than_fifteen_per_cent_of_the_sustained_level_is_excited(share: float, excited: bool) -> None:
    found = select(STAMPS, turning((100.0, 130.0, 1.0), (500.0, 530.0, share)))
    assert found.level == pytest.approx(1.0)
    assert found.threshold == pytest.approx(0.15)
    assert found.excited_s == pytest.approx(32.0 + (28.0 if excited else 0.0), abs=2.2)
    assert len(used(found)) == (2 if excited else 1)


def test_the_level_is_sustained_for_ten_seconds() -> None:
    assert select(STAMPS, turning((100.0, 112.4, 2.0), (300.0, 330.0, 1.0))).level == pytest.approx(2.0)
    assert select(STAMPS, turning((100.0, 111.6, 2.0), (300.0, 330.0, 1.0))).level < 1.999
    assert select(STAMPS, turning((100.0, 103.0, 2.0)), min_s=0.5).level == pytest.approx(2.0)


@pytest.mark.parametrize(("share", "rests"), [(0.0195, True), (0.0205, False)])
def test_slower_than_a_fiftieth_of_the_level_is_rest(share: float, rests: bool) -> None:
    found = select(STAMPS, turning((0.0, 100.0, share), (100.0, 130.0, 1.0), (130.0, 300.0, -share)), rest_s=20.0)
    ((begin, end),) = used(found)
    assert begin == pytest.approx(100.0 - 0.955 - (20.0 if rests else 5.0), abs=0.2)
    assert end == pytest.approx(130.0 + 0.955 + (20.0 if rests else 5.0), abs=0.2)


def test_noise_alone_is_four_times_short_of_excited() -> None:
    found = select(STAMPS, 0.1 * np.random.default_rng(2).normal(size=(len(STAMPS), 3)))
    assert found.threshold == pytest.approx(4.0 * found.noise)
    assert found.noise == pytest.approx(0.1 * np.sqrt(3 / 10), rel=0.02)


@pytest.mark.parametrize(("n", "kept"), [(9, False), (10, True)])
def test_ten_samples_make_a_stretch(n: int, kept: bool) -> None:
    t = np.r_[np.arange(1000) * STEP_S, 20.0 + np.arange(n) * STEP_S, 30.0 + np.arange(1000) * STEP_S]
    without = select(t, None)
    assert [s.used for s in without.segments] == [True, kept, True]
    assert without.segments[1].reason == ("no gyroscope: all of it" if kept else "too short")
    rate = np.tile([1.0, 0.0, 0.0], (len(t), 1)) * np.where(np.arange(len(t)) % 200 < 100, 1.0, -1.0)[:, None]
    found = [s for s in select(t, rate).segments if s.start == 1000]
    assert (found[0].reason != "shorter than ten samples") == kept
    assert np.isnan(found[0].rate_rms) != kept


def test_a_used_piece_of_a_stretch_has_ten_samples_too() -> None:
    level = np.arange(40.0)
    mark = np.zeros(40, dtype=bool)
    mark[5:15], mark[20:29] = True, True
    found = motion_selection._cut(np.r_[np.zeros(100), level], mark, 100, 140, 0.25)
    assert [(s.start, s.stop, s.used) for s in found] == [
        (100, 105, False), (105, 115, True), (115, 120, False), (120, 129, False), (129, 140, False)
    ]  # fmt: skip
    assert [s.reason for s in found] == [
        "quiet: rotation below 0.25", "rotating, or at rest beside it", "quiet: rotation below 0.25",
        "shorter than ten samples", "quiet: rotation below 0.25",
    ]  # fmt: skip
    assert found[1].rate_rms == pytest.approx(np.sqrt(np.mean(level[5:15] ** 2)))


def test_nearness_includes_its_distance() -> None:
    t = np.arange(10.0)
    mark = np.zeros(10, dtype=bool)
    mark[4] = True
    assert np.flatnonzero(motion_selection._near(t, mark, 2.0)).tolist() == [2, 3, 4, 5, 6]
    assert np.flatnonzero(motion_selection._near(t, mark, 0.0)).tolist() == [4]
    mark[[0, 9]] = True
    assert np.flatnonzero(motion_selection._near(t, mark, 1.5)).tolist() == [0, 1, 3, 4, 5, 8, 9]


def test_stamps_that_stand_split_like_a_backward_step() -> None:
    assert contiguous([0.0, 1.0, 1.0, 2.0], 1.0) == [(0, 2), (2, 4)]
    assert contiguous([0.0, 1.0, 2.5], 1.0) == [(0, 2), (2, 3)]
    assert select(np.r_[0.0:0.5:0.01, 0.585:1.0:0.01], None).segments[0].stop > 60
    assert len(select(np.r_[0.0:0.5:0.01, 0.595:1.0:0.01], None).segments) == 2


def test_limits_that_nobody_gives_are_the_configurations() -> None:
    own = inspect.signature(select).parameters
    for name in ("window_s", "pad_s", "rest_s", "min_s", "max_gap_s", "excited_ratio"):
        assert own[name].default == Parameters.model_fields[f"manoeuvre_{name}"].default
