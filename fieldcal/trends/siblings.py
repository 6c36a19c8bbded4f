"""Comparison of a unit with its siblings: whether it is unlike them, and a better estimate of its scatter."""

from __future__ import annotations

import numpy as np
from scipy import special

from fieldcal.estimation.segments import run_starts
from fieldcal.geometry.rotation import Array

LEAST_SIBLINGS = 2
"""Others that a value is measured against, at least."""
ENOUGH_SIBLINGS = 5
"""Others that it takes to look for outliers among them, or to let siblings lend their scatter."""
MOST_OUTLIERS = 0.25
"""Largest share of a group that is looked at as outliers."""
REFERENCE_LEVEL = 0.05
"""A value that is an outlier at this level does not serve as a sibling to others."""
LIKE_FREEDOM = 3.0
"""What the spread of like groups (the other axes) is worth at most, in degrees of freedom: they agree within a factor
of about 1.6 (one sd; ψ′(d/2) is the variance of log s²)."""
LEAST_FREEDOM = 0.5


def sibling_distance(
    group: np.ndarray, value: Array, sd: Array, *, doubtful: np.ndarray | None = None, kind: np.ndarray | None = None
) -> tuple[Array, Array]:
    """(distance from the siblings in sd, its p-value), each (n,).

    The values of a group scatter about a common mean as siblings do, of unknown variance, plus each value's own sd². A
    value is measured against the k others of its group that are in no doubt, t = (x − mean)/√(s̃²(1 + 1/k) + sd²). In
    doubt are outliers (`outliers`) and what `doubtful` marks: units that stepped or drift are no longer where their
    siblings are. s̃² is the others' variance s², of k − 1 degrees of freedom, drawn towards that of the other groups of
    its kind, which count for `LIKE_FREEDOM` degrees at most: in a fleet of five the spread of one axis is next to
    unknown. The p-value is that of one comparison: many are made, which is the caller's to count. NaN and p = 1 with
    fewer than two others.

    Parameters
    ----------
    group : (n,) array
        Equal for siblings.
    value, sd : (n,) arrays
        What is compared.
    doubtful : (n,) bool array, optional
        Values that do not serve as siblings to others; they are measured themselves.
    kind : (n,) array, optional
        Equal for groups of like spread and unit; a group has one kind. Without it every group is compared within
        itself.
    """
    z, p = np.full(len(value), np.nan), np.ones(len(value))
    inside = np.ones(len(value), dtype=bool) if doubtful is None else ~doubtful
    for alike in [np.arange(len(value))] if kind is None else _groups(kind):
        groups = [alike[members] for members in _groups(group[alike])]
        for members in groups:
            good = members[inside[members]]
            if len(good) > ENOUGH_SIBLINGS:
                inside[good] = ~outliers(value[good], sd[good], REFERENCE_LEVEL)
        counted = [m[inside[m]] for m in groups]
        freedom = np.array([len(m) - 1.0 for m in counted])
        squares = np.array([float(np.sum((value[m] - value[m].mean()) ** 2)) if len(m) > 1 else 0.0 for m in counted])
        for i, members in enumerate(groups):
            lent, others = 0.0, 0.0
            if kind is not None:
                rest = np.maximum(freedom, 0.0).sum() - max(freedom[i], 0.0)
                if rest > 0.0:
                    lent, others = (squares.sum() - squares[i]) / rest, 1.0 / (1.0 / LIKE_FREEDOM + 1.0 / rest)
            k = len(counted[i]) - inside[members].astype(float)
            judged = k >= LEAST_SIBLINGS
            if judged.any():
                t, left = _distances(value[members], sd[members], inside[members], lent, others)
                z[members] = np.where(judged, t, np.nan)
                p[members] = np.where(judged, 2.0 * special.stdtr(left, -np.abs(t)), 1.0)
    return z, p


def outliers(value: Array, sd: Array, level: float) -> np.ndarray:
    """Outliers among values (n,) with their sd: Rosner's generalised extreme studentised deviate.

    The most distant value is taken out, then the next, up to a quarter of them; each has the p-value of being the most
    distant of those still in. All up to the last significant one are outliers: they may have hidden each other.

    References
    ----------
    Rosner (1983), Technometrics 25, 165–172.
    """
    inside = np.ones(len(value), dtype=bool)
    taken, last = [], 0
    for _ in range(int(MOST_OUTLIERS * len(value))):
        t, freedom = _distances(value, sd, inside)
        i = int(np.argmax(np.where(inside, np.abs(t), -1.0)))
        if int(inside.sum()) - 1 < ENOUGH_SIBLINGS:
            break
        taken.append(i)
        if int(inside.sum()) * 2.0 * float(special.stdtr(freedom[i], -abs(t[i]))) <= level:
            last = len(taken)
        inside[i] = False
    result = np.zeros(len(value), dtype=bool)
    result[taken[:last]] = True
    return result


def _distances(
    value: Array, sd: Array, inside: np.ndarray, lent: float = 0.0, lent_freedom: float = 0.0
) -> tuple[Array, Array]:
    """t of each value against the others that are inside, and its degrees of freedom; their variance drawn towards
    `lent`."""
    x = value - np.median(value[inside])
    inner = inside * x
    k = np.maximum(inside.sum() - inside.astype(float), 1.0)
    mean = (inner.sum() - inner) / k
    s2 = np.maximum((inner @ inner - inner**2) / k - mean**2, 0.0) * k / np.maximum(k - 1.0, 1.0)
    freedom = k - 1.0 + lent_freedom
    s2 = ((k - 1.0) * s2 + lent_freedom * lent) / np.maximum(freedom, 1.0)
    spread = np.sqrt(s2 * (1.0 + 1.0 / k) + sd**2)
    return np.asarray((x - mean) / np.maximum(spread, 1e-300)), np.asarray(np.maximum(freedom, LEAST_FREEDOM))


def moderated_variance(group: np.ndarray, variance: Array, freedom: Array) -> tuple[Array, Array]:
    """(variance, freedom), each (n,), after each variance has been drawn towards its siblings'.

    A variance from few degrees of freedom is itself uncertain; siblings show what is usual. Theirs are taken as draws
    from a scaled inverse χ² with d0 degrees of freedom about s0², both found from the mean and variance of log s²; then
    s̃² = (d0 s0² + d s²)/(d0 + d), with d0 + d degrees of freedom. Siblings that differ much give a small d0: then each
    is not changed; nor are groups with fewer than six and entries that are not finite.

    References
    ----------
    Smyth (2004), Statistical Applications in Genetics and Molecular Biology 3(1), section 6.2.
    """
    result, total = variance.copy(), freedom.copy()
    usable = np.isfinite(variance) & (variance > 0.0) & (freedom > LEAST_FREEDOM)
    for everyone in _groups(group):
        members = everyone[usable[everyone]]
        if len(members) <= ENOUGH_SIBLINGS:
            continue
        half = 0.5 * freedom[members]
        e = np.log(variance[members]) - special.digamma(half) + np.log(half)
        surplus = float(np.var(e, ddof=1) - np.mean(special.polygamma(1, half)))
        d0 = _inverse_trigamma(surplus) * 2.0 if surplus > 0.0 else np.inf
        d0 = min(d0, float(freedom[members].sum()))
        s0 = np.exp(float(e.mean()) + special.digamma(0.5 * d0) - np.log(0.5 * d0))
        total[members] = freedom[members] + d0
        result[members] = (d0 * s0 + freedom[members] * variance[members]) / total[members]
    return result, total


def _groups(label: np.ndarray) -> list[np.ndarray]:
    """Indices of equal labels."""
    order = np.argsort(label, kind="stable")
    return np.split(order, run_starts(label[order])[1:])


def _inverse_trigamma(y: float) -> float:
    """x with ψ′(x) = y, by Newton on 1/ψ′, which is convex and nearly linear."""
    x = 0.5 + 1.0 / y
    for _ in range(50):
        trigamma = float(special.polygamma(1, x))
        step = trigamma * (1.0 - trigamma / y) / float(special.polygamma(2, x))
        x += step
        if abs(step) <= 1e-10 * x:
            break
    return x
