"""The walk that white noise makes of its integral: density σ² Δt, whatever moves below and however coarse the rate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import welch

from fieldcal.estimation.by_velocity.walk import walk_density
from fieldcal.estimation.joint.problem import Readings

SD = 0.02
LENGTH_S = 400.0


def readings(t: np.ndarray, segment: np.ndarray, logged: np.ndarray) -> Readings:
    return Readings(t, segment, logged, logged, None, -9.81, np.zeros(3), np.zeros((2, len(t), 3)))


def noisy(rate_hz: float, seed: int, length_s: float = LENGTH_S) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(round(length_s * rate_hz)) / rate_hz
    return t, SD * np.random.default_rng(seed).normal(size=(len(t), 3))


def motion_below(frequency_hz: float, t: np.ndarray, seed: int) -> np.ndarray:
    """Noise (n, 3) of nothing above a frequency, three hundred times the readings' own."""
    spectrum = np.fft.rfft(300.0 * SD * np.random.default_rng(seed).normal(size=(len(t), 3)), axis=0)
    spectrum[np.fft.rfftfreq(len(t), t[1] - t[0]) > frequency_hz] = 0.0
    return np.fft.irfft(spectrum, len(t), axis=0)


@pytest.mark.parametrize("rate_hz", [25.0, 60.0, 200.0])
@pytest.mark.parametrize("moves", [False, True])
def test_of_white_noise_in_closed_form_whatever_moves_below_the_band(rate_hz: float, moves: bool) -> None:
    """25 Hz leaves no room above 10 Hz: there the band is the upper half of what it shows."""
    t, noise = noisy(rate_hz, seed=1)
    moved = noise + (motion_below(6.2, t, seed=2) if moves else 0.0)
    scale = np.array([1.0, 2.0, 3.0])
    found = walk_density(readings(t, np.zeros(len(t), dtype=int), moved), moved, scale)
    assert found == pytest.approx(np.mean(scale**2) * SD**2 / rate_hz, rel=0.12)


def test_noise_above_the_band_is_not_the_walks() -> None:
    """A tone of vibration at 60 Hz, a hundred times the noise."""
    t, noise = noisy(200.0, seed=2)
    shaken = noise + 100.0 * SD * np.sin(2.0 * np.pi * 60.0 * t)[:, None]
    found = walk_density(readings(t, np.zeros(len(t), dtype=int), shaken), shaken, np.ones(3))
    assert found == pytest.approx(SD**2 / 200.0, rel=0.12)


@pytest.mark.parametrize(
    ("rate_hz", "lowest_hz", "highest_hz"),
    [(200.0, 10.0, 40.0), (25.5, 6.375, 12.75), (16.0, 4.0, 8.0)],
    ids=["10 to 40 Hz, both counted", "the upper half", "sixteen readings a second"],
)
def test_half_the_median_over_the_band_of_scipys_spectrum_of_four_seconds(
    rate_hz: float, lowest_hz: float, highest_hz: float
) -> None:
    """A reading that lacks an axis is bridged by its neighbours."""
    t, logged = noisy(rate_hz, seed=7, length_s=60.0)
    logged *= 1.0 + t[:, None]
    logged[100, 1] = np.nan
    scale = np.array([1.0, 2.0, 3.0])
    bridged = logged.copy()
    bridged[100] = 0.5 * (logged[99] + logged[101])
    frequency, density = welch(bridged * scale, rate_hz, nperseg=round(4.0 * rate_hz), axis=0)
    band = (frequency > lowest_hz - 1e-9) & (frequency < highest_hz + 1e-9)
    found = walk_density(readings(t, np.zeros(len(t), dtype=int), logged), logged, scale)
    assert found == pytest.approx(0.5 * np.mean(np.median(density[band], axis=0)), rel=1e-9)


def test_the_longest_stretch_tells_and_gaps_in_it_do_not_matter() -> None:
    t, noise = noisy(100.0, seed=3)
    segment = np.where(t < 50.0, 0, np.where(t < 350.0, 1, 2))
    noise[segment != 1] *= 30.0
    noise[np.random.default_rng(4).random(len(t)) < 0.05] = np.nan
    found = walk_density(readings(t, segment, noise), noise, np.ones(3))
    assert found == pytest.approx(SD**2 / 100.0, rel=0.15)


def test_too_few_readings_tell_nothing_and_one_more_does() -> None:
    t, noise = noisy(100.0, seed=5, length_s=0.16)
    whole = readings(t, np.zeros(16, dtype=int), noise)
    assert walk_density(whole, noise, np.ones(3)) > 0.0
    noise[7] = np.nan
    assert walk_density(whole, noise, np.ones(3)) == 0.0
