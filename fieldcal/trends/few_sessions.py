"""What a unit of few sessions borrows from its siblings: their scatter between sessions and their slope on temperature.

Two to four sessions determine neither scatter nor slope. With the siblings' the mean of the sessions can be brought to
one temperature and has an honest sd (empirical Bayes): y = value + slope (T − 25 °C) + u + e with slope ~ N(m, ω²) and
u of variance τ², all three from the siblings. Sessions that scatter beyond that are not averaged: one of them may be a
step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from fieldcal.geometry.rotation import Array
from fieldcal.schemas.reference import ENOUGH_SESSIONS, REFERENCE_DEGC
from fieldcal.trends.regression import Trends
from fieldcal.trends.series import Histories
from fieldcal.trends.siblings import ENOUGH_SIBLINGS, REFERENCE_LEVEL, outliers

LEAST_SESSIONS = 2
CONTRADICTION = 0.01
"""Chance, among units like their siblings, of sessions that scatter more: below it they are not averaged."""
STEP = 6e-7
"""The same (that of five sd) of their scatter alone, though an unusual slope might explain them: it may be a step."""


@dataclass(frozen=True)
class Lent:
    """What siblings lend: slope m with sd ω per °C, τ², φ² (flights beyond their claims), and how many they are."""

    slope: float
    slope_sd: float
    session_variance: float
    flight_variance: float
    siblings: int


def borrow(h: Histories, trends: Trends, group: np.ndarray, sign: Array, steady: np.ndarray) -> tuple[Trends, Array]:
    """(trends in which rows of two to four sessions have a value at 25 °C with the siblings' help, how many siblings
    lent (g,), NaN where none did).

    Parameters
    ----------
    h : Histories
        What the trends were made from.
    group : (g,) array
        Equal for siblings.
    sign : (g,) array
        −1 for rows mounted the other way round than their siblings: their slope has the opposite sign.
    steady : (g,) bool array
        Rows that may lend: they have a trend and neither stepped nor drift.
    """
    names = ("value", "sd", "slope_per_degc", "slope_per_degc_sd", "best_degc", "session_sd", "flight_sd", "last_z")
    columns = {name: getattr(trends, name).copy() for name in names}
    siblings = np.full(len(group), np.nan)
    few = (trends.n_sessions >= LEAST_SESSIONS) & (trends.n_sessions < ENOUGH_SESSIONS)
    starts = np.searchsorted(h.row, np.arange(len(group) + 1))
    for label in np.unique(group[few]):
        members = np.flatnonzero(group == label)
        lent = _lent(trends, members[steady[members]], sign)
        if lent is None:
            continue
        for row in members[few[members]]:
            flights = np.arange(starts[row], starts[row + 1])[trends.kept[starts[row] : starts[row + 1]]]
            mounted = replace(lent, slope=lent.slope * float(sign[row]))
            found = _with(mounted, h, flights)
            if found is None:
                continue
            siblings[row] = lent.siblings
            for name, value in zip(names, found, strict=True):
                columns[name][row] = value
    return replace(trends, **columns), siblings


def _lent(trends: Trends, lenders: np.ndarray, sign: Array) -> Lent | None:
    """Medians over the siblings for the scatter. Slopes: mean m and predictive variance ω² = s²(1 + 1/k)(k − 1)/(k − 3)
    of those that are no outliers (variance of Student's t; k ≥ 5); their errors stay in ω, which is then rather too
    large."""
    if len(lenders) < ENOUGH_SIBLINGS:
        return None
    session, flight = trends.session_sd[lenders], trends.flight_sd[lenders]
    slopes, slopes_sd = (sign * trends.slope_per_degc)[lenders], trends.slope_per_degc_sd[lenders]
    finite = np.isfinite(slopes)
    slopes, slopes_sd = slopes[finite], slopes_sd[finite]
    if len(slopes) > ENOUGH_SIBLINGS:
        slopes = slopes[~outliers(slopes, slopes_sd, REFERENCE_LEVEL)]
    k = len(slopes)
    if k < ENOUGH_SIBLINGS:
        return None
    spread = float(np.std(slopes, ddof=1) * np.sqrt((1.0 + 1.0 / k) * (k - 1.0) / (k - 3.0)))
    return Lent(
        float(slopes.mean()),
        spread,
        float(np.median(session**2)),
        float(np.median(np.nan_to_num(flight) ** 2)),
        len(lenders),
    )


def _with(lent: Lent, h: Histories, flights: np.ndarray) -> tuple[float, ...] | None:
    """(value, sd, slope, its sd, best °C, τ, φ, last z) of one row; None where its sessions contradict each other or
    something that is needed is missing."""
    y, s, warm, session = h.value[flights], h.sd[flights], h.temperature_degc[flights], h.session[flights]
    if not (np.isfinite(s).all() and np.isfinite(warm).all()):
        return None
    dt = warm - REFERENCE_DEGC
    of_flights = np.diag(s**2 + lent.flight_variance)
    v = of_flights + lent.session_variance * (session[:, None] == session) + lent.slope_sd**2 * np.outer(dt, dt)
    left = y - lent.slope * dt
    value, variance, squares = _mean(v, left)
    alone = _mean(v - lent.slope_sd**2 * np.outer(dt, dt), left)[2]
    if special.chdtrc(len(y) - 1, squares) < CONTRADICTION or special.chdtrc(len(y) - 1, alone) < STEP:
        return None
    last = session == session[-1]
    earlier, earlier_variance, weights = _mean_with_weights(v[np.ix_(~last, ~last)], left[~last])
    latest, latest_variance, latest_weights = _mean_with_weights(v[np.ix_(last, last)], left[last])
    shared = float(latest_weights @ v[np.ix_(last, ~last)] @ weights)
    z = (latest - earlier) / np.sqrt(earlier_variance + latest_variance - 2.0 * shared)
    inverse = np.linalg.inv(v)
    ones = np.ones(len(y))
    gain = lent.slope_sd**2 * (dt @ inverse)
    slope = lent.slope + float(gain @ (left - value))
    with_value = -float(gain @ ones) * variance  # covariance of value and slope
    slope_variance = lent.slope_sd**2 - float(gain @ dt) * lent.slope_sd**2 + float(gain @ ones) ** 2 * variance
    best = REFERENCE_DEGC - with_value / slope_variance if slope_variance > 0.0 else REFERENCE_DEGC
    slope_sd = float(np.sqrt(max(slope_variance, 0.0)))
    scatter = (float(np.sqrt(lent.session_variance)), float(np.sqrt(lent.flight_variance)))
    return (value, float(np.sqrt(variance)), slope, slope_sd, best, *scatter, float(z))


def _mean(v: Array, y: Array) -> tuple[float, float, float]:
    """Generalised mean of y with covariance v, its variance, and the weighted sum of squares about it."""
    value, variance, _ = _mean_with_weights(v, y)
    residual = y - value
    return value, variance, float(residual @ np.linalg.solve(v, residual))


def _mean_with_weights(v: Array, y: Array) -> tuple[float, float, Array]:
    inverse = np.linalg.inv(v)
    variance = 1.0 / float(inverse.sum())
    weights = variance * inverse.sum(axis=0)
    return float(weights @ y), variance, weights
