"""Scale and bias of a triad from readings of a vector of known length (magnetometer, accelerometer): Eq. 5–8.

Turned through many attitudes, an ideal triad draws a sphere of radius f; scale and bias make it an ellipsoid. Three
algebraic fits (`li`, `li_full`, `tls`: see `quadric`) and two that minimise distances (`two_step` and, robust and the
default, `robust`) share one entry, `fit_ellipsoid`, one covariance and one refusal (`ellipsoid_refusals`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation import quadric
from fieldcal.estimation.statistics import (
    huber_inflation,
    huber_weights,
    least_squares_covariance,
    robust_sigma,
    white_noise_sigma,
)
from fieldcal.geometry.rotation import Array
from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode


@dataclass(frozen=True)
class TriadFit:
    """A triad's calibration z = Λ z_d + b and its uncertainty.

    `scale` (3, 3) is Λ, diagonal but for `li_full`, polarity included; `bias` (3,) in the field's unit. `covariance`
    (6, 6) of (λx, λy, λz, bx, by, bz), coloured-residual form; `covariance_white` its Cramér–Rao form. `residual_rms`
    is the rms of |z|/f − 1. `condition` is that of the column-normalised Jacobian; `share_used` the mean robust weight.
    """

    scale: Array
    bias: Array
    covariance: Array
    covariance_white: Array
    residual_rms: float
    condition: float
    n_samples: int
    share_used: float
    iterations: int

    @property
    def scale_diagonal(self) -> Array:
        """(λx, λy, λz)."""
        return np.diagonal(self.scale).copy()

    def apply(self, logged: ArrayLike) -> Array:
        """z = Λ z_d + b (Eq. 5), (n, 3) logged → (n, 3) in the field's unit, sensor axes."""
        return np.asarray(logged, dtype=float) @ self.scale.T + self.bias

    @property
    def scale_relative_sd(self) -> list[float]:
        """Claimed sd of the three scales over them; infinite where rounding left no variance: nothing is known."""
        variance = np.diagonal(self.covariance)[:3]
        sd = np.sqrt(np.where(variance > 0.0, variance, np.inf))
        return [float(v) for v in sd / np.abs(self.scale_diagonal)]

    def measured(self) -> dict[str, Json]:
        """The numbers behind the verdict, for the `run` table."""
        return {
            "n_samples": self.n_samples,
            "condition_number": float(self.condition),
            "scale_relative_sd": self.scale_relative_sd,
            "residual_rms_relative": self.residual_rms,
            "mean_robust_weight": self.share_used,
            "iterations": self.iterations,
        }


def fit_ellipsoid(
    measured: ArrayLike,
    magnitude: float,
    *,
    method: str = "robust",
    polarity: ArrayLike = (1.0, 1.0, 1.0),
) -> TriadFit:
    """Estimate triad scale and bias from readings of a vector of known length.

    Parameters
    ----------
    measured : (n, 3) array
        Logged readings z_d, any one unit, sensor axes; n > 9. Keep only samples where gravity (or the local field)
        dominates: this function does not select. Give `robust` *unsmoothed* readings.
    magnitude : float
        Length f of the sensed vector, in the unit wanted for the result. Positive.
    method : {"robust", "li", "li_full", "two_step", "tls"}
    polarity : (3,) of ±1
        Sign of each scale: lengths cannot see it, nor a rotation of the triad.

    Raises
    ------
    ValueError
        Wrong shape, non-finite reading, non-positive `magnitude`, unknown method: the caller's error.
    UnusableFlight
        `ellipsoid_degenerate`: the readings do not curve like an ellipsoid at all (single attitude, plane).
    EstimationError
        `ellipsoid_diverged`: no minimum was reached.

    Notes
    -----
    Whether the result is good enough is decided by `ellipsoid_refusals.require_determined`.

    References
    ----------
    Li & Griffiths (2004); Gebre-Egziabher et al. (2001, 2007); Grauer et al., AIAA 2009-2064, Eq. 6–8 (corrected).

    Examples
    --------
    >>> u = np.random.default_rng(1).normal(size=(100, 3))
    >>> sphere = u / np.linalg.norm(u, axis=1, keepdims=True)
    >>> fit = fit_ellipsoid((sphere - 0.2) / 1e-4, 1.0)
    >>> bool(np.allclose(fit.scale_diagonal, 1e-4) and np.allclose(fit.bias, 0.2))
    True
    """
    z = np.asarray(measured, dtype=float)
    if z.ndim != 2 or z.shape[1] != 3 or len(z) < 10:
        raise ValueError(f"measured must be (n, 3) with n ≥ 10, got {z.shape}")
    if not np.isfinite(z).all():
        raise ValueError("measured holds non-finite readings: mask them first")
    if not magnitude > 0:
        raise ValueError(f"magnitude must be positive, got {magnitude}")
    if method not in METHODS:
        raise ValueError(f"method is one of {', '.join(METHODS)}, not {method!r}")
    # Shift by the mean and divide by one common standard deviation: the constraint is not invariant to scaling by axis.
    centre = z.mean(axis=0)
    spread = float(np.sqrt(np.mean((z - centre) ** 2))) * (_noise_shape(z) if method == "robust" else np.ones(3))
    if not (spread > 0.0).all():
        raise UnusableFlight(
            ReasonCode.ELLIPSOID_DEGENERATE, "All readings are the same: the sensor is stuck or was not moved."
        )
    x = (z - centre) / spread
    scale, bias, weight, iterations = METHODS[method](x)
    fit = _with_statistics(x, scale, bias, weight, iterations)
    return _in_logged_units(fit, centre, spread, magnitude, np.asarray(polarity, dtype=float))


def _noise_shape(z: Array) -> Array:
    """Relative noise of the three axes in logged units, (3,), mean square 1: least distances want it the same on each.

    Axes of one triad differ when their scales do. Where differences say little (a quantised or unordered record) all
    1."""
    sigma = white_noise_sigma(z)
    if not (sigma > 0).all() or sigma.max() > 5.0 * sigma.min():
        return np.ones(3)
    return sigma / np.sqrt(np.mean(sigma**2))


Solution = tuple[Array, Array, Array, int]  # Λ (3, 3), b (3,) for unit radius; robust weights (n,); iterations


def _robust(x: Array) -> Solution:
    """Huber-weighted refinement of the lengths, in logged units."""
    try:
        start = quadric.li_griffiths(x)
    except UnusableFlight:
        start = quadric.sphere(x)
    return _gauss_newton(x, *start, robust=True)


def _two_step(x: Array) -> Solution:
    """Gebre-Egziabher's two steps: linear least squares on Hx², then Gauss–Newton on the lengths themselves."""
    return _gauss_newton(x, *quadric.first_step(x), robust=False)


def _algebraic(fit: Callable[[Array], quadric.Triad], x: Array) -> Solution:
    """An algebraic fit as it is: every reading of weight 1, no iteration."""
    return *fit(x), np.ones(len(x)), 1


# Clipping Gaussian residuals would cost 5 % of the information for nothing: robust weights are for records with more
# than this share of residuals beyond 3σ (Gaussian: 0.0027).
GAUSSIAN_TAIL = 0.006
# The noise term of the distances is held fixed in the gradient, so the solution lies this little above the least cost.
SLACK = 1e-4


@dataclass(frozen=True)
class _Distances:
    """Of readings from an ellipsoid, kept column by column (3, n) for speed: r (n,), u, Λu and ‖Λu‖ at each."""

    residual: Array
    u: Array
    lu: Array
    divisor: Array

    def jacobian(self, x: Array) -> Array:
        """∂r/∂(λ, b), (6, n): [u∘x̂, u]/‖Λu‖ at the reading's foot x̂ = x − r Λu/‖Λu‖."""
        out = np.empty((6, x.shape[1]))
        np.divide(self.u, self.divisor, out=out[3:])
        np.multiply(out[3:], x - (self.residual / self.divisor) * self.lu, out=out[:3])
        return out


def _distances(x: Array, scale: Array, bias: Array, sigma: float = 0.0) -> _Distances:
    """r = (n − 1)/‖Λu‖ in logged units, h = Λx + b, n = ‖h‖, u = h/n, for columns x (3, n).

    The division by ‖Λu‖ is what keeps Λ → 0 from being a perfect fit. Noise `sigma` (logged units) across u makes n too
    long by σ²(‖Λ‖² − ‖Λu‖²)/2n on average: taken off."""
    h = scale @ x + bias[:, None]
    norm = np.sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
    u = h / norm
    lu = scale.T @ u
    divisor = np.sqrt(lu[0] * lu[0] + lu[1] * lu[1] + lu[2] * lu[2])
    residual = (norm - 1.0) / divisor
    if sigma > 0.0:
        residual -= 0.5 * sigma**2 * (np.sum(scale**2) / divisor - divisor) / norm
    return _Distances(residual, u, lu, divisor)


def _gauss_newton(rows: Array, scale: Array, bias: Array, *, robust: bool, max_iterations: int = 50) -> Solution:
    """Least distances from a start by Levenberg–Marquardt; robust weights and noise level are renewed at every step."""
    x = np.ascontiguousarray(rows.T)
    diagonal = np.abs(np.diagonal(scale)).copy()
    bias = np.array(bias, dtype=float)
    weight: Array = np.ones(x.shape[1])
    sigma, damping, tailed = 0.0, 0.0, False
    at = _distances(x, np.diag(diagonal), bias)
    for iteration in range(1, max_iterations + 1):
        if robust:
            sigma = robust_sigma(at.residual)
            if iteration <= 3:
                tailed = float(np.mean(np.abs(at.residual) > 3.0 * sigma)) > GAUSSIAN_TAIL
            if tailed:
                weight = huber_weights(at.residual, sigma)
            at = _distances(x, np.diag(diagonal), bias, sigma)
        jacobian = at.jacobian(x)
        weighted = jacobian * weight
        normal, gradient = weighted @ jacobian.T, weighted @ at.residual
        cost = float(weight @ at.residual**2)
        for _ in range(12):
            damped = normal + damping * np.diag(np.diagonal(normal))
            step = np.linalg.lstsq(damped, -gradient, rcond=1e-15)[0]
            trial, trial_bias = diagonal + step[:3], bias + step[3:]
            if (trial > 0.3 * diagonal).all():
                after = _distances(x, np.diag(trial), trial_bias, sigma)
                if float(weight @ after.residual**2) <= cost * (1 + SLACK) + 1e-24:
                    damping *= 0.1
                    at = after
                    break
            damping = max(10.0 * damping, 1e-6)
        else:
            break  # no direction lowers the cost
        diagonal, bias = trial, trial_bias
        size = float(np.max(np.abs(np.concatenate([step[:3] / diagonal, step[3:]]))))
        if not np.isfinite(size) or diagonal.max() > 1e6 or diagonal.min() < 1e-9:
            break
        # Well inside what noise moves: sigma over the square root of the sample count.
        if size < max(1e-9, 1e-3 * sigma / np.sqrt(x.shape[1])):
            return np.diag(diagonal), bias, weight, iteration
    raise EstimationError(
        ReasonCode.ELLIPSOID_DIVERGED,
        "The ellipsoid refinement found no minimum: too little of the sphere was seen, or other accelerations or fields"
        " drown the curvature.",
        {"iterations": iteration, "residual_rms_relative": float(np.sqrt(np.mean((at.residual * at.divisor) ** 2)))},
    )


METHODS: dict[str, Callable[[Array], Solution]] = {
    "robust": _robust,
    "li": partial(_algebraic, quadric.li_griffiths),
    "li_full": partial(_algebraic, partial(quadric.li_griffiths, full=True)),
    "two_step": _two_step,
    "tls": partial(_algebraic, quadric.total_least_squares),
}


def _with_statistics(rows: Array, scale: Array, bias: Array, weight: Array, iterations: int) -> TriadFit:
    """Covariance at the solution, in scaled coordinates. Cross terms of `li_full` are taken as exact."""
    x = np.ascontiguousarray(rows.T)
    at = _distances(x, scale, bias)
    root = np.sqrt(weight)
    sensitivity = (at.jacobian(x) * root).T
    white, coloured = least_squares_covariance(sensitivity[:, None, :], (at.residual * root)[:, None])
    inflation = huber_inflation(weight)
    return TriadFit(
        scale=scale,
        bias=bias,
        covariance=coloured * inflation,
        covariance_white=white,
        residual_rms=float(np.sqrt(np.mean((at.residual * at.divisor) ** 2))),
        condition=direction_condition(at.u.T),
        n_samples=len(rows),
        share_used=float(weight.mean()),
        iterations=iterations,
    )


def direction_condition(vectors: ArrayLike) -> float:
    """Condition number of the column-normalised Jacobian for vectors (n, 3) seen from the sphere's centre.

    J = [u∘(u − ū), u], the shifted coordinates of the fit: it depends only on which part of the sphere was seen (whole
    sphere 1.6; roll, pitch and yaw uniform within ±75° 10, ±45° 37, ±20° 240)."""
    v = np.asarray(vectors, dtype=float)
    u = v / np.sqrt(np.einsum("ij,ij->i", v, v))[:, None]
    jacobian = np.hstack([u * (u - u.mean(axis=0)), u])
    norms = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    if (norms == 0).any():
        return float("inf")
    eigenvalues = np.linalg.eigvalsh((jacobian.T @ jacobian) / np.outer(norms, norms))
    return float(np.sqrt(eigenvalues[-1] / eigenvalues[0])) if eigenvalues[0] > 0 else float("inf")


def _in_logged_units(fit: TriadFit, centre: Array, spread: Array, magnitude: float, polarity: Array) -> TriadFit:
    """From x = (z − centre)/spread and unit radius to logged units and radius f, polarity put in."""
    sign = np.diag(polarity)
    scale = sign @ fit.scale * (magnitude / spread)  # column j of Λ works on axis j
    bias = sign @ fit.bias * magnitude - scale @ centre
    # (λ, b) = T (λ', b'): λ = s λ' f/spread, b = s f b' − λ centre
    transform = np.zeros((6, 6))
    transform[:3, :3] = sign @ np.diag(magnitude / spread)
    transform[3:, 3:] = sign * magnitude
    transform[3:, :3] = -np.diag(centre) @ transform[:3, :3]
    return replace(
        fit,
        scale=scale,
        bias=bias,
        covariance=transform @ fit.covariance @ transform.T,
        covariance_white=transform @ fit.covariance_white @ transform.T,
    )
