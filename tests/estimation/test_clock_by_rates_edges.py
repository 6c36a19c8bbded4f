"""Clock and outliers at their limits: each threshold from both sides, each refusal by its own cause."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from fieldcal.config.parameters import Parameters
from fieldcal.errors import UnusableFlight
from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.statistics import least_squares_covariance
from fieldcal.geometry.rotation import from_rotation_vector, multiply, propagate
from fieldcal.simulation.experiment import Experiment, Motion

X = np.array([1.0, 0.0, 0.0])


def turned(angles: Sequence[float] | np.ndarray) -> np.ndarray:
    """Attitudes (n, 4) turned about x."""
    return from_rotation_vector(np.asarray(angles)[:, None] * X)


def masked(t: np.ndarray, angles: np.ndarray, **options: float) -> list[int]:
    return np.flatnonzero(~by_rates.mask_outliers(t, turned(angles), **options)).tolist()


def swinging(step: float, excursion: float, at: int = 20, n: int = 41) -> np.ndarray:
    """± step / 2 in turn, so that every attitude is `step` off its neighbours' line; one goes further."""
    angles = 0.5 * step * np.where(np.arange(n) % 2 == 0, 1.0, -1.0)
    angles[at] += excursion
    return angles


# masking -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("off", "gone"), [(1.9e-3, []), (2.1e-3, [20])])
def test_two_milliradians_off_a_quiet_line_are_an_outlier(off: float, gone: list[int]) -> None:
    assert masked(np.arange(41) * 0.01, swinging(0.0, off)) == gone


@pytest.mark.parametrize(("sigmas", "gone"), [(9.8, []), (10.2, [20])])
def test_ten_sigma_off_the_line_are_an_outlier(sigmas: float, gone: list[int]) -> None:
    step = 0.02
    sigma = 1.4826 * step  # of deviations that are all alike
    assert masked(np.arange(41) * 0.01, swinging(step, sigmas * sigma - step)) == gone


@pytest.mark.parametrize("rate", [20.0, 40.0])
@pytest.mark.parametrize(("share", "gone"), [(0.98, []), (1.03, [20])])
def test_there_and_back_faster_than_any_vehicle_is_an_outlier(rate: float, share: float, gone: list[int]) -> None:
    """Two milliradians are allowed on top; within ten sigma all the while."""
    interval, step = 1.0 / 350.0, 0.02
    excursion = share * (rate * interval + 2e-3) - step
    assert masked(np.arange(41) * interval, swinging(step, excursion), max_rate=rate) == gone
    if rate == 40.0:
        assert masked(np.arange(41) * interval, swinging(step, excursion)) == gone


@pytest.mark.parametrize(("share", "gone"), [(0.98, []), (1.02, [20])])
def test_stamps_that_crowd_count_as_a_tenth_of_a_millisecond(share: float, gone: list[int]) -> None:
    step = 0.002
    excursion = share * (40.0 * 1e-4 + 2e-3) - step
    assert masked(np.arange(41) * 2e-5, swinging(step, excursion)) == gone


def test_a_length_five_per_cent_off_is_no_attitude() -> None:
    t, q = np.arange(41) * 0.01, turned(np.zeros(41))
    for place, length in ((5, 1.048), (10, 1.052), (15, 0.952), (20, 0.948)):
        q[place] *= length
    assert np.flatnonzero(~by_rates.mask_outliers(t, q)).tolist() == [10, 20]


def test_a_jump_that_stays_is_no_outlier() -> None:
    """Faster than any vehicle, but not there and back; within ten sigma."""
    assert masked(np.arange(41) / 350.0, swinging(0.02, 0.0) + 0.15 * (np.arange(41) >= 20)) == []


def test_outliers_beside_the_ends_and_at_them() -> None:
    """Each alone is off; the ends' are told from their neighbours, whatever is wrong beyond those."""
    for places in ([1], [39], [0], [40], [0, 4], [36, 40], [0, 4, 36, 40]):
        angles = np.zeros(41)
        angles[places] = 0.1
        assert masked(np.arange(41) * 0.01, angles) == places


def test_of_outliers_in_a_row_the_worst_goes_in_each_of_three_rounds() -> None:
    angles = np.zeros(61)
    angles[20:24] = 0.1, 0.2, 0.4, 0.8
    gone = masked(np.arange(61) * 0.01, angles)
    assert {21, 22, 23} <= set(gone)
    assert 20 not in gone


def test_of_four_attitudes_none_is_judged_and_of_five_one_is() -> None:
    assert masked(np.arange(4) * 0.01, np.array([0.0, 0.0, 1.0, 0.0])) == []
    assert masked(np.arange(5) * 0.01, np.array([0.0, 0.0, 1.0, 0.0, 0.0])) == [2]


def test_the_line_between_neighbours_is_taken_at_the_stamp() -> None:
    """A steady turn with one stamp far from the middle of its neighbours is on the line; by index it is not."""
    t = np.arange(41) * 0.01
    t[20] += 0.006
    assert masked(t, 3.0 * t) == []
    assert masked(t, 3.0 * np.arange(41) * 0.01) == [20]


# grids ---------------------------------------------------------------------------------------------------------------


def vps_at(t: np.ndarray, **options: float) -> by_rates.UniformRates:
    return by_rates.vps_rates(t, turned(t), 0.01, **options)


def imu_at(t: np.ndarray, **options: float) -> by_rates.UniformRates:
    return by_rates.imu_rates(t, np.ones((len(t), 3)), 0.01, **options)


def test_gaps_of_a_twentieth_and_a_tenth_of_a_second_are_crossed_and_longer_ones_are_not() -> None:
    for rates, gap in ((vps_at, 0.05), (imu_at, 0.1)):
        for length, crossed in ((0.99 * gap, True), (1.02 * gap, False)):
            t = np.r_[np.arange(0.0, 1.0, 0.01), 0.99 + length + np.arange(0.0, 1.0, 0.01)]
            assert rates(t).valid.all() == crossed
        sixteenths = np.arange(17) / 16.0
        assert rates(sixteenths, max_gap_s=0.0625).valid.all()


def test_a_gap_spoils_the_four_places_on_either_side() -> None:
    """Nine samples are what the derivative is taken from. From 0.996 s to 1.504 s there is nothing."""
    t = np.arange(0.0, 2.5, 0.004)
    t = 5.0 + t[(t < 0.998) | (t > 1.502)]
    found = vps_at(t)
    assert np.flatnonzero(~found.valid).tolist() == list(range(96, 155))
    np.testing.assert_allclose(found.rate[found.valid], np.tile(X, (found.valid.sum(), 1)), atol=1e-4)
    assert len(found.t) == len(found.rate) == 249


def test_rates_between_stamps_are_linear_and_end_with_the_record() -> None:
    t = np.array([5.0, 5.03, 5.05, 5.1])
    found = by_rates.imu_rates(t, np.stack([t, 2.0 * t, -t], axis=1), 0.02)
    np.testing.assert_allclose(found.t, [5.0, 5.02, 5.04, 5.06, 5.08][: len(found.t)])
    assert len(found.t) in (4, 5)
    np.testing.assert_allclose(found.rate, np.stack([found.t, 2.0 * found.t, -found.t], axis=1))


def test_what_the_filter_mixes_with_a_gap_or_an_end_is_masked() -> None:
    """Half a period of 8 Hz on either side: sixteen samples of a 256th of a second."""
    valid = np.ones(200, dtype=bool)
    valid[100] = False
    found = by_rates._smoothed(by_rates.UniformRates(0.0, 1.0 / 256.0, np.ones((200, 3)), valid))
    expected = np.ones(200, dtype=bool)
    expected[[*range(16), *range(84, 117), *range(184, 200)]] = False
    np.testing.assert_array_equal(found.valid, expected)


def test_the_filters_reach_is_a_sample_at_least_of_slow_records() -> None:
    found = by_rates._smoothed(by_rates.UniformRates(0.0, 0.06, np.ones((9, 3)), np.ones(9, dtype=bool)))
    np.testing.assert_array_equal(found.valid, [False, *[True] * 7, False])


# correlation ---------------------------------------------------------------------------------------------------------


def uniform(norms: np.ndarray, start: float = 0.0) -> by_rates.UniformRates:
    return by_rates.UniformRates(start, 0.1, norms[:, None] * X, np.ones(len(norms), dtype=bool))


@pytest.mark.parametrize(
    ("n", "shift", "counts"), [(200, 148, True), (200, 152, False), (60, 29, True), (60, 31, False)]
)
def test_only_lags_with_enough_overlap_count(n: int, shift: int, counts: bool) -> None:
    """Fifty samples, 5 s, or half of the shorter record where that is less."""
    rng = np.random.default_rng(0)
    a = np.abs(rng.normal(size=n))
    b = np.r_[np.abs(rng.normal(size=shift)), a][:n]
    lag, peak, _, _ = by_rates.correlate(uniform(a), uniform(b), 60.0)
    assert (peak > 0.999 and lag == pytest.approx(-0.1 * shift, abs=0.05)) == counts


@pytest.mark.parametrize(("shared", "counts"), [(31, True), (29, False)])
def test_half_of_the_shorter_record_is_enough(shared: int, counts: bool) -> None:
    """Sixty samples of which so many are the first of two hundred."""
    rng = np.random.default_rng(1)
    a = np.abs(rng.normal(size=200))
    b = np.r_[np.abs(rng.normal(size=60 - shared)), a[:shared]]
    for imu, vps, lag_s in ((a, b, -0.1 * (60 - shared)), (b, a, 0.1 * (60 - shared))):
        lag, peak, _, _ = by_rates.correlate(uniform(imu), uniform(vps), 60.0)
        assert (peak > 0.999 and lag == pytest.approx(lag_s, abs=0.05)) == counts


def test_the_peaks_width_and_the_best_correlation_beside_it() -> None:
    """A triangle of 21 samples in a long quiet record correlates with itself over a known neighbourhood; a copy of half
    its height elsewhere is the runner-up."""
    a = np.zeros(600)
    a[100:121] = 10.0 - np.abs(np.arange(-10, 11))
    b, twice = a.copy(), a.copy()
    twice[400:421] += 0.5 * a[100:121]
    lag, peak, runner_up, width = by_rates.correlate(uniform(a), uniform(b, 3.0), 60.0)
    assert lag == pytest.approx(-3.0, abs=1e-9)
    assert peak == pytest.approx(1.0)

    def correlation(x: np.ndarray, y: np.ndarray, shift: int) -> float:
        u, v = (x[shift:], y[: len(y) - shift]) if shift >= 0 else (x[:shift], y[-shift:])
        return float(np.corrcoef(u, v)[0, 1])

    shifts = range(-40, 41)
    r = np.array([correlation(a, b, shift) for shift in shifts])
    above = np.flatnonzero(r >= 0.5)
    assert width == pytest.approx(0.1 * (above[-1] - above[0] + 2))
    assert runner_up == pytest.approx(r[above[0] - 1 : above[-1] + 2].min(), abs=0.2)
    _, peak, runner_up, _ = by_rates.correlate(uniform(twice), uniform(a), 60.0)
    # The smaller copy alone is a perfect match: means and norms are those of what overlaps.
    assert peak == pytest.approx(correlation(twice, a, 300), abs=1e-9)
    assert runner_up == pytest.approx(correlation(twice, a, 0), abs=1e-9)


def peak_written_out(a: np.ndarray, b: np.ndarray) -> tuple[float, float, float, float]:
    """Lag, peak, runner-up and width from correlations at every lag with half an overlap, one by one."""
    shifts = [s for s in range(1 - len(b), len(a)) if min(len(a), len(b) + s) - max(0, s) > min(len(a), len(b)) / 2]
    pairs = [(a[max(0, s) : len(b) + s], b[max(0, -s) : len(a) - s]) for s in shifts]
    r = [float(np.corrcoef(u, v)[0, 1]) if u.std() and v.std() else 0.0 for u, v in pairs]
    k = low = high = int(np.argmax(r))
    while r[low] >= 0.5 * r[k]:
        low -= 1
    while r[high] >= 0.5 * r[k]:
        high += 1
    return 0.1 * shifts[k], r[k], max(r[:low] + r[high + 1 :]), 0.1 * (high - low)


@pytest.mark.parametrize("backwards", [False, True])
def test_a_lopsided_peak_is_measured_on_either_side(backwards: bool) -> None:
    """A saw-tooth against one short turn correlates along the saw-tooth; nothing else moves, so the runner-up stands
    beside the peak."""
    a, b = np.zeros(100), np.zeros(98)
    a[40:60], b[50:53] = np.arange(20.0), 1.0
    if backwards:
        a, b = a[::-1], b[::-1]
    lag, peak, runner_up, width = by_rates.correlate(uniform(a), uniform(b), 60.0, min_overlap_s=1e9)
    expected = peak_written_out(a, b)
    assert lag == pytest.approx(expected[0], abs=0.05)
    assert 0.3 < expected[1] < 0.8  # half of it is not what one half over it is
    assert (peak, runner_up, width) == pytest.approx(expected[1:], abs=1e-9)


@pytest.mark.parametrize("scale", [1e-4, 1e4])
@pytest.mark.parametrize("of_imu", [False, True])
def test_units_of_either_record_do_not_change_the_correlation(scale: float, of_imu: bool) -> None:
    rng = np.random.default_rng(3)
    a = np.abs(rng.normal(size=300)).cumsum() % 7.0
    b = a[40:240] + 0.3 * rng.uniform(size=200)
    expected = by_rates.correlate(uniform(a), uniform(b), 60.0)
    scales = (scale, 1.0) if of_imu else (1.0, scale)
    found = by_rates.correlate(uniform(scales[0] * a), uniform(scales[1] * b), 60.0)
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("n", "start", "stop"), [(1000, 800, 1000), (1000, 0, 200), (300, 40, 290)])
def test_a_short_record_is_found_anywhere_in_a_long_one(n: int, start: int, stop: int) -> None:
    """Stamps of both agree, so the lag is 0, whichever is the longer."""
    a = np.abs(np.random.default_rng(4).normal(size=n))
    long, short = uniform(a), uniform(a[start:stop], 0.1 * start)
    for imu, vps in ((long, short), (short, long)):
        lag, peak, _, _ = by_rates.correlate(imu, vps, 5.0)
        assert lag == pytest.approx(0.0, abs=0.05)
        assert peak > 0.999


def test_the_largest_lag_belongs_to_the_search() -> None:
    """Eighths are exact: a lag of 2 s is found with a limit of 2 s and not below it."""
    a = np.abs(np.random.default_rng(5).normal(size=400))
    valid = np.ones(300, dtype=bool)
    imu, vps = (by_rates.UniformRates(0.0, 0.125, x[:, None] * X, valid) for x in (a[:300], a[16:316]))
    assert by_rates.correlate(imu, vps, 2.0)[:2] == pytest.approx((2.0, 1.0), abs=0.05)
    assert by_rates.correlate(imu, vps, 1.999)[1] < 0.5


@pytest.mark.parametrize(("n", "gap_s"), [(100, 0.0), (100, 500.0)])
def test_records_that_touch_or_lie_apart_have_no_peak(n: int, gap_s: float) -> None:
    """The only lag of the search has no overlap, or there is none at all."""
    a = np.abs(np.random.default_rng(6).normal(size=n))
    lag, peak, _, _ = by_rates.correlate(uniform(a), uniform(a, 0.1 * (n - 1) + gap_s), 0.04)
    assert peak <= 0.0
    assert np.isfinite(lag)
    assert gap_s or lag == pytest.approx(0.0, abs=1e-9)


def test_a_fractional_lag_is_the_top_of_the_parabola() -> None:
    t = np.arange(0.0, 60.0, 0.1)

    def pulse(at: float) -> np.ndarray:
        return np.exp(-0.5 * ((t - at) / 0.8) ** 2)

    for off in (-0.04, 0.013, 0.05):
        lag, _, _, _ = by_rates.correlate(uniform(pulse(30.0)), uniform(pulse(30.0 - off)), 20.0)
        assert lag == pytest.approx(off, abs=0.002)


# whole ---------------------------------------------------------------------------------------------------------------

IMU_S, VPS_S = 1.0 / 185.0, 1.0 / 350.0


def record(duration_s: float = 30.0, skew_ppm: float = 0.0) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(0)
    motion = Motion(Experiment(seed=0, duration_s=duration_s, sets=2), rng)
    t, t_vps = np.arange(0.0, duration_s, IMU_S), np.arange(0.0, duration_s, VPS_S)
    rate = motion.rate(t) + 0.005 * rng.normal(size=(len(t), 3))
    q = multiply(motion.attitude(t_vps), from_rotation_vector(3e-5 * rng.normal(size=(len(t_vps), 3))))
    return t, rate, t_vps * (1 + 1e-6 * skew_ppm), q


@pytest.mark.parametrize(("skew_ppm", "accepted"), [(1900.0, True), (2100.0, False), (-1900.0, True), (-2100.0, False)])
def test_clocks_that_drift_apart_by_more_than_two_milliseconds_a_second_have_other_rates(
    skew_ppm: float, accepted: bool
) -> None:
    if accepted:
        assert by_rates.synchronise(*record(skew_ppm=skew_ppm)).skew_ppm == pytest.approx(skew_ppm, abs=15.0)
        return
    with pytest.raises(UnusableFlight) as refused:
        by_rates.synchronise(*record(skew_ppm=skew_ppm))
    assert refused.value.reason_code == "clock_rates_differ"
    assert refused.value.measured["skew_ppm"] == pytest.approx(skew_ppm, abs=15.0)
    assert f"differ by 0.21 %, the VPS's is the {'fast' if skew_ppm > 0.0 else 'slow'} one" in refused.value.sentence


def test_the_least_peak_is_the_callers() -> None:
    t, rate, stamps, q = record()
    noisy = rate + 0.6 * np.random.default_rng(1).normal(size=rate.shape)
    peak = by_rates.synchronise(t, noisy, stamps, q, min_peak=0.0).peak
    assert 0.5 < peak < 0.99
    assert by_rates.synchronise(t, noisy, stamps, q, min_peak=peak).peak == peak
    with pytest.raises(UnusableFlight) as refused:
        by_rates.synchronise(t, noisy, stamps, q, min_peak=1.001 * peak)
    assert refused.value.reason_code == "flat_peak"


def code(*arrays: np.ndarray, **options: float) -> str:
    try:
        by_rates.synchronise(*arrays, **options)
    except UnusableFlight as refused:
        return str(refused.reason_code)
    return "synchronised"


def test_limits_that_nobody_gives_are_the_configurations() -> None:
    own = inspect.signature(by_rates.synchronise).parameters
    for name in ("max_lag_s", "min_peak", "max_gap_s"):
        assert own[name].default == Parameters.model_fields[f"vps_{name}"].default


def test_how_short_a_record_may_be() -> None:
    """Fifty samples of either, two seconds of the VPS."""
    t, rate, stamps, q = record(10.0)
    few = slice(0, None, 17)  # 0.0486 s apart
    for n, short in ((49, True), (50, False)):
        assert (code(t, rate, stamps[few][:n], q[few][:n]) == "vps_too_short") == short
        assert (code(t[:n], rate[:n], stamps, q) == "vps_too_short") == short
    for duration_s, short in ((1.9985, True), (2.0015, False)):  # 699 and 700 intervals
        part = stamps <= duration_s
        assert (code(t, rate, stamps[part], q[part]) == "vps_too_short") == short


def test_stamps_on_either_clock() -> None:
    """t_vps = (t_imu − ref)(1 + skew) + ref − lag, there and back; the lag at the first sample is on that line."""
    fit = by_rates.SyncFit(
        lag_mid_s=-0.4, skew_ppm=2e5, covariance=np.diag([4e-6, 9e-12]), peak=1.0, runner_up=0.0, peak_width_s=1.0,
        explained=1.0, matrix=np.eye(3), reference_s=15.0, first_s=10.0, turning=np.eye(3),
    )  # fmt: skip
    t = np.array([10.0, 15.0, 20.0])
    vps = (t - 15.0) * 1.2 + 15.0 + 0.4
    np.testing.assert_allclose(fit.to_imu_clock(vps), t)
    assert fit.lag_s == pytest.approx(t[0] - vps[0])
    assert fit.lag_sd_s == pytest.approx(2e-3)
    assert fit.skew_sd_ppm == pytest.approx(3.0)


@pytest.mark.parametrize(("rate_hz", "duration_s"), [(185.0, 12.0), (2000.0, 11.0), (2000.0, 12.0), (2000.0, 13.0)])
def test_the_grid_is_the_imus_but_no_finer_than_a_millisecond(rate_hz: float, duration_s: float) -> None:
    """Told by the width of the peak, a whole number of steps; what the fit is about, by the IMU's stamps."""
    t, rate, stamps, q = record(duration_s)
    own = 4.0 + np.arange(0.0, duration_s, 1.0 / rate_hz)
    fit = by_rates.synchronise(own, np.stack([np.interp(own - 4.0, t, c) for c in rate.T], axis=1), stamps, q)
    steps = fit.peak_width_s / max(1.0 / rate_hz, 1e-3)
    assert steps == pytest.approx(round(steps), abs=1e-6)
    assert steps > 10
    assert fit.first_s == own[0]
    assert fit.reference_s == pytest.approx(0.5 * (own[0] + own[-1]), rel=1e-12)
    assert fit.lag_s == pytest.approx(4.0, abs=2e-3)


# fit -----------------------------------------------------------------------------------------------------------------


def swaying(
    seed: int, noise: float, *, runaway: float = 0.0, spikes: float = 0.0, pace: float = 1.0
) -> tuple[by_rates.UniformRates, by_rates.UniformRates]:
    """Two sines about two axes, faster by `pace`, and a turn about the third that grows e-fold in 10 s; spikes in a
    hundredth of the gyroscope's readings. IMU and VPS sample together, so nothing is interpolated."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 40.0, 0.01)
    sway = np.stack([np.sin(2.0 * pace * t), np.cos(pace * (1.3 * t + 0.01 * t**2)), 0.0 * t], axis=1)
    rate = sway + runaway * np.exp(t / 10.0)[:, None] * np.array([0.0, 0.0, 1.0])
    noisy = rate + noise * rng.normal(size=rate.shape)
    noisy[rng.uniform(size=len(t)) < 0.01] += spikes
    every = np.ones(len(t), dtype=bool)
    return by_rates.UniformRates(0.0, 0.01, noisy, every), by_rates.UniformRates(0.0, 0.01, rate, every)


def refined(pair: tuple[by_rates.UniformRates, by_rates.UniformRates], lag: float = 0.0) -> by_rates.SyncFit:
    measured = {"peak": 1.0, "runner_up": 0.0, "peak_width_s": 0.1}
    return by_rates._refine(*pair, lag, 0.0, 20.0, measured)


@pytest.mark.parametrize("spikes", [0.0, 5.0])
def test_a_turn_that_grows_exponentially_says_nothing_of_the_lag(spikes: float) -> None:
    """Its derivative is itself, which M takes up: lag and skew are as uncertain as without it."""
    without, with_it = (refined(swaying(0, 0.1, runaway=r, spikes=spikes)) for r in (0.0, 0.2))
    assert with_it.lag_sd_s == pytest.approx(without.lag_sd_s, rel=0.1)


def test_spikes_of_the_gyroscope_move_neither_the_lag_nor_what_is_claimed_of_it() -> None:
    without, spiky = (refined(swaying(0, 0.1, spikes=s)) for s in (0.0, 3.0))
    assert spiky.lag_sd_s == pytest.approx(without.lag_sd_s, rel=0.5)
    assert abs(spiky.lag_mid_s) < 4.0 * without.lag_sd_s
    np.testing.assert_allclose(spiky.matrix[:, :2], np.eye(3)[:, :2], atol=0.02)


def test_the_fit_ends_at_the_same_clock_from_either_side() -> None:
    early, late = (refined(swaying(0, 0.1), lag) for lag in (-0.05, 0.08))
    assert early.lag_mid_s == pytest.approx(late.lag_mid_s, abs=1e-8)
    assert early.skew_ppm == pytest.approx(late.skew_ppm, abs=1e-3)


def test_what_the_vps_explains_is_the_share_of_the_variance() -> None:
    """A gyroscope with a bias: the variance is about its mean; sines have 1/2, white noise what it has."""
    imu, vps = swaying(0, 0.5)
    fit = refined((replace(imu, rate=imu.rate + 3.0), vps))
    signal = float(np.sum(np.var(vps.rate, axis=0)))
    assert fit.explained == pytest.approx(signal / (signal + 3 * 0.5**2), abs=0.02)


def test_the_refusal_says_what_was_found() -> None:
    """A gyroscope of which a third is the VPS's motion and two thirds another's."""
    t, rate, stamps, q = record(20.0)
    other = np.stack([np.sin(2.3 * t), np.sin(3.1 * t), np.cos(1.7 * t)], axis=1)
    with pytest.raises(UnusableFlight) as refused:
        by_rates.synchronise(t, rate + 1.5 * other, stamps, q, min_peak=0.0)
    found = refused.value.measured
    assert refused.value.reason_code == "not_the_same_motion"
    assert 0.1 < found["explained"] < 0.6
    assert f"explains {found['explained']:.0%} of".replace("%", " %") in refused.value.sentence
    assert f"known to {found['lag_sd_s'] * 1000.0:.2g} ms" in refused.value.sentence


def test_covariance_is_that_of_lag_and_skew_among_twelve_coefficients() -> None:
    """All 14 columns by finite differences and by definition; three seconds of the gyroscope are wrong."""
    imu, vps = swaying(0, 0.1)
    imu.rate[1000:1300] += 5.0 * np.sin(np.arange(300.0) / 7.0)[:, None]
    fit = refined((imu, vps))
    spline = CubicSpline(vps.t, vps.rate)

    def rates(lag: float, skew: float) -> np.ndarray:
        return spline((imu.t - 20.0) * (1 + skew) + 20.0 - lag)

    lag, skew = fit.lag_mid_s, 1e-6 * fit.skew_ppm
    x = np.column_stack([rates(lag, skew), np.ones(4000)])
    (affine, residual, _), weight = by_rates._regressed(x, imu.rate)
    columns = np.zeros((4000, 3, 14))
    for i, (dl, ds) in enumerate(((1e-4, 0.0), (0.0, 1e-5))):
        columns[:, :, i] = (rates(lag + dl, skew + ds) - rates(lag - dl, skew - ds)) @ affine[:3] / (2 * (dl + ds))
    for channel in range(3):
        columns[:, channel, 2 + 4 * channel : 6 + 4 * channel] = x
    root = np.sqrt(weight)[:, None]
    over = round(by_rates.STEADY_S / imu.interval_s)
    expected = least_squares_covariance(columns * root[:, :, None], residual * root, steady_over=over)[1][:2, :2]
    sd = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(fit.covariance / np.outer(sd, sd), expected / np.outer(sd, sd), atol=0.02)


def with_noise(level: float, pace: float) -> dict[str, float]:
    """What is measured of a sway and a gyroscope with so much noise; whether it was accepted."""
    imu, vps = swaying(0, level, pace=pace)
    q = propagate(vps.t, vps.rate, np.array([0.0, 0.0, 0.0, 1.0]))
    try:
        fit = by_rates.synchronise(imu.t, imu.rate, vps.t, q, min_peak=0.0)
    except UnusableFlight as refused:
        return {**refused.measured, "accepted": 0.0}
    return {"explained": fit.explained, "lag_sd_s": fit.lag_sd_s, "skew_ppm": fit.skew_ppm, "accepted": 1.0}


@pytest.mark.parametrize(("explained", "accepted"), [(0.62, True), (0.58, False)])
def test_sixty_per_cent_of_the_variance_are_enough(explained: float, accepted: bool) -> None:
    """Noise over signal is (1 - x)/x, and grows with the square of the level."""
    first = with_noise(1.0, 1.2)
    ratio = (1.0 / explained - 1.0) / (1.0 / first["explained"] - 1.0)
    found = with_noise(float(np.sqrt(ratio)), 1.2)
    assert found["explained"] == pytest.approx(explained, abs=0.015)
    assert found["lag_sd_s"] < 0.008
    assert bool(found["accepted"]) == accepted


@pytest.mark.parametrize(("lag_sd_s", "accepted"), [(0.0096, True), (0.0104, False)])
def test_a_lag_known_to_ten_milliseconds_is_known(lag_sd_s: float, accepted: bool) -> None:
    """The standard deviation grows with the level of the noise; of a slow sway much is explained."""
    found = with_noise(lag_sd_s / with_noise(1.0, 0.5)["lag_sd_s"], 0.5)
    assert found["lag_sd_s"] == pytest.approx(lag_sd_s, abs=0.0003)
    assert found["explained"] > 0.65
    assert abs(found["skew_ppm"]) < 1900.0
    assert bool(found["accepted"]) == accepted
