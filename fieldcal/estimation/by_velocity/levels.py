"""How noisy walks, receiver and magnetometer are, by what a step leaves of the residuals; which rows are outliers."""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.by_velocity.equations import (
    FIELD,
    GROUPS,
    LEVEL,
    PUSH,
    TURN,
    VERTICAL,
    Rows,
    Solved,
    predicted,
)
from fieldcal.estimation.by_velocity.problem import Levels
from fieldcal.estimation.joint.variance_components import COLOUR_S, LARGEST_COLOUR
from fieldcal.estimation.statistics import low_frequency_density
from fieldcal.geometry.rotation import Array

# Length of a row over its sd beyond which it loses influence, as in the joint estimate; the median of χ with three.
CLIP_SD, MEDIAN_LENGTH = 4.0, 1.538
LARGEST_LOG_STEP = 1.5
"""Logarithm of the factor by which a level may change in an iteration."""
FEWEST_OF_A_SPECTRUM = 10


def by_group(levels: Levels) -> Array:
    """Level of each group of rows (5,), in the order of GROUPS."""
    return np.array([levels.turn, levels.push, *levels.receiver, levels.field])


def robust_weights(rows: list[Rows]) -> list[Array]:
    """Redescending weights (m, r) of the receiver's epochs and the magnetometer's means, by a row's length over the
    median one: 1 up to CLIP_SD, (CLIP_SD/d)⁴ beyond. Links are the model's own."""
    out = [np.ones_like(rows[0].residual)]
    for one in rows[1:]:
        distance = np.linalg.norm(one.residual / np.sqrt(one.variance), axis=1)
        distance /= max(float(np.median(distance)), 1e-12) / MEDIAN_LENGTH
        own = (CLIP_SD / np.maximum(distance, CLIP_SD)) ** 4
        out.append(np.repeat(own[:, None], one.residual.shape[1], axis=1))
    return out


def left_over(
    rows: list[Rows], weight: list[Array], signs: list[Array], solved: Solved
) -> tuple[list[Array], Array, Array, Array]:
    """Residuals (m, r) after the step, to first order, over their sd and √`weight`; and of each group (5,) their sum of
    squares, the degrees of freedom that they have, and the information on the logarithm of their variance. Both by the
    probes `signs`: what the unknowns take of them is the trace of the hat matrix."""
    square, free, information = np.zeros((3, len(GROUPS)))
    after: list[Array] = []
    step = np.column_stack([solved.theta, solved.probes[0]])
    knots = np.concatenate([solved.knots[..., None], solved.probes[1]], axis=2)
    for one, robust, sign in zip(rows, weight, signs, strict=True):
        root = np.sqrt(robust / one.variance)
        changed = predicted(one, step, knots) * root[..., None]
        whitened = one.residual * root + changed[..., 0]
        after.append(whitened)
        for column, group in enumerate(one.group):
            kept = sign[:, column] - changed[:, column, 1 + group]
            square[group] += np.sum(whitened[:, column] ** 2)
            free[group] += np.sum(sign[:, column] * kept) - np.sum(1.0 - robust[:, column])
            information[group] += np.sum(kept**2)
    return after, square, free, information


def growth(square: Array, free: Array, information: Array, damping: float) -> Array:
    """Factor (g,) on each variance by restricted maximum likelihood: Newton's method in its logarithm."""
    free = np.maximum(free, 1e-6)
    # Downwards the fixed point is the faster where Newton's step would be.
    logarithm = np.minimum((square - free) / information, np.where(square < free, np.log(square / free), np.inf))
    return np.asarray(np.exp(damping * np.clip(logarithm, -LARGEST_LOG_STEP, LARGEST_LOG_STEP)))


def renewed(
    old: Levels,
    least: Array,
    damping: float,
    rows: list[Rows],
    weight: list[Array],
    signs: list[Array],
    solved: Solved,
    offset: Array,
) -> tuple[Levels, float]:
    """Levels after a step, none of them below `least` (5,) in the order of GROUPS, and by how much the one that changed
    most did: as a share, or in its own sd where it is known less well. Knots are at `offset` (K,)."""
    after, square, free, information = left_over(rows, weight, signs, solved)
    # Rows were weighted by coloured variances: white ones would be so many times as heavy.
    square[[LEVEL, VERTICAL, FIELD]] *= old.colour
    given, ratio = information > 0.0, np.ones(len(GROUPS))
    ratio[given] = growth(square[given], free[given], information[given], damping)
    ratio = np.maximum(ratio, least / by_group(old))
    change = np.max(np.abs(ratio - 1.0)[given] * np.minimum(1.0, np.sqrt(0.5 * information[given])))
    levels = Levels(
        old.turn * ratio[TURN],
        old.push * ratio[PUSH],
        old.receiver * ratio[[LEVEL, VERTICAL]],
        old.field * ratio[FIELD],
        colours(rows, after, offset),
    )
    return levels, float(change)


def colours(rows: list[Rows], whitened: list[Array], offset: Array) -> Array:
    """`Levels.colour` (3,): of level and vertical velocity and of the magnetometer, each of all columns (m, r) of its
    rows together; 1 of those that are too few."""
    out = np.ones(3)
    for place, (which, columns) in enumerate(((1, [0, 1]), (1, [2]), (2, [0, 1, 2]))):
        if which < len(rows):
            out[place] = colour(whitened[which][:, columns], offset[rows[which].knot])
    return out


def colour(x: Array, t: Array) -> float:
    """Density at low frequency over that of white noise, of residuals x (m, r) at `t` (m,) s; 1 of fewer than
    FEWEST_OF_A_SPECTRUM."""
    if len(x) < FEWEST_OF_A_SPECTRUM:
        return 1.0
    lags = int(np.clip(COLOUR_S / np.median(np.diff(t)), 1, len(x) // 4))
    return float(low_frequency_density(x, lags, together=x.shape[1], largest=LARGEST_COLOUR)[0])
