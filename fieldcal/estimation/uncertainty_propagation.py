"""Propagation of the magnetometer's and accelerometer's uncertainty into the attitude and the gyroscope (first order).

The method is serial: an error of the first triads turns the attitudes that the gyroscope is fitted to, and moves
with the motion, so the gyroscope's residuals cannot show it. Here their covariance is carried through Wahba's
problem and the normal equations of output error and of equation error.
"""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.gyroscope.equation_error import GyroFit, from_centred
from fieldcal.estimation.gyroscope.output_error import attitude_error, attitude_sensitivity, shooting_segments
from fieldcal.estimation.gyroscope.output_error import without_stretch_means as project
from fieldcal.estimation.segments import begins_run
from fieldcal.estimation.wahba import attitude_covariance
from fieldcal.geometry.rotation import Array, body_from_inertial, skew

MOST_SAMPLES = 1500  # enough for a first-order propagation of smooth sensitivities


def attitude_jacobian(vectors: Array, sigma: Array, which: int, logged: Array, signed_axes: Array) -> Array:
    """∂φ/∂(λ, b) of triad `which`, (n, 3, 6): φ the attitude error, rad, rotation vector in body axes.

    Minimising Σ σ_i⁻²‖b_i − A r_i‖² gives φ = −P Σ σ_i⁻² b_i × δb_i; here δb = R (z_d∘δλ + δb)/‖h‖.

    Parameters
    ----------
    vectors : (n, k, 3) array
        Calibrated vectors, body axes, any length.
    sigma : (k,) array
        Direction noise used as weights, rad.
    which : int
        The triad whose constants are varied.
    logged : (n, 3) array
        Its readings, sensor axes.
    signed_axes : (3, 3) array
        Sensor to body axes, times −1 for a specific-force accelerometer.
    """
    length = np.linalg.norm(vectors, axis=2, keepdims=True)
    unit = vectors / length
    gain = -attitude_covariance(unit, sigma) @ skew(unit[:, which]) @ signed_axes / sigma[which] ** 2
    gain /= length[:, which, :, None]
    return np.concatenate([gain * logged[:, None, :], gain], axis=2)


def thinned(n: int) -> slice:
    """Every so many of n samples that MOST_SAMPLES to twice as many are left."""
    return slice(None, None, max(1, n // MOST_SAMPLES))


def constants_to_gyro(
    t: Array,
    q: Array,
    segment: np.ndarray,
    rate_logged: Array,
    weight: Array,
    fit: GyroFit,
    stretch_s: float,
    pairs: list[tuple[Array, Array]],
) -> Array:
    """Covariance (6, 6) that uncertain vector triads add to the gyroscope's (λ, b).

    `pairs` holds, for each independent triad, ∂φ/∂(its constants) (n, 3, 6) in the gyroscope's axes and their
    covariance (6, 6). δθ = M⁻¹ Σ Sᵀ w R_ns φ with output error's own S, w and M. `thinned` samples are enough.
    """
    if not pairs:
        return np.zeros((6, 6))
    stretch = shooting_segments(t, segment, stretch_s)
    first = begins_run(stretch)
    centre = rate_logged.mean(axis=0)
    spread = rate_logged.std(axis=0)
    x = (rate_logged - centre) / spread
    _, model = attitude_error(t, q, fit.scale * rate_logged + fit.bias, stretch, weight, fixed=False)
    sensitivity = attitude_sensitivity(np.where(first[1:], 0.0, np.diff(t)), model, x, first)
    sensitivity = project(sensitivity, first, weight)
    weighted = (sensitivity * weight[:, None, None]).reshape(-1, 6)
    normal = weighted.T @ sensitivity.reshape(-1, 6)
    r_nb = body_from_inertial(q).transpose(0, 2, 1)
    total = np.zeros((6, 6))
    for jacobian, covariance in pairs:
        moved = (r_nb @ jacobian).reshape(-1, 6)
        gain = np.linalg.solve(normal, weighted.T @ moved)
        total += gain @ covariance @ gain.T
    transform = from_centred(centre, spread)
    return np.asarray(transform @ total @ transform.T)


def constants_to_equation(
    rate_logged: Array,
    rate: Array,
    weight: Array,
    pairs: list[tuple[Array, Array, Array]],
    q: Array | None = None,
) -> Array:
    """Covariance (6, 6) that uncertain vector triads add to equation error's (λ, b).

    An attitude turned by φ, body axes, has the rate ω̂ + φ̇ + ω × φ: what the regression then takes for a rate.

    Parameters
    ----------
    rate_logged, rate : (n, 3) arrays
        The regressor ω_d and the calibrated rate ω, rad/s.
    weight : (n,) array
        Weights of the regression.
    pairs : list
        For each independent triad: ∂φ/∂(its constants) (n, 3, 6) in the gyroscope's axes, its derivative in time, and
        the constants' covariance (6, 6).
    q : (n, 4) array, optional
        Attitude where only the scalar equation is fitted (Eq. 12–15); without it the axes decouple.
    """
    total = np.zeros((6, 6))
    centre = np.average(rate_logged, axis=0, weights=weight)
    spread = np.sqrt(np.average((rate_logged - centre) ** 2, axis=0, weights=weight))
    x = (rate_logged - centre) / spread
    for jacobian, derivative, covariance in pairs:
        turned = derivative + skew(rate) @ jacobian
        if q is None:
            gain: Array = np.zeros((6, len(covariance)))
            for i in range(3):
                regressors = np.stack([x[:, i], np.ones(len(x))], axis=1)
                gain[[i, 3 + i]] = _solved(regressors, turned[:, i], weight)
        else:
            half = -0.5 * q[:, :3]
            gain = _solved(np.concatenate([half * x, half], axis=1), np.einsum("ni,nip->np", half, turned), weight)
        total += gain @ covariance @ gain.T
    transform = from_centred(centre, spread)
    return np.asarray(transform @ total @ transform.T)


def _solved(regressors: Array, target: Array, weight: Array) -> Array:
    weighted = regressors * weight[:, None]
    return np.asarray(np.linalg.solve(weighted.T @ regressors, weighted.T @ target))
