"""How many more sessions would tell what a history does not tell yet.

A slope's sd falls with the number of sessions n, flown at one cadence, as n^-3/2: a record that is longer and denser.
Of 108 such sentences about a drift the median was right, 80 % of them to one session too many or two too few
(`benchmarks/drift_fleet.py --sessions 18 --tell --seeds 40`).

A step is told from a drift by about `STEP_FROM_DRIFT` sessions: one of ten sd amid 8 sessions is never told so, amid 12
in 6 of 20 fleets, 16 in 11, 20 in 19; a drift of half an sd a session is seen from 12 on (`--sessions`)."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from fieldcal.geometry.rotation import Array
from fieldcal.schemas.reference import ENOUGH_SESSIONS
from fieldcal.trends.evidence import FALSE_ALARMS
from fieldcal.trends.regression import Trends

STEP_FROM_DRIFT = 20
SUSPECTED = 0.01
"""Chance of such a slope in a stable unit, of one row alone, below which it is said that it may drift."""


def needed(trends: Trends) -> np.ndarray:
    """How many more sessions (g,) would tell: of too few for a trend, until there are enough; of a drift, whether it is
    a step; of what may drift, whether it does. 0 where nothing is in question."""
    n = trends.n_sessions
    enough = n >= ENOUGH_SESSIONS
    moving = np.isfinite(trends.drift_p) & (trends.drift_p < SUSPECTED) & (trends.moved > 1.0) & enough
    alone = max(int(np.sum(enough)), 1)
    of_fleet = _sigmas(np.array(FALSE_ALARMS / alone))
    own = _sigmas(np.clip(trends.drift_p, 1e-300, 1.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        until_told = np.ceil(n * ((of_fleet / own) ** (2.0 / 3.0) - 1.0))
    more = np.where(moving, np.maximum(np.nan_to_num(until_told), 1.0), 0.0)
    return np.where(enough, more, ENOUGH_SESSIONS - n).astype(int)


def until_step_or_drift(n_sessions: int | None) -> int:
    """How many more sessions tell a step from a drift; 0 where there are enough, or nobody counted them."""
    return 0 if n_sessions is None else max(STEP_FROM_DRIFT - n_sessions, 0)


def _sigmas(p: Array) -> Array:
    return -np.asarray(ndtri(0.5 * p))
