"""Regression that outliers do not draw off: Huber's M-estimate by iteratively reweighted least squares.

Each round solves a weighted problem and takes the next weights from the distances that the solution leaves. What is
solved is the caller's: one equation or three, a sum or a product of quaternions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import TypeVar

import numpy as np

from fieldcal.estimation.statistics import huber_weights, robust_sigma
from fieldcal.geometry.rotation import Array

Solution = TypeVar("Solution")
Solve = Callable[[Array], tuple[Solution, Array]]
"""Weights (n,) → the weighted solution, and the distance (n,) of each sample from it, of either sign."""


def reweighted_rounds(solve: Solve[Solution], n: int) -> Iterator[tuple[Solution, Array]]:
    """Round after round without end: the solution, and the weights (n,) that its distances give.

    The first round's weights are 1. Those after it are Huber's at the scale of the distances themselves, so that the
    caller needs to know no noise level.
    """
    weight: Array = np.ones(n)
    while True:
        solution, distance = solve(weight)
        weight = huber_weights(distance, robust_sigma(distance))
        yield solution, weight


def reweighted(solve: Solve[Solution], n: int, *, rounds: int) -> tuple[Solution, Array]:
    """Solution of the last of so many rounds, and the weights (n,) that its distances give.

    Parameters
    ----------
    solve : callable
        See `Solve`. What it raises comes through.
    n : int
        Number of samples.
    rounds : int
        At least 1. Huber's estimate converges linearly: three rounds leave a few per cent of what the outliers did to
        the first.

    References
    ----------
    Huber (1964); Holland & Welsch (1977) for the reweighting.

    Examples
    --------
    The mean of numbers of which one is wrong:

    >>> x = np.array([1.0, 1.1, 0.9, 1.0, 50.0])
    >>> mean, weight = reweighted(lambda w: (w @ x / w.sum(), x - w @ x / w.sum()), len(x), rounds=50)
    >>> round(float(mean), 2), round(float(weight[-1]), 2)
    (1.03, 0.0)
    """
    *_, last = islice(reweighted_rounds(solve, n), rounds)
    return last
