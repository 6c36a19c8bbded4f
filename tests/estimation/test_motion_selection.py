"""Which stretches of a log are used: minutes of quiet around a manoeuvre, rest, gaps, and logs without motion."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numerics_support import autoregressive

from fieldcal.estimation.motion_selection import Segment, Selection, contiguous, select, turned_within, windowed_rate
from fieldcal.simulation.experiment import Experiment, Motion

RATE_HZ = 100.0
NOISE_RADPS = 0.135
BEGINS_S, LASTS_S, LOG_S = 300.0, 40.0, 640.0
PAD_S, REST_S, WINDOW_S = 5.0, 60.0, 2.0


@pytest.fixture(scope="module")
def t() -> np.ndarray:
    return np.arange(0.0, LOG_S, 1.0 / RATE_HZ)


def turning(seed: int = 0) -> tuple[float, float]:
    """When the first doublet begins and the last one ends, s."""
    motion = Motion(Experiment(seed=seed), np.random.default_rng(seed))
    return BEGINS_S + float(motion.starts[0]), BEGINS_S + float(motion.starts[-1] + motion.lengths[-1])


def log(t: np.ndarray, *, turns: float = 0.0, noise: float = NOISE_RADPS, seed: int = 0) -> np.ndarray:
    """Gyroscope counts: one 40 s manoeuvre in the middle of quiet flight that sways by `turns` rad/s rms."""
    rng = np.random.default_rng(seed)
    motion = Motion(Experiment(seed=seed), rng)
    inside = (t >= BEGINS_S) & (t < BEGINS_S + LASTS_S)
    rate = np.zeros((len(t), 3))
    rate[inside] = motion.rate(t[inside] - BEGINS_S)
    rate += turns * autoregressive(rng, rate.shape, np.exp(-1.0 / RATE_HZ / 0.5))
    return (rate + noise * rng.normal(size=rate.shape)) / 3e-4 + [31600.0, 33000.0, 30900.0]


def used_time(found: Selection, t: np.ndarray) -> tuple[float, float, float]:
    """First and last used stamp, and used seconds."""
    used = [s for s in found.segments if s.used]
    return t[used[0].start], t[used[-1].stop - 1], float(sum(t[s.stop - 1] - t[s.start] for s in used))


def covers_once(segments: list[Segment], n: int) -> None:
    assert segments[0].start == 0
    assert segments[-1].stop == n
    assert all(a.stop == b.start for a, b in pairwise(segments))


@pytest.mark.parametrize("turns", [0.0, 0.03])
def test_one_manoeuvre_in_ten_minutes_of_quiet_flight(t: np.ndarray, turns: float) -> None:
    found = select(t, log(t, turns=turns), pad_s=PAD_S, rest_s=0.0)
    first, last, seconds = used_time(found, t)
    covers_once(found.segments, len(t))
    begin, end = turning()
    assert first == pytest.approx(begin - PAD_S, abs=WINDOW_S)
    assert last == pytest.approx(end + PAD_S, abs=WINDOW_S)
    assert seconds == pytest.approx(last - first, abs=0.1)
    assert found.excited_s == pytest.approx(end - begin, abs=2 * WINDOW_S)
    assert {s.reason for s in found.segments if s.used} == {"rotating, or at rest beside it"}
    assert all("quiet" in s.reason for s in found.segments if not s.used)


def test_rest_beside_the_manoeuvre_is_kept(t: np.ndarray) -> None:
    """With a gyroscope quiet enough to tell rest from slow turning; noisier ones gain nothing from integrating it."""
    begin, end = turning()
    first, last, _ = used_time(select(t, log(t, noise=0.005), pad_s=PAD_S, rest_s=REST_S), t)
    assert first == pytest.approx(begin - REST_S, abs=WINDOW_S)
    assert last == pytest.approx(end + REST_S, abs=WINDOW_S)
    noisy_first, noisy_last, _ = used_time(select(t, log(t), pad_s=PAD_S, rest_s=REST_S), t)
    assert noisy_first == pytest.approx(begin - PAD_S, abs=WINDOW_S)
    assert noisy_last == pytest.approx(end + PAD_S, abs=WINDOW_S)


def test_scale_zero_time_origin_and_order_of_axes_do_not_matter(t: np.ndarray) -> None:
    rate = log(t)
    found = select(t, rate)
    for other in (select(t + 1e6, rate), select(t, -0.01 * rate[:, ::-1] + 7.0)):
        assert [(s.start, s.stop, s.used) for s in other.segments] == [
            (s.start, s.stop, s.used) for s in found.segments
        ]
        assert other.excited_s == pytest.approx(found.excited_s, rel=1e-3)


def test_at_rest_nothing_is_excited(t: np.ndarray) -> None:
    rest = NOISE_RADPS * np.random.default_rng(1).normal(size=(len(t), 3))
    found = select(t, rest)
    assert found.excited_s == 0.0
    assert not any(s.used for s in found.segments)
    assert found.threshold > 0.0


def test_stuck_gyroscope_is_not_excited(t: np.ndarray) -> None:
    found = select(t, np.full((len(t), 3), 32768.0))
    assert found.excited_s == 0.0
    assert not any(s.used for s in found.segments)


def test_gaps_split_and_are_never_inside_a_segment(t: np.ndarray) -> None:
    keep = ~(((t > 310) & (t < 310.5)) | ((t > 320) & (t < 323)))
    keep &= np.random.default_rng(2).uniform(size=len(t)) > 0.02  # single losses do not split
    own = t[keep]
    found = select(own, log(t)[keep])
    assert [s.start for s in found.segments if s.used][1:] == [
        int(np.searchsorted(own, 310.25)),
        int(np.searchsorted(own, 321.0)),
    ]
    for s in found.segments:
        assert np.diff(own[s.start : s.stop]).max(initial=0.0) <= 0.1


def test_a_backward_step_splits() -> None:
    assert contiguous([0.0, 0.01, 0.02, 0.01, 0.02, 0.03], 0.1) == [(0, 3), (3, 6)]


def test_fragments_are_left_out_with_their_reason(t: np.ndarray) -> None:
    own = np.r_[t[:29995], t[29995:30000] + 0.5, t[30000:] + 1.0]
    found = select(own, log(t))
    assert [s.reason for s in found.segments if s.stop - s.start == 5] == ["shorter than ten samples"]


def test_without_a_gyroscope_everything_contiguous_is_used(t: np.ndarray) -> None:
    found = select(np.r_[t, t + 700.0], None)
    assert [(s.start, s.stop, s.used) for s in found.segments] == [(0, len(t), True), (len(t), 2 * len(t), True)]
    assert found.excited_s == pytest.approx(2 * (t[-1] - t[0]))


def test_windowed_rate_is_the_moving_rms() -> None:
    t = np.arange(0.0, 40.0, 0.01)
    rate = np.zeros((len(t), 3))
    rate[3000:] = [0.3, -0.4, 0.0]
    level, noise = windowed_rate(t, rate + np.array([5.0, 6.0, 7.0]), 2.0)
    assert level[3500] == pytest.approx(0.5, rel=1e-9)
    assert level[1000] == pytest.approx(0.0, abs=1e-6)
    assert noise == 0.0
    _, claimed = windowed_rate(t, 0.1 * np.random.default_rng(3).normal(size=rate.shape), 2.0, smooth_s=0.1)
    assert claimed == pytest.approx(0.1 * np.sqrt(3 / 10), rel=0.05)


@pytest.mark.parametrize("lasts_s", [4.0, 8.0])
def test_a_hard_turn_shorter_than_what_is_needed_is_not_eked_out_with_rest(t: np.ndarray, lasts_s: float) -> None:
    """Beside it the sensor drifts a little above its own noise, which is no motion."""
    rng = np.random.default_rng(0)
    rate = 0.001 * autoregressive(rng, (len(t), 3), np.exp(-1.0 / RATE_HZ / 0.5)) + 1e-4 * rng.normal(size=(len(t), 3))
    rate[(t >= BEGINS_S) & (t < BEGINS_S + lasts_s)] += [6.0, -4.0, 2.0]
    found = select(t, rate, window_s=WINDOW_S, pad_s=PAD_S, rest_s=REST_S)
    assert lasts_s - WINDOW_S < found.excited_s < lasts_s + WINDOW_S
    first, last, _ = used_time(found, t)
    assert BEGINS_S - REST_S - WINDOW_S < first < last < BEGINS_S + lasts_s + REST_S + WINDOW_S


@pytest.mark.parametrize("zero_radps", [0.0, 0.3])
def test_how_far_a_vehicle_was_turned_is_the_range_of_the_angle(zero_radps: float) -> None:
    """Sines of known amplitude in a log of which most is rest, across the border of two windows; a pause hides none."""
    t = np.arange(0.0, 60.0, 0.01)
    t[3000:] += 40.0
    phase = np.clip(t - 13.0, 0.0, 4.0) * 2.0 * np.pi / 4.0
    turns = (phase > 0.0) & (phase < 2.0 * np.pi)
    rate = np.zeros((len(t), 3)) + zero_radps
    amplitude = np.deg2rad([10.0, 45.0, 170.0])
    rate[turns] += amplitude / 2.0 * np.sin(phase[turns])[:, None] * 2.0 * np.pi / 4.0
    found = turned_within(t, rate)
    np.testing.assert_allclose(found, amplitude, rtol=2e-3)
    assert np.all(turned_within(t, np.zeros_like(rate)) == 0.0)
    assert turned_within(t[:1], rate[:1]).shape == (3,)
