"""How far the constants are from the truth, and what of that the record itself says."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fieldcal.estimation.by_velocity.equations import Rows, Solved, pulls
from fieldcal.estimation.by_velocity.problem import TRIADS
from fieldcal.estimation.statistics import variance_by_blocks
from fieldcal.geometry.rotation import Array


def wider(rows: list[Rows], weight: list[Array], solved: Solved, offset: Array) -> Array:
    """Factors (p,) on the sd, 1 at least: what blocks of time do to each constant may vary by more than noise of the
    fitted levels would have it. Knots are at `offset` (K,) s."""
    moved, t = [], []
    for one, robust in zip(rows, weight, strict=True):
        residual = one.residual * np.sqrt(robust / one.variance)
        moved.append(pulls(one, robust, residual, solved.followed) @ solved.covariance)
        t.append(offset[one.knot])
    times = np.concatenate(t)
    order = np.argsort(times, kind="stable")
    variance = variance_by_blocks(np.concatenate(moved)[order], times[order])
    return np.asarray(np.sqrt(np.maximum(1.0, variance / np.diagonal(solved.covariance))))


def with_what_belongs(
    layout: Mapping[str, slice], own: tuple[Array, Array], known: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Information (p, p) and gradient (p,) of the record, `own`, with what is known beforehand of lag, arm, drift, …,
    which belongs to it; what is known of the triads does not."""
    beside = np.ones(len(known[1]), dtype=bool)
    for name, columns in layout.items():
        beside[columns] = name not in TRIADS
    return own[0] + np.where(np.outer(beside, beside), known[0], 0.0), own[1] + np.where(beside, known[1], 0.0)
