"""What smoothing leaves of noise: white noise in closed form, no motion, no lines, nothing where it cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.gyroscope.regressor_noise import smoothed_noise_variance
from fieldcal.estimation.smoothing import low_pass
from fieldcal.estimation.uncertainty_propagation import constants_to_equation

INTERVAL_S, CUTOFF_HZ, SIGMA = 1.0 / 200.0, 8.0, 0.3


def motion(t: np.ndarray) -> np.ndarray:
    return 40.0 * np.stack([np.sin(2 * np.pi * f * t) for f in (0.4, 1.1, 2.5)], axis=1)


def noise(n: int, seed: int = 0) -> np.ndarray:
    return SIGMA * np.random.default_rng(seed).normal(size=(n, 3))


@pytest.mark.parametrize("moving", [False, True])
def test_it_is_the_variance_of_smoothed_noise(moving: bool) -> None:
    t = np.arange(40_000) * INTERVAL_S
    white = noise(len(t))
    expected = low_pass(white, CUTOFF_HZ, INTERVAL_S)[200:-200].var(axis=0)
    logged = white + motion(t) if moving else white
    found = smoothed_noise_variance(t, logged, np.zeros(len(t)), CUTOFF_HZ)
    np.testing.assert_allclose(found, expected, rtol=0.06)


def test_a_line_in_the_band_does_not_count() -> None:
    t = np.arange(40_000) * INTERVAL_S
    white = noise(len(t))
    line = 2.0 * np.sin(2 * np.pi * 23.0 * t)[:, None]
    plain, lined = (smoothed_noise_variance(t, x, np.zeros(len(t)), CUTOFF_HZ) for x in (white, white + line))
    np.testing.assert_allclose(lined, plain, rtol=0.15)


def test_units_origin_and_segments() -> None:
    t = np.arange(8_000) * INTERVAL_S
    x, one = noise(len(t)) + motion(t), np.zeros(8_000)
    plain = smoothed_noise_variance(t, x, one, CUTOFF_HZ)
    np.testing.assert_allclose(smoothed_noise_variance(t + 1e4, 5.0 * x + 7.0, one, CUTOFF_HZ), 25.0 * plain, rtol=1e-6)
    apart = t + 30.0 * (t >= t[4_000])
    x[4_000:] += 500.0  # a jump between segments is no noise
    parted = smoothed_noise_variance(apart, x, one + (t >= t[4_000]), CUTOFF_HZ)
    np.testing.assert_allclose(parted, plain, rtol=0.05)


@pytest.mark.parametrize(("rate_hz", "cutoff_hz", "n"), [(200.0, 0.0, 4000), (30.0, 8.0, 4000), (200.0, 8.0, 150)])
def test_nothing_is_taken_for_noise_where_it_cannot_be_told(rate_hz: float, cutoff_hz: float, n: int) -> None:
    found = smoothed_noise_variance(np.arange(n) / rate_hz, noise(n), np.zeros(n), cutoff_hz)
    assert (found == 0.0).all()


@pytest.mark.parametrize(("rate_hz", "told"), [(44.0, False), (46.0, True), (60.0, True)])
def test_three_bins_below_four_fifths_of_nyquist_are_enough(rate_hz: float, told: bool) -> None:
    """From 16 Hz on: 16 and 17 Hz lie below 17.6 Hz, 18 Hz as well below 18.4 Hz."""
    n = int(40 * rate_hz)
    found = smoothed_noise_variance(np.arange(n) / rate_hz, noise(n), np.zeros(n), CUTOFF_HZ)
    assert (found > 0.0).all() == told
    assert (found == 0.0).all() != told


def test_stretches_shorter_than_a_block_are_left_out() -> None:
    t = np.arange(8_000) * INTERVAL_S
    x, label = noise(len(t)), np.zeros(8_000)
    label[4_000:4_199], label[4_199:] = 1, 2
    x[4_000:4_199] *= 1e3
    plain = smoothed_noise_variance(t, noise(len(t)), np.zeros(8_000), CUTOFF_HZ)
    np.testing.assert_allclose(smoothed_noise_variance(t, x, label, CUTOFF_HZ), plain, rtol=0.1)
    label[4_199] = 1  # one sample more is a block, of forty
    x[4_199] *= 1e3
    assert (smoothed_noise_variance(t, x, label, CUTOFF_HZ) > 1e3 * plain).all()


@pytest.mark.parametrize("scalar", [False, True])
def test_what_uncertain_vectors_do_to_equation_error(scalar: bool) -> None:
    """First order against attitudes turned by the constants' errors and fitted again."""
    from numerics_support import constants, finely_integrated, logged

    from fieldcal.estimation.gyroscope.equation_error import fit_equation_error
    from fieldcal.estimation.smoothing import differentiate
    from fieldcal.geometry.rotation import from_rotation_vector, multiply

    interval, size = 0.005, 1e-5
    scale, bias = constants("gyroscope")
    t = np.arange(0.0, 24.0, interval)
    q, rate = finely_integrated(t, np.random.default_rng(0), refinement=10)
    jacobian = np.stack([np.sin(np.outer(t, [0.5, 1.0, 1.5]) + k) for k in range(6)], axis=2)
    derivative = differentiate(jacobian.reshape(len(t), -1), interval).reshape(jacobian.shape)
    counts, weight = logged(rate, scale, bias), np.ones(len(t))
    equations = "scalar" if scalar else "all"

    def fitted(error: np.ndarray) -> np.ndarray:
        turned = multiply(q, from_rotation_vector(jacobian @ error))
        fit = fit_equation_error(turned, differentiate(turned, interval), counts, equations=equations)
        return np.r_[fit.scale, fit.bias]

    moved = [(fitted(size * e) - fitted(-size * e)) / (2.0 * size) for e in np.eye(6)]
    expected = np.sum([np.outer(m, m) for m in moved], axis=0)
    found = constants_to_equation(counts, rate, weight, [(jacobian, derivative, np.eye(6))], q if scalar else None)
    sd = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found / np.outer(sd, sd), expected / np.outer(sd, sd), atol=0.01)
