"""Find the stretches of a log in which the vehicle was turned enough to calibrate on, and say why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation.segments import run_bounds, run_starts
from fieldcal.estimation.statistics import MAD_TO_SIGMA
from fieldcal.geometry.rotation import Array

REST_SHARE = 0.02  # of the sustained level: slower is rest
TURNED_WITHIN_S = 10.0
"""How far a vehicle was turned is judged within so long: a zero of 1°/s that the median leaves makes 10° of it."""
BURST_S = 3.0
"""A log that turns hard for so long and not for `min_s` is judged by that: its rest is no motion."""


@dataclass(frozen=True)
class Segment:
    """Samples [start, stop) of the log; `rate_rms` in logged gyroscope units; `used` and why (not)."""

    start: int
    stop: int
    rate_rms: float
    used: bool
    reason: str


@dataclass(frozen=True)
class Selection:
    """Segments in order, and the numbers that decided: excited time, s; sustained level, threshold and noise of the
    windowed rate."""

    segments: list[Segment]
    excited_s: float
    level: float
    threshold: float
    noise: float


def contiguous(t: ArrayLike, max_gap_s: float) -> list[tuple[int, int]]:
    """Index ranges [start, stop) of stamps t (n,) without a pause longer than `max_gap_s` or a backward step."""
    dt = np.diff(np.asarray(t, dtype=float))
    breaks = np.flatnonzero((dt > max_gap_s) | (dt <= 0)) + 1
    edges = np.r_[0, breaks, len(dt) + 1]
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def windowed_rate(t: ArrayLike, rate: ArrayLike, window_s: float, smooth_s: float = 0.1) -> tuple[Array, float]:
    """Rotation about each sample, (n,): rms over `window_s` of the rate's length less its median, after a short
    running mean; and the same for the sensor's noise alone (from sample-to-sample differences)."""
    t, rate = np.asarray(t, dtype=float), np.asarray(rate, dtype=float)
    interval = float(np.median(np.diff(t)))
    centred = rate - np.median(rate, axis=0)
    short = max(1, round(smooth_s / interval))
    differences = np.diff(rate, axis=0)
    sigma = MAD_TO_SIGMA * np.median(np.abs(differences - np.median(differences, axis=0)), axis=0) / np.sqrt(2.0)
    noise = float(np.sqrt(np.sum(sigma**2) / short))
    smoothed = _running_mean(centred, short)
    power = _running_mean(np.sum(smoothed**2, axis=1, keepdims=True), max(1, round(window_s / interval)))[:, 0]
    return np.sqrt(np.maximum(power, 0.0)), noise


def turned_within(t: ArrayLike, rate: ArrayLike, window_s: float = TURNED_WITHIN_S, max_gap_s: float = 0.1) -> Array:
    """By how much a vehicle was turned about each of its axes, to and fro, within `window_s` at most.

    Parameters
    ----------
    t : (n,) array
        Stamps, s.
    rate : (n, 3) array
        rad/s; its median counts as zero.
    max_gap_s : float
        Over longer pauses nothing is integrated.

    Returns
    -------
    (3,) array
        rad: the largest range of the integrated rate among windows that begin every half of `window_s`.
    """
    t, rate = np.asarray(t, dtype=float), np.asarray(rate, dtype=float)
    dt = np.diff(t, prepend=t[:1])
    dt = np.where((dt > 0.0) & (dt <= max_gap_s), dt, 0.0)
    angle = np.cumsum((rate - np.median(rate, axis=0)) * dt[:, None], axis=0)
    half = ((t - t[0]) / (0.5 * window_s)).astype(np.int64)
    starts = run_starts(half)
    low, high = np.minimum.reduceat(angle, starts), np.maximum.reduceat(angle, starts)
    beside = np.diff(half[starts]) == 1
    both = np.maximum(high[1:], high[:-1])[beside] - np.minimum(low[1:], low[:-1])[beside]
    return np.asarray(np.max(np.concatenate([high - low, both]), axis=0))


def _running_mean(x: Array, width: int) -> Array:
    """Centred running mean over `width` samples, shorter at the ends."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    index = np.arange(len(x))
    low = np.maximum(index - width // 2, 0)
    high = np.minimum(index + (width + 1) // 2, len(x))
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def select(
    t: ArrayLike,
    rate: ArrayLike | None,
    *,
    window_s: float = 2.0,
    pad_s: float = 5.0,
    rest_s: float = 60.0,
    min_s: float = 10.0,
    max_gap_s: float = 0.1,
    excited_ratio: float = 0.15,
) -> Selection:
    """Split a log of any length into used and unused stretches.

    A sample is excited when the rotation in the window around it exceeds `excited_ratio` of the level that the log
    sustains for `min_s` (for `BURST_S`, where that is so much stronger), and four times what the sensor's noise alone
    would show. Excited samples are padded by `pad_s` on either side, and by up to `rest_s` of rest: there the attitude
    is best known, which anchors the integrated gyroscope. Segments are cut where samples pause for more than
    `max_gap_s`.

    Parameters
    ----------
    t : (n,) array
        Stamps, s.
    rate : (n, 3) array or None
        Gyroscope as logged, any unit; without one everything contiguous is used.

    Notes
    -----
    The threshold is relative: the units of counts are unknown here. `excited_s` tells the caller whether it is enough.
    """
    t = np.asarray(t, dtype=float)
    stretches = contiguous(t, max_gap_s)
    if rate is None:
        whole = [
            Segment(a, b, float("nan"), b - a >= 10, "no gyroscope: all of it" if b - a >= 10 else "too short")
            for a, b in stretches
        ]
        return Selection(whole, float(sum(t[s.stop - 1] - t[s.start] for s in whole)), *(float("nan"),) * 3)
    rate = np.asarray(rate, dtype=float)
    level_of, noise = windowed_rate(t, rate, window_s)
    interval = float(np.median(np.diff(t)))
    level, burst = (_sustained(level_of, round(seconds / interval)) for seconds in (min_s, min(BURST_S, min_s)))
    if level < excited_ratio * burst:
        level = burst
    threshold = max(excited_ratio * level, 4.0 * noise)
    excited = level_of > threshold
    # Rest that the sensor's own noise hides is of no use: integrating it only adds the noise.
    moving = level_of > REST_SHARE * level
    segments: list[Segment] = []
    excited_s = 0.0
    for a, b in stretches:
        if b - a < 10:
            segments.append(Segment(a, b, float("nan"), False, "shorter than ten samples"))
            continue
        excited_s += interval * float(excited[a:b].sum())
        used = _near(t[a:b], excited[a:b], pad_s) | (_near(t[a:b], excited[a:b], rest_s) & ~moving[a:b])
        segments += _cut(level_of, used, a, b, threshold)
    return Selection(segments, excited_s, level, threshold, noise)


def _sustained(level: Array, samples: int) -> float:
    """What level (n,) is exceeded in so many samples; in all, where there are fewer."""
    place = len(level) - min(len(level), max(1, samples))
    return float(np.partition(level, place)[place])


def _near(t: Array, mark: np.ndarray, distance_s: float) -> np.ndarray:
    """Which stamps t (n,) lie within `distance_s` of a marked one, (n,) bool."""
    change = np.zeros(len(t) + 1, dtype=np.int64)
    where = t[mark]
    np.add.at(change, np.searchsorted(t, where - distance_s), 1)
    np.add.at(change, np.searchsorted(t, where + distance_s, side="right"), -1)
    return np.asarray(np.cumsum(change[:-1]) > 0)


def _cut(level: Array, used: np.ndarray, a: int, b: int, threshold: float) -> list[Segment]:
    """One contiguous stretch [a, b) as alternating used and unused segments; `used` (b − a,) bool."""
    out = []
    for low, high in run_bounds(used):
        rms = float(np.sqrt(np.mean(level[a + low : a + high] ** 2)))
        keep = bool(used[low]) and high - low >= 10
        why = "rotating, or at rest beside it" if keep else f"quiet: rotation below {threshold:.3g}"
        if used[low] and not keep:
            why = "shorter than ten samples"
        out.append(Segment(a + low, a + high, rms, keep, why))
    return out
