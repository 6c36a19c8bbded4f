"""Stored-sample calibrations of other flight software, from their descriptions: what `benchmarks/onboard.py` compares.

None gives a standard deviation; whether a fit is refused is each one's own rule, where it has one.

PX4 (`commander/mag_calibration`): 240 samples, each at least a distance from all others; Levenberg–Marquardt of a
sphere, then of an ellipsoid (offset, diagonal, off-diagonal) on lengths. ArduPilot (`CompassCalibrator`): 300 samples
by the same kind of rule, sphere then ellipsoid, at most 10 and 20 steps; refused where the fitness is bad or the
diagonal leaves 0.2 to 5. MotionCal: 650 samples; eigenvector of the least eigenvalue of 7 or 10 elements of a quadric.
Betaflight: a sphere of four parameters, streamed; scales stay 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from fieldcal.geometry.rotation import Array

Peer = Callable[[Array, float], Array | None]
"""Readings (n, 3) and the field's length → scale matrix (3, 3), or None where it refuses."""


def kept(z: Array, n: int) -> Array:
    """At most n readings, none nearer to another than n that cover the sphere evenly would be: as they come."""
    centre = 0.5 * (z.max(axis=0) + z.min(axis=0))
    radius = float(np.median(np.linalg.norm(z - centre, axis=1)))
    least = radius * np.sqrt(4 * np.pi / n) * 0.5
    chosen = np.empty((n, 3))
    count = 0
    for reading in z:
        if count < n and (count == 0 or np.min(np.sum((chosen[:count] - reading) ** 2, axis=1)) > least**2):
            chosen[count] = reading
            count += 1
    return chosen[:count]


def lengths(p: Array, z: Array) -> Array:
    """Of M (z − o), M symmetric, p = o (3), diagonal (3), off-diagonal (3)."""
    m = np.array([[p[3], p[6], p[7]], [p[6], p[4], p[8]], [p[7], p[8], p[5]]])
    return np.linalg.norm((z - p[:3]) @ m, axis=1)


def sphere_then_ellipsoid(z: Array, length: float, steps: tuple[int, int]) -> tuple[Array, float]:
    """Scale matrix, and rms of the lengths over the field's, of Levenberg–Marquardt on a sphere, then an ellipsoid."""
    start = np.append(z.mean(axis=0), np.mean(np.linalg.norm(z - z.mean(axis=0), axis=1)))
    sphere = least_squares(
        lambda p: np.linalg.norm(z - p[:3], axis=1) - p[3], start, method="lm", max_nfev=steps[0] * 5
    ).x
    begin = np.concatenate([sphere[:3], np.full(3, length / sphere[3]), np.zeros(3)])
    fit = least_squares(lambda p: lengths(p, z) - length, begin, method="lm", max_nfev=steps[1] * 10)
    p = fit.x
    return np.array([[p[3], p[6], p[7]], [p[6], p[4], p[8]], [p[7], p[8], p[5]]]), float(np.sqrt(np.mean(fit.fun**2)))


def px4(z: Array, length: float) -> Array | None:
    """240 samples, Levenberg–Marquardt."""
    own = kept(z, 240)
    return None if len(own) < 30 else sphere_then_ellipsoid(own, length, (100, 100))[0]


def ardupilot(z: Array, length: float) -> Array | None:
    """300 samples, in two steps."""
    own = kept(z, 300)
    if len(own) < 30:
        return None
    scale, rms = sphere_then_ellipsoid(own, length, (10, 20))
    diagonal = np.diagonal(scale)
    return None if rms > 0.16 * length or diagonal.min() < 0.2 or diagonal.max() > 5.0 else scale


def motioncal(z: Array, length: float, *, full: bool) -> Array | None:
    """650 samples, an eigenvector of 7 or 10 elements."""
    own = z[np.linspace(0, len(z) - 1, 650).astype(int)]
    centre, spread = own.mean(axis=0), float(np.linalg.norm(own.std(axis=0)))
    x, y, w = ((own - centre) / spread).T
    mixed = [2 * y * w, 2 * x * w, 2 * x * y] if full else []
    d = np.column_stack([x * x, y * y, w * w, *mixed, x, y, w, np.ones(len(x))])
    v = np.linalg.eigh(d.T @ d)[1][:, 0]
    a = np.diag(v[:3])
    if full:
        a[1, 2] = a[2, 1] = v[3]
        a[0, 2] = a[2, 0] = v[4]
        a[0, 1] = a[1, 0] = v[5]
    if np.trace(a) < 0:
        a, v = -a, -v
    eigenvalues, axes = np.linalg.eigh(a)
    if eigenvalues[0] <= 0:
        return None
    along = np.linalg.solve(a, 0.5 * v[-4:-1])
    g = along @ a @ along - v[-1]
    return None if g <= 0 else (axes * np.sqrt(eigenvalues / g)) @ axes.T * length / spread


def betaflight(z: Array, length: float) -> Array | None:
    """A sphere by four streamed parameters: one scale for all axes."""
    d = np.column_stack([2 * z, np.ones(len(z))])
    t = np.linalg.lstsq(d, np.sum(z * z, axis=1), rcond=None)[0]
    square = t[3] + t[:3] @ t[:3]
    return None if square <= 0 else np.eye(3) * length / np.sqrt(square)


PEERS: dict[str, Peer] = {
    "PX4: 240 stored, Levenberg–Marquardt, 9 parameters": px4,
    "ArduPilot: 300 stored, two steps, 9 parameters": ardupilot,
    "MotionCal: 650 stored, 7 elements": lambda z, length: motioncal(z, length, full=False),
    "MotionCal: 650 stored, 10 elements": lambda z, length: motioncal(z, length, full=True),
    "Betaflight: 4 streamed parameters": betaflight,
}
