"""Algebraic fits of an ellipsoid to readings: a quadric by least squares, and the triad that maps it to the unit
sphere.

Fast and without a start, but they minimise an algebraic distance: `ellipsoid` refines them. Readings x (n, 3) are
centred and of order one. All raise UnusableFlight `ellipsoid_degenerate` where the quadric is no ellipsoid.
"""

from __future__ import annotations

import numpy as np

from fieldcal.errors import UnusableFlight
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

# Inverse of the matrix of Li and Griffiths' constraint 4J − I² > 0 on (θ1, θ2, θ3).
CONSTRAINT_INVERSE = 0.5 * np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]])

Triad = tuple[Array, Array]
"""Λ (3, 3) and b (3,) with ‖Λx + b‖ ≈ 1."""


def triad_of_quadric(theta: Array, offset: float) -> tuple[Array, Array]:
    """Λ and b for unit radius from the quadric xᵀQx + 2pᵀx + θ10 = 0 (Eq. 7–8 with the bracket's θ10 undivided)."""
    q = np.array(
        [[theta[0], theta[5], theta[4]], [theta[5], theta[1], theta[3]], [theta[4], theta[3], theta[2]]], dtype=float
    )
    p = theta[6:]
    if np.trace(q) < 0:
        q, p, offset = -q, -p, -offset
    lengths, axes = np.linalg.eigh(q)
    if lengths[0] <= 1e-12 * lengths[2]:
        raise UnusableFlight(
            ReasonCode.ELLIPSOID_DEGENERATE,
            "The readings lie on a plane or an open surface, not an ellipsoid: turn through more attitudes.",
            {"quadric_eigenvalues": [float(v) for v in lengths]},
        )
    to_centre = np.linalg.solve(q, p)
    g = float(p @ to_centre - offset)  # G of Eq. 7–8
    if g <= 0:
        raise UnusableFlight(
            ReasonCode.ELLIPSOID_DEGENERATE, "The fitted quadric has no real points: too little motion."
        )
    scale = (axes * np.sqrt(lengths / g)) @ axes.T  # λ_i = f √(θ_i/G); f = 1
    return scale, scale @ to_centre  # b_i = λ_i θ_{i+6}/θ_i


def li_griffiths(x: Array, *, full: bool = False) -> Triad:
    """Li and Griffiths' constrained eigenproblem on S = DᵀD in blocks; `full`: with cross terms."""
    x1, x2, x3 = x.T
    squares = [x1 * x1, x2 * x2, x3 * x3]
    if full:
        squares += [2 * x2 * x3, 2 * x1 * x3, 2 * x1 * x2]
    m = len(squares)
    d = np.stack([*squares, 2 * x1, 2 * x2, 2 * x3, np.ones(len(x))], axis=1)
    s = d.T @ d
    s11, s12, s22 = s[:m, :m], s[:m, m:], s[m:, m:]
    inverse = np.zeros((m, m))
    inverse[:3, :3] = CONSTRAINT_INVERSE
    inverse[range(3, m), range(3, m)] = -0.25
    try:
        lower = np.linalg.solve(s22, s12.T)
    except np.linalg.LinAlgError as error:
        raise UnusableFlight(
            ReasonCode.ELLIPSOID_DEGENERATE, "The readings lie in a plane: turn about more axes."
        ) from error
    values, vectors = np.linalg.eig(inverse @ (s11 - s12 @ lower))
    v1 = vectors[:, int(np.argmax(values.real))].real  # the largest, not "the positive one"
    v2 = -lower @ v1
    theta = np.zeros(9)
    theta[:m] = v1
    theta[6:] = v2[:3]
    return triad_of_quadric(theta, float(v2[3]))


def total_least_squares(x: Array) -> Triad:
    """Total least squares: smallest right singular vector of the column-scaled quadric regressors."""
    d = np.column_stack([x * x, 2 * x, np.ones(len(x))])
    norms = np.linalg.norm(d, axis=0)
    norms[norms == 0.0] = 1.0  # a stuck axis has none
    theta = np.linalg.svd(d / norms, full_matrices=False)[2][-1] / norms
    return triad_of_quadric(np.concatenate([theta[:3], np.zeros(3), theta[3:6]]), float(theta[6]))


def first_step(x: Array) -> Triad:
    """The first of Gebre-Egziabher's two steps: linear least squares on Hx²."""
    x1, x2, x3 = x.T
    regressors = np.column_stack([2 * x1, -x2 * x2, 2 * x2, -x3 * x3, 2 * x3, np.ones(len(x))])
    t = np.linalg.lstsq(regressors, x1 * x1, rcond=None)[0]
    theta = np.array([1.0, t[1], t[3], 0, 0, 0, -t[0], -t[2], -t[4]])
    return triad_of_quadric(theta, -float(t[5]))


def sphere(x: Array) -> Triad:
    """Linear least-squares sphere: the start where the quadric is no ellipsoid."""
    d = np.column_stack([2 * x, np.ones(len(x))])
    t, _, rank, _ = np.linalg.lstsq(d, np.sum(x * x, axis=1), rcond=None)
    radius_squared = float(t[3] + t[:3] @ t[:3])
    if rank < 4 or radius_squared <= 0:
        raise UnusableFlight(ReasonCode.ELLIPSOID_DEGENERATE, "The readings lie in a plane: turn about more axes.")
    radius = np.sqrt(radius_squared)
    return np.eye(3) / radius, -t[:3] / radius
