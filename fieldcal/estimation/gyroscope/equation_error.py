"""Gyroscope scale and bias by equation error on the quaternion kinematics: Eq. 10–15."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.robust import reweighted
from fieldcal.estimation.statistics import huber_inflation, least_squares_covariance
from fieldcal.geometry.rotation import Array, body_rate, rate_matrix
from fieldcal.reason_codes import ReasonCode


@dataclass(frozen=True)
class GyroFit:
    """z = λ∘ω_d + b: `scale` (3,), `bias` (3,) rad/s, `covariance` (6, 6) coloured form, `covariance_white` Cramér–Rao.

    `residual_rms` in the unit of what was fitted: 1/s or rad/s for equation error, rad for output error.
    `iterations` 1 for a linear fit."""

    scale: Array
    bias: Array
    covariance: Array
    covariance_white: Array
    residual_rms: float
    n_samples: int
    iterations: int = 1


ROBUST_ROUNDS = 6
NOISE_DENSITY_SD = 0.25
"""The attenuation by noise is corrected to this share of itself: a sensor's noise is not quite white."""
MOST_ATTENUATION = 0.2
"""More of a reading's variance than this is not taken for noise: there would hardly be a manoeuvre."""


def fit_equation_error(
    q: ArrayLike,
    q_dot: ArrayLike,
    rate_logged: ArrayLike,
    *,
    equations: str = "all",
    weights: ArrayLike | None = None,
    noise_variance: ArrayLike | None = None,
) -> GyroFit:
    """Least squares of the kinematic equations q̇ = ½ Ξ(q)(Λ ω_d + b).

    Parameters
    ----------
    q, q_dot : (n, 4) arrays
        Attitude and its local smoothed derivative, 1/s, hemisphere continuous.
    rate_logged : (n, 3) array
        Gyroscope as logged, ω_d, body axes, smoothed with the *same* weights as the attitude: noise in this regressor
        pulls the scales towards zero (−3.5 % raw, −0.8 % smoothed at the paper's noise).
    noise_variance : (3,) array, optional
        Variance of the noise that is left in `rate_logged`, its unit². It is subtracted from the regressor's variance
        (errors in variables), which removes that pull; `equations="scalar"`, the paper's, keeps it.
    equations : {"all", "scalar"}
        "scalar" is the paper's δ̇ alone (Eq. 12–15, with the ½ the paper's X lacks). "all" uses the four: ω̂ = 2Ξᵀq̇
        on (ω_d, 1), where the axes decouple.
    weights : (n,) array, optional
        Relative trust in each sample's attitude.

    Raises
    ------
    UnusableFlight
        `gyro_not_excited`: some axis did not turn.

    Notes
    -----
    Covariances are of the equation's residual, corrected for its colour (Eq. 13's σ_ω is that residual's, not the
    gyroscope's noise), and of the attenuation's correction. Attitude is taken as perfect: what uncertain vector triads
    do to it, `uncertainty_propagation.constants_to_equation` adds.
    """
    q, q_dot, w_d = (np.asarray(v, dtype=float) for v in (q, q_dot, rate_logged))
    n = len(q)
    if q.shape != (n, 4) or q_dot.shape != (n, 4) or w_d.shape != (n, 3) or n < 10:
        raise ValueError(f"shapes (n, 4), (n, 4), (n, 3) with n ≥ 10 wanted, got {q.shape}, {q_dot.shape}, {w_d.shape}")
    trust = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
    centre = np.average(w_d, axis=0, weights=trust)
    spread = np.sqrt(np.average((w_d - centre) ** 2, axis=0, weights=trust))
    if not (spread > 0).all():
        raise UnusableFlight(
            ReasonCode.GYRO_NOT_EXCITED, "A gyroscope axis reads one constant value: stuck, or never turned."
        )
    x = (w_d - centre) / spread
    share = np.zeros(3) if noise_variance is None else np.asarray(noise_variance, dtype=float) / spread**2
    share = np.minimum(share, MOST_ATTENUATION)
    robust = weights is not None
    theta: Array = np.zeros(6)
    white: Array = np.zeros((6, 6))
    coloured: Array = np.zeros((6, 6))
    squares = 0.0
    if equations == "all":
        # ω̂ = 2Ξᵀq̇ on (ω_d, 1): one small regression an axis
        target = body_rate(q, q_dot)
        for i in range(3):
            pair_of_axis = np.ix_([i, 3 + i], [i, 3 + i])
            sensitivity = np.stack([x[:, i], np.ones(n)], axis=1)
            pair = _robust_solve(sensitivity, target[:, i], trust, robust=robust, share=float(share[i]))
            theta[[i, 3 + i]], residual, white[pair_of_axis], coloured[pair_of_axis] = pair
            coloured[i, i] += (NOISE_DENSITY_SD * share[i] * theta[i]) ** 2
            squares += float(residual @ residual)
    elif equations == "scalar":
        half = -0.5 * q[:, :3]  # the last row of ½Ξ
        sensitivity = np.concatenate([half * x, half], axis=1)
        theta, residual, white, coloured = _robust_solve(sensitivity, q_dot[:, 3], trust, robust=robust)
        squares = float(residual @ residual)
    else:
        raise ValueError(f'equations is "all" or "scalar", not {equations!r}')
    transform = from_centred(centre, spread)
    constants = transform @ theta
    return GyroFit(
        scale=constants[:3],
        bias=constants[3:],
        covariance=transform @ coloured @ transform.T,
        covariance_white=transform @ white @ transform.T,
        residual_rms=float(np.sqrt(squares / n)),
        n_samples=n,
    )


def _robust_solve(
    sensitivity: Array, target: Array, trust: Array, *, robust: bool, share: float = 0.0
) -> tuple[Array, Array, Array, Array]:
    """Weighted least squares (Huber-refined when `robust`): θ (p,), residual (n,), its two covariances (p, p).

    `share` of the mean square of the first regressor, 1, is noise."""

    def solve(huber: Array) -> tuple[tuple[Array, Array], Array]:
        weight = trust * huber
        weighted = sensitivity * weight[:, None]
        normal = weighted.T @ sensitivity
        normal[0, 0] -= share * weight.sum()
        theta = np.linalg.solve(normal, weighted.T @ target)
        residual = target - sensitivity @ theta
        return (theta, residual), residual

    huber: Array = np.ones(len(trust))
    if robust:
        (theta, residual), huber = reweighted(solve, len(trust), rounds=ROBUST_ROUNDS)
    else:
        (theta, residual), _ = solve(huber)
    inflation = huber_inflation(huber) if robust else 1.0
    white, coloured = _covariances(sensitivity, residual, trust * huber)
    stretch = np.ones(len(theta))
    stretch[0] /= 1.0 - share
    both = np.outer(stretch, stretch)
    return theta, residual, white * both, coloured * both * inflation


def _covariances(sensitivity: Array, residual: Array, weight: Array) -> tuple[Array, Array]:
    """Cramér–Rao and coloured covariance (p, p) of one weighted regression."""
    root = np.sqrt(weight)
    return least_squares_covariance((sensitivity * root[:, None])[:, None, :], (residual * root)[:, None])


def from_centred(centre: Array, spread: Array) -> Array:
    """(6, 6) that takes (λ', b') fitted to (ω_d − c)/s to (λ, b): λ = λ'/s, b = b' − λ c."""
    transform = np.eye(6)
    transform[:3, :3] = np.diag(1.0 / spread)
    transform[3:, :3] = -np.diag(centre / spread)
    return transform


def predicted_quaternion_rate(q: ArrayLike, rate: ArrayLike) -> Array:
    """½ Ξ(q) ω (Eq. 10), (n, 4), 1/s: what the calibrated rates say of q̇."""
    return np.asarray(0.5 * np.einsum("nij,nj->ni", rate_matrix(q), np.asarray(rate, dtype=float)))
