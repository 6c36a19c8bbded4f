"""Synchronise the VPS with the IMU: clock offset, clock drift and the two constant rotations between their frames.

Coarse: masked, normalised cross-correlation of rotation-rate norms (no frame alignment needed), parabolic peak.
Fine: Gauss–Newton on the vector rates, ω_imu(t) ≈ M ω_vps(t) + c with the VPS stamps stretched and moved; the free
3×3 M takes up any constant rotation and any calibration the gyroscope still lacks, so neither can move the lag.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.robust import reweighted
from fieldcal.estimation.smoothing import differentiate, low_pass
from fieldcal.estimation.statistics import least_squares_covariance, robust_sigma
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import (
    IDENTITY,
    Array,
    body_rate,
    conjugate,
    continuous,
    from_rotation_vector,
    mean_quaternion,
    multiply,
    normalise,
    slerp,
    to_rotation_vector,
)
from fieldcal.reason_codes import ReasonCode

# Low-pass of the rates, its length on either side, and the rate that is enough after it: it falls to nothing at
# f_c + π/side, 14 Hz.
FINE_CUTOFF_HZ, FINE_SIDE_S, FINE_RATE_HZ = 8.0, 0.5, 50.0
# The lag anew from slower motion alone: a VPS that smooths, or whose error goes with the motion, is not late by one
# time at all frequencies. Length of that low-pass on either side, the rate that is enough after it, fewest rows.
SLOWER_CUTOFF_HZ, SLOWER_SIDE_S, SLOWER_RATE_HZ, FEWEST_SLOWER = 2.0, 1.5, 40.0, 200
REGRESSION_ROUNDS = 3  # of reweighting, at each step of the clock
STEADY_S = 1.0  # over which the residual's size is taken for the same
LARGEST_GRID_PER_SAMPLE, SHORT_GRID = 50, 100_000  # of the grids that one clock alone lies on
# Chance peaks of unrelated motions reach 0.9 in the coarse correlation; the vector fit tells them apart.
MOST_GRID_PER_SAMPLE = 20  # a grid over hours of which minutes were recorded fills the memory with gaps
MIN_EXPLAINED, MAX_SKEW_PPM, MAX_LAG_SD_S = 0.6, 2000.0, 0.01
SURELY_EXPLAINED = 0.97  # share from which an impossible clock, not another motion, is what differs
FASTEST_RADPS2 = 40.0  # angular acceleration that may bend the way over a pose
LEAST_OVERLAP_S = 5.0  # of both records at a lag that is looked at, or half of the shorter one
SLOW_POSE_S = 0.0125  # poses further apart are interpolated by a cubic: the turn between them is not steady


@dataclass(frozen=True)
class UniformRates:
    """Rates on a uniform grid starting at `start_s` with `interval_s`: `rate` (n, 3), rad/s or logged units; `valid`
    (n,)."""

    start_s: float
    interval_s: float
    rate: Array
    valid: np.ndarray

    @property
    def t(self) -> Array:
        """Grid times, s."""
        return self.start_s + self.interval_s * np.arange(len(self.rate))


@dataclass(frozen=True)
class SyncFit:
    """VPS clock + lag = IMU clock: `lag_mid_s` at mid-record, IMU time `reference_s`; `skew_ppm` > 0: VPS clock fast;
    `covariance` (2, 2) of the lag at mid-record, s, and the skew (a ratio), of noise alone; `spread` (2,) half of what
    both differ from those by slower motion beyond chance, as an sd; `first_s` the first IMU sample.

    `explained` is the share of the rates' variance that the VPS accounts for; `peak` and `runner_up` are
    correlations (the second: best one outside the peak); `matrix` (3, 3) maps VPS body rates to logged rates, whose
    covariance over the record is `turning` (3, 3), (rad/s)²."""

    lag_mid_s: float
    skew_ppm: float
    covariance: Array
    peak: float
    runner_up: float
    peak_width_s: float
    explained: float
    matrix: Array
    reference_s: float
    first_s: float
    turning: Array
    spread: Array = field(default_factory=lambda: np.zeros(2))

    @property
    def lag_s(self) -> float:
        """Lag at the first IMU sample, s."""
        return self.lag_mid_s + 1e-6 * self.skew_ppm * (self.reference_s - self.first_s)

    @property
    def lag_sd_s(self) -> float:
        """Standard deviation of the lag at mid-record, s."""
        return float(np.hypot(np.sqrt(self.covariance[0, 0]), self.spread[0]))

    @property
    def skew_sd_ppm(self) -> float:
        """Standard deviation of the skew, ppm."""
        return float(1e6 * np.hypot(np.sqrt(self.covariance[1, 1]), self.spread[1]))

    def to_vps_clock(self, t_imu: ArrayLike) -> Array:
        """IMU stamps, s, on the VPS's clock."""
        t = np.asarray(t_imu, dtype=float)
        return (t - self.reference_s) * (1 + 1e-6 * self.skew_ppm) + self.reference_s - self.lag_mid_s

    def to_imu_clock(self, t_vps: ArrayLike) -> Array:
        """VPS stamps, s, on the IMU clock."""
        t = np.asarray(t_vps, dtype=float)
        # t_vps = (t_imu − ref)(1 + skew) + ref − lag_mid
        return (t + self.lag_mid_s - self.reference_s) / (1 + 1e-6 * self.skew_ppm) + self.reference_s


def mask_outliers(t: ArrayLike, q: ArrayLike, *, max_rate: float = 40.0) -> np.ndarray:
    """Which VPS attitudes (n, 4) at stamps t to keep, (n,) bool: finite, unit, near their neighbours.

    A sample is an outlier when the shortest path over it (before → it → after) is longer than the direct one by more
    than the motion explains (robust threshold; 40 rad/s² of acceleration), or implies more than `max_rate` rad/s."""
    t, q = np.asarray(t, dtype=float), np.asarray(q, dtype=float)
    keep = np.abs(np.linalg.norm(q, axis=1) - 1.0) < 0.05  # not where one is NaN or infinite
    keep &= np.r_[True, np.diff(t) > 0]
    for _ in range(3):
        i = np.flatnonzero(keep)
        if len(i) < 5:
            return keep
        middle = _deviation(q[i[:-2]], q[i[1:-1]], q[i[2:]], t[i])
        # Between slow poses, or beside a gap, the way is no line where the vehicle speeds up.
        curved = 0.5 * FASTEST_RADPS2 * (t[i[1:-1]] - t[i[:-2]]) * (t[i[2:]] - t[i[1:-1]])
        limit = np.maximum(max(10.0 * robust_sigma(middle), 2e-3), curved)
        bad = np.zeros(len(i), dtype=bool)
        bad[1:-1] = middle > limit
        step = np.linalg.norm(to_rotation_vector(multiply(conjugate(q[i[:-1]]), q[i[1:]])), axis=1)
        fast = step > max_rate * np.maximum(np.diff(t[i]), 1e-4) + 2e-3
        bad[1:-1] |= fast[:-1] & fast[1:]
        # Of neighbouring suspects only the worst goes at a time: a single outlier also spoils the two beside it.
        score = np.r_[0.0, middle, 0.0]
        # The first and last are seen only by their neighbours: one that is off while the next but one is not.
        for end, beside, beyond in ((0, 1, 2), (-1, -2, -3)):
            if bad[beside] and not bad[beyond]:
                bad[end], score[end] = True, np.inf  # which is worse than what is beside it
        worst = bad & (score >= np.r_[0.0, score[:-1]]) & (score >= np.r_[score[1:], 0.0])
        if not worst.any():
            break
        keep[i[worst]] = False
    return keep


def _deviation(before: Array, it: Array, after: Array, t: Array) -> Array:
    """Angle between each attitude and the one interpolated between its neighbours, rad."""
    share = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None]
    step = to_rotation_vector(multiply(conjugate(before), after))
    predicted = multiply(before, from_rotation_vector(share * step))
    return np.asarray(np.linalg.norm(to_rotation_vector(multiply(conjugate(predicted), it)), axis=1))


def vps_rates(t: ArrayLike, q: ArrayLike, interval_s: float, *, max_gap_s: float = 0.05) -> UniformRates:
    """Body rates from VPS attitudes (n, 4) at stamps t (n,), on a uniform grid; gaps are masked, never crossed.

    SLERP to the grid, local smoothed differentiation, ω = 2Ξᵀq̇. Raises UnusableFlight (`gaps`) as `_grid`."""
    t, q = np.asarray(t, dtype=float), continuous(q)
    grid = _grid(t, interval_s)
    on_grid = slerp(t, q, grid) if np.median(np.diff(t)) <= SLOW_POSE_S else cubic(t, q, grid)
    i = interval_of(t, grid)
    valid = (t[i + 1] - t[i]) <= max_gap_s
    # The derivative at a place uses its neighbours: grow the gaps by the window.
    spoiled = np.convolve(~valid, np.ones(9), mode="same") > 0
    rate = body_rate(on_grid, differentiate(on_grid, interval_s))
    return UniformRates(float(t[0]), interval_s, rate, ~spoiled)


def _grid(t: Array, interval_s: float) -> Array:
    """Even times from the first of the stamps t to the last.

    Raises
    ------
    UnusableFlight
        `gaps`: far more of them than stamps; a grid over years of which seconds were recorded fills the memory.
    """
    span_s = float(t[-1] - t[0])
    if span_s > interval_s * LARGEST_GRID_PER_SAMPLE * max(len(t), SHORT_GRID):
        raise UnusableFlight(
            ReasonCode.GAPS,
            f"The stamps span {span_s:.0f} s, of which little was recorded: the pauses are too long for even steps of "
            f"{interval_s:g} s. Split the log there.",
            {"span_s": span_s},
        )
    return np.asarray(t[0] + interval_s * np.arange(int(span_s / interval_s)))


def cubic(t: Array, q: Array, at: Array) -> Array:
    """Attitudes (m, 4) at times `at` by a cubic spline through q (n, 4) at t (n,), hemisphere continuous."""
    from scipy.interpolate import CubicSpline

    return normalise(CubicSpline(t, q)(at))


def imu_rates(t: ArrayLike, rate: ArrayLike, interval_s: float, *, max_gap_s: float = 0.1) -> UniformRates:
    """IMU rates (n, 3) at stamps t (n,) on a uniform grid, linear in between; gaps masked."""
    t, rate = np.asarray(t, dtype=float), np.asarray(rate, dtype=float)
    grid = _grid(t, interval_s)
    i = interval_of(t, grid)
    valid = (t[i + 1] - t[i]) <= max_gap_s
    on_grid = np.stack([np.interp(grid, t, column) for column in rate.T], axis=1)
    return UniformRates(float(t[0]), interval_s, on_grid, valid)


def correlate(
    imu: UniformRates, vps: UniformRates, max_lag_s: float, *, min_overlap_s: float = LEAST_OVERLAP_S
) -> tuple[float, float, float, float]:
    """Coarse lag by masked, normalised FFT cross-correlation of rate norms: (lag_s, peak, runner_up, width_s).

    At each lag only samples valid in both count, and means and norms are taken over those (Padfield 2012)."""
    a, b = np.linalg.norm(imu.rate, axis=1), np.linalg.norm(vps.rate, axis=1)
    ma, mb = imu.valid.astype(float), vps.valid.astype(float)
    a, b = (a - a[imu.valid].mean()) * ma, (b - b[vps.valid].mean()) * mb
    size = fft.next_fast_len(len(a) + len(b), real=True)

    def cross(x: Array, y: Array) -> Array:
        return np.asarray(fft.irfft(fft.rfft(x, size) * np.conj(fft.rfft(y, size)), size))

    overlap = np.maximum(cross(ma, mb), 1e-9)
    sum_a, sum_b = cross(a, mb), cross(ma, b)
    variance = (cross(a * a, mb) - sum_a**2 / overlap) * (cross(ma, b * b) - sum_b**2 / overlap)
    enough = overlap > min(min_overlap_s / imu.interval_s, 0.5 * min(ma.sum(), mb.sum()))
    floor = max(1e-6 * float(np.sum(a * a)) * float(np.sum(b * b)), 1e-300)
    r = np.where(
        enough & (variance > floor), (cross(a, b) - sum_a * sum_b / overlap) / np.sqrt(np.maximum(variance, floor)), 0.0
    )
    shift = np.arange(size)
    shift = np.where(shift < len(a), shift, shift - size)  # the VPS's first sample at one of the IMU's, or before all
    lag = imu.start_s - vps.start_s + shift * imu.interval_s
    r[np.abs(lag) > max_lag_s] = -1.0
    order = np.argsort(lag)
    r, lag = r[order], lag[order]
    k = int(np.argmax(r))
    # Neighbourhood of the peak: down to half its height on either side.
    low = k - int(np.argmax(r[k::-1] < 0.5 * r[k]))
    high = k + int(np.argmax(r[k:] < 0.5 * r[k]))
    away = np.ones(len(r), dtype=bool)
    away[low : high + 1] = False
    runner_up = float(r[away].max())  # lags without overlap, at either end, are away
    offset = 0.0
    if 0 < k < len(r) - 1:
        left, mid, right = r[k - 1], r[k], r[k + 1]
        offset = 0.5 * (left - right) / (left - 2 * mid + right)  # left < mid: the first of the highest is taken
    return float(lag[k] + offset * imu.interval_s), float(r[k]), runner_up, float((high - low) * imu.interval_s)


def synchronise(
    t_imu: ArrayLike,
    rate_imu: ArrayLike,
    t_vps: ArrayLike,
    q_vps: ArrayLike,
    *,
    max_lag_s: float = 60.0,
    min_peak: float = 0.5,
    max_gap_s: float = 0.05,
    min_overlap_s: float = LEAST_OVERLAP_S,
) -> SyncFit:
    """Lag and drift of the VPS clock against the IMU's.

    Parameters
    ----------
    t_imu, rate_imu : (n,), (n, 3) arrays
        IMU stamps, s, and gyroscope readings, any axes; calibrated or, if need be, logged units less their median.
    t_vps, q_vps : (m,), (m, 4) arrays
        VPS stamps, s, on the VPS clock, and attitudes, outliers already removed (`mask_outliers`).

    Raises
    ------
    UnusableFlight
        `vps_too_short`, `gaps` (hours of pauses for minutes of samples),
        `flat_peak` (peak below `min_peak`), `ambiguous_peak` (runner-up within 2 % of the peak),
        `clock_rates_differ`, `not_the_same_motion` (the vector fit fails at the best lag); `measured` has the numbers.
        `flat_peak` also where the lag stays uncertain.

    Notes
    -----
    The lag contains the difference of the two sensors' group delays. Both sides get the same zero-phase low-pass.
    Half of what the lag by slower motion differs from it, beyond chance, is in its sd.
    """
    imu, vps = on_one_grid(t_imu, rate_imu, t_vps, q_vps, max_gap_s=max_gap_s)
    lag, peak, runner_up, width = correlate(imu, vps, max_lag_s, min_overlap_s=min_overlap_s)
    measured = {"peak": peak, "runner_up": runner_up, "peak_width_s": width, "coarse_lag_s": lag}
    if peak < min_peak:
        where = f"within vps_max_lag_s = {max_lag_s:g} s" if np.isfinite(max_lag_s) else "at any lag"
        raise UnusableFlight(
            ReasonCode.FLAT_PEAK,
            f"IMU and VPS do not match {where}: their best correlation is {peak:.2f}, below {min_peak:.2f}.",
            measured,
        )
    if runner_up > 0.98 * peak:
        raise UnusableFlight(
            ReasonCode.AMBIGUOUS_PEAK,
            f"Two lags fit about equally well (correlations {peak:.3f} and {runner_up:.3f}): add an unrepeated motion.",
            measured,
        )
    return refined(imu, vps, lag, 0.0, np.asarray(t_imu, dtype=float), measured)


def on_one_grid(
    t_imu: ArrayLike, rate_imu: ArrayLike, t_vps: ArrayLike, q_vps: ArrayLike, *, max_gap_s: float
) -> tuple[UniformRates, UniformRates]:
    """Rates of IMU and VPS at the IMU's interval, each on its own clock, low-passed alike. Arguments and errors as
    `synchronise` has them."""
    t_imu, t_vps = np.asarray(t_imu, dtype=float), np.asarray(t_vps, dtype=float)
    if len(t_vps) < 50 or t_vps[-1] - t_vps[0] < 2.0 or len(t_imu) < 50:
        raise UnusableFlight(
            ReasonCode.VPS_TOO_SHORT, "The VPS or IMU record is too short to synchronise.", {"n_vps": len(t_vps)}
        )
    interval = float(max(np.median(np.diff(t_imu)), 1e-3))
    longest = float(max(t_imu[-1] - t_imu[0], t_vps[-1] - t_vps[0]))
    if longest > MOST_GRID_PER_SAMPLE * interval * (len(t_imu) + len(t_vps)):
        raise UnusableFlight(
            ReasonCode.GAPS,
            f"The stamps span {longest:.0f} s, of which little was recorded: the pauses are too long to synchronise "
            "across. Split the log there.",
            {"span_s": longest},
        )
    imu = imu_rates(t_imu, rate_imu, interval)
    vps = vps_rates(t_vps, q_vps, interval, max_gap_s=max_gap_s)
    imu, vps = _smoothed(imu), _smoothed(vps)
    if not vps.valid.any():
        raise UnusableFlight(
            ReasonCode.VPS_TOO_SHORT,
            f"The VPS has no stretch without gaps longer than vps_max_gap_s = {max_gap_s:g} s. Raise it if its poses"
            " come more slowly.",
            {"n_vps": len(t_vps)},
        )
    return imu, vps


def refined(
    imu: UniformRates, vps: UniformRates, lag_s: float, skew: float, t_imu: Array, measured: dict[str, float]
) -> SyncFit:
    """The clock by the vector rates from lag, s at mid-record, and skew (a ratio) nearby; judged. Adds to `measured`.

    Raises UnusableFlight with `clock_rates_differ`, `not_the_same_motion`, `flat_peak`."""
    middle = 0.5 * float(t_imu[0] + t_imu[-1])
    fit = _refine(_thinned(imu, FINE_RATE_HZ), vps, lag_s, float(t_imu[0]), middle, measured, skew=skew)
    measured |= {"explained": fit.explained, "skew_ppm": fit.skew_ppm, "lag_sd_s": fit.lag_sd_s}
    if fit.explained >= SURELY_EXPLAINED and abs(fit.skew_ppm) > MAX_SKEW_PPM and fit.lag_sd_s <= MAX_LAG_SD_S:
        raise UnusableFlight(
            ReasonCode.CLOCK_RATES_DIFFER,
            f"The IMU and the VPS show the same motion ({100 * fit.explained:.0f} % of the variance) on clocks whose"
            f" rates differ by {1e-4 * abs(fit.skew_ppm):.2f} %, the VPS's is the"
            f" {'fast' if fit.skew_ppm > 0 else 'slow'} one: the stamps, or the sample rate that they were made from,"
            " are wrong on one side, and the gyroscope's scale by as much. Correct them.",
            measured,
        )
    if fit.explained < MIN_EXPLAINED or abs(fit.skew_ppm) > MAX_SKEW_PPM:
        raise UnusableFlight(
            ReasonCode.NOT_THE_SAME_MOTION,
            f"At the best lag the VPS explains {100 * fit.explained:.0f} % of the gyroscope's variance, with a clock"
            f" drift of {fit.skew_ppm:.0f} ppm and a lag known to {1e3 * fit.lag_sd_s:.2g} ms: not the same motion.",
            measured,
        )
    if fit.lag_sd_s > MAX_LAG_SD_S:
        raise UnusableFlight(
            ReasonCode.FLAT_PEAK,
            f"The lag between IMU and VPS is known to {1e3 * fit.lag_sd_s:.2g} ms only, where {1e3 * MAX_LAG_SD_S:.0f}"
            " ms are needed: the motion is too slow, or too little of it is in both records.",
            measured,
        )
    return replace(fit, spread=_spread(imu, vps, fit, measured))


def _spread(imu: UniformRates, vps: UniformRates, fit: SyncFit, measured: dict[str, float]) -> Array:
    """Half of what lag, s, and skew (a ratio) by slower motion differ from the fit's, the chance of both taken off, as
    an sd (2,); 0 where too little of the record is far enough from gaps to tell."""
    own, other = (_thinned(_smoothed(r, SLOWER_CUTOFF_HZ, SLOWER_SIDE_S), SLOWER_RATE_HZ) for r in (imu, vps))
    if _both_valid(own, other, fit.to_vps_clock(own.t)).sum() < FEWEST_SLOWER:
        return np.zeros(2)
    slower = _refine(own, other, fit.lag_mid_s, fit.first_s, fit.reference_s, measured, skew=1e-6 * fit.skew_ppm)
    difference = np.array([slower.lag_mid_s - fit.lag_mid_s, 1e-6 * (slower.skew_ppm - fit.skew_ppm)])
    by_chance = np.diagonal(fit.covariance) + np.diagonal(slower.covariance)
    return np.asarray(0.5 * np.sqrt(np.maximum(difference**2 - by_chance, 0.0)))


def _thinned(s: UniformRates, rate_hz: float) -> UniformRates:
    """Every so many of low-passed rates, `rate_hz` or more."""
    every = max(1, int(1.0 / (rate_hz * s.interval_s)))
    return UniformRates(s.start_s, every * s.interval_s, s.rate[::every], s.valid[::every])


def _smoothed(s: UniformRates, cutoff_hz: float = FINE_CUTOFF_HZ, side_s: float = FINE_SIDE_S) -> UniformRates:
    """Low-passed rates; what the filter's main lobe mixes with a gap or an end is masked too."""
    rate = low_pass(s.rate, cutoff_hz, s.interval_s, side_s=side_s)
    reach = round(0.5 / cutoff_hz / s.interval_s)
    bad = np.pad(~s.valid, reach, constant_values=True)
    total = np.concatenate([[0], np.cumsum(bad)])
    near = total[2 * reach + 1 :] - total[: len(s.valid)] > 0
    return UniformRates(s.start_s, s.interval_s, rate, ~near)


def _refine(
    imu: UniformRates,
    vps: UniformRates,
    lag: float,
    first: float,
    middle: float,
    measured: dict[str, float],
    *,
    skew: float = 0.0,
) -> SyncFit:
    """Gauss–Newton for offset, drift and the affine map M, c between the rates, on the IMU's grid."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(vps.t, vps.rate)
    slope = spline.derivative()
    t = imu.t
    for _ in range(12):
        # t_vps = (t − middle)(1 + skew) + middle − lag
        at = (t - middle) * (1 + skew) + middle - lag
        inside = _both_valid(imu, vps, at)
        w, w_dot = spline(at[inside]), slope(at[inside])
        x = np.column_stack([w, np.ones(len(w))])
        (affine, residual, xw), weight = _regressed(x, imu.rate[inside])
        matrix = affine[:3].T
        # Sensitivity of the prediction to lag (minus) and skew; the columns of the affine map are projected out.
        moved = w_dot @ matrix.T
        columns = np.stack([-moved, moved * (t[inside] - middle)[:, None]], axis=2)
        flat = columns.reshape(len(w), 6)
        flat = flat - x @ np.linalg.lstsq(xw.T @ x, (x * weight[:, None]).T @ flat, rcond=None)[0]
        root = np.sqrt(weight)
        sensitivity = flat.reshape(len(w), 3, 2) * root[:, None, None]
        a = sensitivity.reshape(-1, 2)
        step = np.linalg.lstsq(a.T @ a, a.T @ (residual * root[:, None]).reshape(-1), rcond=1e-18)[0]
        lag, skew = lag + float(step[0]), skew + float(step[1])
        if abs(step[0]) < 1e-9 and abs(step[1]) < 1e-10:
            break
    spread = imu.rate[inside] - np.average(imu.rate[inside], axis=0, weights=weight)
    explained = 1.0 - float(weight @ np.sum(residual**2, axis=1)) / float(weight @ np.sum(spread**2, axis=1))
    # Both sides are filtered: the residual's colour sets the sd. What a VPS and a gyroscope get wrong grows with the
    # motion, which alone tells the lag.
    _, covariance = least_squares_covariance(
        sensitivity, residual * root[:, None], steady_over=max(1, round(STEADY_S / imu.interval_s))
    )
    return SyncFit(
        lag_mid_s=lag,
        skew_ppm=1e6 * skew,
        covariance=covariance,
        explained=explained,
        peak=measured["peak"],
        runner_up=measured["runner_up"],
        peak_width_s=measured["peak_width_s"],
        matrix=matrix,
        reference_s=middle,
        first_s=first,
        turning=np.cov(w.T),
    )


def _both_valid(imu: UniformRates, vps: UniformRates, at: Array) -> np.ndarray:
    """Which of the IMU's samples, at times `at` (n,) of the VPS's clock, are valid on both sides, (n,) bool."""
    nearest = np.rint((at - vps.start_s) / vps.interval_s)
    inside = (nearest >= 1) & (nearest < len(vps.rate) - 1) & imu.valid
    inside[inside] = vps.valid[nearest[inside].astype(int)]
    return np.asarray(inside)


def _regressed(x: Array, y: Array) -> tuple[tuple[Array, Array, Array], Array]:
    """y (n, 3) on x (n, m), robust: coefficients (m, 3), residuals (n, 3) and the weighted x of the last round; the
    weights (n,) that those residuals give."""

    def solve(weight: Array) -> tuple[tuple[Array, Array, Array], Array]:
        xw = x * weight[:, None]
        coefficients = np.linalg.lstsq(xw.T @ x, xw.T @ y, rcond=None)[0]
        residual = y - x @ coefficients
        return (coefficients, residual, xw), np.linalg.norm(residual, axis=1)

    return reweighted(solve, len(x), rounds=REGRESSION_ROUNDS)


def align_frames(q_imu: ArrayLike, q_vps: ArrayLike, *, iterations: int = 10) -> tuple[Array, Array]:
    """The two constant rotations, as quaternions (world, body), with q_imu ≈ world ⊗ q_vps ⊗ body.

    Alternating Wahba solutions over matched attitudes (n, 4), robust to single bad ones; where the motion
    leaves a part of one unobserved, it stays at the identity's side."""
    q_imu, q_vps = np.asarray(q_imu, dtype=float), np.asarray(q_vps, dtype=float)
    body = IDENTITY

    def solve(weight: Array) -> tuple[tuple[Array, Array], Array]:
        nonlocal body
        world = mean_quaternion(multiply(q_imu, conjugate(multiply(q_vps, body))), weight)
        body = mean_quaternion(multiply(conjugate(multiply(world, q_vps)), q_imu), weight)
        error = to_rotation_vector(multiply(conjugate(multiply(multiply(world, q_vps), body)), q_imu))
        return (world, body), np.linalg.norm(error, axis=1)

    return reweighted(solve, len(q_imu), rounds=iterations)[0]
