"""Clock offset, drift and frames between VPS and IMU: known fractional delays, spoiled data, refusals, honest sd."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import angle, constants, logged, random_attitudes, rms
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.gyroscope.output_error import propagate_stretches
from fieldcal.geometry.rotation import from_euler, from_rotation_vector, multiply, normalise
from fieldcal.simulation.experiment import Experiment, Motion

IMU_INTERVAL_S, VPS_INTERVAL_S = 1.0 / 185.0, 1.0 / 350.0
DURATION_S = 30.0
TENTH_MS, PPM = 1e-4, 1e-6
GOOD_GYRO_RADPS, PAPER_GYRO_RADPS = 0.005, 0.135
VPS_NOISE_RAD = 3e-5
MILLIDEGREE_RAD = float(np.radians(1e-3))
HONEST = (0.8, 1.4)

Record = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def record(
    seed: int = 0,
    *,
    offset_s: float = 0.37,
    skew_ppm: float = 20.0,
    gyro_noise: float = GOOD_GYRO_RADPS,
    vps_noise: float = VPS_NOISE_RAD,
    vps_from: float = 0.0,
) -> Record:
    """IMU stamps and rates, VPS stamps (own clock: t (1 + skew) + offset) and attitudes of one simulated motion."""
    rng = np.random.default_rng(seed)
    motion = Motion(Experiment(seed=seed, duration_s=DURATION_S, sets=2), rng)
    t, t_vps = np.arange(0.0, DURATION_S, IMU_INTERVAL_S), np.arange(vps_from, DURATION_S, VPS_INTERVAL_S)
    rate = motion.rate(t) + gyro_noise * rng.normal(size=(len(t), 3))
    q = multiply(motion.attitude(t_vps), from_rotation_vector(vps_noise * rng.normal(size=(len(t_vps), 3))))
    return t, rate, t_vps * (1 + skew_ppm * PPM) + offset_s, q


@pytest.fixture(scope="module")
def clean() -> Record:
    return record()


def lag_error(fit: by_rates.SyncFit, offset_s: float = 0.37) -> float:
    """VPS clock + lag = IMU clock at IMU time 0, so the truth is −offset."""
    return fit.lag_s + offset_s


# exact ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset_s", [0.0, 0.0001, 0.0013, 0.37, -0.37123, -7.5, 20.0049])
def test_fractional_delays(offset_s: float) -> None:
    fit = by_rates.synchronise(*record(offset_s=offset_s))
    assert abs(lag_error(fit, offset_s)) < TENTH_MS
    assert fit.peak > 0.99
    assert 0.0 < fit.runner_up < fit.peak


@pytest.mark.parametrize("skew_ppm", [0.0, -50.0, 150.0])
def test_drift(skew_ppm: float) -> None:
    """To 10 ppm, a tenth of a millisecond over ten seconds; stamps come back onto the IMU's clock."""
    t, rate, stamps, q = record(skew_ppm=skew_ppm)
    fit = by_rates.synchronise(t, rate, stamps, q)
    assert abs(fit.skew_ppm - skew_ppm) < 10.0
    assert abs(lag_error(fit)) < TENTH_MS
    middle = DURATION_S / 2
    assert abs(fit.lag_mid_s + 0.37 + skew_ppm * PPM * middle) < TENTH_MS
    true = np.arange(0.0, DURATION_S, VPS_INTERVAL_S)
    assert np.abs(fit.to_imu_clock(stamps) - true).max() < 2 * TENTH_MS


def test_noise_free_floor() -> None:
    """Left over: interpolation of both sides to the IMU's rate."""
    fit = by_rates.synchronise(*record(gyro_noise=0.0, vps_noise=0.0))
    assert abs(lag_error(fit)) < 0.2 * TENTH_MS
    assert abs(fit.skew_ppm - 20.0) < 2.0


def test_vps_that_covers_less_than_the_imu(clean: Record) -> None:
    t, rate, stamps, q = clean
    part = slice(2500, 8500)
    assert abs(lag_error(by_rates.synchronise(t, rate, stamps[part], q[part]))) < 2 * TENTH_MS


# spoiled data --------------------------------------------------------------------------------------------------------


def with_outliers(q: np.ndarray, share: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    wrong = rng.uniform(size=len(q)) < share
    spoiled = q.copy()
    spoiled[wrong] = multiply(q[wrong], from_rotation_vector(0.5 * rng.normal(size=(int(wrong.sum()), 3))))
    return spoiled, wrong


def kept_samples(stamps: np.ndarray, seed: int) -> np.ndarray:
    """Which samples are left of a VPS record that misses a tenth, in pieces of 0.3 s."""
    keep = np.ones(len(stamps), dtype=bool)
    for start in np.random.default_rng(seed).uniform(0.4, DURATION_S, 10):
        keep[(stamps > start) & (stamps < start + 0.3)] = False
    return keep


@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_dropouts_are_masked(clean: Record, seed: int) -> None:
    t, rate, stamps, q = clean
    keep = kept_samples(stamps, seed)
    fit = by_rates.synchronise(t, rate, stamps[keep], q[keep])
    assert keep.mean() < 0.95
    assert abs(lag_error(fit)) < TENTH_MS


def test_no_rate_is_called_valid_inside_a_gap(clean: Record) -> None:
    _, _, stamps, q = clean
    keep = kept_samples(stamps, 2)
    rates = by_rates.vps_rates(stamps[keep], q[keep], IMU_INTERVAL_S)
    for start, stop in zip(stamps[:-1][~keep[1:] & keep[:-1]], stamps[1:][keep[1:] & ~keep[:-1]], strict=True):
        assert not rates.valid[(rates.t > start) & (rates.t < stop)].any()


def test_outliers_are_masked_before_they_move_the_lag(clean: Record) -> None:
    t, rate, stamps, q = clean
    spoiled, wrong = with_outliers(q, 0.01)
    keep = by_rates.mask_outliers(stamps, spoiled)
    assert not (keep & wrong).any()
    assert (~keep & ~wrong).sum() <= 0.001 * len(q)
    masked = by_rates.synchronise(t, rate, stamps[keep], spoiled[keep])
    assert abs(lag_error(masked)) < TENTH_MS
    assert by_rates.synchronise(t, rate, stamps, spoiled).lag_sd_s > 5 * masked.lag_sd_s


def test_nothing_is_masked_in_a_healthy_record(clean: Record) -> None:
    _, _, stamps, q = clean
    signs = np.random.default_rng(3).choice([-1.0, 1.0], (len(q), 1))
    assert by_rates.mask_outliers(stamps, signs * q).all()


def test_impossible_poses_are_masked(clean: Record) -> None:
    _, _, stamps, q = clean
    spoiled, t = q.copy(), stamps.copy()
    spoiled[100], spoiled[200], spoiled[300] = np.nan, 0.0, 2.0 * q[300]
    t[400] = t[399]
    np.testing.assert_array_equal(np.flatnonzero(~by_rates.mask_outliers(t, spoiled)), [100, 200, 300, 400])


# frames, units -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_misaligned_frames_do_not_matter(clean: Record, seed: int) -> None:
    t, rate, stamps, q = clean
    world, body = random_attitudes(np.random.default_rng(seed), 2)
    turned = by_rates.synchronise(t, rate, stamps, multiply(multiply(world, q), body))
    assert abs(lag_error(turned)) < TENTH_MS
    expected = Rotation.from_quat(body).as_matrix()  # rates in the VPS's body are R_bodyᵀ ω: M turns them back
    np.testing.assert_allclose(turned.matrix, expected, atol=0.01)


def test_raw_counts_do_not_matter(clean: Record) -> None:
    """Logged units, one axis reversed, less their median: what an uncalibrated log offers."""
    t, rate, stamps, q = clean
    counts = logged(rate, *constants("gyroscope"))
    fit = by_rates.synchronise(t, counts - np.median(counts, axis=0), stamps, q)
    assert abs(lag_error(fit)) < 2 * TENTH_MS


def test_signs_and_time_origin_do_not_matter(clean: Record) -> None:
    t, rate, stamps, q = clean
    signs = np.random.default_rng(4).choice([-1.0, 1.0], (len(q), 1))
    a = by_rates.synchronise(t, rate, stamps, q)
    b = by_rates.synchronise(t + 1000.0, rate, stamps + 1000.0, signs * q)
    assert abs(b.lag_s - a.lag_s) < 0.01 * TENTH_MS
    c = by_rates.synchronise(t, rate, stamps + 1000.0, q, max_lag_s=1100.0)
    assert abs(c.lag_s - (a.lag_s - 1000.0)) < 0.01 * TENTH_MS


# refusal -------------------------------------------------------------------------------------------------------------


def refusal(*arrays: np.ndarray, **options: float) -> UnusableFlight:
    with pytest.raises(UnusableFlight) as caught:
        by_rates.synchronise(*arrays, **options)
    return caught.value


def test_gyroscope_at_rest_has_a_flat_peak(clean: Record) -> None:
    t, rate, stamps, q = clean
    error = refusal(t, PAPER_GYRO_RADPS * np.random.default_rng(5).normal(size=rate.shape), stamps, q)
    assert error.reason_code == "flat_peak"
    assert error.measured["peak"] < 0.5
    assert f"{error.measured['peak']:.2f}" in error.sentence


def test_both_at_rest(clean: Record) -> None:
    t, rate, stamps, q = clean
    rng = np.random.default_rng(6)
    still = from_rotation_vector(VPS_NOISE_RAD * rng.normal(size=(len(q), 3)))
    error = refusal(t, PAPER_GYRO_RADPS * rng.normal(size=rate.shape), stamps, still)
    assert error.reason_code in {"flat_peak", "ambiguous_peak"}


def test_offset_beyond_the_search(clean: Record) -> None:
    t, rate, stamps, q = clean
    assert refusal(t, rate, stamps + 300.0, q, max_lag_s=60.0).reason_code == "flat_peak"


@pytest.mark.parametrize("seed", range(8))
def test_vps_of_another_flight_is_refused(seed: int) -> None:
    """Chance peaks of unrelated manoeuvres reach 0.9; the vector fit does not follow them."""
    (t, rate, _, _), (_, _, stamps, q) = record(seed), record(seed + 7)
    assert refusal(t, rate, stamps, q).reason_code in {"flat_peak", "ambiguous_peak", "not_the_same_motion"}


def test_a_repeated_motion_is_ambiguous() -> None:
    """The same manoeuvre flown twice within the IMU's record, once within the VPS's: two lags fit equally well."""
    motion = Motion(Experiment(seed=0, duration_s=20.0, sets=1), np.random.default_rng(0))
    t, t_vps = np.arange(0.0, 40.0, IMU_INTERVAL_S), np.arange(0.0, 20.0, VPS_INTERVAL_S)
    rate = motion.rate(np.mod(t, 20.0)) + GOOD_GYRO_RADPS * np.random.default_rng(7).normal(size=(len(t), 3))
    error = refusal(t, rate, t_vps, motion.attitude(t_vps))
    assert error.reason_code == "ambiguous_peak"
    assert error.measured["runner_up"] > 0.98 * error.measured["peak"]


def test_a_periodic_motion_is_ambiguous() -> None:
    t, t_vps = np.arange(0.0, 40.0, IMU_INTERVAL_S), np.arange(0.0, 40.0, VPS_INTERVAL_S)
    q = from_euler(np.c_[np.sin(2 * np.pi * 0.25 * t_vps), np.zeros((len(t_vps), 2))])
    rate = np.c_[2 * np.pi * 0.25 * np.cos(2 * np.pi * 0.25 * t), np.zeros((len(t), 2))]
    assert refusal(t, rate, t_vps, q, max_lag_s=20.0).reason_code == "ambiguous_peak"


@pytest.mark.parametrize("samples", [10, 600])
def test_too_short_a_vps_record(clean: Record, samples: int) -> None:
    t, rate, stamps, q = clean
    error = refusal(t, rate, stamps[:samples], q[:samples])
    assert error.reason_code == "vps_too_short"
    assert error.measured["n_vps"] == samples


def test_a_day_of_pause_is_refused_and_takes_no_memory(clean: Record) -> None:
    t, rate, stamps, q = clean
    half = np.where(t > t[len(t) // 2], 86_400.0, 0.0)
    error = refusal(t + half, rate, stamps, q)
    assert error.reason_code == "gaps"
    assert error.measured["span_s"] == pytest.approx(86_400.0 + t[-1] - t[0], rel=1e-9)


@pytest.mark.parametrize("end", [0, -1])
def test_an_outlier_at_either_end_is_masked(clean: Record, end: int) -> None:
    _, _, stamps, q = clean
    spoiled = q.copy()
    spoiled[end] = multiply(q[end], from_rotation_vector(np.array([0.3, -0.4, 0.2])))
    expected = [len(q) - 1 if end else 0]
    np.testing.assert_array_equal(np.flatnonzero(~by_rates.mask_outliers(stamps, spoiled)), expected)


# honest --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gyro_noise", "vps_noise"), [(GOOD_GYRO_RADPS, 3e-4), (PAPER_GYRO_RADPS, VPS_NOISE_RAD)])
def test_claimed_sd_of_lag_and_drift_is_honest(gyro_noise: float, vps_noise: float) -> None:
    ratios = []
    for seed in range(40):
        fit = by_rates.synchronise(*record(seed, gyro_noise=gyro_noise, vps_noise=vps_noise))
        middle_error = fit.lag_mid_s + 0.37 + 20.0 * PPM * fit.reference_s
        ratios.append([middle_error / fit.lag_sd_s, (fit.skew_ppm - 20.0) / fit.skew_sd_ppm])
    lag, skew = np.array(ratios).T
    assert HONEST[0] < rms(lag) < HONEST[1]
    assert HONEST[0] < rms(skew) < HONEST[1]


def test_noise_that_grows_with_the_motion_is_in_the_sd() -> None:
    """Half of the record is rest; the average over it would understate the sd twice."""
    ratios = []
    for seed in range(12):
        t, rate, stamps, q = record(seed, gyro_noise=0.0)
        over_a_second = np.convolve(np.sum(rate**2, axis=1), np.full(185, 1.0 / 185.0), mode="same")
        noise = 1e-3 + 0.05 * np.sqrt(over_a_second)[:, None]
        noisy = rate + noise * np.random.default_rng(1000 + seed).normal(size=rate.shape)
        fit = by_rates.synchronise(t, noisy, stamps, q)
        middle_error = fit.lag_mid_s + 0.37 + 20.0 * PPM * fit.reference_s
        ratios.append([middle_error / fit.lag_sd_s, (fit.skew_ppm - 20.0) / fit.skew_sd_ppm])
    assert HONEST[0] < rms(np.array(ratios)) < HONEST[1]


def brisk(seed: int, smoothing_s: float) -> tuple[Record, float]:
    """30 s of motion up to 6 Hz seen by a VPS that smooths by one pole; its delay of slow motion, s."""
    rng = np.random.default_rng(seed)
    interval_s = 1.0 / 400.0
    t = np.arange(0.0, DURATION_S, interval_s)
    phase = 2 * np.pi * rng.uniform(0.2, 6.0, (60, 1)) * t + rng.uniform(0, 2 * np.pi, (60, 1))
    rate = 0.12 * np.sin(phase).T @ rng.normal(size=(60, 3))
    q = propagate_stretches(t, rate, np.zeros(len(t), dtype=int))
    kept = np.exp(-interval_s / smoothing_s)
    smoothed = lfilter([1.0 - kept], [1.0, -kept], q, axis=0, zi=q[:1] * kept)[0]
    noisy = rate[::2] + GOOD_GYRO_RADPS * rng.normal(size=(len(t[::2]), 3))
    return (t[::2], noisy, t + 0.37, normalise(smoothed)), interval_s * kept / (1.0 - kept)


@pytest.mark.parametrize("smoothing_s", [0.01, 0.04])
def test_a_vps_that_smooths_has_no_one_lag(smoothing_s: float) -> None:
    """Slow motion is later than fast motion: both are within the sd, to which noise adds little."""
    for seed in range(3):
        given, delay_s = brisk(seed, smoothing_s)
        fit = by_rates.synchronise(*given)
        error = abs(fit.lag_mid_s + 0.37 + delay_s)
        assert error < 4.0 * fit.lag_sd_s
        assert error > 4.0 * np.sqrt(fit.covariance[0, 0])
        assert fit.lag_sd_s == pytest.approx(np.hypot(np.sqrt(fit.covariance[0, 0]), fit.spread[0]))


def test_what_slower_motion_cannot_tell_adds_nothing(clean: Record) -> None:
    """A VPS lost every 0.4 s has no stretch as long as a slow low-pass asks."""
    t, rate, stamps, q = clean
    seen = (stamps % 0.4) > 0.06
    assert (by_rates.synchronise(t, rate, stamps[seen], q[seen]).spread == 0.0).all()
    assert by_rates.synchronise(*clean).spread[0] < 0.1 * TENTH_MS


def test_a_noisy_vps_does_not_pull_the_lag() -> None:
    """VPS noise of 1 mrad over 12 seeds: the mean error is within three times its own scatter."""
    lags = np.array([lag_error(by_rates.synchronise(*record(seed, vps_noise=1e-3))) for seed in range(12)])
    assert abs(lags.mean()) < 3.0 * lags.std() / np.sqrt(len(lags))


# parts ---------------------------------------------------------------------------------------------------------------


def test_correlation_is_the_masked_one_written_out() -> None:
    """Padfield's masked normalised correlation at every lag, by loops."""
    rng = np.random.default_rng(8)
    common = rng.normal(size=(80, 3)).cumsum(axis=0)
    valid = rng.uniform(size=(2, 80)) > 0.1
    imu = by_rates.UniformRates(5.0, 0.1, common * valid[0][:, None], valid[0])
    vps = by_rates.UniformRates(3.0, 0.1, np.roll(common, -7, axis=0)[:60] * valid[1][:60, None], valid[1][:60])
    a, b = np.linalg.norm(imu.rate, axis=1), np.linalg.norm(vps.rate, axis=1)
    best = {}
    for shift in range(-40, 60):
        pairs = [(i, i - shift) for i in range(80) if 0 <= i - shift < 60 and valid[0][i] and valid[1][i - shift]]
        if len(pairs) > 25:
            best[shift] = float(np.corrcoef([a[i] for i, _ in pairs], [b[j] for _, j in pairs])[0, 1])
    lag, peak, _, _ = by_rates.correlate(imu, vps, 60.0, min_overlap_s=2.6)
    top = max(best, key=best.__getitem__)
    assert top == 7
    assert peak == pytest.approx(best[top], abs=1e-9)
    assert lag == pytest.approx(5.0 - 3.0 + 0.7, abs=0.05)


def test_vps_rates_are_the_motions() -> None:
    motion = Motion(Experiment(seed=9), np.random.default_rng(9))
    t = np.arange(10.0, 25.0, VPS_INTERVAL_S)
    found = by_rates.vps_rates(t, motion.attitude(t), IMU_INTERVAL_S)
    curvature_radps = 0.01  # of five samples of a doublet of a few rad/s
    inside = found.valid & (found.t > 10.1) & (found.t < 24.9)
    np.testing.assert_allclose(found.rate[inside], motion.rate(found.t[inside]), atol=curvature_radps)
    assert found.interval_s == IMU_INTERVAL_S
    assert found.start_s == 10.0


def test_imu_gaps_are_masked() -> None:
    t = np.r_[np.arange(0.0, 2.0, 0.01), np.arange(3.0, 5.0, 0.01)]
    found = by_rates.imu_rates(t, np.ones((len(t), 3)), 0.01)
    assert not found.valid[(found.t > 2.0) & (found.t < 2.98)].any()
    assert found.valid[(found.t < 1.98) | (found.t > 3.01)].all()


def test_both_constant_rotations_are_found() -> None:
    rng = np.random.default_rng(11)
    q = random_attitudes(rng, 400)
    world, body = from_rotation_vector(rng.normal(size=(2, 3)) * 0.3)
    imu = multiply(multiply(world, q), body)
    imu[::50] = random_attitudes(rng, 8)  # a few bad ones
    found_world, found_body = by_rates.align_frames(imu, q, iterations=100)
    assert angle(found_world, world) < MILLIDEGREE_RAD
    assert angle(found_body, body) < MILLIDEGREE_RAD
