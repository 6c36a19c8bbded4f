"""Low-pass, differentiation and lattice against direct sums, SciPy's Savitzky–Golay and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import rms
from scipy.signal import savgol_filter

from fieldcal.estimation import smoothing

INTERVAL_S = 1.0 / 185.0
CUTOFF_HZ = 8.0
SIDE = round(0.5 / INTERVAL_S)
FFT_ROUNDING = 1e-12
PASS_BAND_GAIN_ERROR = 0.005
ODD_END_ERROR, EVEN_END_ERROR = 0.01, 0.10


@pytest.fixture
def noise() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(700, 3))


def direct_sum(x: np.ndarray, weights: np.ndarray, sign: float) -> np.ndarray:
    """The filter written out: reflected ends, Σ h_k x_{i+k}, one sample at a time."""
    side, n = len(weights) // 2, len(x)
    out = np.zeros_like(x)
    for i in range(n):
        for k in range(-side, side + 1):
            j = i + k
            if j < 0:
                value = x[-j] if sign > 0 else 2 * x[0] - x[-j]
            elif j >= n:
                mirrored = x[2 * (n - 1) - j]
                value = mirrored if sign > 0 else 2 * x[-1] - mirrored
            else:
                value = x[j]
            out[i] += weights[k + side] * value
    return out


@pytest.mark.parametrize(("ends", "sign"), [("odd", -1.0), ("even", 1.0)])
def test_fft_is_the_direct_sum(noise: np.ndarray, ends: str, sign: float) -> None:
    x = noise[:200]
    weights = smoothing.low_pass_weights(CUTOFF_HZ, INTERVAL_S, SIDE)
    np.testing.assert_allclose(
        smoothing.low_pass(x, CUTOFF_HZ, INTERVAL_S, ends=ends), direct_sum(x, weights, sign), atol=FFT_ROUNDING
    )


def test_gain() -> None:
    """Unity in the pass band, nothing past the roll-off."""
    weights = smoothing.low_pass_weights(CUTOFF_HZ, INTERVAL_S, SIDE)
    frequency = np.linspace(0.0, 0.5 / INTERVAL_S, 2000)
    k = np.arange(-SIDE, SIDE + 1)
    gain = np.cos(2 * np.pi * frequency[:, None] * k * INTERVAL_S) @ weights
    end_hz = CUTOFF_HZ + np.pi / (SIDE * INTERVAL_S)
    assert gain[0] == pytest.approx(1.0, abs=1e-14)
    assert np.abs(gain[frequency <= CUTOFF_HZ] - 1.0).max() < PASS_BAND_GAIN_ERROR
    assert np.abs(gain[frequency >= end_hz]).max() < PASS_BAND_GAIN_ERROR


def test_zero_phase_on_a_sine() -> None:
    t = INTERVAL_S * np.arange(2000)
    x = np.sin(2 * np.pi * 3.0 * t)[:, None]
    inside = slice(SIDE, -SIDE)
    smooth = smoothing.low_pass(x, CUTOFF_HZ, INTERVAL_S)
    assert np.abs(smooth - x)[inside].max() < PASS_BAND_GAIN_ERROR


@pytest.mark.parametrize(("ends", "worst"), [("odd", ODD_END_ERROR), ("even", EVEN_END_ERROR)])
def test_end_error_on_a_1_hz_sine(ends: str, worst: float) -> None:
    t = INTERVAL_S * np.arange(740)
    errors = []
    for phase in np.linspace(0.0, 2 * np.pi, 24, endpoint=False):
        x = np.sin(2 * np.pi * t + phase)[:, None]
        errors.append(np.abs(smoothing.low_pass(x, CUTOFF_HZ, INTERVAL_S, ends=ends) - x).max())
    assert max(errors) < worst


def test_a_straight_line_and_a_constant_pass() -> None:
    t = np.arange(300.0)[:, None]
    np.testing.assert_allclose(smoothing.low_pass(2.0 + 0.1 * t, CUTOFF_HZ, INTERVAL_S), 2.0 + 0.1 * t, atol=1e-11)
    constant = np.full((300, 1), -4.2)
    np.testing.assert_allclose(smoothing.low_pass(constant, CUTOFF_HZ, INTERVAL_S, ends="even"), constant, atol=1e-12)


def test_fixed_weights_do_not_depend_on_the_length_of_the_record(noise: np.ndarray) -> None:
    long, short = (smoothing.low_pass(x, CUTOFF_HZ, INTERVAL_S) for x in (noise, noise[:500]))
    np.testing.assert_allclose(long[: 500 - SIDE], short[: 500 - SIDE], atol=FFT_ROUNDING)


def test_linear_and_column_by_column(noise: np.ndarray) -> None:
    smooth = smoothing.low_pass(noise, CUTOFF_HZ, INTERVAL_S)
    np.testing.assert_allclose(smoothing.low_pass(1e6 * noise, CUTOFF_HZ, INTERVAL_S), 1e6 * smooth, atol=1e-5)
    alone = smoothing.low_pass(noise[:, 1:2], CUTOFF_HZ, INTERVAL_S)
    np.testing.assert_allclose(alone[:, 0], smooth[:, 1], atol=FFT_ROUNDING)


@pytest.mark.parametrize("n", [1, 2, 5, 40])
def test_records_shorter_than_the_weights(n: int) -> None:
    x = np.linspace(1.0, 2.0, n)[:, None]
    np.testing.assert_allclose(smoothing.low_pass(x, CUTOFF_HZ, INTERVAL_S), x, atol=1e-12)


def test_cut_off_above_nyquist_changes_nothing(noise: np.ndarray) -> None:
    np.testing.assert_array_equal(smoothing.low_pass(noise, 0.5 / INTERVAL_S, INTERVAL_S), noise)
    np.testing.assert_array_equal(smoothing.smooth_samples(np.arange(700) * INTERVAL_S, noise, 0.0), noise)


def test_unknown_ends_and_impossible_weights(noise: np.ndarray) -> None:
    with pytest.raises(ValueError, match="odd"):
        smoothing.low_pass(noise, CUTOFF_HZ, INTERVAL_S, ends="zero")
    with pytest.raises(ValueError, match="positive"):
        smoothing.low_pass_weights(-1.0, INTERVAL_S, SIDE)
    with pytest.raises(ValueError, match="at least 5"):
        smoothing.differentiate(noise[:4], INTERVAL_S)


@pytest.mark.parametrize(("window_s", "samples"), [(0.0, 5), (0.027, 5), (0.054, 11), (0.2, 37)])
def test_derivative_is_savitzky_golay(noise: np.ndarray, window_s: float, samples: int) -> None:
    expected = savgol_filter(noise, samples, 2, deriv=1, delta=INTERVAL_S, axis=0, mode="interp")
    np.testing.assert_allclose(
        smoothing.differentiate(noise, INTERVAL_S, window_s=window_s), expected, rtol=1e-9, atol=1e-9 / INTERVAL_S
    )


def test_derivative_of_a_parabola_is_exact_to_the_ends() -> None:
    t = INTERVAL_S * np.arange(50)[:, None]
    np.testing.assert_allclose(
        smoothing.differentiate(1.0 - 3.0 * t + 5.0 * t * t, INTERVAL_S), -3.0 + 10.0 * t, atol=1e-9
    )


def test_noise_gain_of_five_points() -> None:
    noise = np.random.default_rng(1).normal(size=(20000, 2))
    gain = rms(smoothing.differentiate(noise, INTERVAL_S)[2:-2])
    assert gain == pytest.approx(1.0 / (np.sqrt(10.0) * INTERVAL_S), rel=0.02)


def test_lattice_counts_losses_under_jitter_and_drift() -> None:
    rng = np.random.default_rng(2)
    places = np.flatnonzero(rng.uniform(size=20000) > 0.05)
    true_interval = INTERVAL_S * (1 + 40e-6)
    jitter_s = 1e-3
    t = 1234.5 + places * true_interval + np.clip(3e-4 * rng.normal(size=len(places)), -jitter_s, jitter_s)
    index, interval = smoothing.lattice(t)
    np.testing.assert_array_equal(index, places - places[0])
    assert interval == pytest.approx(true_interval, rel=2 * jitter_s / (t[-1] - t[0]))


def test_lattice_on_25_microsecond_ticks() -> None:
    """The median interval is off by up to half a tick, 0.24 %: counting with it would slip within 2.2 s."""
    t = np.round(np.arange(7400) * INTERVAL_S / 25.6e-6) * 25.6e-6
    index, interval = smoothing.lattice(t)
    np.testing.assert_array_equal(index, np.arange(7400))
    assert interval == pytest.approx(INTERVAL_S, rel=1e-6)


def test_lost_samples_are_bridged_for_the_filter_only() -> None:
    rng = np.random.default_rng(3)
    t = INTERVAL_S * np.arange(3000)
    x = np.column_stack([np.sin(2 * np.pi * t), np.cos(2 * np.pi * 0.7 * t)])
    keep = rng.uniform(size=len(t)) > 0.03
    keep[[0, -1]] = True
    smooth = smoothing.smooth_samples(t[keep], x[keep], CUTOFF_HZ)
    derivative = smoothing.differentiate_samples(t[keep], x[keep])
    whole, whole_derivative = smoothing.smooth_samples(t, x, CUTOFF_HZ), smoothing.differentiate_samples(t, x)
    assert smooth.shape == x[keep].shape
    chord_s = 4 * INTERVAL_S  # the longest bridge here
    sagitta = (2 * np.pi) ** 2 * chord_s**2 / 8
    assert np.abs(smooth - whole[keep]).max() < sagitta
    assert np.abs(derivative - whole_derivative[keep]).max() < sagitta / INTERVAL_S


def test_time_origin_and_units_of_time_do_not_matter(noise: np.ndarray) -> None:
    t = INTERVAL_S * np.arange(len(noise))
    smooth = smoothing.smooth_samples(t, noise, CUTOFF_HZ)
    np.testing.assert_allclose(smoothing.smooth_samples(t + 1e5, noise, CUTOFF_HZ), smooth, atol=1e-6)
    in_ms = smoothing.smooth_samples(1e3 * t, noise, 1e-3 * CUTOFF_HZ, side_s=500.0)
    np.testing.assert_allclose(in_ms, smooth, atol=1e-9)
