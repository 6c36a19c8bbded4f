"""What a history says by itself, before the fleet is asked: the steps that it might have, and the line for each number
of them. A function of the one history alone, bit by bit where the same rows come together: it may be kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from fieldcal.geometry.rotation import Array
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.trends.change_points import scatter_variance, strongest_step, temperature_slope
from fieldcal.trends.random_effects import Grouping, Regression, fit_random_effects
from fieldcal.trends.series import FLOOR, TEMPERATURE, TIME, Histories, Prepared, largest, prepare

FALSE_ALARMS = 0.01
"""Share of the alarms of one kind (drift, step) that may be false, over all rows (Benjamini and Hochberg)."""
MOST_STEPS = 3
STEPS_THAT_DRIFT = 0.05
"""Share of stepping units that are taken to drift as well, before their record is looked at. A slope in time and a step
explain much the same data: a slope that is not there would double the sd of the step's size, one that is there and left
out would shift it."""
ESTIMATES = (
    "value",
    "sd",
    "slope_per_degc",
    "slope_per_degc_sd",
    "slope_per_day",
    "slope_per_day_sd",
    "best_degc",
    "best_day",
    "session_variance",
    "flight_variance",
    "freedom",
    "last_error",
    "last_line",
    "drift_z",
    "moved",
    "change_day",
    "change_size",
    "change_size_sd",
)


@dataclass(frozen=True)
class Evidence:
    """One entry a row. `estimates`: by name (`ESTIMATES`) and number of steps, (g, MOST_STEPS + 1), NaN where that is
    not asked; `step_p` (g, MOST_STEPS): chance of another such step when so many are given, NaN where fewer are in
    question.

    Variances, `last_error`, `last_line` (the line's variance at the last flight), `last_variance` and `moved` are
    in units of the row's `unit`. `enough`: sessions for a trend; `timed`: flights have an order; `last_kept`: whether
    the last flight is in the fit; `kept` (n,): flights that count.
    """

    n_flights: np.ndarray
    n_sessions: np.ndarray
    enough: np.ndarray
    timed: np.ndarray
    unit: Array
    mean_variance: Array
    last_variance: Array
    last_kept: np.ndarray
    step_p: Array
    estimates: dict[str, Array]
    kept: np.ndarray


def evidence(h: Histories) -> Evidence:
    """What each history says.

    Raises
    ------
    ValueError
        As `trends.series.prepare`.
    """
    p = prepare(h)
    g = len(p.unit)
    steps, step_p = _steps(p)
    estimates = {name: np.full((g, MOST_STEPS + 1), np.nan) for name in ESTIMATES}
    for count in range(MOST_STEPS + 1):
        rows = np.arange(g) if count == 0 else np.flatnonzero(steps[:, count - 1] >= 0)
        if not len(rows):
            break
        part_h, part, sessions = (h, p, None) if count == 0 else _part(h, p, rows)
        first = steps[rows, :count] if sessions is None else np.searchsorted(sessions, steps[rows, :count])
        for name, column in _estimates(part_h, part, first).items():
            estimates[name][rows, count] = column
    last = np.maximum(p.last(p.usable), 0)
    return Evidence(
        n_flights=p.n_flights,
        n_sessions=p.n_sessions,
        enough=p.enough,
        timed=p.timed,
        unit=p.unit,
        mean_variance=p.mean_variance,
        last_variance=p.variance[last],
        last_kept=p.keep[last],
        step_p=step_p,
        estimates=estimates,
        kept=p.keep,
    )


def _steps(p: Prepared) -> tuple[np.ndarray, Array]:
    """(first session after each step (g, MOST_STEPS), −1: none in question; p-values (g, MOST_STEPS)).

    Session means are searched, level, temperature and time fitted along: a steady drift is not a step. A step is in
    question up to the largest p-value that can be an alarm in any fleet."""
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
    steps, p_value = np.full((grouping.n_rows, MOST_STEPS), -1), np.full((grouping.n_rows, MOST_STEPS), np.nan)
    rows, sessions = np.flatnonzero(p.enough & p.timed), np.arange(len(owner))
    for i in range(MOST_STEPS):
        kept = np.isin(owner[sessions], rows)
        sessions, x = sessions[kept], x[kept]
        if not len(rows):
            break
        row = np.searchsorted(rows, owner[sessions])
        index, p_value[rows, i] = strongest_step(row, x, level[sessions], weight[sessions], len(rows))
        first = np.where(index >= 0, sessions[np.maximum(index, 0)], -1)
        asked = (p_value[rows, i] <= FALSE_ALARMS) & (first >= 0)
        steps[rows[asked], i] = first[asked]
        x = np.column_stack([x, (sessions >= first[row]) & there[sessions]])
        rows = rows[asked]
    return steps, p_value


def _part(h: Histories, p: Prepared, rows: np.ndarray) -> tuple[Histories, Prepared, np.ndarray]:
    """The same of some rows alone, and the former numbers of their sessions, which keep their order."""
    grouping = p.grouping
    members = np.flatnonzero(np.isin(grouping.row, rows))
    sessions, session = np.unique(grouping.session[members], return_inverse=True)
    row = np.searchsorted(rows, grouping.row[members])
    part = Grouping(row, session, np.searchsorted(rows, grouping.row_of_session[sessions]), len(rows))
    by_flight = {name: getattr(h, name)[members] for name in ("session", "time_day", "temperature_degc", "value", "sd")}
    slope, slope_sd = (None if s is None else s[rows] for s in (h.slope_per_degc, h.slope_per_degc_sd))
    by_row = {name: getattr(p, name)[rows] for name in ("centre", "unit", "x_centre", "x_width", "enough", "timed")}
    kept = {name: getattr(p, name)[members] for name in ("y", "variance", "regressors", "usable", "keep")}
    part_h = Histories(row, **by_flight, slope_per_degc=slope, slope_per_degc_sd=slope_sd)
    return part_h, replace(p, grouping=part, **by_row, **kept), sessions


def _estimates(h: Histories, p: Prepared, steps: np.ndarray) -> dict[str, Array]:
    """The line with these steps (g, count), first sessions after each, in the units of the rows."""
    first = steps[p.grouping.row]
    design = np.column_stack([p.regressors, (p.grouping.session[:, None] >= first).astype(float)])
    given, given_variance = _given_slope(h, p, design.shape[1])
    fit = fit_random_effects(p.grouping, design, p.y, p.variance, p.keep, given=given, given_variance=given_variance)
    last, g = p.last(p.keep), len(p.unit)
    there, warm = last >= 0, fit.active[:, TEMPERATURE]
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
    time = p.keep * design[:, TIME]
    span = largest(p.grouping.row, time, g) + largest(p.grouping.row, -time, g)
    error, line = _last_error(p, design, fit)
    (per_degc, per_degc_sd), (per_day, per_day_sd) = _slope(p, fit, TEMPERATURE), _slope(p, fit, TIME)
    change_day, size, size_sd = _latest_step(h, p, design, steps)
    timed = fit.active[:, TIME]
    return {
        "value": _only(there, value),
        "sd": _only(there, sd),
        "slope_per_degc": per_degc,
        "slope_per_degc_sd": per_degc_sd,
        "slope_per_day": per_day,
        "slope_per_day_sd": per_day_sd,
        "best_degc": np.where(warm, REFERENCE_DEGC - to_best, p.x_centre[:, TEMPERATURE]),
        "best_day": _only(there & timed, h.time_day[np.maximum(last, 0)] - earlier),
        "session_variance": fit.session_variance,
        "flight_variance": fit.flight_variance,
        "freedom": fit.freedom,
        "last_error": error,
        "last_line": line,
        "drift_z": _only(timed, drift_z),
        "moved": _only(timed, np.abs(fit.coefficients[:, TIME]) * span),
        "change_day": change_day,
        "change_size": size,
        "change_size_sd": size_sd,
    }


def _only(mask: np.ndarray, x: Array) -> Array:
    return np.where(mask, x, np.nan)


def _slope(p: Prepared, fit: Regression, column: int) -> tuple[Array, Array]:
    factor = _only(fit.active[:, column], p.unit / p.x_width[:, column])
    variance = np.maximum(fit.covariance[:, column, column], 0.0)
    return factor * fit.coefficients[:, column], factor * np.sqrt(variance)


def _last_error(p: Prepared, design: Array, fit: Regression) -> tuple[Array, Array]:
    """(y − ŷ, xᵀCx) of the last flight of each row, whether or not it is in the fit."""
    last = np.maximum(p.last(p.usable), 0)
    x = design[last]
    error = p.y[last] - np.einsum("gp,gp->g", x, fit.coefficients)
    return error, np.asarray(np.einsum("gp,gpq,gq->g", x, fit.covariance, x))


def _given_slope(h: Histories, p: Prepared, n_columns: int) -> tuple[Array | None, Array | None]:
    """The warm-up flights' slope in the coordinates of the regression."""
    if h.slope_per_degc is None or h.slope_per_degc_sd is None:
        return None, None
    given, variance = np.zeros((len(p.unit), n_columns)), np.full((len(p.unit), n_columns), np.inf)
    factor = p.x_width[:, TEMPERATURE] / p.unit
    there = np.isfinite(h.slope_per_degc) & np.isfinite(h.slope_per_degc_sd) & (h.slope_per_degc_sd > 0)
    given[there, TEMPERATURE] = (h.slope_per_degc * factor)[there]
    variance[there, TEMPERATURE] = ((h.slope_per_degc_sd * factor) ** 2)[there]
    return given, variance


def _latest_step(h: Histories, p: Prepared, design: Array, steps: np.ndarray) -> tuple[Array, Array, Array]:
    """(time of the first flight, size, sd) of the latest step of each row; NaN without one.

    The size is the mean of two models', with a slope in time and without, by their posterior probability: BIC's
    approximation to the odds of the slope, times the prior ones (`STEPS_THAT_DRIFT`). Its variance holds the models'
    disagreement. Hoeting et al. (1999), Statistical Science 14, 382–417.
    """
    g = len(p.unit)
    if not steps.shape[1]:
        nothing = np.full(g, np.nan)
        return nothing, nothing, nothing
    data = p.y, p.variance, p.keep
    sloped = fit_random_effects(p.grouping, design, *data)
    plain = fit_random_effects(p.grouping, np.where(np.arange(design.shape[1]) == TIME, 0.0, design), *data)
    rows, latest = np.arange(g), steps.argmax(axis=1)
    column = TIME + 1 + latest
    t2 = sloped.coefficients[:, TIME] ** 2 / np.maximum(sloped.covariance[:, TIME, TIME], 1e-300)
    n, freedom = p.n_sessions, np.maximum(sloped.freedom, 1.0)
    log_odds = 0.5 * (n * np.log1p(t2 / freedom) - np.log(n)) + special.logit(STEPS_THAT_DRIFT)
    drifts = np.where(sloped.active[:, TIME], special.expit(log_odds), 0.0)
    with_slope, without = sloped.coefficients[rows, column], plain.coefficients[rows, column]
    mean = drifts * with_slope + (1.0 - drifts) * without
    variance = (
        drifts * sloped.covariance[rows, column, column]
        + (1.0 - drifts) * plain.covariance[rows, column, column]
        + drifts * (1.0 - drifts) * (with_slope - without) ** 2
    )
    first = np.full(len(p.grouping.row_of_session), len(h.row))
    index = np.flatnonzero(p.keep)
    np.minimum.at(first, p.grouping.session[index], index)
    return h.time_day[first[steps[rows, latest]]], p.unit * mean, p.unit * np.sqrt(variance)
