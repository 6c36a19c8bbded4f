"""The VPS clock by the magnetometer: exact, honest, immune to calibration, and no word where the sensors disagree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics_support import rms

from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.clock_sync.by_field import FieldClock, refine_by_field
from fieldcal.simulation.experiment import SimulatedFlight, simulate

MOVING = {"translation_rms_mps2": 0.3, "vps_skew_ppm": 200.0, "vps_misalignment_rad": 0.1}
# Left over without noise: SLERP between VPS samples and the 0.03 s slope.
FLOOR_S, FLOOR_PPM = 5e-6, 1.0
HONEST = 0.7, 1.4  # rms of error ÷ sd over 10 flights, 20 numbers: two and a half of its own standard deviations


def gyro_clock(r: SimulatedFlight) -> tuple[by_rates.SyncFit, np.ndarray, np.ndarray]:
    keep = by_rates.mask_outliers(r.vps_t, r.vps_q)
    t, q = r.vps_t[keep], r.vps_q[keep]
    gyro = r.counts["gyroscope"] - np.median(r.counts["gyroscope"], axis=0)
    return by_rates.synchronise(r.t, gyro, t, q), t, q


def both(
    r: SimulatedFlight, magnetometer: np.ndarray | None = None
) -> tuple[by_rates.SyncFit, by_rates.SyncFit, FieldClock]:
    fit, t, q = gyro_clock(r)
    logged = r.counts["magnetometer"] if magnetometer is None else magnetometer
    refined, own = refine_by_field(r.t, logged, t, q, fit)
    assert own is not None
    return fit, refined, own


def test_noise_free_clock_is_recovered() -> None:
    r = simulate(seed=1, noise=False, quantisation=False, band_limit=False, **MOVING)
    fit, _, own = both(r)
    assert abs(own.lag_mid_s - r.lag_at(fit.reference_s)) < FLOOR_S
    assert abs(1e6 * own.skew - 200.0) < FLOOR_PPM


def test_calibration_units_and_axes_cannot_move_it() -> None:
    r = simulate(seed=2, **MOVING)
    mixed = r.counts["magnetometer"] @ np.array([[0.9, 0.1, 0.0], [0.2, -1.3, 0.1], [0.0, 0.3, 0.7]]) - 4000.0
    assert abs(both(r)[2].lag_mid_s - both(r, mixed)[2].lag_mid_s) < 0.05e-3


def test_claimed_sd_is_honest_with_dropouts_and_outliers() -> None:
    ratios, lags = [], []
    for seed in range(100, 110):
        r = simulate(seed=seed, vps_dropout_share=0.1, vps_outlier_share=0.01, **MOVING)
        _, refined, _ = both(r)
        lags.append(refined.lag_mid_s - r.lag_at(refined.reference_s))
        ratios += [lags[-1] / refined.lag_sd_s, (refined.skew_ppm - 200.0) / refined.skew_sd_ppm]
    assert HONEST[0] < rms(np.array(ratios)) < HONEST[1]
    assert np.median(np.abs(lags)) < 0.15e-3


def test_magnetic_bursts_are_survived() -> None:
    r = simulate(seed=3, magnetic_bursts=4, **MOVING)
    _, refined, _ = both(r)
    assert abs(refined.lag_mid_s - r.lag_at(refined.reference_s)) < 4.0 * refined.lag_sd_s


def test_a_magnetometer_with_a_delay_of_its_own_has_no_word() -> None:
    r = simulate(seed=4, **MOVING)
    late = np.column_stack([np.interp(r.t - 0.011, r.t, c) for c in r.counts["magnetometer"].T])
    fit, refined, own = both(r, late)
    assert refined is fit
    assert own.lag_mid_s - fit.lag_mid_s == pytest.approx(0.011, abs=0.002)


def test_too_few_readings_leave_the_gyroscope_alone() -> None:
    r = simulate(seed=5, **MOVING)
    fit, t, q = gyro_clock(r)
    logged = np.where(np.arange(len(r.t))[:, None] < 150, r.counts["magnetometer"], np.nan)
    assert refine_by_field(r.t, logged, t, q, fit) == (fit, None)


def test_clocks_contradict_each_other_by_their_distance_in_what_both_and_slower_motion_leave_open() -> None:
    r = simulate(seed=4, **MOVING)
    fit, t, q = gyro_clock(r)
    fit = replace(fit, spread=np.array([3e-4, 2e-5]))
    _, own = refine_by_field(r.t, r.counts["magnetometer"], t, q, fit)
    assert own is not None
    apart = np.array([own.lag_mid_s - fit.lag_mid_s, own.skew - 1e-6 * fit.skew_ppm])
    total = own.covariance + fit.covariance + np.diag([9e-8, 4e-10])
    assert own.disagreement == pytest.approx(apart @ np.linalg.inv(total) @ apart)
