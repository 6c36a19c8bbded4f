"""The sensor model and the geometry around it: Eq. 5, gravity sign, axes, Eq. 3's lever arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.geometry.frames import FRD_FROM_FLU
from fieldcal.geometry.rotation import Array

GRAVITY_SIGNS = {"gravity": 1.0, "specific_force": -1.0}


def calibrate(logged: ArrayLike, scale: ArrayLike, bias: ArrayLike) -> Array:
    """z = Λ z_d + b (Eq. 5) in sensor axes, (n, 3); `scale` is (3,) or a full (3, 3)."""
    z, scale = np.asarray(logged, dtype=float), np.asarray(scale, dtype=float)
    return (z * scale if scale.ndim == 1 else z @ scale.T) + np.asarray(bias, dtype=float)


def through(matrix: Array, v: Array) -> Array:
    """matrix · v, (3, 3) and (3,): an unknown or infinite element of v concerns only what it has a part in."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(matrix == 0.0, 0.0, matrix * v).sum(axis=1))


def frd_from_sensor(rotation_body_from_sensor: ArrayLike, body: str) -> Array:
    """Sensor axes → the paper's nose-starboard-underside axes, (3, 3): R_BS, then FLU → FRD where the body is "flu"."""
    r = np.asarray(rotation_body_from_sensor, dtype=float)
    if body == "flu":
        return FRD_FROM_FLU @ r
    if body == "frd":
        return r
    raise ValueError(f'body is "frd" or "flu", not {body!r}')


def lever_arm_acceleration(rate: ArrayLike, rate_dot: ArrayLike, lever_arm: ArrayLike) -> Array:
    """Acceleration of the sensor relative to the centre of mass, m/s², body axes, (n, 3).

    −[ωᵀω I − ωωᵀ − S(ω̇)] r_SB, the bracket of Eq. 3 with its sign turned: ω̇ × r + ω × (ω × r).
    Rates (n, 3) rad/s, their derivatives rad/s², lever arm (3,) m.
    """
    w, w_dot, r = (np.asarray(v, dtype=float) for v in (rate, rate_dot, lever_arm))
    return np.asarray(np.cross(w_dot, r) + w * (w @ r)[:, None] - np.sum(w * w, axis=1)[:, None] * r)


def to_centre_of_mass(
    logged: ArrayLike,
    scale: ArrayLike,
    acceleration: ArrayLike,
    frd_from_sensor_axes: ArrayLike,
    gravity_sign: str,
) -> Array:
    """Logged accelerometer readings (n, 3) as they would be at the centre of mass (Eq. 3), still in logged units.

    `acceleration` (n, 3) is `lever_arm_acceleration`, body axes. A gravity-signed sensor reads minus it."""
    sensed = -GRAVITY_SIGNS[gravity_sign] * np.asarray(acceleration) @ np.asarray(frd_from_sensor_axes)
    scale = np.asarray(scale, dtype=float)
    inverse = np.diag(1.0 / scale) if scale.ndim == 1 else np.linalg.inv(scale)
    return np.asarray(logged, dtype=float) - sensed @ inverse.T


def default_reference_reading(logged: ArrayLike, unit: str) -> Array:
    """The IMU's fixed reference reading d0 (3,): 0 for physical units and signed words, mid-scale for unsigned words.

    Decided per axis from readings (n, 3): counts that never go below 0 and pass 32767/2 on average are unsigned
    16-bit words."""
    logged = np.asarray(logged, dtype=float)
    if unit != "counts":
        return np.zeros(3)
    return np.full(3, 32768.0) if np.nanmin(logged) >= 0 and np.nanmedian(logged) > 16384 else np.zeros(3)
