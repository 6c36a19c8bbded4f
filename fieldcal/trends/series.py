"""Histories made ready for regression: sessions numbered, every row scaled to O(1), bad flights set aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldcal.geometry.rotation import Array
from fieldcal.schemas.reference import ENOUGH_SESSIONS
from fieldcal.trends.change_points import isolated, scatter_variance, temperature_slope
from fieldcal.trends.random_effects import Grouping

TEMPERATURE_SPAN_DEGC = 2.0
TIME_SPAN_DAY = 1.0
FLOOR = 1e-6
"""Smallest sd of a flight, in units of the row's spread: a claim of no error at all is not believed."""

LEAST_UNIT = 1e-150
"""Of a row whose flights are all 0; its square is a number still."""

LEVEL, TEMPERATURE, TIME = 0, 1, 2


@dataclass(frozen=True)
class Histories:
    """Flights of many histories, one history after the other, each in order of time.

    `row` (n,) counts histories from 0, ascending, none left out; `session` (n,) labels flights of the same session
    within a row; `time_day` and `temperature_degc` (n,) are NaN where unknown, `sd` (n,) too; `value` (n,) is finite.
    `slope_per_degc`, `slope_per_degc_sd` (g,), optional: what warm-up flights say of the slope by themselves, NaN
    where nothing. `kind` (g,), optional: equal for siblings, whose scatter is alike.
    """

    row: np.ndarray
    session: np.ndarray
    time_day: Array
    temperature_degc: Array
    value: Array
    sd: Array
    slope_per_degc: Array | None = None
    slope_per_degc_sd: Array | None = None
    kind: np.ndarray | None = None


@dataclass(frozen=True)
class Prepared:
    """Histories in the coordinates of the regression.

    `y`, `variance` (n,): (value − centre)/unit and its s²; `centre`, `unit` (g,). `regressors` (n, 3): 1, then
    temperature and time as (x − x_centre)/x_width, 0 throughout a row that does not determine the slope; both (g, 3).
    `usable` (n,): flights with all that the line needs; `keep` (n,): of them those that count. `enough` (g,): rows with
    sessions for a trend; `timed` (g,): rows whose flights have an order in time.
    """

    grouping: Grouping
    y: Array
    variance: Array
    centre: Array
    unit: Array
    regressors: Array
    x_centre: Array
    x_width: Array
    usable: np.ndarray
    keep: np.ndarray
    enough: np.ndarray
    timed: np.ndarray

    @property
    def n_flights(self) -> np.ndarray:
        """Flights (g,) that count."""
        return np.bincount(self.grouping.row, self.keep, self.grouping.n_rows).astype(int)

    @property
    def n_sessions(self) -> np.ndarray:
        """Sessions (g,) with a flight that counts."""
        return _sessions(self.grouping, self.keep)

    @property
    def mean_variance(self) -> Array:
        """Mean s² (g,) of the flights that count."""
        return self.grouping.by_row(self.keep * self.variance) / np.maximum(self.n_flights, 1)

    def last(self, good: np.ndarray) -> np.ndarray:
        """Index of the last good flight of each row, −1 where there is none."""
        result = np.full(self.grouping.n_rows, -1)
        index = np.flatnonzero(good)
        result[self.grouping.row[index]] = index  # ascending: the last one stays
        return result


def prepare(h: Histories) -> Prepared:
    """Scale, choose regressors, set bad flights aside.

    Raises
    ------
    ValueError
        Rows not ascending from 0 or one left out, or a value that is not finite.
    """
    row = np.asarray(h.row)
    if len(row) == 0 or row[0] != 0 or not np.isin(np.diff(row), (0, 1)).all() or not np.isfinite(h.value).all():
        raise ValueError("histories need at least one flight, ascending rows without a gap, and finite values")
    grouping = _grouping(row, np.asarray(h.session), int(row[-1]) + 1)
    usable = _with_all_it_needs(h, grouping)
    centre, unit, y, variance = _scaled(h, grouping)
    keep = usable & ~_alone(h, grouping, usable, y, variance)
    enough = _sessions(grouping, keep) >= ENOUGH_SESSIONS
    regressors, x_centre, x_width = _regressors(h, grouping, usable)
    regressors[~enough[row], TEMPERATURE:] = 0.0
    timed = grouping.by_row((usable & ~np.isfinite(h.time_day)).astype(float)) == 0.0
    return Prepared(grouping, y, variance, centre, unit, regressors, x_centre, x_width, usable, keep, enough, timed)


def largest(row: np.ndarray, x: Array, n_rows: int) -> Array:
    """Largest x by row, at least 0."""
    result = np.zeros(n_rows)
    np.maximum.at(result, row, x)
    return result


def _grouping(row: np.ndarray, session: np.ndarray, n_rows: int) -> Grouping:
    """Sessions numbered by row, then by first flight."""
    _, label = np.unique(session, return_inverse=True)
    _, first, inverse = np.unique(row * (label.max() + 1) + label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=int)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return Grouping(row, rank[inverse], row[np.sort(first)], n_rows)


def _sessions(grouping: Grouping, keep: np.ndarray) -> np.ndarray:
    there = (grouping.by_session(keep.astype(float)) > 0.0).astype(float)
    return grouping.sessions_by_row(there).astype(int)


def _with_all_it_needs(h: Histories, grouping: Grouping) -> np.ndarray:
    """Flights (n,) with a time where the row has any, and with a temperature where most of the row have one."""
    timed, warm = np.isfinite(h.time_day), np.isfinite(h.temperature_degc)
    flights = np.bincount(h.row)
    any_time = grouping.by_row(timed.astype(float)) > 0
    most_warm = grouping.by_row(warm.astype(float)) > 0.5 * flights
    return np.asarray((timed | ~any_time[h.row]) & (warm | ~most_warm[h.row]))


def _scaled(h: Histories, grouping: Grouping) -> tuple[Array, Array, Array, Array]:
    """(centre (g,), unit (g,), y, s²). A missing sd is the mean of the row's others, else 0."""
    row, flights, finite = h.row, np.bincount(h.row), np.isfinite(h.sd)
    mean_sd = grouping.by_row(np.where(finite, h.sd, 0.0)) / np.maximum(grouping.by_row(finite.astype(float)), 1)
    sd = np.where(finite, h.sd, mean_sd[row])
    centre = grouping.by_row(h.value) / flights
    unit = np.sqrt(grouping.by_row((h.value - centre[row]) ** 2 + sd**2) / flights)
    unit = np.maximum(unit, np.maximum(1e-12 * np.abs(centre), LEAST_UNIT))
    return centre, unit, (h.value - centre[row]) / unit[row], np.maximum((sd / unit[row]) ** 2, FLOOR**2)


def _regressors(h: Histories, grouping: Grouping, usable: np.ndarray) -> tuple[Array, Array, Array]:
    """(regressors (n, 3), centre (g, 3), width (g, 3))."""
    columns, centre, width = [np.ones(len(h.row))], [np.zeros(grouping.n_rows)], [np.ones(grouping.n_rows)]
    count = np.maximum(grouping.by_row(usable.astype(float)), 1.0)
    for x, least_span in ((h.temperature_degc, TEMPERATURE_SPAN_DEGC), (h.time_day, TIME_SPAN_DAY)):
        good = usable & np.isfinite(x)
        filled = np.where(good, x, 0.0)
        mean = grouping.by_row(filled) / count
        off = np.where(good, filled - mean[h.row], 0.0)
        spread = np.sqrt(grouping.by_row(off**2) / count)
        span = largest(h.row, off, grouping.n_rows) + largest(h.row, -off, grouping.n_rows)
        w = np.where(spread > 0, spread, 1.0)
        columns.append(np.where(span[h.row] >= least_span, off / w[h.row], 0.0))
        centre.append(np.where(grouping.by_row(good.astype(float)) > 0, mean, np.nan))
        width.append(w)
    return np.column_stack(columns), np.column_stack(centre), np.column_stack(width)


def _alone(h: Histories, grouping: Grouping, usable: np.ndarray, y: Array, variance: Array) -> np.ndarray:
    """Flights that stand alone among flights, or whose session stands alone among sessions."""
    there = np.flatnonzero(usable)
    row, session = grouping.row[there], grouping.session[there]
    warmth = np.nan_to_num(h.temperature_degc[there])
    slope = temperature_slope(row, y[there], h.temperature_degc[there], grouping.n_rows)
    residual = y[there] - slope[row] * warmth
    claimed_variance = variance[there]
    total = claimed_variance + scatter_variance(row, residual, claimed_variance, grouping.n_rows)[row]
    alone = np.zeros(len(y), dtype=bool)
    alone[there] = isolated(row, residual, total)
    # The same for sessions of several flights, from what is left of them.
    good = ~alone[there]
    weight = np.bincount(session, good / total, len(grouping.row_of_session))
    present = np.flatnonzero(weight > 0)
    mean = np.bincount(session, good * residual / total, len(weight))[present] / weight[present]
    claimed = 1.0 / np.bincount(session, good / claimed_variance, len(weight))[present]
    owner = grouping.row_of_session[present]
    between = scatter_variance(owner, mean, claimed, grouping.n_rows)[owner]
    spoiled = np.zeros(len(weight), dtype=bool)
    spoiled[present] = isolated(owner, mean, claimed + between)
    return alone | spoiled[grouping.session]
