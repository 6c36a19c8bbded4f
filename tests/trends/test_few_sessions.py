"""Two to four sessions with the siblings' help: honest, better than the latest flight alone, and no step is hidden."""

from __future__ import annotations

import numpy as np
import pytest
from drift_support import PER_DEGC, TAU, VALUE, fleet
from numerics_support import Array, rms

from fieldcal.trends.few_sessions import borrow
from fieldcal.trends.regression import Trends, analyse, moving
from fieldcal.trends.series import ENOUGH_SESSIONS, Histories

ROWS, OLD, SESSIONS = 22, 12, 24
SLOPE_SPREAD = 0.05
"""of units, a quarter of the slope"""
STEP = 10.0 * TAU
HONEST = (0.8, 1.25)


def borrowed(
    seed: int, sessions: int, *, step_at: int | None = None, sign: float = 1.0, old: int = OLD
) -> tuple[Trends, Trends, Array, Array, Array]:
    """(trends before, after, how many lent, latest value, slope) of rows from `old` on, which flew few sessions."""
    rng = np.random.default_rng([seed, sessions])
    f = fleet(seed, ROWS, SESSIONS)
    slope = PER_DEGC + SLOPE_SPREAD * rng.normal(size=ROWS)
    value = f.value + (slope - PER_DEGC)[:, None] * (f.temperature_degc - 25.0)
    kept = np.ones((ROWS, SESSIONS), dtype=bool)
    kept[old:, sessions:] = False
    if step_at is not None:
        value[old:, step_at:] += STEP * rng.choice([-1.0, 1.0])
    turned = np.where(np.arange(ROWS) < old, 1.0, sign)
    value = turned[:, None] * value
    h = Histories(
        np.repeat(np.arange(ROWS), SESSIONS)[kept.ravel()],
        *(x[kept] for x in (f.session, f.time_day, f.temperature_degc, value, f.sd)),
        kind=np.zeros(ROWS, dtype=int),
    )
    before = analyse(h)
    stepped, drifting = moving(before)
    steady = (before.n_sessions >= ENOUGH_SESSIONS) & ~stepped & ~drifting
    after, siblings = borrow(h, before, np.zeros(ROWS, dtype=int), turned, steady)
    return before, after, siblings, turned * value[:, sessions - 1], turned * slope


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("sessions", [2, 3, 4])
def test_the_mean_is_honest_and_better_than_the_latest_flight(sessions: int, sign: float) -> None:
    ratios, errors, alone, slopes, shares = [], [], [], [], []
    for seed in range(20):
        before, after, siblings, latest, slope = borrowed(seed, sessions, sign=sign)
        there = np.isfinite(siblings)
        shares.append(there[OLD:].mean())
        assert not there[:OLD].any()
        assert (after.value[:OLD] == before.value[:OLD]).all()
        error = sign * after.value[there] - VALUE
        errors.extend(error)
        alone.extend(latest[there] - VALUE)
        ratios.extend(error / after.sd[there])
        slopes.extend((after.slope_per_degc - slope)[there] / after.slope_per_degc_sd[there])
    assert HONEST[0] < rms(ratios) < HONEST[1]
    assert HONEST[0] < rms(slopes) < HONEST[1]
    assert rms(errors) < 0.5 * rms(alone)
    assert np.mean(shares) > 0.95


@pytest.mark.parametrize(("sessions", "step_at"), [(2, 1), (3, 1), (3, 2), (4, 1), (4, 2), (4, 3)])
def test_a_step_is_not_averaged_away(sessions: int, step_at: int) -> None:
    shares = [np.isfinite(borrowed(seed, sessions, step_at=step_at)[2][OLD:]).mean() for seed in range(20)]
    assert np.mean(shares) < 0.03


def test_few_siblings_lend_nothing_and_nothing_is_lent_to_a_single_session() -> None:
    for sessions, old in ((3, 4), (1, OLD)):
        before, after, siblings, _, _ = borrowed(1, sessions, old=old)
        assert np.isnan(siblings).all()
        np.testing.assert_array_equal(after.value, before.value)
