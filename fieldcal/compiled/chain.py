"""The chain of knots in C (`chain.c`): wrappers that check shapes. Names and shapes are those of
`estimation.joint.chain_solver`."""

from __future__ import annotations

import ctypes

import numpy as np

from fieldcal.compiled import pointer, real

STATES, RIGHTS = 12, 5  # of chain.c


def eliminate(
    library: ctypes.CDLL, diagonal: np.ndarray, below: np.ndarray, right: np.ndarray, p: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Cholesky factors (K, s, s), couplings (K−1, s, s), right-hand sides carried forward (K, s, c), and what the knots
    absorb of the parameters (p, c); None where the matrix is not positive definite."""
    k, columns = len(diagonal), right.shape[2]
    factor, coupling = (
        real(diagonal, k, STATES, STATES).copy(),
        real(below, k - 1, STATES, STATES).copy(),
    )
    carried, absorbed = real(right, k, STATES, columns).copy(), np.zeros((p, columns))
    status = library.eliminate(
        ctypes.c_int64(k), ctypes.c_int64(columns), ctypes.c_int64(p), *map(pointer, (factor, coupling, carried)),
        pointer(absorbed),
    )  # fmt: skip
    return None if status else (factor, coupling, carried, absorbed)


def substitute(library: ctypes.CDLL, factor: np.ndarray, coupling: np.ndarray, carried: np.ndarray) -> np.ndarray:
    """Solutions (K, s, c) of right-hand sides carried forward (K, s, c), by the results of `eliminate`."""
    k, columns = len(factor), carried.shape[2]
    out = real(carried, k, STATES, columns).copy()
    given = real(factor, k, STATES, STATES), real(coupling, k - 1, STATES, STATES)
    library.substitute(ctypes.c_int64(k), ctypes.c_int64(columns), *map(pointer, (*given, out)))
    return out


def add_jumps(
    library: ctypes.CDLL,
    jump: np.ndarray,
    moved: np.ndarray,
    weight: np.ndarray,
    probe: np.ndarray,
    normal: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Add attitude jumps to `normal`: diagonal, below, right, parameters, parameters_right."""
    links, _, p = moved.shape
    given = real(jump, links, 3), real(moved, links, 3, p), real(weight, links), real(probe, links, 3)
    _check(normal, links + 1, p)
    library.add_jumps(ctypes.c_int64(links + 1), ctypes.c_int64(p), *map(pointer, (*given, *normal)))


def add_motion(
    library: ctypes.CDLL,
    process: tuple[np.ndarray, np.ndarray, np.ndarray],
    motion: np.ndarray,
    probe: np.ndarray,
    start: np.ndarray,
    normal: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Add the translation's process (ahead, behind (K−1, 3, 3), first (K, 3, 3)) to `normal`."""
    k, p = len(motion), len(normal[3])
    ahead, behind, first = process
    given = (
        real(ahead, k - 1, 3, 3), real(behind, k - 1, 3, 3), real(first, k, 3, 3),
        real(motion, k, 9), real(probe, k - 1, 3, 3), real(start, k, 3, 3),
    )  # fmt: skip
    _check(normal, k, p)
    library.add_motion(ctypes.c_int64(k), ctypes.c_int64(p + RIGHTS), *map(pointer, (*given, *normal[:3])))


def _check(normal: tuple[np.ndarray, ...], k: int, p: int) -> None:
    shapes = (
        (k, STATES, STATES), (k - 1, STATES, STATES), (k, STATES, p + RIGHTS), (p, p), (p, RIGHTS),
    )  # fmt: skip
    if any(x.shape != shape or x.dtype != np.float64 for x, shape in zip(normal, shapes, strict=True)):
        raise ValueError("Normal equations of another shape than the kernel's.")
