"""Between which two stamps a time lies: the look-up behind every interpolation."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike


def interval_of(t: ArrayLike, at: ArrayLike, *, on_stamp: Literal["begins", "ends"] = "begins") -> np.ndarray:
    """Index i, same shape as `at`, of the interval [t_i, t_{i+1}] in which each time lies.

    Parameters
    ----------
    t : (n,) array
        Stamps, ascending, n ≥ 2.
    at : array
        Times, same unit and origin. One outside the stamps gets the first or last interval: mask it where that matters.
    on_stamp : {"begins", "ends"}
        Whether a time equal to a stamp is in the interval that begins there or in the one that ends there.
    """
    side: Literal["left", "right"] = "right" if on_stamp == "begins" else "left"
    stamps = np.asarray(t)
    return np.asarray(np.clip(np.searchsorted(stamps, at, side=side) - 1, 0, len(stamps) - 2))


def share_of_interval(t: np.ndarray, i: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Share of interval i gone by at each time `at` (m,), from 0 at t_i to 1 at t_{i+1}; times outside take the end."""
    return np.asarray(np.clip((at - t[i]) / (t[i + 1] - t[i]), 0.0, 1.0))
