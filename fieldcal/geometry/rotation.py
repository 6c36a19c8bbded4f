"""Quaternion algebra on arrays: products, rotation vectors, kinematics (Eq. 1, 10, 11), interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldcal import compiled
from fieldcal.compiled import quaternions
from fieldcal.geometry.intervals import interval_of, share_of_interval

Array = NDArray[np.floating]  # of any width, because numpy.linalg's answers are so to the type check

IDENTITY = np.broadcast_to(np.array([0.0, 0.0, 0.0, 1.0]), 4)
"""The quaternion of no rotation; read-only, as every user has the same one."""


def skew(v: ArrayLike) -> Array:
    """S(v): the cross-product matrix, (…, 3) → (…, 3, 3); S(v) u = v × u."""
    v = np.asarray(v, dtype=float)
    s = np.zeros((*v.shape[:-1], 3, 3))
    s[..., 0, 1], s[..., 0, 2] = -v[..., 2], v[..., 1]
    s[..., 1, 0], s[..., 1, 2] = v[..., 2], -v[..., 0]
    s[..., 2, 0], s[..., 2, 1] = -v[..., 1], v[..., 0]
    return s


def conjugate(q: ArrayLike) -> Array:
    """The inverse rotation of unit quaternions (…, 4)."""
    return np.asarray(q, dtype=float) * np.array([-1.0, -1.0, -1.0, 1.0])


def multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Product p ⊗ q, scalar last, so that as body-to-inertial rotations R(p ⊗ q) = R(p) R(q). Broadcasts."""
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    if compiled.LIBRARY is not None and max(p.ndim, q.ndim) == 2 and (p.ndim != q.ndim or len(p) == len(q)):
        return quaternions.multiply(compiled.LIBRARY, p, q)
    px, py, pz, pw = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qx, qy, qz, qw = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty((*np.broadcast_shapes(p.shape[:-1], q.shape[:-1]), 4))
    out[..., 0] = pw * qx + px * qw + py * qz - pz * qy
    out[..., 1] = pw * qy - px * qz + py * qw + pz * qx
    out[..., 2] = pw * qz + px * qy - py * qx + pz * qw
    out[..., 3] = pw * qw - px * qx - py * qy - pz * qz
    return out


def normalise(q: ArrayLike) -> Array:
    """Unit quaternions (…, 4)."""
    q = np.asarray(q, dtype=float)
    return q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))


def from_rotation_vector(v: ArrayLike) -> Array:
    """Unit quaternions of rotation vectors (…, 3), rad: Eq. 1 with axis v/‖v‖ and angle ‖v‖."""
    v = np.asarray(v, dtype=float)
    half_squared = 0.25 * np.sum(v * v, axis=-1)
    half = np.sqrt(half_squared)
    out = np.empty((*v.shape[:-1], 4))
    # sin(x)/x by numpy's sinc, exact at 0
    out[..., :3] = 0.5 * np.sinc(half / np.pi)[..., None] * v
    out[..., 3] = np.cos(half)
    return out


def to_rotation_vector(q: ArrayLike) -> Array:
    """Rotation vectors (…, 3), rad, of unit quaternions; the shorter way round (angle ≤ π)."""
    q = np.asarray(q, dtype=float)
    sine = np.sqrt(np.sum(q[..., :3] ** 2, axis=-1))
    angle = 2.0 * np.arctan2(sine, np.abs(q[..., 3]))
    factor = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-12)
    return np.asarray(np.copysign(1.0, q[..., 3])[..., None] * factor[..., None] * q[..., :3])


def body_from_inertial(q: ArrayLike) -> Array:
    """A(q), (…, 4) → (…, 3, 3): inertial to body components."""
    q = np.asarray(q, dtype=float)
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    a = np.empty((*q.shape[:-1], 3, 3))
    a[..., 0, 0], a[..., 1, 1], a[..., 2, 2] = (
        1 - 2 * (y * y + z * z),
        1 - 2 * (x * x + z * z),
        1 - 2 * (x * x + y * y),
    )
    a[..., 0, 1], a[..., 1, 0] = 2 * (x * y + w * z), 2 * (x * y - w * z)
    a[..., 0, 2], a[..., 2, 0] = 2 * (x * z - w * y), 2 * (x * z + w * y)
    a[..., 1, 2], a[..., 2, 1] = 2 * (y * z + w * x), 2 * (y * z - w * x)
    return a


def parallel_to_quaternion(a: ArrayLike) -> Array:
    """Vectors (…, 4) along the quaternions of A (…, 3, 3), inertial to body, largest component positive; not of unit
    length.

    Of 4qqᵀ, whose elements are sums of A's, the row with the largest diagonal element (Shepperd 1978): it never
    vanishes, at any attitude."""
    a = np.asarray(a, dtype=float)
    diagonal = np.stack([a[..., 0, 0], a[..., 1, 1], a[..., 2, 2], np.trace(a, axis1=-2, axis2=-1)], axis=-1)
    outer = np.empty((*a.shape[:-2], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., i, i] = 1 + diagonal[..., i] - diagonal[..., j] - diagonal[..., k]
        outer[..., i, j] = outer[..., j, i] = a[..., i, j] + a[..., j, i]
        outer[..., i, 3] = outer[..., 3, i] = a[..., j, k] - a[..., k, j]
    outer[..., 3, 3] = 1 + diagonal[..., 3]
    largest = np.argmax(diagonal, axis=-1)[..., None, None]
    return np.asarray(np.take_along_axis(outer, largest, axis=-2)[..., 0, :])


def from_matrix(a: ArrayLike) -> Array:
    """Quaternion (4,) of one A (3, 3), inertial to body, with δ ≥ 0."""
    q = parallel_to_quaternion(a)
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def continuous(q: ArrayLike) -> Array:
    """Flip signs so that neighbouring quaternions (n, 4) share a hemisphere."""
    q = np.array(q, dtype=float)
    if len(q) > 1:
        flips = np.sum(q[1:] * q[:-1], axis=1) < 0
        q[1:][np.cumsum(flips) % 2 == 1] *= -1
    return q


def rate_matrix(q: ArrayLike) -> Array:
    """Ξ(q), (…, 4) → (…, 4, 3): q̇ = ½ Ξ(q) ω (Eq. 10–11)."""
    q = np.asarray(q, dtype=float)
    xi = np.empty((*q.shape[:-1], 4, 3))
    xi[..., :3, :] = skew(q[..., :3])
    for i in range(3):
        xi[..., i, i] = q[..., 3]
    xi[..., 3, :] = -q[..., :3]
    return xi


def body_rate(q: ArrayLike, q_dot: ArrayLike) -> Array:
    """ω̂ = 2 Ξᵀ q̇, rad/s, body axes: the four kinematic equations (Eq. 10) solved for the rate.

    Written as the vector part of 2 q* ⊗ q̇."""
    return 2.0 * multiply(conjugate(q), q_dot)[..., :3]


def angle_between(p: ArrayLike, q: ArrayLike) -> Array:
    """Rotation angle, rad, from attitude p to attitude q (n, 4)."""
    return np.asarray(np.linalg.norm(to_rotation_vector(multiply(conjugate(p), q)), axis=-1))


def mean_quaternion(q: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """The quaternion (4,) nearest to all of q (n, 4), signs ignored (Markley et al. 2007: largest eigenvector)."""
    q = np.asarray(q, dtype=float)
    w = np.ones(len(q)) if weights is None else np.asarray(weights, dtype=float)
    vector = np.linalg.eigh((q * w[:, None]).T @ q)[1][:, -1]
    return np.asarray(vector if vector[3] >= 0 else -vector)


def rotation_steps(t: ArrayLike, rate: ArrayLike) -> Array:
    """Rotation vectors (n−1, 3) between samples of body rate (n, 3) at real stamps t (n,), rate linear in between.

    The cross term is the second-order (coning) part of the rotation vector for a linear rate."""
    t, rate = np.asarray(t, dtype=float), np.asarray(rate, dtype=float)
    dt = np.diff(t)[:, None]
    return 0.5 * dt * (rate[:-1] + rate[1:]) + dt * dt / 12.0 * np.cross(rate[:-1], rate[1:])


def cumulative_product(steps: ArrayLike) -> Array:
    """Running product s0, s0 ⊗ s1, … of quaternions (n, 4): the one scan of output error.

    Done as √n vectorised steps inside blocks and one pass over the blocks."""
    steps = np.asarray(steps, dtype=float)
    n = len(steps)
    if n == 0:
        return steps.copy()
    length = max(1, int(np.sqrt(n)))
    blocks = -(-n // length)
    padded = np.zeros((blocks * length, 4))
    padded[:, 3] = 1.0
    padded[:n] = steps
    padded = np.ascontiguousarray(padded.reshape(blocks, length, 4).transpose(1, 0, 2))
    for k in range(1, length):
        padded[k] = multiply(padded[k - 1], padded[k])
    start = np.empty((blocks, 4))
    start[0] = IDENTITY
    for k in range(1, blocks):
        start[k] = multiply(start[k - 1], padded[-1, k - 1])
    return normalise(multiply(start, padded).transpose(1, 0, 2).reshape(-1, 4)[:n])


def propagate(t: ArrayLike, rate: ArrayLike, initial: ArrayLike) -> Array:
    """Attitudes (n, 4) from body rates (n, 3) at stamps t (n,), starting at `initial` (4,) (Eq. 10 integrated)."""
    steps = from_rotation_vector(rotation_steps(t, rate))
    q = np.empty((len(steps) + 1, 4))
    q[0] = initial
    q[1:] = multiply(initial, cumulative_product(steps))
    return q


def hermite(t: ArrayLike, q: ArrayLike, rate: ArrayLike, at: ArrayLike) -> Array:
    """Cubic interpolation of attitudes (n, 4) with body rates (n, 3), rad/s, at times `at` (m,).

    Between samples T apart SLERP cuts a swing of ω rad/s short by (ωT)²/12: 0.3 % at 3 Hz and 10 ms. Samples without a
    rate (NaN) fall back on it."""
    t, q, rate, at = (np.asarray(x, dtype=float) for x in (t, q, rate, at))
    if compiled.LIBRARY is not None and len(t) > 1:
        return quaternions.hermite(compiled.LIBRARY, t, q, rate, at)
    i = interval_of(t, at)
    step = t[i + 1] - t[i]
    u = share_of_interval(t, i, at)[:, None]
    whole = to_rotation_vector(multiply(conjugate(q[i]), q[i + 1]))
    begin, end = rate[i] * step[:, None], rate[i + 1] * step[:, None]
    begin, end = (np.where(np.isfinite(x), x, whole) for x in (begin, end))
    turned = (3 - 2 * u) * u**2 * whole + u * (1 - u) ** 2 * begin - u**2 * (1 - u) * end
    return multiply(q[i], from_rotation_vector(turned))


def slerp(t: ArrayLike, q: ArrayLike, at: ArrayLike) -> Array:
    """Spherical interpolation of attitudes q (n, 4) at rising stamps t (n,) to the times `at` (m,).

    Times outside t take the nearest end; mask them. Does not look for gaps: mask those too."""
    t, q, at = np.asarray(t, dtype=float), np.asarray(q, dtype=float), np.asarray(at, dtype=float)
    if compiled.LIBRARY is not None and len(t) > 1:
        return quaternions.slerp(compiled.LIBRARY, t, q, at)
    i = interval_of(t, at)
    step = to_rotation_vector(multiply(conjugate(q[i]), q[i + 1]))
    return continuous(multiply(q[i], from_rotation_vector(share_of_interval(t, i, at)[:, None] * step)))


def euler_angles(q: ArrayLike) -> Array:
    """Bank φ, pitch θ, heading ψ (…, 3), rad, of attitudes (…, 4) (3-2-1 sequence)."""
    a = body_from_inertial(q)
    return np.stack(
        [
            np.arctan2(a[..., 1, 2], a[..., 2, 2]),
            -np.arcsin(np.clip(a[..., 0, 2], -1.0, 1.0)),
            np.arctan2(a[..., 0, 1], a[..., 0, 0]),
        ],
        axis=-1,
    )


def from_euler(angles: ArrayLike) -> Array:
    """Attitudes (…, 4) from bank, pitch and heading (…, 3), rad (3-2-1 sequence)."""
    half = 0.5 * np.asarray(angles, dtype=float)
    c, s = np.cos(half), np.sin(half)
    cf, ct, cp = c[..., 0], c[..., 1], c[..., 2]
    sf, st, sp = s[..., 0], s[..., 1], s[..., 2]
    return np.stack(
        [
            sf * ct * cp - cf * st * sp,
            cf * st * cp + sf * ct * sp,
            cf * ct * sp - sf * st * cp,
            cf * ct * cp + sf * st * sp,
        ],
        axis=-1,
    )
