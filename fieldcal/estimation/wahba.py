"""Attitude from vector observations (Wahba's problem, Eq. 9): QUEST and its alternatives, with covariance and TASTE.

Observations are unit or unnormalised vectors in body axes, b_i (k of them, k ≥ 2), each with its reference r_i in n.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.geometry.rotation import Array, continuous, from_euler, parallel_to_quaternion

NEWTON_STEPS = 6
CHUNK = 4096  # samples worked on at a time: what the processor's cache holds


@dataclass(frozen=True)
class AttitudeFit:
    """Attitudes `q` (n, 4), their fit statistic `taste` (n,) and standard deviation `sd` (n,), rad, root of the
    trace of P."""

    q: Array
    taste: Array
    sd: Array


def attitudes(
    observed: ArrayLike, reference: ArrayLike, sigma: ArrayLike, *, method: str = "quest", declination: float = 0.0
) -> AttitudeFit:
    """Attitude of every sample from k ≥ 2 vectors.

    Parameters
    ----------
    observed : (n, k, 3) array
        Vectors in body axes; lengths are ignored. For `triad` the heavier of the first two is exact; for `euler` k is
        2: magnetic field, then gravity.
    reference : (k, 3) array
        The same vectors in n, non-collinear.
    sigma : (k,) array
        Direction noise of each vector, rad per axis. Weights are σ_t²/σ_i².
    method : {"quest", "davenport", "svd", "triad", "euler"}
    declination : float
        Rad east; used by `euler` only (the others have it in the reference).

    Returns
    -------
    AttitudeFit
        TASTE = 2(Σw − λ)/σ_t² ~ χ²(2k − 3): a fault test by sample, blind to heading.

    Raises
    ------
    ValueError
        Shapes, unknown method, collinear references or a non-positive σ.

    References
    ----------
    Shuster & Oh (1981); Shuster & Freeman (1984) for TASTE; Eq. 2, 4 and 9 of the paper.
    """
    b = np.asarray(observed, dtype=float)
    r = np.asarray(reference, dtype=float)
    s = np.asarray(sigma, dtype=float)
    if b.ndim != 3 or b.shape[2] != 3 or b.shape[1] < 2:
        raise ValueError(f"observed must be (n, k, 3) with k ≥ 2, got {b.shape}")
    if r.shape != b.shape[1:] or s.shape != (b.shape[1],) or not (s > 0).all():
        raise ValueError(f"reference must be {b.shape[1:]} and sigma positive ({b.shape[1]},)")
    if method != "euler" and method not in METHODS:
        raise ValueError(f"method is one of {', '.join(METHODS)}, euler, not {method!r}")
    r = r / np.linalg.norm(r, axis=1, keepdims=True)
    if np.linalg.norm(np.cross(r[0], r[1])) < 1e-3:
        raise ValueError("the reference vectors are collinear: the rotation about them is unknown")
    length = np.sqrt(np.einsum("nki,nki->nk", b, b))
    total = 1.0 / float(np.sum(1.0 / s**2))  # σ_t²
    weights = total / s**2
    if method == "euler":
        q = _euler(b, declination)
    b = b / length[:, :, None]
    if method != "euler":
        q = METHODS[method](b, r, weights)
    # λ at the solution: Σ w_i b_i·A(q) r_i, so TASTE is the weighted squared misfit for every method.
    misfit = np.zeros(len(q))
    for i in range(len(r)):
        misfit += weights[i] * (1.0 - np.einsum("ni,ni->n", b[:, i], rotate_reference(q, r[i])))
    return AttitudeFit(continuous(q), 2.0 * misfit / total, _rotation_sd(b, s))


def rotate_reference(q: Array, r: Array) -> Array:
    """A(q) r for one reference vector r (3,) and attitudes q (n, 4): what a perfect sensor would see, (n, 3)."""
    x, y, z, w = q.T
    tx, ty, tz = 2 * (y * r[2] - z * r[1]), 2 * (z * r[0] - x * r[2]), 2 * (x * r[1] - y * r[0])
    return np.stack(
        [r[0] - w * tx + (y * tz - z * ty), r[1] - w * ty + (z * tx - x * tz), r[2] - w * tz + (x * ty - y * tx)],
        axis=1,
    )


def attitude_covariance(observed: ArrayLike, sigma: ArrayLike) -> Array:
    """P = [Σ σ_i⁻² (I − b_i b_iᵀ)]⁻¹, rad², rotation vector in body axes, (n, 3, 3), for unit vectors b (n, k, 3)."""
    return np.linalg.inv(_information(np.asarray(observed, dtype=float), np.asarray(sigma, dtype=float)))


def _information(b: Array, s: Array) -> Array:
    weighted = b / s[None, :, None]
    outer = weighted.transpose(0, 2, 1) @ weighted
    return np.sum(1.0 / s**2) * np.eye(3) - outer


def _rotation_sd(b: Array, s: Array) -> Array:
    """√tr P. For a symmetric 3×3 F: tr F⁻¹ = ½(tr²F − tr F²)/det F."""
    if b.shape[1] == 2:
        # closed form: F has eigenvectors b1×b2 and two in their plane
        p1, p2 = 1.0 / s**2
        cross_squared = 1.0 - np.einsum("ni,ni->n", b[:, 0], b[:, 1]) ** 2
        in_plane = (p1 + p2) / np.maximum(p1 * p2 * cross_squared, 1e-300)
        return np.asarray(np.sqrt(1.0 / (p1 + p2) + in_plane))
    f = _information(b, s)
    trace = np.trace(f, axis1=1, axis2=2)
    square = np.einsum("nij,nij->n", f, f)
    return np.asarray(np.sqrt(0.5 * (trace**2 - square) / np.maximum(np.linalg.det(f), 1e-300)))


def quest(b: Array, r: Array, weights: Array) -> Array:
    """QUEST with sequential rotations: unit b (n, k, 3), unit r (k, 3), weights (k,) of sum 1 → q (n, 4).

    Vectorised over samples; S is never inverted (it is singular at common attitudes)."""
    q = np.empty((len(b), 4))
    wr = weights[:, None] * r
    for start in range(0, len(b), CHUNK):
        part = b[start : start + CHUNK]
        _quest_chunk(_profile(part, wr), q[start : start + CHUNK])
    return q


def _profile(b: Array, wr: Array) -> Array:
    """B = Σ w b rᵀ as (3, 3, n): one contiguous row per element."""
    components = np.ascontiguousarray(b.transpose(1, 2, 0))
    out = np.multiply(components[0][:, None, :], wr[0][None, :, None])
    for i in range(1, len(wr)):
        out += components[i][:, None, :] * wr[i][None, :, None]
    return out


def _quest_chunk(profile: Array, out: Array) -> None:
    """One cache-sized chunk of `quest`; profile B (3, 3, n), result into out (n, 4)."""
    x, gamma, derivative, lam = _quest_solution(profile)
    # γ/|ψ′(λ)| is δ²: the same quantity of the frame turned by 180° about axis i is ε_i². Where δ² is small use the
    # largest.
    weak = np.flatnonzero(np.abs(gamma) < 0.1 * np.abs(derivative))
    out[:, 0], out[:, 1], out[:, 2], out[:, 3] = x[0], x[1], x[2], gamma
    if len(weak):
        sub, lam = profile[:, :, weak], lam[weak]
        best = np.abs(gamma[weak])
        choice = out[weak]
        for axis in range(3):
            sign = np.full(3, -1.0)
            sign[axis] = 1.0
            xr, gr, _, _ = _quest_solution(sub * sign[None, :, None], lam)
            better = np.flatnonzero(np.abs(gr) > best)
            best[better] = np.abs(gr[better])
            choice[better] = _turn_back(np.stack([*xr, gr], axis=1)[better], axis)
        out[weak] = choice
    out /= np.sqrt(np.einsum("ni,ni->n", out, out))[:, None]


def _turn_back(q: Array, axis: int) -> Array:
    """Undo a reference frame turned by 180° about `axis`: q ⊗-free reordering of the four components."""
    i, j, k = axis, (axis + 1) % 3, (axis + 2) % 3
    out = np.empty_like(q)
    out[:, i], out[:, 3] = q[:, 3], -q[:, i]
    out[:, j], out[:, k] = -q[:, k], q[:, j]
    return out


def _quest_solution(profile: Array, lam: Array | None = None) -> tuple[Array, Array, Array, Array]:
    """X (3, n), γ (n,), ψ′(λ) (n,) and λ (n,) of QUEST for B (3, 3, n); λ is found by Newton when not given."""
    (b11, b12, b13), (b21, b22, b23), (b31, b32, b33) = profile
    sigma = b11 + b22 + b33
    s11, s22, s33 = 2 * b11, 2 * b22, 2 * b33
    s12, s13, s23 = b12 + b21, b13 + b31, b23 + b32
    z1, z2, z3 = b23 - b32, b31 - b13, b12 - b21
    m11, m12, m13 = s22 * s33 - s23 * s23, s13 * s23 - s12 * s33, s12 * s23 - s13 * s22
    kappa = m11 + (s11 * s33 - s13 * s13) + (s11 * s22 - s12 * s12)
    delta = s11 * m11 + s12 * m12 + s13 * m13
    y1, y2, y3 = s11 * z1 + s12 * z2 + s13 * z3, s12 * z1 + s22 * z2 + s23 * z3, s13 * z1 + s23 * z2 + s33 * z3
    sigma2 = sigma * sigma
    a = sigma2 - kappa
    b = sigma2 + z1 * z1 + z2 * z2 + z3 * z3
    c = delta + z1 * y1 + z2 * y2 + z3 * y3
    d = y1 * y1 + y2 * y2 + y3 * y3
    ab, constant = a + b, a * b + c * sigma - d
    if lam is None:
        lam = np.ones_like(sigma)
        for _ in range(NEWTON_STEPS):
            square = lam * lam
            slope = (4 * square - 2 * ab) * lam - c
            step = ((square - ab) * square - c * lam + constant) / np.where(np.abs(slope) > 1e-14, slope, 1.0)
            lam = lam - step
            if np.max(np.abs(step)) < 1e-13:
                break
    derivative = (4 * lam * lam - 2 * ab) * lam - c
    alpha = lam * lam - sigma2 + kappa
    beta = lam - sigma
    gamma = (lam + sigma) * alpha - delta
    yy1, yy2, yy3 = s11 * y1 + s12 * y2 + s13 * y3, s12 * y1 + s22 * y2 + s23 * y3, s13 * y1 + s23 * y2 + s33 * y3
    x = np.stack([alpha * z1 + beta * y1 + yy1, alpha * z2 + beta * y2 + yy2, alpha * z3 + beta * y3 + yy3])
    return x, gamma, derivative, lam


def davenport(b: Array, r: Array, weights: Array) -> Array:
    """Davenport's q-method: eigenvector of K's largest eigenvalue."""
    profile = np.einsum("k,nki,kj->nij", weights, b, r)
    sigma = np.trace(profile, axis1=1, axis2=2)
    k = np.empty((len(b), 4, 4))
    k[:, :3, :3] = profile + profile.transpose(0, 2, 1) - sigma[:, None, None] * np.eye(3)
    z = np.stack(
        [profile[:, 1, 2] - profile[:, 2, 1], profile[:, 2, 0] - profile[:, 0, 2], profile[:, 0, 1] - profile[:, 1, 0]],
        axis=1,
    )
    k[:, :3, 3] = k[:, 3, :3] = z
    k[:, 3, 3] = sigma
    return np.asarray(np.linalg.eigh(k)[1][:, :, -1])


def svd(b: Array, r: Array, weights: Array) -> Array:
    """Markley's SVD solution of Wahba's problem."""
    return _from_matrices(nearest_rotation(np.einsum("k,nki,kj->nij", weights, b, r)))


def nearest_rotation(profile: ArrayLike) -> Array:
    """The rotation A (…, 3, 3) with the largest tr(A Bᵀ) for attitude profiles B = Σ w b rᵀ (…, 3, 3): b ≈ A r
    (Markley 1988)."""
    u, _, vt = np.linalg.svd(np.asarray(profile, dtype=float))
    signs = np.ones(u.shape[:-1])
    signs[..., 2] = np.linalg.det(u) * np.linalg.det(vt)
    return np.asarray((u * signs[..., None, :]) @ vt)


def rotation_between(a: ArrayLike, b: ArrayLike) -> Array:
    """The rotation R (3, 3) with b ≈ R a for vectors a, b (n, 3) of any length, each as heavy as it is long."""
    return nearest_rotation(np.asarray(b, dtype=float).T @ np.asarray(a, dtype=float))


def triad(b: Array, r: Array, weights: Array) -> Array:
    """TRIAD on the first two vectors, the heavier one exact."""
    first, second = (0, 1) if weights[0] >= weights[1] else (1, 0)

    def base(v: Array, w: Array) -> Array:
        n = np.cross(v, w)
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        return np.stack([v, n, np.cross(v, n)], axis=-1)

    return _from_matrices(base(b[:, first], b[:, second]) @ base(r[first], r[second]).T)


def _from_matrices(a: Array) -> Array:
    """Quaternions (n, 4) of A (n, 3, 3)."""
    q = parallel_to_quaternion(a)
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def _euler(vectors: Array, declination: float) -> Array:
    """Eq. 4 for bank and pitch, Eq. 2 for heading: good at small angles, what a small processor can afford.

    `vectors` (n, 2, 3): magnetic field, then gravity-signed acceleration, in body axes, any common length each."""
    a = vectors[:, 1] / np.median(np.linalg.norm(vectors[:, 1], axis=1))
    bank = np.arcsin(np.clip(a[:, 1], -1.0, 1.0))
    pitch = -np.arcsin(np.clip(a[:, 0], -1.0, 1.0))
    heading = -np.arctan2(vectors[:, 0, 1], vectors[:, 0, 0]) + declination
    return from_euler(np.stack([bank, pitch, heading], axis=1))


METHODS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "quest": quest,
    "davenport": davenport,
    "svd": svd,
    "triad": triad,
}
