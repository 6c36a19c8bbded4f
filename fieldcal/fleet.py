"""Which unit of a fleet is unlike its siblings: Rosner's many-outlier procedure with each value's own uncertainty."""

from __future__ import annotations

import numpy as np
from scipy import stats

from fieldcal.rotation import Array

ENOUGH_SIBLINGS = 5
MOST_OUTLIERS = 0.25
"""Largest share of a group that is looked at as outliers."""


def sibling_distance(group: np.ndarray, value: Array, sd: Array, n_groups: int) -> tuple[Array, Array]:
    """(distance from the siblings in sd, its p-value), each (n,).

    The values of a group scatter about a common mean as siblings do, of unknown variance, plus each value's own sd².
    The most distant one is taken out, then the next, up to a quarter of the group; each is measured against those still
    in, t = (x − mean)/√(s²(1 + 1/k) + sd²), with k − 1 degrees of freedom, and its p-value counts the k + 1 that it was
    the most distant of (generalised extreme studentised deviate). Those never taken out are measured against the
    others. NaN and p = 1 in groups with fewer than six.

    References
    ----------
    Rosner (1983), Technometrics 25, 165–172.
    """
    z, p = np.full(len(value), np.nan), np.ones(len(value))
    for g in range(n_groups):
        members = np.flatnonzero(group == g)
        if len(members) > ENOUGH_SIBLINGS:
            z[members], p[members] = _one_group(value[members], sd[members])
    return z, p


def _one_group(value: Array, sd: Array) -> tuple[Array, Array]:
    n = len(value)
    inside = np.ones(n, dtype=bool)
    out, p_out = [], []
    for _ in range(int(MOST_OUTLIERS * n)):
        t = _distances(value, sd, inside)
        i = int(np.argmax(np.where(inside, np.abs(t), -1.0)))
        k = int(inside.sum()) - 1
        if k < ENOUGH_SIBLINGS:
            break
        out.append(i)
        p_out.append(min(1.0, (k + 1) * 2.0 * float(stats.t.sf(abs(t[i]), k - 1))))
        inside[i] = False
    p = np.ones(n)
    # Rosner: all up to the last significant one are outliers together, so each has the best of what followed it.
    best = np.minimum.accumulate(np.array(p_out)[::-1])[::-1] if out else np.empty(0)
    p[out] = best
    significant = np.zeros(n, dtype=bool)
    significant[[i for i, pi in zip(out, best, strict=True) if pi < 0.05]] = True
    return _distances(value, sd, ~significant), p


def _distances(value: Array, sd: Array, inside: np.ndarray) -> Array:
    """t of each value against the others that are inside."""
    others = inside[None, :] & ~np.eye(len(value), dtype=bool)
    k = others.sum(axis=1)
    mean = others @ value / k
    s2 = np.sum(others * (value[None, :] - mean[:, None]) ** 2, axis=1) / (k - 1)
    spread = np.sqrt(s2 * (1.0 + 1.0 / k) + sd**2)
    return np.asarray((value - mean) / np.maximum(spread, 1e-300))
