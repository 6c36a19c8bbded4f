"""Logarithms of chances so small that no number holds them: which of two surprises is the greater is asked of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.geometry.rotation import Array


def log_beyond_either_way(z: ArrayLike, freedom: ArrayLike) -> Array:
    """Of Student's t with `freedom` degrees, log P(|t| > |z|); elementwise."""
    from scipy.stats import t as t_distribution

    t, nu = np.abs(np.asarray(z, dtype=float)), np.asarray(freedom, dtype=float)
    steepness = (nu + 1.0) * t / (nu + t**2)
    tail = _tail(t_distribution.logsf(t, nu), t_distribution.logpdf(t, nu), steepness)
    return np.asarray(np.log(2.0) + tail)


def log_beyond(x: ArrayLike, count: ArrayLike, freedom: ArrayLike) -> Array:
    """Of Fisher's F with `count` and `freedom` degrees, log P(F > x); elementwise."""
    from scipy.stats import f as f_distribution

    f, m, nu = (np.asarray(one, dtype=float) for one in (x, count, freedom))
    with np.errstate(divide="ignore"):
        steepness = 0.5 * (m + nu) * m / (nu + m * f) - (0.5 * m - 1.0) / f
    return _tail(f_distribution.logsf(f, m, nu), f_distribution.logpdf(f, m, nu), steepness)


def _tail(exact: Array, log_density: Array, steepness: Array) -> Array:
    """`exact` where it is a number; beyond, the density over how steeply it falls: to first order (Laplace)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(np.isneginf(exact), log_density - np.log(steepness), exact))
