"""Trends of calibrated parameters over temperature and time, from the flights of many histories at once.

    y = value(25 °C, last flight) + slope_T (T − 25 °C) + slope_t (t − t_last) − Σ steps still to come + u + e

u is the scatter between sessions (drawn anew at every power-up), e the error of a flight. Before the line is drawn,
flights that agree with none of their neighbours are set aside and steps are looked for; what the record then says of
each number, with its standard deviation, is in `Trends`. A history is a row; all rows of a fleet go in together: the
share of false alarms is controlled over all of them.

Sessions are taken as independent draws about the line, and the line as straight. A parameter that wanders from session
to session (a random walk) is therefore reported as drifting or stepping sooner than these shares say, and one whose
curve over temperature bends is reported with its bend as scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from fieldcal.geometry.rotation import Array
from fieldcal.names import DriftStatus
from fieldcal.schemas.reference import ENOUGH_SESSIONS
from fieldcal.trends.evidence import FALSE_ALARMS, MOST_STEPS, Evidence, evidence
from fieldcal.trends.random_effects import fit_random_effects
from fieldcal.trends.series import LEVEL, Histories, prepare
from fieldcal.trends.siblings import LEAST_FREEDOM, moderated_variance

FALSE_OUTLIERS = 0.05
"""Share of false alarms (`FALSE_ALARMS`) for outliers among siblings, which claim less: nothing has changed."""
LEAST_LEFT = 0.05
"""Share of a flight's variance that is left to it, at least, however much it draws the line to itself."""


@dataclass(frozen=True)
class Trends:
    """The regression of each history, one entry a row; NaN where the record does not determine it.

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
    return judge(evidence(h), h.kind)


def judge(e: Evidence, kind: np.ndarray | None = None) -> Trends:
    """What the evidence says once the rows of a fleet are seen together: how many steps each has, and its scatter.

    `kind` (g,): equal for siblings, whose scatter is alike; without it every row keeps its scatter.
    """
    steps = _steps(e)
    chosen = {name: column[np.arange(len(steps)), steps] for name, column in e.estimates.items()}
    session, flight, freedom = chosen["session_variance"], chosen["flight_variance"], chosen["freedom"]
    ratio = np.ones(len(steps))
    if kind is not None:
        claimed = e.mean_variance + flight
        total = np.where(e.enough, session + claimed, np.nan)
        moderated, lent = moderated_variance(np.asarray(kind), total * e.unit**2, freedom)
        moderated = moderated / e.unit**2
        ratio = np.where(e.enough, moderated / total, 1.0)
        session = np.where(e.enough, np.maximum(moderated - claimed, 0.0), session)
        freedom = np.where(e.enough, lent, freedom)
    wider = np.sqrt(ratio)
    drift_p = 2.0 * special.stdtr(np.maximum(freedom, LEAST_FREEDOM), -np.abs(chosen["drift_z"] / wider))
    v = e.last_variance + session + flight
    line = chosen["last_line"] * ratio
    spread = np.where(e.last_kept, np.maximum(v - line, LEAST_LEFT * v), v + line)
    several = e.n_sessions >= 2
    return Trends(
        n_flights=e.n_flights,
        n_sessions=e.n_sessions,
        value=chosen["value"],
        sd=chosen["sd"] * wider,
        slope_per_degc=chosen["slope_per_degc"],
        slope_per_degc_sd=chosen["slope_per_degc_sd"] * wider,
        slope_per_day=chosen["slope_per_day"],
        slope_per_day_sd=chosen["slope_per_day_sd"] * wider,
        best_degc=chosen["best_degc"],
        best_day=chosen["best_day"],
        session_sd=np.where(several, e.unit * np.sqrt(session), np.nan),
        flight_sd=np.where(several, e.unit * np.sqrt(flight), np.nan),
        last_z=np.where(e.enough & e.timed, chosen["last_error"] / np.sqrt(spread), np.nan),
        change_day=chosen["change_day"],
        change_size=chosen["change_size"],
        change_size_sd=chosen["change_size_sd"],
        drift_p=np.where(freedom > LEAST_FREEDOM, drift_p, np.nan),
        step_p=np.where(e.enough & e.timed, e.step_p[:, 0], np.nan),
        moved=chosen["moved"] / np.sqrt(e.mean_variance + session + flight),
        kept=e.kept,
    )


def _steps(e: Evidence) -> np.ndarray:
    """How many steps (g,) each row has: one more where its next strongest stands out among all rows."""
    searched = e.enough & e.timed
    searching, steps = searched.copy(), np.zeros(len(searched), dtype=int)
    for _ in range(MOST_STEPS):
        p_value = e.step_p[np.arange(len(steps)), np.minimum(steps, MOST_STEPS - 1)]
        found = np.zeros(len(searched), dtype=bool)
        found[searched] = alarms(p_value[searched])
        searching &= found
        if not searching.any():
            break
        steps += searching
    return steps


def moving(trends: Trends) -> tuple[np.ndarray, np.ndarray]:
    """(stepped, drifting), each (g,). Drifting takes more than significance: over its record the parameter has moved by
    more than one flight scatters."""
    enough = trends.n_sessions >= ENOUGH_SESSIONS
    drifting = np.zeros(len(enough), dtype=bool)
    drifting[enough] = alarms(trends.drift_p[enough])
    return enough & np.isfinite(trends.change_size), enough & drifting & (trends.moved > 1.0)


def statuses(trends: Trends, fleet_p: Array) -> np.ndarray:
    """`insufficient`, `step`, `drifting`, `outlier` or `stable` for each row, the first that applies.

    `fleet_p` (g,): chance of such a distance from the siblings (`trends.siblings.sibling_distance`).
    """
    enough = trends.n_sessions >= ENOUGH_SESSIONS
    status = np.full(len(enough), DriftStatus.INSUFFICIENT.value, dtype=object)
    outlier = np.zeros(len(enough), dtype=bool)
    outlier[enough] = alarms(fleet_p[enough], FALSE_OUTLIERS)
    stepped, drifting = moving(trends)
    status[enough] = DriftStatus.STABLE.value
    status[enough & outlier] = DriftStatus.OUTLIER.value
    status[drifting] = DriftStatus.DRIFTING.value
    status[stepped] = DriftStatus.STEP.value
    return status


def alarms(p_value: Array, rate: float = FALSE_ALARMS) -> np.ndarray:
    """Which of these p-values stand out when at most `rate` of those named may be false (Benjamini and Hochberg)."""
    from scipy.stats import false_discovery_control

    p = np.where(np.isfinite(p_value), p_value, 1.0)
    if len(p) == 0:
        return np.zeros(0, dtype=bool)
    return np.asarray(false_discovery_control(p) <= rate)


def pooled(h: Histories) -> tuple[Array, Array]:
    """Mean of each history and its sd (g,), scatter between sessions estimated and included: no slopes, no steps."""
    p = prepare(h)
    everything = np.ones(len(p.y), dtype=bool)
    fit = fit_random_effects(p.grouping, p.regressors[:, :1], p.y, p.variance, everything)
    return p.centre + p.unit * fit.coefficients[:, LEVEL], p.unit * np.sqrt(fit.covariance[:, LEVEL, LEVEL])
