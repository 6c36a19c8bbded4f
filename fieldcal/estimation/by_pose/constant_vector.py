"""A vector triad against the VPS's attitude alone: a constant vector (the field; gravity, where nothing tells the
translation) seen from axes that are known at every moment."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.by_pose.triad import TriadByPose, axis_sigma
from fieldcal.estimation.robust import reweighted
from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.smoothing import differentiate_samples
from fieldcal.estimation.statistics import colour, least_squares_covariance
from fieldcal.geometry.rotation import Array, body_from_inertial
from fieldcal.reason_codes import ReasonCode

BLOCK_S = 0.05  # readings and attitudes are averaged over, alike
FEWEST_BLOCKS = 100
MAX_ITERATIONS = 30
CONVERGED_SHARE = 1e-9  # of the sum of squares
ROUNDING = 1e-18  # of a reading's square, which is of order one
REGRESSION_ROUNDS = 4
PARAMETERS = 15  # B (9), z (3), direction of the field (2), delay


def fit_constant_vector(
    t: ArrayLike,
    segment: np.ndarray,
    logged: ArrayLike,
    q: ArrayLike,
    known: np.ndarray,
    *,
    length: float,
    polarity: ArrayLike,
) -> tuple[TriadByPose, Array, Array]:
    """Full matrix, bias and delay of a vector triad by attitude, and the vector in the attitude's world.

    Parameters
    ----------
    t, segment : (n,) arrays
        Stamps, s, and contiguous stretches.
    logged : (n, 3) array
        Readings, NaN where there is none.
    q : (n, 4) array
        Attitude of the sensor axes.
    known : (n,) array of bool
        Samples at which the attitude is the VPS's, not one carried over a gap.
    length : float
        Of the vector, calibrated unit.
    polarity : (3,) array
        Signs of the axes: they tell the vector from its opposite.

    Returns
    -------
    The triad; the vector (3,), world axes; its covariance (3, 3), singular along the vector, whose length is given.

    Raises
    ------
    UnusableFlight
        `too_little_motion`: fewer than FEWEST_BLOCKS blocks of BLOCK_S.
    EstimationError
        `ellipsoid_diverged`: no minimum was found.

    Notes
    -----
    logged = B R(q)ᵀ h + z, with B the inverse of the matrix: linear in (B, z) and in h.
    """
    t, logged = np.asarray(t, dtype=float), np.asarray(logged, dtype=float)
    x, turn, slope = _blocks(t, segment, logged, np.asarray(q, dtype=float), known)
    if len(x) < FEWEST_BLOCKS:
        raise UnusableFlight(ReasonCode.TOO_LITTLE_MOTION, "Too few readings have an attitude by the VPS.")
    centre, spread = x.mean(axis=0), float(max(x.std(axis=0).max(), 1e-300))
    x, slope = (x - centre) / spread, slope / spread

    start = _start(x, turn, length)

    def solve(weight: Array) -> tuple[tuple[Array, Array, Array, Array], Array]:
        nonlocal start
        found = _minimised(x, turn, slope, weight, length, *start)
        start = found[:2]
        return found, np.linalg.norm(found[2] / axis_sigma(found[2]), axis=1)

    (theta, h, residual, sensitivity), weight = reweighted(solve, len(x), rounds=REGRESSION_ROUNDS)
    root = np.sqrt(weight)[:, None]
    _, covariance = least_squares_covariance(sensitivity * root[..., None], residual * root)
    if np.sum(np.sign(theta[[0, 4, 8]]) * np.asarray(polarity, dtype=float)) < 0:
        h, theta = -h, np.r_[-theta[:9], theta[9:]]
        covariance = covariance * np.outer(*[np.r_[-np.ones(9), np.ones(3), -np.ones(2), 1.0]] * 2)
    b, z = theta[:9].reshape(3, 3) * spread, theta[9:12] * spread + centre
    matrix = np.linalg.inv(b)
    # M = B⁻¹, bias = −M z; δM = −M δB M, δbias = −M (δz + δB bias).
    bias = -matrix @ z
    jacobian = np.zeros((12, PARAMETERS))
    jacobian[:9, :9] = -np.einsum("ik,lj->ijkl", matrix, matrix).reshape(9, 9) * spread
    jacobian[9:, :9] = -np.einsum("ik,l->ikl", matrix, bias).reshape(3, 9) * spread
    jacobian[9:, 9:12] = -matrix * spread
    across = _across(h)
    calibrated = residual * spread @ matrix.T
    triad = TriadByPose(
        matrix=matrix,
        bias=bias,
        covariance=jacobian @ covariance @ jacobian.T,
        delay_s=float(theta[14]),
        delay_sd_s=float(np.sqrt(max(covariance[14, 14], 0.0))),
        misfit=float(np.sqrt(np.average(np.sum(calibrated**2, axis=1), weights=weight)) / length),
        weight=weight,
        colour=colour(residual * root),
    )
    return triad, h, across @ covariance[12:14, 12:14] @ across.T


def _blocks(t: Array, segment: np.ndarray, logged: Array, q: Array, known: np.ndarray) -> tuple[Array, Array, Array]:
    """Means over blocks of BLOCK_S: readings (m, 3), R(q)ᵀ (m, 3, 3), and slope of the readings (m, 3), 1/s."""
    usable = np.isfinite(logged).all(axis=1) & known
    slope = np.zeros_like(logged)
    for a, b in run_bounds(segment):
        valid = np.flatnonzero(usable[a:b]) + a
        if len(valid) >= 5:
            slope[valid] = differentiate_samples(t[valid], logged[valid], window_s=BLOCK_S)
    at = np.flatnonzero(usable)
    if not len(at):
        return logged[at], body_from_inertial(q[at]), slope[at]
    block = np.unique(np.floor((t[at] - t[0]) / BLOCK_S) + 1e9 * segment[at], return_inverse=True)[1]
    count = np.bincount(block).astype(float)

    def mean(v: Array) -> Array:
        flat = v.reshape(len(v), -1)
        sums = np.stack([np.bincount(block, column) for column in flat.T], axis=1)
        return (sums / count[:, None]).reshape(-1, *v.shape[1:])

    return mean(logged[at]), mean(body_from_inertial(q[at])), mean(slope[at])


def _start(x: Array, turn: Array, length: float) -> tuple[Array, Array]:
    """θ (15,), its delay 0, and field (3,), by linear regressions."""
    # Every component is linear in the nine elements of the attitude; the field is what their coefficients share.
    regressor = np.column_stack([turn.reshape(len(turn), 9), np.ones(len(turn))])
    coefficients = np.linalg.lstsq(regressor, x, rcond=1e-6)[0]
    shared = np.linalg.svd(coefficients[:9].T.reshape(9, 3))[2][0]
    h = length * shared / np.linalg.norm(shared)
    # Given the field B and z are linear.
    theta = np.zeros(PARAMETERS)
    solved = np.linalg.lstsq(np.column_stack([turn @ h, np.ones(len(turn))]), x, rcond=1e-9)[0]
    theta[:9], theta[9:12] = solved[:3].T.ravel(), solved[3]
    return theta, h


def _minimised(
    x: Array, turn: Array, slope: Array, weight: Array, length: float, theta: Array, h: Array
) -> tuple[Array, Array, Array, Array]:
    """Gauss–Newton from θ (15,) and field (3,): both, residuals (m, 3) and their sensitivities (m, 3, 15)."""
    root, theta = np.sqrt(weight)[:, None], theta.copy()
    eye = np.eye(3)
    cost = np.inf
    for _ in range(MAX_ITERATIONS):
        seen = turn @ h
        sensitivity = np.zeros((len(x), 3, PARAMETERS))
        b = theta[:9].reshape(3, 3)
        across = _across(h)
        sensitivity[..., :9] = np.einsum("ij,nk->nijk", eye, seen).reshape(len(x), 3, 9)
        sensitivity[..., 9:12] = eye
        sensitivity[..., 12:14] = np.einsum("ij,njk,kl->nil", b, turn, across)
        sensitivity[..., 14] = -slope
        residual = x - (seen @ b.T + theta[9:12] - theta[14] * slope)
        now = float(np.sum(residual**2 * root**2))
        if abs(cost - now) <= CONVERGED_SHARE * now + ROUNDING * len(x):
            return theta, h, residual, sensitivity
        cost = now
        flat = (sensitivity * root[..., None]).reshape(-1, PARAMETERS)
        scale = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
        step = np.linalg.lstsq(flat / scale, (residual * root).reshape(-1), rcond=1e-9)[0] / scale
        theta[:12] += step[:12]
        theta[14] += step[14]
        h = h + across @ step[12:14]
        h = h * (length / np.linalg.norm(h))
    raise EstimationError(
        ReasonCode.ELLIPSOID_DIVERGED, "The readings do not fit a constant vector along the VPS's attitude."
    )


def _across(h: Array) -> Array:
    """Two directions across the field, of its length, (3, 2)."""
    return np.linalg.svd(h[None])[2][1:].T * np.linalg.norm(h)
