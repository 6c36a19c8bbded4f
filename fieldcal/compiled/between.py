"""Attitudes between stamps in C (`between.c`): wrappers that check shapes. Names are those of `geometry.rotation`."""

from __future__ import annotations

import ctypes

import numpy as np

from fieldcal.compiled import pointer, real


def slerp(library: ctypes.CDLL, t: np.ndarray, q: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Attitudes (m, 4) at times `at` (m,), neighbours on one hemisphere; two stamps t (n,) at least."""
    n, m = len(t), len(at)
    given, out = (real(t, n), real(q, n, 4), real(at, m)), np.empty((m, 4))
    library.slerp(ctypes.c_int64(n), ctypes.c_int64(m), *map(pointer, (*given, out)))
    return out


def hermite(library: ctypes.CDLL, t: np.ndarray, q: np.ndarray, rate: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Attitudes (m, 4) at times `at` (m,), by rates (n, 3) too; two stamps t (n,) at least."""
    n, m = len(t), len(at)
    given, out = (real(t, n), real(q, n, 4), real(rate, n, 3), real(at, m)), np.empty((m, 4))
    library.hermite(ctypes.c_int64(n), ctypes.c_int64(m), *map(pointer, (*given, out)))
    return out
