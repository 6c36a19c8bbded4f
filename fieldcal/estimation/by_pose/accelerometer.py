"""The accelerometer against the VPS's position: in world axes specific force is the second derivative of position less
gravity, and every unknown is linear in it.

Both sides pass the same low-pass, so that no part of the motion stands on one side only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_pose.triad import TriadByPose, axis_sigma
from fieldcal.estimation.motion_selection import contiguous
from fieldcal.estimation.robust import reweighted
from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.smoothing import differentiate_samples, fill, lattice, low_pass
from fieldcal.estimation.statistics import colour, least_squares_covariance
from fieldcal.geometry.rotation import Array, body_from_inertial, normalise
from fieldcal.reason_codes import ReasonCode

# Cut-offs tried, Hz, the highest first: noise of a position grows with the square of the frequency, and so does what
# the motion tells, and what a side's bandwidth takes from it.
CUTOFFS_HZ = (5.0, 2.5, 1.2, 0.6)
SIDE_PERIODS = 3.0  # of the cut-off: length of the low-pass on either side; what it mixes with a gap is left out
LEAST_SAMPLES_A_PERIOD = 6.0  # of the VPS, at the cut-off
ROWS_A_PERIOD = 5.0  # of the cut-off
# Readings and attitudes are low-passed and thinned before they are multiplied: what turns faster than this would be
# missed in their product.
MOTION_HZ, THINNED_HZ, THINNING_SIDE_S = 20.0, 80.0, 0.3
BRIDGED_PERIODS = 0.1  # of the cut-off: the longest gap between positions that is interpolated over
SHORTEST_S = 3.0  # of a stretch without a gap
REGRESSION_ROUNDS = 4
FEWEST_ROWS = 100
UNKNOWNS = 18  # matrix (9), bias (3), delay, lever arm (3), tilt (2)
LATE = 12  # place of the delay


def fit_accelerometer(
    t: ArrayLike,
    segment: np.ndarray,
    logged: ArrayLike,
    q: ArrayLike,
    t_vps: ArrayLike,
    position: ArrayLike,
    *,
    gravity_mps2: float,
    max_gap_s: float,
) -> TriadByPose:
    """Full matrix, bias, lever arm and delay of an accelerometer by attitude and position.

    Parameters
    ----------
    t, segment : (n,) arrays
        IMU stamps, s, and contiguous stretches.
    logged : (n, 3) array
        Readings, logged units.
    q : (n, 4) array
        Attitude of the sensor axes, inertial NED (level to a few degrees: its tilt is estimated).
    t_vps, position : (m,), (m, 3) arrays
        VPS stamps on the IMU's clock, s, and positions, m, in the axes of `q`.
    gravity_mps2 : float
        Signed: negative for an accelerometer that reads specific force.
    max_gap_s : float
        Longest gap between positions that is interpolated over; slower motion bridges longer ones.

    Raises
    ------
    UnusableFlight
        `vps_too_short`: the position covers less than FEWEST_ROWS rows of any cut-off.

    Notes
    -----
    In world axes, with R(q) from sensor to world and s the sign of gravity:
    s R (M x + b) + (R r)″ − g τ = g e_z − p″, for the matrix M, bias b, lever arm r and tilt τ of the world's vertical.

    A mismatch of bandwidths (a VPS that smooths, a mounting that bends) shows as constants that depend on the cut-off.
    The cut-off is the one whose scales are best known, their distance from those at the lowest cut-off counted as an
    error; half of the spread over all cut-offs is in every sd.
    """
    times, x, path = (np.asarray(v, dtype=float) for v in (t, logged, position))
    seen = np.isfinite(path).all(axis=1)
    at, path, turn = np.asarray(t_vps, dtype=float)[seen], path[seen], np.asarray(q, dtype=float)
    valid = np.isfinite(x).all(axis=1)
    if len(at) > 4 and valid.any():
        centre, spread = x[valid].mean(axis=0), float(np.maximum(x[valid].std(axis=0).max(), 1e-300))
        x = (x - centre) / spread
        fastest = 1.0 / (LEAST_SAMPLES_A_PERIOD * float(np.median(np.diff(at))))
        cutoffs = sorted({min(f, fastest) for f in CUTOFFS_HZ}, reverse=True)
        products = cache(partial(_products, times, x, valid, turn, at, path))
        fits = []
        for cutoff_hz in cutoffs:
            # Slower motion is known across longer gaps.
            gap_s = max(max_gap_s, BRIDGED_PERIODS / cutoff_hz)
            rows = _rows(products, segment, at, gravity_mps2, gap_s, cutoff_hz)
            if sum(len(y) for _, y in rows) >= FEWEST_ROWS:
                columns, y = (np.concatenate(parts) for parts in zip(*rows, strict=True))
                fits.append(_solved(columns, y, abs(gravity_mps2)))
        if fits:
            return _best(fits, centre, spread)
    raise UnusableFlight(
        ReasonCode.VPS_TOO_SHORT, "The VPS has too few positions without gaps to compare accelerations with."
    )


def _best(fits: list[TriadByPose], centre: Array, spread: float) -> TriadByPose:
    """Of fits to centred readings, the lowest cut-off last: the best known, in logged units."""
    values = np.array([np.r_[fit.matrix.ravel(), fit.bias] for fit in fits])
    scales = [0, 4, 8]
    variance = np.array([np.diagonal(fit.covariance)[scales] for fit in fits])
    error = np.sqrt(variance + (values - values[-1])[:, scales] ** 2)
    best = int(np.argmin(error.max(axis=1)))
    fit = fits[best]
    to_logged = _to_logged(centre, spread)
    systematic = 0.5 * np.ptp(values, axis=0)
    covariance = to_logged @ (fit.covariance + np.diag(systematic**2)) @ to_logged.T
    logged = to_logged @ values[best]
    return replace(fit, matrix=logged[:9].reshape(3, 3), bias=logged[9:], covariance=covariance)


Stretch = tuple[tuple[int, int], tuple[int, int]]
"""Without a gap: readings [a, b) and positions [c, d)."""


@dataclass(frozen=True)
class _Products:
    """What the unknowns are linear in, not yet low-passed, of a stretch: `every` (n, 3 · 22), each world axis by matrix
    (9), the readings' slope by matrix (9), bias (3) and position (1), every `interval_s`."""

    every: Array
    interval_s: float


def _products(
    t: Array, x: Array, valid: np.ndarray, q: Array, t_vps: Array, position: Array, stretch: Stretch
) -> _Products | None:
    """The same for every cut-off; None of a stretch that is too short."""
    (a, b), (c, d) = stretch
    inside = np.arange(a, b)[(t[a:b] >= t_vps[c]) & (t[a:b] <= t_vps[d - 1]) & valid[a:b]]
    if len(inside) < 20 or t[inside[-1]] - t[inside[0]] < SHORTEST_S:
        return None
    index, own_interval_s = lattice(t[inside])
    thinning = max(1, int(1.0 / (THINNED_HZ * own_interval_s)))
    interval_s = thinning * own_interval_s
    both = np.concatenate(
        [fill(index, x[inside]), body_from_inertial(normalise(fill(index, q[inside]))).reshape(-1, 9)], axis=1
    )
    if thinning > 1:
        both = low_pass(both, MOTION_HZ, own_interval_s, side_s=THINNING_SIDE_S)[::thinning]
    at = t[inside[0]] + interval_s * np.arange(len(both))
    reading, turn = both[:, :3], both[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)
    slope = differentiate_samples(at, reading)
    path = CubicSpline(t_vps[c:d], position[c:d])(at)
    n = len(at)
    every = np.concatenate(
        [np.einsum("nij,nk->nijk", turn, v).reshape(n, 3, 9) for v in (reading, slope)] + [turn, path[..., None]],
        axis=2,
    ).reshape(n, -1)
    return _Products(every, interval_s)


def _rows(
    products: Callable[[Stretch], _Products | None],
    segment: np.ndarray,
    t_vps: Array,
    gravity_mps2: float,
    max_gap_s: float,
    cutoff_hz: float,
) -> list[tuple[Array, Array]]:
    """Columns (n, 3, 26) and right-hand side (n, 3) of every stretch without a gap, both through the same low-pass and
    thinned to what that leaves.

    Columns: matrix (9), bias (3), the readings' slope for the delay, by matrix element (9), lever arm (3), tilt (2)."""
    sign, g = float(np.sign(gravity_mps2)), abs(gravity_mps2)
    out = []
    for of_stretch in map(products, product(run_bounds(segment), contiguous(t_vps, max_gap_s))):
        if of_stretch is None:
            continue
        interval_s, n = of_stretch.interval_s, len(of_stretch.every)
        side_s = SIDE_PERIODS / cutoff_hz
        smooth = low_pass(of_stretch.every, cutoff_hz, interval_s, side_s=side_s).reshape(n, 3, -1)
        by_matrix, late, turn, path = np.split(smooth, [9, 18, 21], axis=2)
        tilt = np.broadcast_to(-g * np.eye(3)[:, :2], (n, 3, 2))
        arm = _second_derivative(turn, interval_s)
        columns = np.concatenate([sign * by_matrix, sign * turn, sign * late, arm, tilt], axis=2)
        y = np.array([0.0, 0.0, g]) - _second_derivative(path, interval_s)[..., 0]
        edge, step = round(side_s / interval_s), max(1, round(1.0 / ROWS_A_PERIOD / cutoff_hz / interval_s))
        rows = slice(edge, n - edge, step)
        out.append((columns[rows], y[rows]))
    return [stretch for stretch in out if len(stretch[1])]


def _second_derivative(x: Array, interval_s: float) -> Array:
    """Fourth-order central second difference along the first axis; the two samples at either end are 0."""
    out = np.zeros_like(x)
    out[2:-2] = (-x[4:] + 16.0 * x[3:-1] - 30.0 * x[2:-2] + 16.0 * x[1:-3] - x[:-4]) / (12.0 * interval_s**2)
    return out


def _solved(columns: Array, y: Array, g: float) -> TriadByPose:
    """Robust regression: the triad for centred readings. The delay's column is made of the matrix before it."""
    x = np.zeros((*y.shape, UNKNOWNS))
    x[..., :LATE], x[..., LATE + 1 :] = columns[..., :LATE], columns[..., 21:]
    theta: Array = np.zeros(UNKNOWNS)

    def solve(weight: Array) -> tuple[tuple[Array, Array], Array]:
        nonlocal theta
        for _ in range(2):
            # A triad that is late reads M (x + delay · dx/dt) = the force of now.
            x[..., LATE] = columns[..., 12:21] @ theta[:9]
            # A tilted vertical is as long as a level one.
            level = y - np.array([0.0, 0.0, g * (1.0 - np.sqrt(max(1.0 - float(theta[16:] @ theta[16:]), 0.0)))])
            root = np.sqrt(weight)[:, None]
            flat = (x * root[..., None]).reshape(-1, UNKNOWNS)
            scale = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
            theta = np.linalg.lstsq(flat / scale, (level * root).reshape(-1), rcond=1e-9)[0] / scale
        residual = level - x @ theta
        return (theta, residual), np.linalg.norm(residual / axis_sigma(residual), axis=1)

    (theta, residual), weight = reweighted(solve, len(y), rounds=REGRESSION_ROUNDS)
    root = np.sqrt(weight)[:, None]
    _, covariance = least_squares_covariance(x * root[..., None], residual * root)
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    return TriadByPose(
        matrix=theta[:9].reshape(3, 3),
        bias=theta[9:12],
        covariance=covariance[:12, :12],
        delay_s=float(theta[LATE]),
        delay_sd_s=float(sd[LATE]),
        misfit=float(np.sqrt(np.average(np.sum(residual**2, axis=1), weights=weight)) / g),
        weight=weight,
        colour=colour(residual * root),
        lever_arm_m=theta[LATE + 1 : LATE + 4],
        lever_arm_sd_m=sd[LATE + 1 : LATE + 4],
    )


def _to_logged(centre: Array, spread: float) -> Array:
    """(12, 12): matrix and bias of logged readings from those of centred ones."""
    out = np.eye(12)
    out[:9] /= spread
    out[9:, :9] = -np.kron(np.eye(3), centre) / spread
    return out
