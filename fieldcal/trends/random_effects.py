"""Regression with random effects, many short histories at once: flat arrays, one pass over all of them.

A history is a row of the answer. Its flights lie one after the other in flat arrays and say which row and which session
they belong to: sums over rows and sessions are one call each, and nothing is padded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldcal.estimation.segments import run_starts
from fieldcal.geometry.rotation import Array

ITERATIONS = 25
CONVERGED = 1e-10
STILL = 1e-9
"""A scaled regressor that moves less than this within a session stands still there."""
LEAST_FREEDOM = 0.01
WITHIN_FREEDOM = 3
"""Flights beyond the first of their session that it takes to tell the scatter of flights from that of sessions."""


@dataclass(frozen=True)
class Grouping:
    """Where flights belong: `row` (n,) ascends and leaves none of the n_rows out, `session` (n,) counts from 0,
    `row_of_session` (m,) ascends likewise; a session has one row."""

    row: np.ndarray
    session: np.ndarray
    row_of_session: np.ndarray
    n_rows: int

    def by_row(self, x: Array) -> Array:
        """Sums (n_rows, …) over the flights of each row."""
        return _runs(self.row, x)

    def by_session(self, x: Array) -> Array:
        """Sums (m, …) over the flights of each session."""
        return summed(self.session, x, len(self.row_of_session))

    def sessions_by_row(self, x: Array) -> Array:
        """Sums (n_rows, …) over the sessions of each row."""
        return _runs(self.row_of_session, x)


@dataclass(frozen=True)
class Regression:
    """Coefficients (g, p) with covariance (g, p, p), which of them are in the row's model, (g, p), the two variances
    of scatter τ², φ² (g,) and the freedom between sessions (g,)."""

    coefficients: Array
    covariance: Array
    active: np.ndarray
    session_variance: Array
    flight_variance: Array
    freedom: Array


def summed(label: np.ndarray, x: Array, size: int) -> Array:
    """Sums of x (n, …) by label, (size, …)."""
    flat = x.reshape(len(x), -1)
    sums = np.empty((size, flat.shape[1]))
    for j in range(flat.shape[1]):
        sums[:, j] = np.bincount(label, flat[:, j], size)
    return sums.reshape(size, *x.shape[1:])


def _runs(label: np.ndarray, x: Array) -> Array:
    """`summed` where labels ascend and none is left out."""
    return np.asarray(np.add.reduceat(np.asarray(x, dtype=float), run_starts(label), axis=0))


def fit_random_effects(
    grouping: Grouping,
    design: Array,
    value: Array,
    variance: Array,
    keep: np.ndarray,
    *,
    given: Array | None = None,
    given_variance: Array | None = None,
) -> Regression:
    """Generalised least squares of y = Xβ + u_session + e with var e = s² + φ² and var u = τ².

    τ² is Paule and Mandel's: it makes the weighted sum of squares of the session means equal to its expectation, the
    number of sessions less what the coefficients took from it, tr C XᵀV⁻¹X; φ² likewise from the flights about their
    session's mean, where sessions hold several.

    Parameters
    ----------
    design : (n, p) array
        Regressors, scaled to O(1). A column that is zero throughout a row is left out of that row: its coefficient
        and variance are 0.
    value, variance : (n,) arrays
        y and s², scaled to O(1) by row; s² > 0.
    keep : (n,) bool array
        Flights that count.
    given, given_variance : (g, p) arrays, optional
        Coefficients estimated elsewhere with independent errors; variance inf: not estimated.

    References
    ----------
    Paule & Mandel (1982); DerSimonian & Kacker (2007), generalised to regression.
    """
    active = grouping.by_row((design * keep[:, None]) ** 2) > 0.0
    information, prior = np.zeros(active.shape), np.zeros(active.shape)
    if given is not None and given_variance is not None:
        information = np.where(np.isfinite(given_variance), 1.0 / np.maximum(given_variance, 1e-30), 0.0)
        prior = np.where(information > 0.0, given, 0.0)
    active |= information > 0.0
    flights = grouping.by_row(keep.astype(float))
    sessions = grouping.sessions_by_row((grouping.by_session(keep.astype(float)) > 0.0).astype(float))
    flight_variance = _flight_variance(grouping, design, value, variance, keep, flights - sessions)
    parts = _split(grouping, design, value, variance + flight_variance[grouping.row], keep)
    tau2: Array = np.zeros(grouping.n_rows)
    for _ in range(ITERATIONS):
        _, _, squares, slope, taken = _solve(grouping, parts, tau2, active, information, prior)
        new = _towards(squares, sessions - taken, slope, tau2)
        done = np.abs(new - tau2) <= CONVERGED * new
        tau2 = new
        if done.all():
            break
    beta, covariance, _, _, taken = _solve(grouping, parts, tau2, active, information, prior)
    diagonal = np.arange(active.shape[1])
    covariance[:, diagonal, diagonal] = np.where(active, covariance[:, diagonal, diagonal], 0.0)
    return Regression(beta, covariance, active, tau2, flight_variance, sessions - taken)


def _towards(squares: Array, freedom: Array, slope: Array, variance: Array) -> Array:
    """Newton's step on 1/Q(variance) = 1/freedom: 1/Q is nearly linear in a variance of scatter, which is never < 0."""
    moving = (slope > 0.0) & (freedom > LEAST_FREEDOM)
    ratio = squares / np.maximum(freedom, LEAST_FREEDOM) - 1.0
    return np.where(moving, np.maximum(variance + ratio * squares / np.where(moving, slope, 1.0), 0.0), 0.0)


@dataclass(frozen=True)
class _Parts:
    """Session means of X (m, p) and y (m,) with their information (m,), and flights about them, X (n, p), y (n,) and
    weight (n,); the latter None where no session has two."""

    x: Array
    y: Array
    weight: Array
    inner: tuple[Array, Array, Array] | None


def _split(grouping: Grouping, x: Array, y: Array, spread: Array, keep: np.ndarray) -> _Parts:
    weight = keep / spread
    total = grouping.by_session(weight)
    mean = grouping.by_session(np.column_stack([x, y]) * weight[:, None]) / np.where(total > 0, total, 1.0)[:, None]
    inner = None
    if (grouping.by_session(keep.astype(float)) > 1.0).any():
        inner = x - mean[grouping.session, :-1], y - mean[grouping.session, -1], weight
    return _Parts(mean[:, :-1], mean[:, -1], total, inner)


def _solve(
    grouping: Grouping, parts: _Parts, tau2: Array, active: np.ndarray, information: Array, prior: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """(β, covariance C, Q of the session means, −dQ/dτ², tr C XᵀV⁻¹X of the session means) at τ²."""
    weight = parts.weight / (1.0 + tau2[grouping.row_of_session] * parts.weight)
    weighted = parts.x * weight[:, None]
    between = grouping.sessions_by_row(parts.x[:, :, None] * weighted[:, None, :])
    normal = between.copy()
    right = grouping.sessions_by_row(weighted * parts.y[:, None])
    if parts.inner is not None:
        x, y, w = parts.inner
        normal += grouping.by_row(x[:, :, None] * (x * w[:, None])[:, None, :])
        right += grouping.by_row(x * (y * w)[:, None])
    diagonal = np.arange(normal.shape[1])
    normal[:, diagonal, diagonal] += np.where(active, information, 1.0)
    # Weights may be anything: to O(1), so that what the tolerance of the inverse cuts is collinear, not just light.
    size = 1.0 / np.sqrt(normal[:, diagonal, diagonal])
    scaled = size[:, :, None] * normal * size[:, None, :]
    covariance = size[:, :, None] * np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) * size[:, None, :]
    beta = np.einsum("gij,gj->gi", covariance, right + information * prior)
    residual = parts.y - np.einsum("mj,mj->m", parts.x, beta[grouping.row_of_session])
    squares = grouping.sessions_by_row(weight * residual**2)
    taken = np.einsum("gij,gji->g", covariance, between)
    return beta, covariance, squares, grouping.sessions_by_row((weight * residual) ** 2), taken


def _flight_variance(
    grouping: Grouping, design: Array, value: Array, variance: Array, keep: np.ndarray, freedom: Array
) -> Array:
    """φ² (g,): scatter of flights about their session beyond what they claim; 0 where sessions hold single flights.

    Sessions are fixed effects here: what the regressors do within a session is taken out by least squares. `freedom`
    (g,): flights less sessions."""
    phi2 = np.zeros(grouping.n_rows)
    several = freedom >= WITHIN_FREEDOM
    if not several.any():
        return phi2
    for _ in range(ITERATIONS):
        parts = _split(grouping, design, value, variance + phi2[grouping.row], keep)
        assert parts.inner is not None
        x, y, weight = parts.inner
        x = np.where(np.abs(x) > STILL, x, 0.0)
        normal = grouping.by_row(x[:, :, None] * (x * weight[:, None])[:, None, :])
        inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
        beta = np.einsum("gij,gj->gi", inverse, grouping.by_row(x * (y * weight)[:, None]))
        residual = y - np.einsum("nj,nj->n", x, beta[grouping.row])
        left = freedom - np.linalg.matrix_rank(normal, hermitian=True, rtol=1e-9)
        squares, slope = grouping.by_row(residual**2 * weight), grouping.by_row((residual * weight) ** 2)
        new = np.where(several, _towards(squares, left, slope, phi2), 0.0)
        done = np.abs(new - phi2) <= CONVERGED * new
        phi2 = new
        if done.all():
            break
    return phi2
