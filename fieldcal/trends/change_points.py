"""Flights that stand alone, and steps between sessions: they are found in a history before a line is drawn."""

from __future__ import annotations

import numpy as np
from scipy.special import stdtr

from fieldcal.estimation.segments import begins_run, run_starts
from fieldcal.estimation.statistics import MAD_TO_SIGMA
from fieldcal.geometry.rotation import Array
from fieldcal.trends.random_effects import summed

NEIGHBOURS = 2
"""A point is compared with so many before and so many after it."""
ISOLATED_SIGMAS, FEW_POINTS = 3.0, 5.0
"""Distance from every neighbour, in sd of the difference, beyond which a point stands alone: 3 (1 + (5/n)²), for the sd
is itself found from the n points."""
SIDE_SESSIONS = 2
"""Sessions that must lie on either side of a step: one odd session alone is not a step yet."""
PAIR_LAGS = 3
LEAST_SQUARES = 0.25
"""Residuals may not count as smaller than this share of the variance that was claimed: a perfect fit proves no step."""


def temperature_slope(row: np.ndarray, value: Array, temperature: Array, n_rows: int) -> Array:
    """Slope of value on temperature (g,), from differences of near neighbours in time: a step spoils few of them.

    Least absolute deviations through the origin is the median of Δy/ΔT weighted by |ΔT|. 0 where temperature does not
    move or is NaN.
    """
    pairs = [(row[lag:] == row[:-lag], lag) for lag in range(1, PAIR_LAGS + 1) if len(row) > lag]
    if not pairs:
        return np.zeros(n_rows)
    dy = np.concatenate([(value[lag:] - value[:-lag])[same] for same, lag in pairs])
    dt = np.concatenate([(temperature[lag:] - temperature[:-lag])[same] for same, lag in pairs])
    owner = np.concatenate([row[lag:][same] for same, lag in pairs])
    moved = np.isfinite(dt) & (np.abs(dt) > 1e-6)
    return weighted_median(owner[moved], dy[moved] / dt[moved], np.abs(dt[moved]), n_rows)


def weighted_median(label: np.ndarray, x: Array, weight: Array, size: int) -> Array:
    """Weighted median of x by label, (size,); 0 for labels without any."""
    order = np.argsort(x)
    small = label.astype(np.uint16) if size < 1 << 16 else label  # a radix sort
    order = order[np.argsort(small[order], kind="stable")]
    label, x, weight = label[order], x[order], weight[order]
    total = np.bincount(label, weight, size)
    before = np.concatenate([[0.0], np.cumsum(total)])[label]
    reached = np.cumsum(weight) - before >= 0.5 * total[label] * (1 - 1e-12)
    result = np.zeros(size)
    first = np.flatnonzero(reached & (begins_run(label) | ~np.r_[False, reached[:-1]]))
    result[label[first]] = x[first]
    return result


def scatter_variance(row: np.ndarray, residual: Array, variance: Array, n_rows: int) -> Array:
    """Scatter beyond the claimed variances (g,), robust, from differences of neighbours: steps and trends hardly
    enter."""
    pairs = [(row[lag:] == row[:-lag], lag) for lag in (1, 2) if len(row) > lag]
    if not pairs:
        return np.zeros(n_rows)
    owner = np.concatenate([row[lag:][same] for same, lag in pairs])
    difference = np.concatenate([(residual[lag:] - residual[:-lag])[same] for same, lag in pairs])
    claimed = np.concatenate([(variance[lag:] + variance[:-lag])[same] for same, lag in pairs])
    one = np.ones(len(owner))
    spread = MAD_TO_SIGMA * weighted_median(owner, np.abs(difference), one, n_rows)
    return np.maximum(0.5 * (spread**2 - weighted_median(owner, claimed, one, n_rows)), 0.0)


def isolated(row: np.ndarray, residual: Array, variance: Array) -> np.ndarray:
    """Points (n,) that agree with none of their neighbours in time: bad flights, not steps (after a step the new
    neighbours agree).

    `row` ascending, `residual` without the effect of temperature, `variance` the whole of each point. Rows with fewer
    than six points have no isolated ones, and of six or seven a bad one often hides in the scatter that it makes.
    """
    n = len(row)
    nearest = np.full(n, np.inf)
    for lag in range(1, NEIGHBOURS + 1):
        if n <= lag:
            break
        same = row[lag:] == row[:-lag]
        z = np.abs(residual[lag:] - residual[:-lag]) / np.sqrt(variance[lag:] + variance[:-lag])
        z = np.where(same, z, np.inf)
        nearest[lag:] = np.minimum(nearest[lag:], z)
        nearest[:-lag] = np.minimum(nearest[:-lag], z)
    count = np.bincount(row)[row]
    return (nearest > ISOLATED_SIGMAS * (1.0 + (FEW_POINTS / count) ** 2)) & (count > 2 * NEIGHBOURS + 1)


def strongest_step(
    row: np.ndarray, design: Array, value: Array, weight: Array, n_rows: int
) -> tuple[np.ndarray, Array]:
    """The one step that explains most in each row: (index of the first point after it (g,), p-value (g,)). `weight`
    (n,): 1/variance, 0 for points that do not count.

    Every boundary between two points is tried as an additional regressor to `design` (n, p); its gain in the weighted
    sum of squares comes from cumulative sums. The p-value is that of its t statistic times the number of boundaries
    tried (Bonferroni; neighbouring boundaries share their data, so it is on the safe side). Index −1, p = 1 where no
    boundary can be tried.
    """
    n, p = design.shape
    index, p_value = np.full(n_rows, -1), np.ones(n_rows)
    if n == 0:
        return index, p_value
    counts = weight > 0.0
    wx = design * weight[:, None]
    normal = summed(row, design[:, :, None] * wx[:, None, :], n_rows)
    active = np.einsum("gii->gi", normal) > 0.0
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    beta = np.einsum("gij,gj->gi", inverse, summed(row, wx * value[:, None], n_rows))
    residual = value - np.einsum("nj,nj->n", design, beta[row])
    squares = np.bincount(row, weight * residual**2, n_rows)
    after = _from_here(row, np.column_stack([wx, weight, weight * residual, counts]), n_rows)
    zx, zz, zr, points = after[:, :p], after[:, p], after[:, p + 1], after[:, p + 2]
    free = zz - np.einsum("ni,nij,nj->n", zx, inverse[row], zx)
    total = np.bincount(row, counts.astype(float), n_rows)
    possible = (
        counts & (points >= SIDE_SESSIONS - 0.5) & (total[row] - points >= SIDE_SESSIONS - 0.5) & (free > 1e-6 * zz)
    )
    gain = np.where(possible, zr**2 / np.where(possible, free, 1.0), -1.0)
    order = np.lexsort((-np.arange(n), gain, row))
    last = np.r_[run_starts(row[order])[1:], n] - 1
    best = order[last]
    best = best[gain[best] > 0.0]
    rows = row[best]
    freedom = total[rows] - active[rows].sum(axis=1) - 1
    left = (squares[rows] - gain[best]) / np.maximum(freedom, 1)
    t = np.sqrt(gain[best] / np.maximum(left, LEAST_SQUARES))
    tried = np.bincount(row, possible.astype(float), n_rows)[rows]
    index[rows] = best
    p_value[rows] = np.where(freedom > 0, np.minimum(1.0, tried * 2.0 * stdtr(np.maximum(freedom, 1), -t)), 1.0)
    return index, p_value


def _from_here(row: np.ndarray, x: Array, n_rows: int) -> Array:
    """Sums of x (n, m) from each point to the end of its row."""
    total = summed(row, x, n_rows)
    before = np.cumsum(x, axis=0) - x
    start = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(total, axis=0)])[:-1]
    return total[row] - (before - start[row])
