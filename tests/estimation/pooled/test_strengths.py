"""Predictions from session to session against a Kalman filter written out, and where a series starts anew."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.pooled.strengths import Series, Strengths, innovations


def test_innovations_are_those_of_a_kalman_filter_with_a_walk_and_a_slope() -> None:
    rng = np.random.default_rng(1)
    m, walk, scatter, slope = 7, 0.02, 0.3, 0.05
    day, warmth = np.cumsum(rng.uniform(1.0, 9.0, m)), rng.uniform(-5.0, 9.0, m)
    value, variance = rng.normal(size=m), rng.uniform(0.2, 1.5, m)
    z, s = innovations(Series.of([np.column_stack([day, warmth, value, variance])]), Strengths(walk, scatter, slope))
    # The first session tells value and slope together, of which the value was anything.
    state, p = np.zeros(2), np.diag([1e9, slope])
    for k in range(m):
        p[0, 0] += walk * (day[k] - day[k - 1]) if k else 0.0
        h = np.array([1.0, warmth[k]])
        expected = h @ p @ h + variance[k] + scatter
        error = value[k] - h @ state
        if k:
            assert s[k, 0] == pytest.approx(expected, rel=1e-6)
            assert z[k, 0] == pytest.approx(error / np.sqrt(expected), rel=1e-5)
        else:
            assert np.isnan(z[k, 0])
        gain = p @ h / expected
        state, p = state + gain * error, p - np.outer(gain, gain) * expected


@pytest.mark.parametrize(("off_sd", "anew"), [(4.4, False), (4.6, True), (-4.4, False), (-4.6, True)])
def test_what_is_four_and_a_half_sd_off_starts_the_series_anew(off_sd: float, anew: bool) -> None:
    value = np.array([1.0, 1.0 + off_sd * np.sqrt(2.0), 1.0 + off_sd * np.sqrt(2.0)])
    rows = np.column_stack([np.arange(3.0), np.zeros(3), value, np.ones(3)])
    z, s = innovations(Series.of([rows]), Strengths(0.0, 0.0, 0.0))
    assert np.isnan(z[1, 0]) == anew
    if anew:  # from the second session on: the third equals it
        assert (z[2, 0], s[2, 0]) == (pytest.approx(0.0), pytest.approx(2.0))
    else:
        assert z[1, 0] == pytest.approx(off_sd)
        assert s[2, 0] == pytest.approx(1.5)
