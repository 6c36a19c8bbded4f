"""Prediction errors of series of sessions in C (`series.c`): a wrapper that checks shapes. Names are those of
`estimation.pooled.strengths`."""

from __future__ import annotations

import ctypes

import numpy as np

from fieldcal.compiled import pointer, real


def innovations(
    library: ctypes.CDLL,
    day: np.ndarray,
    warmth_degc: np.ndarray,
    value: np.ndarray,
    variance: np.ndarray,
    strengths: tuple[float, float, float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Errors over their sd and their variances (m, n) of series (m, n); `strengths`: walk a day, scatter, slope, and
    the square of the error over its sd beyond which a series starts anew."""
    m, n = value.shape
    given = (*(real(x, m, n) for x in (day, warmth_degc, value, variance)), real(strengths, 4))
    z, expected = np.empty((2, m, n))
    library.innovations(ctypes.c_int64(m), ctypes.c_int64(n), *map(pointer, (*given, z, expected)))
    return z, expected
