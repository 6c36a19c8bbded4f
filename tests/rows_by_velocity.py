"""Linearised rows of the estimate by velocity drawn at random, and the same rows in one dense matrix."""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.by_velocity.equations import FIELD, LEVEL, PUSH, STATES, TURN, VERTICAL, Rows
from fieldcal.geometry.rotation import Array


def drawn_rows(rng: np.random.Generator, knots: int, p: int) -> list[Rows]:
    """Links of each knot to the next, epochs at some, means: sensitivities drawn at random."""

    def one(knot: np.ndarray, group: tuple[int, ...], linked: bool) -> Rows:
        m, r = len(knot), len(group)
        there = rng.normal(size=(m, r, STATES)) if linked else None
        here, theta = rng.normal(size=(m, r, STATES)), rng.normal(size=(m, r, p))
        return Rows(rng.normal(size=(m, r)), here, there, theta, knot, rng.uniform(0.1, 2.0, (m, r)), group)

    return [
        one(np.arange(knots - 1), (TURN, TURN, TURN, PUSH, PUSH, PUSH), True),
        one(np.sort(rng.choice(knots, 2 * knots // 3, replace=False)), (LEVEL, LEVEL, VERTICAL), False),
        one(np.arange(knots - 1), (FIELD,) * 3, False),
    ]


def dense(rows: list[Rows], weight: list[Array], knots: int) -> tuple[Array, Array, np.ndarray]:
    """All rows whitened, (M, 6K + p), what they predict too little (M,), and their groups (M,)."""
    lines, right, group = [], [], []
    for one, robust in zip(rows, weight, strict=True):
        for m, knot in enumerate(one.knot):
            for r in range(one.residual.shape[1]):
                line = np.zeros(STATES * knots + one.theta.shape[2])
                line[STATES * knot : STATES * (knot + 1)] = one.here[m, r]
                if one.there is not None:
                    line[STATES * (knot + 1) : STATES * (knot + 2)] = one.there[m, r]
                line[STATES * knots :] = one.theta[m, r]
                root = np.sqrt(robust[m, r] / one.variance[m, r])
                lines.append(root * line)
                right.append(-root * one.residual[m, r])
                group.append(one.group[r])
    return np.array(lines), np.array(right), np.array(group)
