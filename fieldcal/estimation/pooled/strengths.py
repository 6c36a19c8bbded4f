"""How much constants of a kind move, by marginal likelihood over all units of the fleet: siblings share it.

A series is one constant of one unit: what each session says of it, y with variance v (of estimation). It is modelled as
y = c + β (T − T̄) + u + e with a walk c of variance q a day, a scatter u of sessions of variance τ², which no number of
flights in one session averages out, and a slope β of variance σ² among siblings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq, minimize

from fieldcal.compiled import LIBRARY
from fieldcal.compiled import series as compiled
from fieldcal.estimation.pooled.chance import log_beyond_either_way
from fieldcal.geometry.rotation import Array

RESTART_SD = 4.5
"""An innovation beyond it is a step or spoiled: the series starts anew, and tells nothing of its usual movement."""
LIMITS = 2.0 * np.log(1e-3), 2.0 * np.log(1e3)
"""Of logarithms of variances that are looked for, over that of a session (by the median gap and the range)."""
FEW = 4.0
"""Innovations that the expectation of half a session's own sd counts for: little beside many."""
EXPECTED_SHARE = 0.5
NEAR, LOOKED_AT = 0.02, 49
"""Of a logarithm of a variance, so near the likeliest and so many times it is looked at for the mean."""
RISE = 0.3
"""Of minus twice the logarithm of the likelihood that a strength is still likely at: half a standard deviation."""
TOLERANCES = {"fatol": 0.01, "xatol": 0.02}
"""Of minus twice the logarithm of the likelihood and of logarithms of variances: well below `RISE` and `GRID`."""
GRID = 1.25
"""Ratio of neighbouring variances that are told apart."""
BENT = 0.01
"""Chance that a straight series is taken for a bent one: then its scatter counts a little too small."""
START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)
"""Sd of walk, scatter and slope over that of a session itself, and times them, from where the likeliest are looked
for."""


NO_PAIRS = np.zeros((0, 3))


@dataclass(frozen=True)
class Strengths:
    """Of one kind of constant: variance of the `walk` a day, of the `scatter` of sessions, of the `slope` on
    temperature, (unit²/°C²)."""

    walk: float
    scatter: float
    slope: float
    freedom: float = 1e6
    """Innovations that they were estimated from: so uncertain is what is divided by them."""

    def coarse(self) -> Strengths:
        """Each on a grid of `GRID`, which is finer than it is known: a flight more then leaves nearly all as they
        are, and with them every unit that did not fly."""
        walk, scatter, slope, freedom = map(_on_grid, (self.walk, self.scatter, self.slope, self.freedom))
        return Strengths(walk, scatter, slope, float(round(freedom)))


@dataclass(frozen=True)
class Series:
    """`day`, `temperature_degc` less the reference, `value` and `variance` of estimation, each (m, n): m sessions of n
    series, NaN where a series has no more."""

    day: Array
    warmth_degc: Array
    value: Array
    variance: Array

    @classmethod
    def of(cls, rows: list[Array]) -> Series:
        """Of arrays (k, 4), one a series."""
        longest = max(map(len, rows), default=0)
        padded = np.full((4, longest, len(rows)), np.nan)
        for j, own in enumerate(rows):
            padded[:, : len(own), j] = own.T
        return cls(*padded)


def innovations(series: Series, strengths: Strengths) -> tuple[Array, Array]:
    """One-step prediction errors over their sd and the variances, (m, n); NaN where there are none: at the first
    session of each series, and where it starts anew."""
    if LIBRARY is not None:
        variances = strengths.walk, strengths.scatter, strengths.slope, RESTART_SD**2
        return compiled.innovations(LIBRARY, series.day, series.warmth_degc, series.value, series.variance, variances)
    count, width = series.value.shape
    z, variance = np.full((2, count, width), np.nan)
    c, slope = np.zeros((2, width))
    of_c, p_cs, p_ss = np.zeros(width), np.zeros(width), np.full(width, strengths.slope)
    started, last = np.zeros(width, dtype=bool), np.zeros(width)
    for k in range(count):
        day, t, y = series.day[k], series.warmth_degc[k], series.value[k]
        here = np.isfinite(y)
        r = series.variance[k] + strengths.scatter
        of_c = of_c + strengths.walk * np.where(started & here, day - last, 0.0)
        s = of_c + 2.0 * t * p_cs + t**2 * p_ss + r
        error = y - c - slope * t
        usual = here & started & (error**2 < RESTART_SD**2 * s)
        z[k, usual], variance[k, usual] = (error / np.sqrt(s))[usual], s[usual]
        gain_c, gain_s = (of_c + t * p_cs) / s, (p_cs + t * p_ss) / s
        anew = here & ~usual
        new_c = of_c - gain_c**2 * s, p_cs - gain_c * gain_s * s, p_ss - gain_s**2 * s
        start = r + t**2 * p_ss, -t * p_ss, p_ss
        c, slope = (
            np.where(usual, c + gain_c * error, np.where(anew, y - slope * t, c)),
            np.where(usual, slope + gain_s * error, slope),
        )
        of_c, p_cs, p_ss = (
            np.where(usual, a, np.where(anew, b, old))
            for a, b, old in zip(new_c, start, (of_c, p_cs, p_ss), strict=True)
        )
        started, last = started | here, np.where(here, day, last)
    return z, variance


def strengths_of(series: Series, *, with_slope: bool = True, within: Array = NO_PAIRS) -> Strengths:
    """The strengths that make the series' innovations likeliest.

    `within` (k, 3): of two flights of a session, which share its scatter, by how much temperature and value differ and
    the variance of that: slopes are told by them too.

    Few innovations cannot tell a little from nothing: then the scatter, and what the slope does over the temperatures
    flown, are taken for half of a session's own sd. Nor can they tell a walk or a slope from scatter: what may be
    either is scatter. A walk is what it is on average of all that it may be (`mean_of_variance`): one of a few per cent
    of the scatter a √day, which doubles the sd of the mean of twenty sessions, is often likeliest to be none. Without
    any two sessions to compare nothing is known to move, but the scatter is that."""
    known = np.isfinite(series.value)
    if not known.any():
        return Strengths(0.0, 0.0, 0.0, FEW)
    own = float(np.median(series.variance[known]))
    gap_day = usual_gap(series.day)
    warmth = series.warmth_degc[known]
    range_degc = max(float(np.std(warmth)), 1.0)
    expected = EXPECTED_SHARE**2 * own
    if (known.sum(axis=0) < 2).all():
        return Strengths(0.0, expected, own / range_degc**2 if with_slope else 0.0, FEW)
    size = 3 if with_slope else 2
    units = np.array([own / gap_day, own, own / range_degc**2])[:size]

    def given(x: Array) -> Strengths:
        walk, scatter, *slope = map(float, units * np.exp(np.clip(x, *LIMITS)))
        return Strengths(walk, scatter, slope[0] if slope else 0.0)

    def cost(x: Array) -> float:
        strengths = given(x)
        z, variance = innovations(series, strengths)
        at = np.isfinite(z)
        started_anew = known.sum() - at.sum()
        likelihood = np.sum(np.log(variance[at] / own) + z[at] ** 2) + started_anew * RESTART_SD**2
        few = unlikely(strengths.scatter / own) + beside_scatter(strengths, gap_day, range_degc)
        if with_slope:
            few += unlikely(strengths.slope / units[2]) + of_pairs(within, strengths.slope, own)
        outside = np.sum(np.maximum(np.abs(x) - LIMITS[1], 0.0) ** 2)
        return float(likelihood + few + outside)

    start = min((np.log(np.square(at[:size])) for at in _starts(with_slope)), key=cost)
    simplex = start + np.eye(size + 1, size, -1)
    best = minimize(cost, start, method="Nelder-Mead", options={**TOLERANCES, "initial_simplex": simplex})
    most = [largest_likely(cost, best.x, best.fun, i) for i in range(1, size)]
    found = given(np.array([mean_of_variance(cost, best.x, best.fun, 0), *most]))
    return replace(found, freedom=FEW + float(np.isfinite(innovations(series, found)[0]).sum()))


def _starts(with_slope: bool) -> list[Array]:
    """Where the likeliest are looked for from: sessions may be known far better than constants scatter, and were each
    innovation then a restart, no strength near a session's own sd would be likelier than another."""
    walk, scatter, slope = START
    times = TIMES if with_slope else TIMES[:1]
    return [np.array([walk * a, scatter * a, slope * b]) for a in TIMES for b in times]


def usual_gap(day: Array) -> float:
    """Median of the days (m, n) from one session to the next of a series, where there are two on two days; else 1."""
    gap = np.diff(day, axis=0)
    gap = gap[gap > 0.0]
    return float(np.median(gap)) if len(gap) else 1.0


def beside_scatter(strengths: Strengths, gap_day: float, range_degc: float) -> float:
    """Minus twice the logarithm of the chance beforehand that what few innovations show is a walk or a slope, by how
    much each does over the usual gap and the temperatures flown beside the scatter."""
    walk = np.log1p(strengths.walk * gap_day / strengths.scatter)
    return float(FEW * walk + 0.5 * FEW * np.log1p(strengths.slope * range_degc**2 / strengths.scatter))


def of_pairs(within: Array, slope: float, own: float) -> float:
    """Minus twice the logarithm of the likelihood of differences `within` (k, 3) (of temperature and value, and the
    variance of that) at a variance of slopes, over that of a session itself; one beyond RESTART_SD counts no more."""
    variance = slope * within[:, 0] ** 2 + within[:, 2]
    return float(np.sum(np.minimum(np.log(variance / own) + within[:, 1] ** 2 / variance, RESTART_SD**2)))


def is_bent(series: Array, scatter: float) -> bool:
    """Whether a series (m, 4), m > 3, of day, temperature, value and variance bends with temperature by its scatter:
    Student's t of the coefficient of the square. `scatter` beside the variances weighs the sessions alone."""
    _, warmth, value, variance = series.T
    freedom = len(value) - 3
    root = (variance + scatter) ** -0.5
    axes = np.linalg.qr(np.vander(warmth, 3, increasing=True) * root[:, None])[0]
    told = axes.T @ (value * root)
    left = float(np.sum((value * root - axes @ told) ** 2))
    return bool(log_beyond_either_way(told[2] / np.sqrt(max(left, 1e-300) / freedom), freedom) < np.log(BENT))


def _on_grid(value: float) -> float:
    return float(GRID ** np.round(np.log(value) / np.log(GRID))) if value > 0.0 else 0.0


def unlikely(ratio: float) -> float:
    """Minus twice the logarithm of the chance of a variance beforehand, over that of a session itself: much less than
    expected is unlikely, much more hardly, for sessions may be known ever so well."""
    above = np.log(ratio / EXPECTED_SHARE**2)
    return float(above if above > 0.0 else FEW * (above + EXPECTED_SHARE**2 / ratio - 1.0))


def mean_of_variance(cost: Callable[[Array], float], best: Array, least: float, i: int) -> float:
    """Logarithm of the mean of variance i over all that it may be by the likelihood, any sd as likely as another
    beforehand, the other elements of x as they are."""
    first, last = np.arcsinh((np.array(LIMITS) - best[i]) / NEAR)
    u = np.linspace(first, last, LOOKED_AT)
    x = np.repeat(best[None], LOOKED_AT, axis=0)
    x[:, i] += NEAR * np.sinh(u)
    likely = np.cosh(u) * np.exp(0.5 * (least - np.array(list(map(cost, x))) + x[:, i]))
    return float(np.log(likely @ np.exp(x[:, i]) / likely.sum()))


def largest_likely(cost: Callable[[Array], float], best: Array, least: float, i: int) -> float:
    """The largest element i of x that is likely (`RISE`): a strength that the fleet hardly shows is
    not taken for none."""
    low, high = float(best[i]), LIMITS[1]

    def rise(value: float) -> float:
        x = best.copy()
        x[i] = value
        return cost(x) - least - RISE

    return float(brentq(rise, low, high, xtol=TOLERANCES["xatol"])) if rise(high) > 0.0 else low
