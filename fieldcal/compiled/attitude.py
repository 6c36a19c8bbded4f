"""Output error's pass over the samples in C (`attitude.c`): wrappers that check shapes. Names are those of
`estimation.gyroscope.output_error`."""

from __future__ import annotations

import ctypes

import numpy as np

from fieldcal.compiled import flags, pointer, real


def propagate_stretches(library: ctypes.CDLL, t: np.ndarray, rate: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Attitude (n, 4) relative to the start of each stretch; `begins` (n,) bool, the first sample begins one."""
    n = len(t)
    out = np.empty((n, 4))
    given = real(t, n), real(rate, n, 3), flags(begins, n)
    library.propagate_stretches(ctypes.c_int64(n), *map(pointer, (*given, out)))
    return out


def normal_equations(
    library: ctypes.CDLL,
    t: np.ndarray,
    model: np.ndarray,
    x: np.ndarray,
    begins: np.ndarray,
    weight: np.ndarray,
    residual: np.ndarray,
    *,
    fixed: bool,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal matrix (6, 6), gradient (6,) and weighted square of the residual."""
    n = len(t)
    given = (
        real(t, n), real(model, n, 4), real(x, n, 3), flags(begins, n), real(weight, n), real(residual, n, 3),
    )  # fmt: skip
    normal, gradient, square = np.zeros((6, 6)), np.zeros(6), np.zeros(1)
    library.output_error_sums(
        ctypes.c_int64(n), *map(pointer, given), ctypes.c_int64(fixed), *map(pointer, (normal, gradient, square))
    )
    return normal, gradient, float(square[0])
