"""Random walk of a gyroscope's bias (rate random walk, IEEE 952), from its rate errors against a better attitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import dct

from fieldcal.estimation.segments import true_runs
from fieldcal.geometry.rotation import Array

# Shorter periods are left out: they show the attitude's noise, not the gyroscope's.
SHORTEST_PERIOD_S = 4.0
# So are all but so many of the slowest coefficients of a segment: an attitude that follows a disturbed field makes rate
# errors with periods of tens of seconds; a walk is distinguished from them by being stronger still at longer periods.
COEFFICIENTS = 12
# Variance of the walk over that of white noise, of one step, searched on this grid: walks two per cent apart.
RATIOS = np.r_[0.0, np.geomspace(1e-9, 1e3, 601)]


def bias_walk(rate: ArrayLike, interval_s: ArrayLike, joined: ArrayLike) -> float:
    """Density of the random walk in a rate, by restricted maximum likelihood beside white noise.

    The cosine transform makes both diagonal: with the mean taken out, a walk of variance q²Δt a step has the variance
    q²Δt/(4 sin²(πk/2n)) in the k-th of n coefficients, white noise the same in all of them.

    Parameters
    ----------
    rate : (n, c) array
        Mean rate error of each interval, rad/s; the c axes share one density.
    interval_s : (n,) array
        Length of each interval, s, nearly equal.
    joined : (n,) array of bool
        Intervals inside a contiguous segment; the others separate segments, each of which has its own mean.

    Returns
    -------
    float
        q, rad/s/√s; 0 where white noise alone is at least as likely, or every segment is too short.
    """
    rate, joined = np.asarray(rate, dtype=float), np.asarray(joined, dtype=bool)
    if not joined.any():
        return 0.0
    step = float(np.mean(np.asarray(interval_s, dtype=float)[joined]))
    parts = [_spectrum(rate[a:b], step) for a, b in zip(*true_runs(joined), strict=True)]
    power, gain = (np.concatenate(pieces) for pieces in zip(*parts, strict=True))
    if len(power) < 2 or not power.any():
        return 0.0
    shape = 1.0 + RATIOS[:, None] * gain
    white = np.mean(power / shape, axis=1)
    best = int(np.argmin(np.mean(np.log(shape), axis=1) + np.log(white)))
    return float(np.sqrt(RATIOS[best] * white[best] / step))


def _spectrum(rate: Array, step_s: float) -> tuple[Array, Array]:
    """Mean square over the axes of a segment's slow cosine coefficients, and the same expected of a walk of unit
    steps."""
    n = len(rate)
    k = np.arange(1, 1 + min(n - 1, COEFFICIENTS, int(2.0 * n * step_s / SHORTEST_PERIOD_S)))  # of period 2 n Δt / k
    coefficient = dct(rate, type=2, axis=0, norm="ortho")[k]
    return np.mean(coefficient**2, axis=1), 0.25 / np.sin(0.5 * np.pi * k / n) ** 2
