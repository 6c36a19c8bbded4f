"""Noise that smoothing leaves in a regressor: what attenuates an equation-error slope."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.smoothing import fill, lattice, low_pass_weights
from fieldcal.geometry.rotation import Array

BLOCK_S = 1.0
BAND = (2.0, 4.0)
"""Where only noise is expected, in units of the smoother's cut-off …"""
HIGHEST = 0.8
"""… and of Nyquist's frequency; a converter's own filter rolls off above it."""
LEAST_BINS = 3


def smoothed_noise_variance(
    t: ArrayLike, logged: ArrayLike, segment: ArrayLike, cutoff_hz: float, *, side_s: float = 0.5
) -> Array:
    """Variance (m,) of the noise of readings (n, m) that the fixed-weight low-pass lets through, logged units².

    White noise of density S, one-sided, leaves ½ S f_s Σh² behind weights h. S is read off one to two octaves above the
    cut-off, where the motion has ended: the median over frequency of the mean periodogram of 1 s blocks (Hann), so
    that a motor's line does not count. 0 where smoothing is off or the sampling leaves no such band.

    Parameters
    ----------
    t : (n,) array
        Stamps, s.
    segment : (n,) array
        Number of the contiguous stretch that a sample belongs to.
    cutoff_hz, side_s : float
        Of the smoothing (`smoothing.low_pass`).
    """
    stamps, x, label = np.asarray(t, dtype=float), np.asarray(logged, dtype=float), np.asarray(segment)
    none = np.zeros(x.shape[1])
    power, blocks = none, 0
    interval = float(np.median(np.diff(stamps)))
    length = round(BLOCK_S / interval)
    low, high = BAND[0] * cutoff_hz, min(BAND[1] * cutoff_hz, 0.5 * HIGHEST / interval)
    if cutoff_hz <= 0.0 or not length:
        return none
    frequency = np.fft.rfftfreq(length, interval)
    band = (frequency >= low) & (frequency <= high)
    if band.sum() < LEAST_BINS:
        return none
    window = np.hanning(length + 1)[:-1, None]
    for a, b in run_bounds(label):
        if b - a < length:
            continue
        even = fill(lattice(stamps[a:b])[0], x[a:b])
        n = len(even) // length
        cut = even[: n * length].reshape(n, length, -1)
        spectrum = np.fft.rfft((cut - cut.mean(axis=1, keepdims=True)) * window, axis=1)
        power = power + np.sum(np.abs(spectrum[:, band]) ** 2, axis=0)
        blocks += n
    if blocks == 0:
        return none
    white = np.median(power, axis=0) / blocks / np.sum(window**2)  # ½ S f_s
    side = max(1, round(side_s / interval))
    return np.asarray(white * np.sum(low_pass_weights(cutoff_hz, interval, side) ** 2))
