"""Trends of calibrated parameters over temperature and time, from the flights of many histories at once.

    y = value(25 °C, last flight) + slope_T (T − 25 °C) + slope_t (t − t_last) − Σ steps still to come + u + e

u is the scatter between sessions (every power-up has its own), e the flight's own error. Before the line is drawn,
flights that agree with none of their neighbours are set aside and steps are looked for; what the record then says of
each number, with its standard deviation, is in `Trends`. A history is a row; all rows of a fleet go in together: the
share of false alarms is controlled over all of them.

Sessions are taken as independent draws about the line, and the line as straight. A parameter that wanders from session
to session (a random walk) is therefore told as drifting or stepping sooner than these shares say, and one whose curve
over temperature bends is told with its bend as scatter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special, stats

from fieldcal.change_points import scatter_variance, strongest_step, temperature_slope
from fieldcal.fleet import LEAST_FREEDOM, moderated_variance
from fieldcal.histories import (
    ENOUGH_SESSIONS,
    FLOOR,
    LEVEL,
    TEMPERATURE,
    TIME,
    Histories,
    Prepared,
    largest,
    prepare,
)
from fieldcal.random_effects import Grouping, Regression, fit_random_effects
from fieldcal.rotation import Array

REFERENCE_DEGC = 25.0
FALSE_ALARMS = 0.01
"""Share of the alarms of one kind (drift, step) that may be false, over all rows (Benjamini and Hochberg)."""
FALSE_OUTLIERS = 0.05
"""The same for outliers among siblings, which claim less: nothing has changed."""
MOST_STEPS = 3
STEPS_THAT_DRIFT = 0.05
"""Share of stepping units that are taken to drift as well, before their record is looked at. A slope in time and a step
tell much the same story: a slope that is not there would double the sd of the step's size, one that is there and left
out would shift it."""
LEAST_LEFT = 0.05
"""Share of a flight's variance that is left to it, at least, however much it draws the line to itself."""


@dataclass(frozen=True)
class Trends:
    """What the histories say, one entry a row; NaN where the record does not tell.

    `n_flights`, `n_sessions`: that count; `value`, `sd`: at 25 °C as of the last flight that counts; `best_degc`:
    temperature at which the value is independent of the slope, so that var(T) = var(best) + slope_sd² (T − best)²;
    `best_day`: the same of the slope in time, at 25 °C;
    `session_sd`, `flight_sd`: scatter between sessions and, beyond their claims, of flights within them; `last_z`: the
    last flight's distance from the line drawn without it, in sd; `change_day`, `change_size`: first flight after the
    latest step, and the step; `drift_p`, `step_p`: chance of such a slope in time, such a step, in a stable unit.
    `moved`: slope over the record's length in units of a single flight's scatter. `kept` (n,): flights that count.
    """

    n_flights: np.ndarray
    n_sessions: np.ndarray
    value: Array
    sd: Array
    slope_per_degc: Array
    slope_per_degc_sd: Array
    slope_per_day: Array
    slope_per_day_sd: Array
    best_degc: Array
    best_day: Array
    session_sd: Array
    flight_sd: Array
    last_z: Array
    change_day: Array
    change_size: Array
    change_size_sd: Array
    drift_p: Array
    step_p: Array
    moved: Array
    kept: np.ndarray


def analyse(h: Histories) -> Trends:
    """Trends of all histories.

    Fewer than five sessions give a mean with its scatter and no slopes; so does a temperature that moves less than 2 °C
    for the slope on temperature, and a record shorter than a day for the slope on time. Without times there are
    neither steps nor a last flight.

    Raises
    ------
    ValueError
        Rows not ascending from 0 or one left out, or a value that is not finite.
    """
    p = prepare(h)
    steps, step_p = _steps(p)
    design = np.column_stack([p.regressors, _step_columns(p.grouping, steps)])
    known, known_variance = _known(h, p, design.shape[1])
    fit = fit_random_effects(
        p.grouping, design, p.y, p.variance, p.keep, known=known, known_variance=known_variance
    )
    if h.kind is not None:
        fit = _among_siblings(fit, p, np.asarray(h.kind))
    return _told(h, p, design, fit, steps, step_p)


def moving(trends: Trends) -> tuple[np.ndarray, np.ndarray]:
    """(stepped, drifting), each (g,). Drifting takes more than significance: over its record the parameter has moved by
    more than one flight scatters."""
    enough = trends.n_sessions >= ENOUGH_SESSIONS
    drifting = np.zeros(len(enough), dtype=bool)
    drifting[enough] = alarms(trends.drift_p[enough])
    return enough & np.isfinite(trends.change_size), enough & drifting & (trends.moved > 1.0)


def statuses(trends: Trends, fleet_p: Array) -> np.ndarray:
    """`insufficient`, `step`, `drifting`, `outlier` or `stable` for each row, the first that applies.

    `fleet_p` (g,): chance of such a distance from the siblings (`fleet.sibling_distance`).
    """
    enough = trends.n_sessions >= ENOUGH_SESSIONS
    status = np.full(len(enough), "insufficient", dtype=object)
    outlier = np.zeros(len(enough), dtype=bool)
    outlier[enough] = alarms(fleet_p[enough], FALSE_OUTLIERS)
    stepped, drifting = moving(trends)
    status[enough] = "stable"
    status[enough & outlier] = "outlier"
    status[drifting] = "drifting"
    status[stepped] = "step"
    return status


def alarms(p_value: Array, rate: float = FALSE_ALARMS) -> np.ndarray:
    """Which of these p-values stand out when at most `rate` of those named may be false (Benjamini and Hochberg)."""
    p = np.where(np.isfinite(p_value), p_value, 1.0)
    if len(p) == 0:
        return np.zeros(0, dtype=bool)
    return np.asarray(stats.false_discovery_control(p) <= rate)


def pooled(h: Histories) -> tuple[Array, Array]:
    """Mean of each history and its sd (g,), scatter between sessions estimated and included: no slopes, no steps."""
    p = prepare(h)
    everything = np.ones(len(p.y), dtype=bool)
    fit = fit_random_effects(p.grouping, p.regressors[:, :1], p.y, p.variance, everything)
    return p.centre + p.unit * fit.coefficients[:, LEVEL], p.unit * np.sqrt(fit.covariance[:, LEVEL, LEVEL])


def _steps(p: Prepared) -> tuple[np.ndarray, Array]:
    """(first session after each step (g, MOST_STEPS), −1: none; p-value of the strongest step (g,)).

    Session means are searched, level, temperature and time fitted along: a steady drift is not a step."""
    grouping, owner = p.grouping, p.grouping.row_of_session
    weight = p.keep / p.variance
    information = grouping.by_session(weight)
    there = information > 0.0
    safe = np.where(there, information, 1.0)
    mean = grouping.by_session(np.column_stack([p.regressors, p.y]) * weight[:, None]) / safe[:, None]
    x, level, claimed = mean[:, :-1], mean[:, -1], np.where(there, 1.0 / safe, 0.0)
    present = np.flatnonzero(there)
    slope = temperature_slope(owner[present], level[present], x[present, TEMPERATURE], grouping.n_rows)
    residual = level[present] - slope[owner[present]] * x[present, TEMPERATURE]
    between = scatter_variance(owner[present], residual, claimed[present], grouping.n_rows)
    weight = np.where(there, 1.0 / (claimed + between[owner] + FLOOR**2), 0.0)
    steps = np.full((grouping.n_rows, MOST_STEPS), -1)
    searched = p.enough & p.timed
    searching, strongest_p = searched.copy(), np.full(grouping.n_rows, np.nan)
    for i in range(MOST_STEPS):
        index, p_value = strongest_step(owner, x, level, weight, grouping.n_rows)
        if i == 0:
            strongest_p[searched] = p_value[searched]
        found = np.zeros(grouping.n_rows, dtype=bool)
        found[searched] = alarms(p_value[searched])
        searching &= found
        steps[searching, i] = index[searching]
        if not searching.any():
            break
        after = searching[owner] & (np.arange(len(owner)) >= index[owner])
        x = np.column_stack([x, after & there])
    return steps, strongest_p


def _step_columns(grouping: Grouping, steps: np.ndarray) -> Array:
    """(n, up to MOST_STEPS): 1 after the step; as many columns as the row with most steps has."""
    used = int((steps >= 0).sum(axis=1).max())
    first = steps[grouping.row, :used]
    return ((first >= 0) & (grouping.session[:, None] >= first)).astype(float)


def _known(h: Histories, p: Prepared, n_columns: int) -> tuple[Array | None, Array | None]:
    """The warm-up flights' slope in the coordinates of the regression."""
    if h.slope_per_degc is None or h.slope_per_degc_sd is None:
        return None, None
    known, variance = np.zeros((len(p.unit), n_columns)), np.full((len(p.unit), n_columns), np.inf)
    factor = p.x_width[:, TEMPERATURE] / p.unit
    there = np.isfinite(h.slope_per_degc) & np.isfinite(h.slope_per_degc_sd) & (h.slope_per_degc_sd > 0)
    known[there, TEMPERATURE] = (h.slope_per_degc * factor)[there]
    variance[there, TEMPERATURE] = ((h.slope_per_degc_sd * factor) ** 2)[there]
    return known, variance


def _among_siblings(fit: Regression, p: Prepared, kind: np.ndarray) -> Regression:
    """The scatter of each row, claims included, drawn towards its siblings' (`fleet.moderated_variance`)."""
    claimed = p.mean_variance + fit.flight_variance
    total = np.where(p.enough, fit.session_variance + claimed, np.nan)
    moderated, freedom = moderated_variance(kind, total * p.unit**2, fit.freedom)
    moderated = moderated / p.unit**2
    ratio = np.where(p.enough, moderated / total, 1.0)
    return replace(
        fit,
        covariance=fit.covariance * ratio[:, None, None],
        session_variance=np.where(p.enough, np.maximum(moderated - claimed, 0.0), fit.session_variance),
        freedom=np.where(p.enough, freedom, fit.freedom),
    )


def _told(h: Histories, p: Prepared, design: Array, fit: Regression, steps: np.ndarray, step_p: Array) -> Trends:
    """The regression in the units of the rows."""
    last = p.last(p.keep)
    there, several = last >= 0, p.n_sessions >= 2
    warm, timed = fit.active[:, TEMPERATURE], fit.active[:, TIME]
    direction = design[np.maximum(last, 0)].copy()
    with np.errstate(invalid="ignore"):
        to_reference = (REFERENCE_DEGC - p.x_centre[:, TEMPERATURE]) / p.x_width[:, TEMPERATURE]
    direction[:, TEMPERATURE] = np.where(warm, to_reference, 0.0)
    value = p.centre + p.unit * np.einsum("gp,gp->g", direction, fit.coefficients)
    with_all = np.einsum("gpq,gq->gp", fit.covariance, direction)
    sd = p.unit * np.sqrt(np.maximum(np.einsum("gp,gp->g", direction, with_all), 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        drift_z = fit.coefficients[:, TIME] / np.sqrt(fit.covariance[:, TIME, TIME])
        to_best, earlier = (
            with_all[:, column] / fit.covariance[:, column, column] * p.x_width[:, column]
            for column in (TEMPERATURE, TIME)
        )
    freedom = np.maximum(fit.freedom, LEAST_FREEDOM)
    drift_p = np.where(timed & (fit.freedom > LEAST_FREEDOM), 2.0 * stats.t.sf(np.abs(drift_z), freedom), np.nan)
    single = np.sqrt(p.mean_variance + fit.session_variance + fit.flight_variance)
    time, g = p.keep * design[:, TIME], len(p.unit)
    span = largest(h.row, time, g) + largest(h.row, -time, g)
    change_day, size, size_sd = _latest_step(h, p, design, steps)

    def only(mask: np.ndarray, x: Array) -> Array:
        return np.where(mask, x, np.nan)

    def slope(column: int) -> tuple[Array, Array]:
        factor = only(fit.active[:, column], p.unit / p.x_width[:, column])
        variance = np.maximum(fit.covariance[:, column, column], 0.0)
        return factor * fit.coefficients[:, column], factor * np.sqrt(variance)

    (per_degc, per_degc_sd), (per_day, per_day_sd) = slope(TEMPERATURE), slope(TIME)
    return Trends(
        n_flights=p.n_flights,
        n_sessions=p.n_sessions,
        value=only(there, value),
        sd=only(there, sd),
        slope_per_degc=per_degc,
        slope_per_degc_sd=per_degc_sd,
        slope_per_day=per_day,
        slope_per_day_sd=per_day_sd,
        best_degc=np.where(warm, REFERENCE_DEGC - to_best, p.x_centre[:, TEMPERATURE]),
        best_day=only(there & fit.active[:, TIME], h.time_day[np.maximum(last, 0)] - earlier),
        session_sd=only(several, p.unit * np.sqrt(fit.session_variance)),
        flight_sd=only(several, p.unit * np.sqrt(fit.flight_variance)),
        last_z=only(p.enough & p.timed, _last_distance(p, design, fit)),
        change_day=change_day,
        change_size=size,
        change_size_sd=size_sd,
        drift_p=drift_p,
        step_p=step_p,
        moved=only(timed, np.abs(fit.coefficients[:, TIME]) * span / single),
        kept=p.keep,
    )


def _last_distance(p: Prepared, design: Array, fit: Regression) -> Array:
    """(y − ŷ)/sd of the last flight against the line without it: e/√(v(1 − h)) where it is in the fit (deletion
    formula), e/√(v + xᵀCx) where it was set aside."""
    last = np.maximum(p.last(p.usable), 0)
    x = design[last]
    error = p.y[last] - np.einsum("gp,gp->g", x, fit.coefficients)
    line = np.einsum("gp,gpq,gq->g", x, fit.covariance, x)
    v = p.variance[last] + fit.session_variance + fit.flight_variance
    spread = np.where(p.keep[last], np.maximum(v - line, LEAST_LEFT * v), v + line)
    return np.asarray(error / np.sqrt(spread))


def _latest_step(h: Histories, p: Prepared, design: Array, steps: np.ndarray) -> tuple[Array, Array, Array]:
    """(time of the first flight, size, sd) of the latest step of each row; NaN without one.

    The size is the mean of two models', with a slope in time and without, by their posterior probability: BIC's
    approximation to the odds of the slope, times the prior ones (`STEPS_THAT_DRIFT`). Its variance holds the models'
    disagreement. Hoeting et al. (1999), Statistical Science 14, 382–417.
    """
    grouping, g = p.grouping, len(p.unit)
    latest, found = steps.argmax(axis=1), steps.max(axis=1) >= 0
    day, size, size_sd = np.full(g, np.nan), np.full(g, np.nan), np.full(g, np.nan)
    if not found.any():
        return day, size, size_sd
    members = np.flatnonzero(found[grouping.row])
    rows, row = np.unique(grouping.row[members], return_inverse=True)
    sessions, session = np.unique(grouping.session[members], return_inverse=True)
    part = Grouping(row, session, np.searchsorted(rows, grouping.row_of_session[sessions]), len(rows))
    data = p.y[members], p.variance[members], p.keep[members]
    sloped = fit_random_effects(part, design[members], *data)
    plain = fit_random_effects(part, np.where(np.arange(design.shape[1]) == TIME, 0.0, design[members]), *data)
    own, column = np.arange(len(rows)), TIME + 1 + latest[rows]
    t2 = sloped.coefficients[:, TIME] ** 2 / np.maximum(sloped.covariance[:, TIME, TIME], 1e-300)
    n, freedom = p.n_sessions[rows], np.maximum(sloped.freedom, 1.0)
    log_odds = 0.5 * (n * np.log1p(t2 / freedom) - np.log(n)) + special.logit(STEPS_THAT_DRIFT)
    drifts = np.where(sloped.active[:, TIME], special.expit(log_odds), 0.0)
    with_slope, without = sloped.coefficients[own, column], plain.coefficients[own, column]
    mean = drifts * with_slope + (1.0 - drifts) * without
    variance = (
        drifts * sloped.covariance[own, column, column]
        + (1.0 - drifts) * plain.covariance[own, column, column]
        + drifts * (1.0 - drifts) * (with_slope - without) ** 2
    )
    size[rows], size_sd[rows] = p.unit[rows] * mean, p.unit[rows] * np.sqrt(variance)
    first = np.full(len(grouping.row_of_session), len(h.row))
    index = np.flatnonzero(p.keep)
    np.minimum.at(first, grouping.session[index], index)
    day[rows] = h.time_day[first[steps[rows, latest[rows]]]]
    return day, size, size_sd
