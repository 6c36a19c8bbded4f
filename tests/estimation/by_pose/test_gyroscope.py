"""The gyroscope by poses: where it starts, and what a VPS whose error is coloured does to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics_support import autoregressive, rms

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_pose.gyroscope import fit_gyroscope, start_by_rates
from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.estimation.joint.problem import Readings
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector, multiply
from fieldcal.simulation.experiment import SimulatedFlight, constants_at, simulate

ABOUT_NOSE = np.diag([1.0, -1.0, -1.0])


def test_a_unit_that_agrees_is_the_start() -> None:
    scale, rotation = start_by_rates(np.diag([0.98, 1.03, -1.01]), (1, 1, -1), (1.0, 1.0, 1.0))
    assert (scale == [1.0, 1.0, -1.0]).all()
    assert (rotation == np.eye(3)).all()


def test_a_wrong_unit_is_one_factor_for_all_axes() -> None:
    scale, _ = start_by_rates(np.eye(3) * 57.3, (1, 1, 1), (1.0, 1.0, 1.0))
    assert scale == pytest.approx(np.full(3, 1.0 / 57.3))


def test_an_axis_that_hardly_turned_keeps_its_unit() -> None:
    scale, rotation = start_by_rates(np.diag([0.1, 0.2, 1.0]), (1, 1, 1), (1.0, 1.0, 1.0))
    assert (scale == 1.0).all()
    assert (rotation == np.eye(3)).all()


def test_counts_start_from_what_the_rates_show() -> None:
    counts = np.array([900.0, 1000.0, 1100.0])
    scale, _ = start_by_rates(np.diag(counts) @ np.diag([1.0, -1.0, 1.0]), (1, -1, 1), None)
    assert scale == pytest.approx([1.0 / 900.0, -1.0 / 1000.0, 1.0 / 1100.0])


def test_an_unconfigured_mounting_is_found_and_a_small_one_left_to_the_fit() -> None:
    assert start_by_rates(ABOUT_NOSE, (1, 1, 1), (1.0, 1.0, 1.0))[1] == pytest.approx(ABOUT_NOSE)
    small = body_from_inertial(from_rotation_vector([0.1, 0.0, 0.0]))
    assert (start_by_rates(small, (1, 1, 1), (1.0, 1.0, 1.0))[1] == np.eye(3)).all()


def readings(r: SimulatedFlight) -> Readings:
    n = len(r.t)
    return Readings(
        t=r.t,
        segment=np.zeros(n, dtype=np.int64),
        gyroscope=r.counts["gyroscope"],
        accelerometer=None,
        magnetometer=None,
        gravity_mps2=9.81,
        field_ned=np.array([1.0, 0.0, 0.0]),
        turning=np.zeros((2, n, 3)),
    )


def fitted(r: SimulatedFlight, error: Array | None = None, poses: slice = slice(None)) -> tuple[JointFit, JointFit]:
    """By the simulator's poses, turned by an error (m, 3), rad."""
    given, q = readings(r), r.vps_q if error is None else multiply(from_rotation_vector(error), r.vps_q)
    sign = np.sign(r.experiment.scale["gyroscope"])
    zero = np.median(given.gyroscope, axis=0)
    clock = by_rates.synchronise(r.t, (given.gyroscope - zero) * 1e-3 * sign, r.vps_t, q)
    scale, rotation = start_by_rates(clock.matrix / (1e-3 * sign)[:, None], sign, None)
    return fit_gyroscope(given, r.vps_t[poses], q[poses], clock, (scale, -scale * zero), rotation, max_gap_s=0.05)


def normalised(r: SimulatedFlight, fit: JointFit) -> Array:
    scale, bias, covariance = fit.constants("gyroscope")
    true_scale, true_bias = constants_at(r.experiment, "gyroscope", 25.0)
    # Zeros are at the middle of the counts: biases alone would be errors of the scales times that.
    middle = 32768.0
    to_zero = np.hstack([np.eye(3) * middle, np.eye(3)])
    zero = scale * middle + bias - (true_scale * middle + true_bias)
    sd = np.r_[np.sqrt(np.diagonal(covariance)[:3]), np.sqrt(np.diagonal(to_zero @ covariance @ to_zero.T))]
    return np.r_[scale - true_scale, zero] / sd


def test_sd_are_honest_where_the_poses_are_exact() -> None:
    z = []
    for seed in range(5, 13):
        r = simulate(seed=seed, vps_misalignment_rad=0.1, vps_dropout_share=0.1)
        z.append(normalised(r, fitted(r)[0]))
    assert 0.6 < rms(z) < 1.5
    assert np.abs(z).max() < 4.5


def test_an_error_of_the_poses_that_wanders_over_seconds_does_not_spoil_them() -> None:
    """0.3° rms, correlated over 2 s, as that of a marker cloud whose body is not as rigid as its model. The walk of a
    noisy gyroscope would take it up as its own, and with it the constants."""
    z = []
    for seed in range(5, 11):
        r = simulate(seed=seed, duration_s=80.0, sets=6)
        rng = np.random.default_rng(seed)
        step_s = float(np.median(np.diff(r.vps_t)))
        error = np.radians(0.3) * autoregressive(rng, (len(r.vps_t), 3), 1.0 - step_s / 2.0)
        z.append(normalised(r, fitted(r, error)[0]))
    assert rms(z) < 1.7
    assert np.abs(z).max() < 4.5


def test_the_trajectory_follows_the_poses_closely() -> None:
    r = simulate(seed=5)
    stiff, close = fitted(r)
    for fit in (stiff, close):
        assert fit.vps is not None
    jumped = [np.sqrt(np.mean(np.sum(fit.path.jump**2, axis=1))) for fit in (stiff, close)]
    assert jumped[1] >= jumped[0] * 0.99


def test_too_few_poses_are_refused() -> None:
    r = simulate(seed=5, duration_s=20.0, sets=1)
    with pytest.raises(UnusableFlight) as error:
        fitted(r, poses=slice(3000, 3200))
    assert error.value.reason_code == "vps_too_short"
    elsewhere = replace(r, vps_t=r.vps_t + 0.0)
    with pytest.raises(UnusableFlight):
        fitted(elsewhere, poses=slice(0, 3))
