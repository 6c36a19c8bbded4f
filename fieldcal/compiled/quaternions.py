"""Products of quaternions and attitudes between stamps in C (`quaternions.c`): wrappers that check shapes. Names are
those of `geometry.rotation`."""

from __future__ import annotations

import ctypes

import numpy as np

from fieldcal.compiled import pointer, real


def multiply(library: ctypes.CDLL, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """p ⊗ q of two of (n, 4), or of one of (n, 4) and one of (4,)."""
    n = max(len(x) for x in (p, q) if x.ndim == 2)
    p, q = (real(x, n, 4) if x.ndim == 2 else real(x, 4) for x in (p, q))
    step_p, step_q = (ctypes.c_int64(4 * (x.ndim - 1)) for x in (p, q))
    out = np.empty((n, 4))
    library.products(ctypes.c_int64(n), step_p, pointer(p), step_q, pointer(q), pointer(out))
    return out


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
