"""Zeros against temperature within one flight, from the windows in which the IMU was at rest.

At rest the rate is 0, so a gyroscope's mean reading of a window is the zero at the window's temperature: no scale, no
attitude and no other sensor come in. While the IMU warms up these means draw a curve. An accelerometer at rest reads
gravity, so only while it lies as it lay does its reading move with temperature alone: by its zero, and by its scale as
far as gravity is along the axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.motion_selection import contiguous
from fieldcal.estimation.robust import reweighted_rounds
from fieldcal.estimation.statistics import (
    huber_inflation,
    least_squares_covariance,
    white_noise_sigma,
)
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

WINDOW_S = 2.0
BLOCK_S = 0.1
REST_RATIO = 3.0
"""At rest the block means of a window scatter by less than so many times what the sensor's noise gives them."""
LEAST_WINDOWS = 8
LEAST_SPAN_DEGC = 3.0
CUBIC_WINDOWS = 16
SCALE_PER_DEGC_SD = 2e-4
"""Usual relative slope of an accelerometer's scale: what gravity along an axis can add to the slope of its zero."""
ITERATIONS = 20


@dataclass(frozen=True)
class WarmUp:
    """`zero_per_degc`, `sd` (3,) in logged units per °C; `zero` (3,) at `temperature_degc`, their mean; windows used
    and the temperatures they span.

    `bend` (3, 3), an axis a row: coefficients of x, x² and x³, x = (T − temperature_degc)/`width_degc`, with covariance
    (3, 3, 3) by axis; None where the windows are too few for a cubic.
    """

    zero_per_degc: Array
    sd: Array
    zero: Array
    temperature_degc: float
    n_windows: int
    span_degc: float
    width_degc: float
    bend: Array | None
    bend_covariance: Array | None


def rest_windows(t: ArrayLike, logged: ArrayLike, *, max_gap_s: float = 0.1) -> tuple[Array, Array]:
    """(middle of each window at rest (m,), s; mean reading (m, k)) of readings (n, k) at stamps t (n,), s.

    Windows are cut from stretches without a gap. One is at rest when the means of its 0.1 s blocks scatter about the
    window's own straight line, in every column, by less than three times the sensor's white noise: a zero that drifts
    is no motion.
    """
    t, logged = np.asarray(t, dtype=float), np.asarray(logged, dtype=float)
    interval = float(np.median(np.diff(t)))
    block = max(1, round(BLOCK_S / interval))
    blocks = max(2, round(WINDOW_S / (block * interval)))
    size = block * blocks
    ramp = np.arange(blocks) - 0.5 * (blocks - 1)
    noise = white_noise_sigma(logged) / np.sqrt(block)
    middles, means = [], []
    for a, b in contiguous(t, max_gap_s):
        n = (b - a) // size
        if n == 0:
            continue
        part = logged[a : a + n * size].reshape(n, blocks, block, -1).mean(axis=2)
        mean = part.mean(axis=1)
        off = part - mean[:, None]
        off -= ramp[:, None] * (np.einsum("b,wbi->wi", ramp, off) / (ramp @ ramp))[:, None]
        scatter = np.sqrt(np.mean(off**2, axis=1))
        rest = (scatter <= REST_RATIO * np.maximum(noise, 1e-12 * np.abs(mean))).all(axis=1)
        middles.append(t[a : a + n * size].reshape(n, size).mean(axis=1)[rest])
        means.append(mean[rest])
    if not middles:
        return np.empty(0), np.empty((0, logged.shape[1]))
    return np.concatenate(middles), np.concatenate(means)


def fit_warm_up(t: ArrayLike, logged: ArrayLike, temperature_degc: ArrayLike, *, max_gap_s: float = 0.1) -> WarmUp:
    """Slope of the gyroscope's zero on temperature from one flight's windows at rest.

    Straight line, and a cubic beside it, by Huber weights (a window of slow, steady turning is an outlier), their
    covariance from the coloured residuals.
    What changes with time as the IMU warms up, gradients inside it for instance, is in the slope: a flight that warms
    up quickly need not agree with flights at different temperatures.

    Parameters
    ----------
    t : (n,) array
        Stamps, s.
    logged : (n, 3) array
        Readings, any unit.
    temperature_degc : (n,) array
        Temperature of the IMU at the stamps.

    Raises
    ------
    UnusableFlight
        `too_little_rest`: fewer than 8 windows; `temperature_steady`: they span less than 3 °C.
    """
    stamps = np.asarray(t, dtype=float)
    middles, means = rest_windows(stamps, logged, max_gap_s=max_gap_s)
    if len(middles) < LEAST_WINDOWS:
        raise UnusableFlight(
            ReasonCode.TOO_LITTLE_REST,
            f"{len(middles)} windows of {WINDOW_S:g} s at rest; {LEAST_WINDOWS} are needed for a slope on temperature.",
            {"rest_windows": len(middles)},
        )
    warm = np.interp(middles, stamps, np.asarray(temperature_degc, dtype=float))
    span = float(np.ptp(warm))
    if span < LEAST_SPAN_DEGC:
        raise UnusableFlight(
            ReasonCode.TEMPERATURE_STEADY,
            f"The temperature moved by {span:.1f} °C at rest; {LEAST_SPAN_DEGC:g} °C are needed for a slope.",
            {"rest_windows": len(middles), "span_degc": span},
        )
    centre = float(warm.mean())
    x = np.column_stack([np.ones(len(warm)), warm - centre])
    slope, sd, zero = np.empty(3), np.empty(3), np.empty(3)
    for axis in range(3):
        beta, covariance = _robust(x, means[:, axis])
        zero[axis], slope[axis], sd[axis] = beta[0], beta[1], np.sqrt(covariance[1, 1])
    width = float(np.abs(x[:, 1]).max())
    if len(middles) < CUBIC_WINDOWS:
        return WarmUp(slope, sd, zero, centre, len(middles), span, width, None, None)
    powers = np.vander(x[:, 1] / width, 4, increasing=True)
    bends = [_robust(powers, means[:, axis]) for axis in range(3)]
    bend, bend_covariance = np.stack([b[1:] for b, _ in bends]), np.stack([v[1:, 1:] for _, v in bends])
    return WarmUp(slope, sd, zero, centre, len(middles), span, width, bend, bend_covariance)


def fit_resting_accelerometer(
    t: ArrayLike,
    rate_logged: ArrayLike,
    acceleration_logged: ArrayLike,
    temperature_degc: ArrayLike,
    gravity_logged: ArrayLike,
    *,
    max_gap_s: float = 0.1,
) -> WarmUp:
    """Slope of the accelerometer's zero on temperature from the longest stretch in which nothing moved.

    What it cannot see: the slope of the scale, which moves the reading as far as gravity is along the axis (the usual
    size of it is in the sd, so an axis along gravity says little), and the IMU settling: 0.01° of tilt is 2 mm/s².

    Parameters
    ----------
    t, rate_logged, temperature_degc
        As `fit_warm_up`.
    acceleration_logged : (n, 3) array
        Readings, any unit.
    gravity_logged : (n, 3) array
        The part of them that is gravity: readings less the zero.

    Raises
    ------
    UnusableFlight
        `too_little_rest`, `temperature_steady`, as `fit_warm_up`, of the one stretch.
    """
    stamps, acceleration = np.asarray(t, dtype=float), np.asarray(acceleration_logged, dtype=float)
    both = np.hstack([np.asarray(rate_logged, dtype=float), acceleration, np.asarray(gravity_logged, dtype=float)])
    middles, means = rest_windows(stamps, both, max_gap_s=max_gap_s)
    run = _longest_run(middles)
    middles, means = middles[run], means[run]
    warm = np.interp(middles, stamps, np.asarray(temperature_degc, dtype=float))
    span = float(np.ptp(warm)) if len(warm) else 0.0
    if len(middles) < LEAST_WINDOWS or span < LEAST_SPAN_DEGC:
        code = ReasonCode.TOO_LITTLE_REST if len(middles) < LEAST_WINDOWS else ReasonCode.TEMPERATURE_STEADY
        raise UnusableFlight(
            code,
            f"The longest rest has {len(middles)} windows and {span:.1f} °C; {LEAST_WINDOWS} and {LEAST_SPAN_DEGC:g} °C"
            " are needed for a slope.",
            {"rest_windows": len(middles), "span_degc": span},
        )
    centre = float(warm.mean())
    x = np.column_stack([np.ones(len(warm)), warm - centre])
    fits = [_robust(x, means[:, 3 + axis]) for axis in range(3)]
    zero, slope = np.stack([beta for beta, _ in fits]).T
    variance = np.array([covariance[1, 1] for _, covariance in fits])
    sd = np.sqrt(variance + (SCALE_PER_DEGC_SD * means[:, 6:].mean(axis=0)) ** 2)
    return WarmUp(slope, sd, zero, centre, len(middles), span, float(np.abs(x[:, 1]).max()), None, None)


def _longest_run(middles: Array) -> slice:
    """Windows that follow one another without a pause."""
    if not len(middles):
        return slice(0, 0)
    ends = np.flatnonzero(np.r_[np.diff(middles) > 1.5 * WINDOW_S, True]) + 1
    starts = np.r_[0, ends[:-1]]
    longest = int(np.argmax(ends - starts))
    return slice(int(starts[longest]), int(ends[longest]))


def _robust(x: Array, y: Array) -> tuple[Array, Array]:
    """Huber's regression and its covariance."""

    def solve(weight: Array) -> tuple[tuple[Array, Array], Array]:
        root = np.sqrt(weight)
        beta = np.linalg.lstsq(x * root[:, None], y * root, rcond=None)[0]
        residual = y - x @ beta
        return (beta, residual), residual

    beta: Array = np.zeros(x.shape[1])
    for last in islice(reweighted_rounds(solve, len(y)), ITERATIONS):
        new = last[0][0]
        if np.allclose(new, beta, rtol=1e-12, atol=0.0):
            break
        beta = new
    (_, residual), weight = last
    root = np.sqrt(weight)[:, None]
    _, covariance = least_squares_covariance((x * root)[:, None, :], residual[:, None] * root)
    return beta, huber_inflation(weight) * covariance
