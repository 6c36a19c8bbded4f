"""The accelerometer by attitude and position, against closed forms and the simulator's truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics_support import rms

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_pose.accelerometer import fit_accelerometer
from fieldcal.estimation.by_pose.triad import TriadByPose, body_axes
from fieldcal.estimation.joint.problem import CROSS
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector, multiply, propagate
from fieldcal.simulation.experiment import SimulatedFlight, constants_at, simulate

G = 9.81
ARM = np.array([0.05, 0.02, -0.03])
MATRIX = np.array([[1.02, 0.0, 0.0], [0.01, 0.985, 0.0], [-0.015, 0.008, 1.01]])
BIAS = np.array([0.2, -0.3, 0.15])
QUIET = {"noise": False, "quantisation": False, "band_limit": False}


class Flown:
    """Turns and translates in sums of sinusoids: specific force in closed form but for the integrated attitude."""

    def __init__(self, duration_s: float = 60.0, rate_hz: float = 200.0, late_s: float = 0.0) -> None:
        self.t = np.arange(0.0, duration_s, 1.0 / rate_hz)
        fine = np.arange(-1.0, duration_s + 1.0, 1.0 / (4.0 * rate_hz))
        rate = np.column_stack([np.sin(2.0 * np.pi * f * fine + f) for f in (0.13, 0.17, 0.11)])
        q = propagate(fine, rate, np.array([0.0, 0.0, 0.0, 1.0]))
        w = 2.0 * np.pi * np.array([0.4, 0.3, 0.5])
        amplitude = np.array([0.3, 0.2, 0.25])
        turn = body_from_inertial(q).transpose(0, 2, 1)
        # Of the VPS's point; the sensor is at an arm from it.
        position = amplitude * np.sin(w * fine[:, None])
        sensor = position + turn @ ARM
        acceleration = np.gradient(np.gradient(sensor, fine, axis=0), fine, axis=0)
        force = np.einsum("nji,nj->ni", turn, acceleration - np.array([0.0, 0.0, G]))
        logged = (force - BIAS) @ np.linalg.inv(MATRIX).T

        def at(x: Array, times: Array) -> Array:
            return np.column_stack([np.interp(times, fine, column) for column in x.T])

        self.logged = at(logged, self.t - late_s)
        q_at = at(q, self.t)
        self.q = q_at / np.linalg.norm(q_at, axis=1, keepdims=True)
        self.t_vps = np.arange(0.0, duration_s, 0.01)
        self.position = amplitude * np.sin(w * self.t_vps[:, None])

    def fitted(self, **changes: Array) -> TriadByPose:
        given = {name: changes.get(name, getattr(self, name)) for name in ("logged", "q", "position")}
        segment = np.zeros(len(self.t), dtype=np.int64)
        return fit_accelerometer(
            self.t,
            segment,
            given["logged"],
            given["q"],
            self.t_vps,
            given["position"],
            gravity_mps2=-G,
            max_gap_s=0.05,
        )


@pytest.fixture(scope="module")
def flown() -> Flown:
    return Flown()


def test_matrix_bias_and_lever_arm_of_a_closed_form(flown: Flown) -> None:
    fit = flown.fitted()
    assert np.abs(fit.matrix - MATRIX).max() < 5e-4
    assert np.abs(fit.bias - BIAS).max() < 3e-3
    assert fit.lever_arm_m is not None
    assert np.abs(fit.lever_arm_m - ARM).max() < 5e-4
    assert abs(fit.delay_s) < 1e-4
    assert fit.misfit < 1e-3


def test_a_position_with_a_part_missing_is_none(flown: Flown) -> None:
    part, whole = flown.position.copy(), flown.position.copy()
    part[1000:1003, 1] = np.nan
    whole[1000:1003] = np.nan
    one, other = flown.fitted(position=part), flown.fitted(position=whole)
    assert one.matrix.tolist() == other.matrix.tolist()
    assert np.isfinite(one.matrix).all()


def test_a_late_sensor_is_told_and_moves_no_constant() -> None:
    fit = Flown(late_s=0.006).fitted()
    assert abs(fit.delay_s - 0.006) < 2e-4
    assert np.abs(fit.matrix - MATRIX).max() < 1e-3


def test_a_world_that_is_not_level_changes_nothing(flown: Flown) -> None:
    """Gravity is as long in a tilted world: at 6° taking it for longer would cost half a per cent."""
    tilt = from_rotation_vector([0.08, -0.07, 0.5])
    turned = flown.fitted(q=multiply(tilt, flown.q), position=flown.position @ body_from_inertial(tilt))
    assert np.abs(turned.matrix - flown.fitted().matrix).max() < 2e-4


def test_axes_of_its_own_are_found_whatever_the_trajectory_s(flown: Flown) -> None:
    """A trajectory in axes turned by 10° shows M turned; lower triangular it is the same again, and the turn known."""
    mounting = from_rotation_vector([0.1, -0.12, 0.08])
    turned = flown.fitted(q=multiply(flown.q, mounting))
    own, rotation, covariance = body_axes(turned, np.ones(3))
    assert np.abs(own.matrix - MATRIX).max() < 5e-4
    assert np.abs(own.bias - BIAS).max() < 3e-3
    assert np.abs(rotation @ body_from_inertial(mounting) - np.eye(3)).max() < 1e-3
    assert (np.diagonal(covariance) >= 0.0).all()
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.linalg.det(body_axes(turned, [1.0, -1.0, 1.0])[1]) == pytest.approx(-1.0)


def test_square_axes_are_the_estimate_given_zero_elements(flown: Flown) -> None:
    own, _, _ = body_axes(flown.fitted(), np.ones(3))
    assert np.all(own.matrix[np.triu_indices(3, 1)] == 0.0)
    square = own.square(flown.logged.mean(axis=0), CROSS["accelerometer"])
    assert not square.matrix[np.tril_indices(3, -1)].any()
    assert square.cross_sd is None
    assert own.cross_sd is not None
    assert own.cross_test(CROSS["accelerometer"]) > 1e3
    # What the elements may be stays in the sd of the diagonal.
    assert (np.diagonal(square.diagonal_covariance)[:3] >= 0.99 * np.diagonal(own.diagonal_covariance)[:3]).all()


def test_square_axes_have_no_dust_of_rounding(flown: Flown) -> None:
    """Which made a full matrix of it, its elements 1e-19 with standard deviations of 1e-22."""
    rng, fit = np.random.default_rng(4), flown.fitted()
    for _ in range(40):
        root = 1e-4 * rng.normal(size=(12, 12))
        own, _, _ = body_axes(replace(fit, covariance=root @ root.T), np.ones(3))
        square = own.square(flown.logged.mean(axis=0), CROSS["accelerometer"])
        np.testing.assert_array_equal(square.matrix, np.diag(np.diagonal(square.matrix)))


def test_outliers_of_the_position_do_not_count(flown: Flown) -> None:
    wild = flown.position.copy()
    wild[2000:2040] += 0.02
    fit = flown.fitted(position=wild)
    assert np.abs(fit.matrix - MATRIX).max() < 3e-3
    assert fit.weight.min() < 0.2


def _simulated(r: SimulatedFlight) -> TriadByPose:
    """By the truth's attitude and the simulated position, clocks known."""
    e = r.experiment
    t_imu = (r.vps_t - e.vps_offset_s) / (1.0 + 1e-6 * e.vps_skew_ppm) + r.delay_s
    fit = fit_accelerometer(
        r.t,
        np.zeros(len(r.t), dtype=np.int64),
        r.counts["accelerometer"],
        r.q,
        t_imu,
        r.vps_position,
        gravity_mps2=e.gravity_mps2,
        max_gap_s=0.05,
    )
    return body_axes(fit, np.sign(e.scale["accelerometer"]))[0]


def test_simulated_counts_without_noise() -> None:
    r = simulate(seed=3, translation_rms_mps2=0.3, lever_arm_m=tuple(ARM), **QUIET)
    fit, (scale, _) = _simulated(r), constants_at(r.experiment, "accelerometer", 25.0)
    assert np.abs(np.diagonal(fit.matrix) / scale - 1.0).max() < 1e-3


def test_claimed_sd_are_honest() -> None:
    z = []
    for seed in range(20, 28):
        r = simulate(seed=seed, translation_rms_mps2=0.3, lever_arm_m=tuple(ARM))
        fit, (scale, bias) = _simulated(r), constants_at(r.experiment, "accelerometer", 25.0)
        sd = np.sqrt(np.diagonal(fit.diagonal_covariance))
        z.append((np.r_[np.diagonal(fit.matrix) - scale, fit.bias - bias]) / sd)
    assert 0.4 < rms(z) < 1.6
    assert np.abs(z).max() < 4.0


def test_too_few_positions_are_refused(flown: Flown) -> None:
    missing = np.full_like(flown.position, np.nan)
    missing[:300] = flown.position[:300]
    for position in (missing, np.full_like(missing, np.nan)):
        with pytest.raises(UnusableFlight) as error:
            flown.fitted(position=position)
        assert error.value.reason_code == "vps_too_short"
