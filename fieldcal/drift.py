"""Trends of calibrated parameters over temperature and time, from the flights of many histories at once.

    y = value(25 °C, last flight) + slope_T (T − 25 °C) + slope_t (t − t_last) − Σ steps still to come + u + e

u is the scatter between sessions (every power-up has its own), e the flight's own error. Before the line is drawn,
flights that agree with none of their neighbours are set aside and steps are looked for; what the record then says of
each number, with its standard deviation, is in `Trends`. A history is a row; all rows of a fleet go in together: the
share of false alarms is controlled over all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from fieldcal.change_points import isolated, scatter_variance, strongest_step, temperature_slope
from fieldcal.random_effects import Grouping, Regression, fit_random_effects
from fieldcal.rotation import Array

REFERENCE_DEGC = 25.0
FALSE_ALARMS = 0.01
"""Share of the alarms of one kind (drift, step, outlier) that may be false, over all rows (Benjamini and Hochberg)."""
ENOUGH_SESSIONS = 5
"""Fewer sessions than this are no trend: level, two slopes, and something left to judge them by."""
TEMPERATURE_SPAN_DEGC = 2.0
TIME_SPAN_DAY = 1.0
MOST_STEPS = 3
NO_TREND_SIGMAS = 2.0
"""A step's size is taken without a slope in time when that slope is not beyond this: the two tell the same story twice,
and a slope that is not there would double the size's sd."""
FLOOR = 1e-6
"""Smallest sd of a flight, in units of the row's spread: a claim of no error at all is not believed."""

LEVEL, TEMPERATURE, TIME = 0, 1, 2


@dataclass(frozen=True)
class Histories:
    """Flights of many histories, one history after the other, each in order of time.

    `row` (n,) counts histories from 0, ascending; `session` (n,) labels flights of the same session within a row;
    `time_day` and `temperature_degc` (n,) are NaN where unknown, `sd` (n,) too; `value` (n,) is finite.
    `slope_per_degc`, `slope_per_degc_sd` (g,), optional: what warm-up flights say of the slope by themselves, NaN
    where nothing.
    """

    row: np.ndarray
    session: np.ndarray
    time_day: Array
    temperature_degc: Array
    value: Array
    sd: Array
    slope_per_degc: Array | None = None
    slope_per_degc_sd: Array | None = None


@dataclass(frozen=True)
class Trends:
    """What the histories say, one entry a row; NaN where the record does not tell.

    `n_flights`, `n_sessions`: that count; `value`, `sd`: at 25 °C as of the last flight that counts; `best_degc`:
    temperature at which the value is independent of the slope, so that var(T) = var(best) + slope_sd² (T − best)²;
    `session_sd`, `flight_sd`: scatter between sessions and, beyond their claims, of flights within them; `last_z`: the
    last flight's distance from the line drawn without it, in sd; `change_day`, `change_size`: first flight after the
    latest step, and the step; `drift_p`, `step_p`: chance of such a slope in time, such a step, in a stable unit.
    `moved`: slope over the record's length in units of a single flight's scatter. `kept` (n,): flights that count.
    `last` (g,): index of the last flight with all that the line needs.
    """

    n_flights: np.ndarray
    n_sessions: Array
    value: Array
    sd: Array
    slope_per_degc: Array
    slope_per_degc_sd: Array
    slope_per_day: Array
    slope_per_day_sd: Array
    best_degc: Array
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
    last: np.ndarray


def analyse(h: Histories) -> Trends:
    """Trends of all histories.

    Fewer than five sessions give a mean with its scatter and no slopes; so does a temperature that moves less than 2 °C
    for the slope on temperature, and a record shorter than a day for the slope on time.

    Raises
    ------
    ValueError
        Rows not ascending, or a value that is not finite.
    """
    row = np.asarray(h.row)
    if len(row) == 0 or np.any(np.diff(row) < 0) or not np.isfinite(h.value).all():
        raise ValueError("histories need at least one flight, ascending rows and finite values")
    n_rows = int(row[-1]) + 1
    grouping = _grouping(row, np.asarray(h.session), n_rows)
    usable = _with_all_it_needs(h, n_rows)
    scale, y, variance = _scaled(h, row, n_rows)
    columns = _columns(h, grouping, usable)
    keep = usable & ~_alone(grouping, h, usable, y, variance)
    enough = _sessions(grouping, keep) >= ENOUGH_SESSIONS
    columns.design[~enough[row], TEMPERATURE:] = 0.0
    step_session, step_p = _steps(grouping, columns.design, y, variance, keep, enough)
    design = np.column_stack([columns.design, _step_columns(grouping, step_session)])
    known, known_variance = _known(h, columns, scale, design.shape[1], n_rows)
    fit = fit_random_effects(grouping, design, y, variance, keep, known=known, known_variance=known_variance)
    return _told(h, grouping, columns, design, y, variance, keep, usable, enough, scale, fit, step_session, step_p)


@dataclass(frozen=True)
class _Columns:
    """Regressors (n, 3) level, temperature, time as (x − centre)/width; centre and width (g, 3)."""

    design: Array
    centre: Array
    width: Array


def _grouping(row: np.ndarray, session: np.ndarray, n_rows: int) -> Grouping:
    """Sessions numbered by row, then by first flight."""
    _, label = np.unique(session, return_inverse=True)
    _, first, inverse = np.unique(row * (label.max() + 1) + label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=int)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return Grouping(row, rank[inverse], row[np.sort(first)], n_rows)


def _with_all_it_needs(h: Histories, n_rows: int) -> np.ndarray:
    """Flights (n,) with a time where the row has any, and with a temperature where most of the row have one."""
    timed, warm = np.isfinite(h.time_day), np.isfinite(h.temperature_degc)
    flights = np.bincount(h.row, minlength=n_rows)
    any_time = np.bincount(h.row, timed, n_rows) > 0
    most_warm = np.bincount(h.row, warm, n_rows) > 0.5 * flights
    return np.asarray((timed | ~any_time[h.row]) & (warm | ~most_warm[h.row]))


def _scaled(h: Histories, row: np.ndarray, n_rows: int) -> tuple[Array, Array, Array]:
    """(scale (g, 2): centre and unit, y, s²): each row at O(1). A missing sd is the mean of the others', else 0."""
    known = np.isfinite(h.sd)
    mean_sd = np.bincount(row, np.where(known, h.sd, 0.0), n_rows) / np.maximum(np.bincount(row, known, n_rows), 1)
    sd = np.where(known, h.sd, mean_sd[row])
    flights = np.maximum(np.bincount(row, minlength=n_rows), 1)
    centre = np.bincount(row, h.value, n_rows) / flights
    unit = np.sqrt(np.bincount(row, (h.value - centre[row]) ** 2 + sd**2, n_rows) / flights)
    unit = np.maximum(unit, np.maximum(1e-12 * np.abs(centre), 1e-300))
    variance = (sd / unit[row]) ** 2
    return np.column_stack([centre, unit]), (h.value - centre[row]) / unit[row], np.maximum(variance, FLOOR**2)


def _columns(h: Histories, grouping: Grouping, usable: np.ndarray) -> _Columns:
    design, centre, width = [np.ones(len(h.row))], [np.zeros(grouping.n_rows)], [np.ones(grouping.n_rows)]
    count = np.maximum(np.bincount(h.row, usable, grouping.n_rows), 1)
    for x, span in ((h.temperature_degc, TEMPERATURE_SPAN_DEGC), (h.time_day, TIME_SPAN_DAY)):
        good = usable & np.isfinite(x)
        filled = np.where(good, x, 0.0)
        mean = np.bincount(h.row, filled, grouping.n_rows) / count
        off = np.where(good, filled - mean[h.row], 0.0)
        spread = np.sqrt(np.bincount(h.row, off**2, grouping.n_rows) / count)
        range_ = _extreme(h.row, off, grouping.n_rows) + _extreme(h.row, -off, grouping.n_rows)
        w = np.where(spread > 0, spread, 1.0)
        design.append(np.where(range_[h.row] >= span, off / w[h.row], 0.0))
        centre.append(np.where(np.bincount(h.row, good, grouping.n_rows) > 0, mean, np.nan))
        width.append(w)
    return _Columns(np.column_stack(design), np.column_stack(centre), np.column_stack(width))


def _extreme(row: np.ndarray, x: Array, n_rows: int) -> Array:
    """Largest x by row, at least 0."""
    result = np.zeros(n_rows)
    np.maximum.at(result, row, x)
    return result


def _alone(grouping: Grouping, h: Histories, usable: np.ndarray, y: Array, variance: Array) -> np.ndarray:
    """Flights that stand alone among flights, or whose session stands alone among sessions."""
    there = np.flatnonzero(usable)
    row, session = grouping.row[there], grouping.session[there]
    warmth = h.temperature_degc[there]
    slope = temperature_slope(row, y[there], warmth, grouping.n_rows)
    known = np.isfinite(warmth)
    residual = y[there] - np.where(known, slope[row] * np.where(known, warmth, 0.0), 0.0)
    own = variance[there]
    total = own + scatter_variance(row, residual, own, grouping.n_rows)[row]
    alone = np.zeros(len(y), dtype=bool)
    alone[there] = isolated(row, residual, total)
    # The same for sessions of several flights, from what is left of them.
    good = ~alone[there]
    weight = np.bincount(session, good / total, len(grouping.row_of_session))
    present = np.flatnonzero(weight > 0)
    mean = np.bincount(session, good * residual / total, len(weight))[present] / weight[present]
    claimed = 1.0 / np.bincount(session, good / own, len(weight))[present]
    owner = grouping.row_of_session[present]
    between = scatter_variance(owner, mean, claimed, grouping.n_rows)[owner]
    spoiled = np.zeros(len(weight), dtype=bool)
    spoiled[present] = isolated(owner, mean, claimed + between)
    return alone | spoiled[grouping.session]


def _sessions(grouping: Grouping, keep: np.ndarray) -> Array:
    """Sessions (g,) with a flight that counts."""
    return grouping.sessions_by_row((grouping.by_session(keep.astype(float)) > 0).astype(float))


def _steps(
    grouping: Grouping, design: Array, y: Array, variance: Array, keep: np.ndarray, enough: np.ndarray
) -> tuple[np.ndarray, Array]:
    """(first session after each step (g, MOST_STEPS), −1: none; p-value of the strongest step (g,)).

    Session means are searched, level, temperature and time fitted along: a steady drift is not a step."""
    inverse = grouping.by_session(keep / variance)
    weighted = grouping.by_session(np.column_stack([design, y]) * (keep / variance)[:, None])
    there = inverse > 0.0
    mean = weighted / np.where(there, inverse, 1.0)[:, None]
    claimed = np.where(there, 1.0 / np.where(there, inverse, 1.0), 0.0)
    x, level = mean[:, :-1], mean[:, -1]
    owner = grouping.row_of_session
    present = np.flatnonzero(there)
    slope = temperature_slope(owner[present], level[present], x[present, TEMPERATURE], grouping.n_rows)
    residual = level[present] - slope[owner[present]] * x[present, TEMPERATURE]
    between = scatter_variance(owner[present], residual, claimed[present], grouping.n_rows)
    weight = np.where(there, 1.0 / (claimed + between[owner] + FLOOR**2), 0.0)
    steps = np.full((grouping.n_rows, MOST_STEPS), -1)
    strongest_p = np.ones(grouping.n_rows)
    searching = enough.copy()
    for i in range(MOST_STEPS):
        index, p = strongest_step(owner, x, level, weight, grouping.n_rows)
        if i == 0:
            strongest_p = np.where(enough, p, np.nan)
        found = np.zeros(grouping.n_rows, dtype=bool)
        found[enough] = alarms(p[enough])
        searching &= found
        steps[searching, i] = index[searching]
        if not searching.any():
            break
        number = np.arange(len(owner))
        after = searching[owner] & (number >= index[owner])
        x = np.column_stack([x, after * there])
    return steps, strongest_p


def alarms(p_value: Array, rate: float = FALSE_ALARMS) -> np.ndarray:
    """Which of these p-values stand out when at most `rate` of those named may be false (Benjamini and Hochberg)."""
    p = np.where(np.isfinite(p_value), p_value, 1.0)
    if len(p) == 0:
        return np.zeros(0, dtype=bool)
    return np.asarray(stats.false_discovery_control(p) <= rate)


def _step_columns(grouping: Grouping, steps: np.ndarray) -> Array:
    """(n, up to MOST_STEPS): 1 after the step; as many columns as the row with most steps has."""
    used = int((steps >= 0).sum(axis=1).max())
    first = steps[grouping.row, :used]
    return ((first >= 0) & (grouping.session[:, None] >= first)).astype(float)


def _known(
    h: Histories, columns: _Columns, scale: Array, p: int, n_rows: int
) -> tuple[Array | None, Array | None]:
    """The warm-up flights' slope in the scaled coordinates of the regression."""
    if h.slope_per_degc is None or h.slope_per_degc_sd is None:
        return None, None
    known, variance = np.zeros((n_rows, p)), np.full((n_rows, p), np.inf)
    factor = columns.width[:, TEMPERATURE] / scale[:, 1]
    there = np.isfinite(h.slope_per_degc) & np.isfinite(h.slope_per_degc_sd) & (h.slope_per_degc_sd > 0)
    known[there, TEMPERATURE] = (h.slope_per_degc * factor)[there]
    variance[there, TEMPERATURE] = ((h.slope_per_degc_sd * factor) ** 2)[there]
    return known, variance


def _told(
    h: Histories,
    grouping: Grouping,
    columns: _Columns,
    design: Array,
    y: Array,
    variance: Array,
    keep: np.ndarray,
    usable: np.ndarray,
    enough: np.ndarray,
    scale: Array,
    fit: Regression,
    steps: np.ndarray,
    step_p: Array,
) -> Trends:
    """The regression in the units of the rows."""
    g, unit = grouping.n_rows, scale[:, 1]
    last = _last(grouping.row, usable, g)
    last_kept = _last(grouping.row, keep, g)
    there = last_kept >= 0
    at = np.where(there, last_kept, 0)
    direction = design[at].copy()
    with np.errstate(invalid="ignore"):
        to_reference = (REFERENCE_DEGC - columns.centre[:, TEMPERATURE]) / columns.width[:, TEMPERATURE]
    direction[:, TEMPERATURE] = np.where(fit.active[:, TEMPERATURE], to_reference, 0.0)
    value = scale[:, 0] + unit * np.einsum("gp,gp->g", direction, fit.coefficients)
    with_all = np.einsum("gpq,gq->gp", fit.covariance, direction)
    sd = unit * np.sqrt(np.maximum(np.einsum("gp,gp->g", direction, with_all), 0.0))
    slopes = _slopes(fit, columns, unit)
    with np.errstate(invalid="ignore", divide="ignore"):
        z = fit.coefficients[:, TIME] / np.sqrt(fit.covariance[:, TIME, TIME])
        best = REFERENCE_DEGC - with_all[:, TEMPERATURE] / fit.covariance[:, TEMPERATURE, TEMPERATURE] * (
            columns.width[:, TEMPERATURE]
        )
    drift_p = np.where(
        fit.active[:, TIME] & (fit.freedom > 0.5), 2.0 * stats.t.sf(np.abs(z), np.maximum(fit.freedom, 0.5)), np.nan
    )
    best = np.where(fit.active[:, TEMPERATURE], best, columns.centre[:, TEMPERATURE])
    own = np.bincount(h.row, keep * variance, g) / np.maximum(np.bincount(h.row, keep, g), 1)
    single = np.sqrt(own + fit.session_variance + fit.flight_variance)
    span = _extreme(h.row, keep * design[:, TIME], g) + _extreme(h.row, keep * -design[:, TIME], g)
    change_day, size, size_sd = _latest_step(h, grouping, design, y, variance, keep, unit, fit, z, steps)
    several = _sessions(grouping, keep) >= 2

    def only(mask: np.ndarray, x: Array) -> Array:
        return np.where(mask, x, np.nan)

    return Trends(
        n_flights=np.bincount(h.row, keep, g),
        n_sessions=_sessions(grouping, keep),
        value=only(there, value),
        sd=only(there, sd),
        slope_per_degc=slopes[0],
        slope_per_degc_sd=slopes[1],
        slope_per_day=slopes[2],
        slope_per_day_sd=slopes[3],
        best_degc=best,
        session_sd=only(several, unit * np.sqrt(fit.session_variance)),
        flight_sd=only(several, unit * np.sqrt(fit.flight_variance)),
        last_z=only(enough, _last_distance(grouping, design, y, variance, keep, fit, np.maximum(last, 0))),
        change_day=change_day,
        change_size=size,
        change_size_sd=size_sd,
        drift_p=drift_p,
        step_p=step_p,
        moved=only(fit.active[:, TIME], np.abs(fit.coefficients[:, TIME]) * span / single),
        kept=keep,
        last=last,
    )


def _last(row: np.ndarray, good: np.ndarray, n_rows: int) -> np.ndarray:
    """Index of the last good flight of each row, −1 where there is none."""
    result = np.full(n_rows, -1)
    index = np.flatnonzero(good)
    result[row[index]] = index  # ascending: the last one stays
    return result


def _slopes(fit: Regression, columns: _Columns, unit: Array) -> tuple[Array, Array, Array, Array]:
    """slope, sd on temperature, slope, sd on time."""
    out = []
    for j in (TEMPERATURE, TIME):
        factor = unit / columns.width[:, j]
        out.append(np.where(fit.active[:, j], factor * fit.coefficients[:, j], np.nan))
        out.append(np.where(fit.active[:, j], factor * np.sqrt(np.maximum(fit.covariance[:, j, j], 0.0)), np.nan))
    return out[0], out[1], out[2], out[3]


def _last_distance(
    grouping: Grouping, design: Array, y: Array, variance: Array, keep: np.ndarray, fit: Regression, last: np.ndarray
) -> Array:
    """(y − ŷ)/sd of the last flight against the line without it: e/√(v(1 − h)) where it is in the fit (deletion
    formula), e/√(v + xᵀCx) where it was set aside."""
    x = design[last]
    error = y[last] - np.einsum("gp,gp->g", x, fit.coefficients)
    line = np.einsum("gp,gpq,gq->g", x, fit.covariance, x)
    v = variance[last] + fit.session_variance + fit.flight_variance
    spread = np.where(keep[last], np.maximum(v - line, 0.05 * v), v + line)
    return np.asarray(error / np.sqrt(spread))


def _latest_step(
    h: Histories,
    grouping: Grouping,
    design: Array,
    y: Array,
    variance: Array,
    keep: np.ndarray,
    unit: Array,
    fit: Regression,
    z: Array,
    steps: np.ndarray,
) -> tuple[Array, Array, Array]:
    """(time of the first flight, size, sd) of the latest step of each row; NaN without one."""
    g = grouping.n_rows
    latest = steps.argmax(axis=1)
    found = steps.max(axis=1) >= 0
    day, size, size_sd = np.full(g, np.nan), np.full(g, np.nan), np.full(g, np.nan)
    if not found.any():
        return day, size, size_sd
    without = design.copy()
    flat = found & ~(np.abs(z) > NO_TREND_SIGMAS)
    without[flat[grouping.row], TIME] = 0.0
    members = np.flatnonzero(found[grouping.row])
    rows, row = np.unique(grouping.row[members], return_inverse=True)
    sessions, session = np.unique(grouping.session[members], return_inverse=True)
    part = Grouping(row, session, np.searchsorted(rows, grouping.row_of_session[sessions]), len(rows))
    refit = fit_random_effects(part, without[members], y[members], variance[members], keep[members])
    own = np.arange(len(rows))
    column = TIME + 1 + latest[rows]
    size[rows] = unit[rows] * refit.coefficients[own, column]
    size_sd[rows] = unit[rows] * np.sqrt(refit.covariance[own, column, column])
    first = np.full(len(grouping.row_of_session), len(h.row))
    index = np.flatnonzero(keep)
    np.minimum.at(first, grouping.session[index], index)
    day[rows] = h.time_day[first[steps[rows, latest[rows]]]]
    return day, size, size_sd


def statuses(trends: Trends, fleet_p: Array) -> np.ndarray:
    """`insufficient`, `step`, `drifting`, `outlier` or `stable` for each row, the first that applies.

    `fleet_p` (g,): chance of such a distance from the siblings (`fleet.sibling_distance`). Drifting takes more than
    significance: over its record the parameter has moved by more than one flight scatters.
    """
    enough = trends.n_sessions >= ENOUGH_SESSIONS
    status = np.full(len(enough), "insufficient", dtype=object)
    drifting, outlier = np.zeros(len(enough), dtype=bool), np.zeros(len(enough), dtype=bool)
    drifting[enough] = alarms(trends.drift_p[enough])
    outlier[enough] = alarms(fleet_p[enough])
    status[enough] = "stable"
    status[enough & outlier] = "outlier"
    status[enough & drifting & (trends.moved > 1.0)] = "drifting"
    status[enough & np.isfinite(trends.change_size)] = "step"
    return status


def pooled(h: Histories) -> tuple[Array, Array]:
    """Mean of each history and its sd (g,), scatter between sessions estimated and included: no slopes, no steps."""
    row = np.asarray(h.row)
    n_rows = int(row[-1]) + 1
    grouping = _grouping(row, np.asarray(h.session), n_rows)
    scale, y, variance = _scaled(h, row, n_rows)
    fit = fit_random_effects(grouping, np.ones((len(y), 1)), y, variance, np.ones(len(y), dtype=bool))
    mean = scale[:, 0] + scale[:, 1] * fit.coefficients[:, LEVEL]
    return mean, scale[:, 1] * np.sqrt(fit.covariance[:, LEVEL, LEVEL])
