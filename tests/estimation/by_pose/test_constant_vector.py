"""A vector triad by attitude alone, against a closed form: matrix, bias, field, delay, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import autoregressive, rms

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_pose.constant_vector import fit_constant_vector
from fieldcal.estimation.by_pose.triad import TriadByPose
from fieldcal.geometry.rotation import Array, body_from_inertial, propagate

FIELD = np.array([0.2, 0.05, 0.43])
LENGTH = float(np.linalg.norm(FIELD))
MATRIX = np.array([[1.05, 0.03, 0.0], [0.03, 0.95, -0.02], [0.0, -0.02, -1.1]])
BIAS = np.array([0.12, -0.08, 0.2])
POLARITY = (1, 1, -1)


class Turned:
    """An attitude in closed form but for its integration, and what a triad reads of a constant vector."""

    def __init__(self, rng: np.random.Generator, noise: float = 0.0, correlation: float = 0.0, late_s: float = 0.0):
        fine = np.arange(-0.1, 60.0, 0.0025)
        rate = np.column_stack([np.sin(2.0 * np.pi * f * fine + f) for f in (0.13, 0.19, 0.11)])
        turn = body_from_inertial(q := propagate(fine, rate, np.array([0.0, 0.0, 0.0, 1.0])))
        at = np.arange(40, len(fine), 2)
        self.t, self.q = fine[at], q[at]
        seen = turn @ FIELD
        late = np.column_stack([np.interp(self.t - late_s, fine, column) for column in seen.T])
        self.logged = (late - BIAS) @ np.linalg.inv(MATRIX).T
        if noise:
            self.logged = self.logged + noise * autoregressive(rng, self.logged.shape, correlation)

    def fitted(self, known: np.ndarray | None = None) -> tuple[TriadByPose, Array, Array]:
        every = np.ones(len(self.t), dtype=bool) if known is None else known
        segment = np.zeros(len(self.t), dtype=np.int64)
        return fit_constant_vector(
            self.t, segment, self.logged, self.q, every, length=LENGTH, polarity=np.array(POLARITY)
        )


def test_a_full_matrix_and_the_field_of_a_closed_form() -> None:
    fit, field, covariance = Turned(np.random.default_rng(1)).fitted()
    assert np.abs(fit.matrix - MATRIX).max() < 1e-4
    assert np.abs(fit.bias - BIAS).max() < 1e-4
    assert np.abs(field - FIELD).max() < 1e-4
    assert np.abs(covariance @ field).max() < 1e-12


def test_a_late_triad_is_told() -> None:
    fit, _, _ = Turned(np.random.default_rng(1), late_s=0.012).fitted()
    assert abs(fit.delay_s - 0.012) < 5e-4
    assert np.abs(fit.matrix - MATRIX).max() < 2e-3


@pytest.mark.parametrize("correlation", [0.0, 0.995])
def test_claimed_sd_are_honest_for_white_and_for_slow_noise(correlation: float) -> None:
    """Correlated over a second, as a room's field: ten times the sd of white noise, and claimed."""
    z, colour = [], []
    for seed in range(12):
        fit, _, _ = Turned(np.random.default_rng(seed), noise=0.01, correlation=correlation).fitted()
        sd = np.sqrt(np.diagonal(fit.covariance))
        z.append((np.r_[fit.matrix.ravel(), fit.bias] - np.r_[MATRIX.ravel(), BIAS]) / sd)
        colour.append(fit.colour)
    assert 0.7 < rms(z) < 1.5
    assert (np.median(colour) > 5.0) == (correlation > 0.0)


def test_a_passing_magnet_has_little_weight() -> None:
    turned = Turned(np.random.default_rng(2), noise=0.002)
    turned.logged[4000:4400] += 0.3
    fit, _, _ = turned.fitted()
    assert np.abs(fit.matrix - MATRIX).max() < 0.01
    assert fit.weight.min() < 0.1


def test_a_field_that_is_none_shows_in_the_misfit() -> None:
    rng = np.random.default_rng(3)
    turned = Turned(rng)
    turned.logged = turned.logged + 0.1 * autoregressive(rng, turned.logged.shape, 0.999)
    assert turned.fitted()[0].misfit > 0.1


def test_only_known_attitudes_count() -> None:
    turned = Turned(np.random.default_rng(4))
    known = np.ones(len(turned.t), dtype=bool)
    known[5000:] = False
    turned.logged[5000:] = 7.0
    assert np.abs(turned.fitted(known)[0].matrix - MATRIX).max() < 1e-3
    known[100:] = False
    with pytest.raises(UnusableFlight) as error:
        turned.fitted(known)
    assert error.value.reason_code == "too_little_motion"
