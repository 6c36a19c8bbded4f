"""Predictions from session to session against a Kalman filter written out, and where a series starts anew."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq, minimize
from scipy.stats import norm

import fieldcal.estimation.pooled.strengths as module
from fieldcal.estimation.pooled.strengths import (
    FEW,
    RISE,
    Series,
    Strengths,
    beside_scatter,
    innovations,
    largest_likely,
    mean_of_variance,
    of_pairs,
    strengths_of,
    unlikely,
    usual_gap,
)


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


@pytest.mark.parametrize("by_numpy", [False, True])
def test_over_a_session_that_says_nothing_a_constant_walks_once(
    by_numpy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if by_numpy:
        monkeypatch.setattr(module, "LIBRARY", None)
    day, none = np.array([[0.0], [3.0], [7.0]]), np.array([[1.0], [np.nan], [2.0]])
    z, s = innovations(Series(day, np.zeros((3, 1)), none, np.ones((3, 1))), Strengths(0.5, 0.25, 0.0))
    assert np.isnan(z[:2]).all()
    assert s[2, 0] == pytest.approx(1.25 + 0.5 * 7.0 + 1.25)
    assert z[2, 0] == pytest.approx(1.0 / np.sqrt(s[2, 0]))


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


def test_of_nothing_nothing_is_known_to_move() -> None:
    assert strengths_of(Series.of([])) == Strengths(0.0, 0.0, 0.0, FEW)
    assert strengths_of(Series.of([np.zeros((0, 4))])) == Strengths(0.0, 0.0, 0.0, FEW)


@pytest.mark.parametrize(("warmth", "range_degc"), [([-6.0, 0.0, 6.0], np.sqrt(24.0)), ([0.1, 0.2, 0.3], 1.0)])
def test_of_single_sessions_the_slope_is_their_sd_over_the_temperatures_flown(
    warmth: list[float], range_degc: float
) -> None:
    """Of three units, one session each, of which the median variance counts."""
    rows = [np.array([[0.0, t, 7.0, v]]) for t, v in zip(warmth, (1.0, 4.0, 100.0), strict=True)]
    series = Series.of(rows)
    found = strengths_of(series)
    assert (found.walk, found.scatter, found.freedom) == (0.0, 1.0, FEW)
    assert found.slope == pytest.approx(4.0 / range_degc**2)
    assert strengths_of(series, with_slope=False).slope == 0.0


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [
        (0.25, 0.0),
        (0.5, np.log(2.0)),
        (25.0, np.log(100.0)),
        (0.125, 4.0 * (1.0 - np.log(2.0))),
        (0.025, 4.0 * (9.0 - np.log(10.0))),
    ],
)
def test_a_variance_of_a_quarter_is_the_likeliest_and_less_the_unlikelier(ratio: float, expected: float) -> None:
    """As four innovations of that variance would have it below, and above by an even chance for every magnitude."""
    assert unlikely(ratio) == pytest.approx(expected)


def test_the_largest_likely_strength_is_where_the_likelihood_has_fallen_by_half_a_standard_deviation() -> None:
    best = np.array([1.0, -2.0])

    def cost(x: np.ndarray) -> float:
        return 5.0 + float((x[0] - 1.0) ** 2 + 4.0 * (x[1] + 2.0) ** 2)

    for i, steep in ((0, 1.0), (1, 4.0)):
        assert largest_likely(cost, best, 5.0, i) == pytest.approx(best[i] + np.sqrt(RISE / steep), abs=0.02)
    np.testing.assert_array_equal(best, [1.0, -2.0])
    # A sd a thousand times a session's own is the largest that is looked for.
    for rises_at, found in ((2.0 * np.log(990.0), 2.0 * np.log(990.0)), (2.0 * np.log(1010.0), 1.0)):

        def rising(x: np.ndarray, at: float = rises_at) -> float:
            return RISE * (1.0 + float(x[0]) - at)

        assert largest_likely(rising, best, 0.0, 0) == pytest.approx(found, abs=0.02)
    # A likelihood that never falls so far tells nothing: the likeliest stays.
    assert largest_likely(lambda x: 0.01 * x[0], best, 0.01, 0) == 1.0


@pytest.mark.parametrize("count", [6, 20, 200])
def test_a_variance_on_average_is_that_of_an_inverse_gamma_distribution(count: int) -> None:
    """So much normal numbers of one unknown variance, any sd of which was as likely as another, tell of it:
    their sum of squares over three less than their number; the sum is three times their number."""
    best = np.array([7.0, np.log(3.0)])

    def cost(x: np.ndarray) -> float:
        return 50.0 + count * float(x[1] + 3.0 * np.exp(-x[1]))

    found = mean_of_variance(cost, best, cost(best), 1)
    assert np.exp(found) == pytest.approx(3.0 * count / (count - 3), rel=0.01)
    np.testing.assert_array_equal(best, [7.0, np.log(3.0)])


def last_by_gaussian_process(series: Series, strengths: Strengths) -> tuple[np.ndarray, np.ndarray]:
    """(value, variance) of each series' constant at its last session, at the reference temperature: kriging with an
    unknown mean, of sessions whose covariance is that of the walk, the scatter and the slope."""
    value, variance = np.empty((2, series.value.shape[1]))
    for j, (day, t, y, own) in enumerate(
        zip(series.day.T, series.warmth_degc.T, series.value.T, series.variance.T, strict=True)
    ):
        walked = day - day[0]
        k = strengths.walk * np.minimum.outer(walked, walked) + strengths.slope * np.outer(t, t)
        inverse = np.linalg.inv(k + np.diag(own + strengths.scatter))
        here, one = strengths.walk * walked, np.ones(len(day))
        mean = one @ inverse @ y / (one @ inverse @ one)
        value[j] = mean + here @ inverse @ (y - mean)
        left = 1.0 - one @ inverse @ here
        variance[j] = here[-1] - here @ inverse @ here + left**2 / (one @ inverse @ one)
    return value, variance


@pytest.mark.parametrize("walk", [0.0, 0.05, 0.1])
def test_a_walk_that_sessions_hardly_show_is_in_the_sd(walk: float) -> None:
    """Of twenty sessions of six constants, whose scatter is 1; a twentieth of it a √day is often likeliest to be none,
    and the last value is then claimed as well as the mean of all."""
    off = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        day, warmth = np.cumsum(rng.uniform(1.0, 10.0, (20, 6)), axis=0), rng.uniform(-20.0, 10.0, (20, 6))
        steps = walk * np.sqrt(np.diff(day, axis=0)) * rng.normal(size=(19, 6))
        walked = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
        value = walked + rng.normal(size=(20, 6)) + 0.2 * rng.normal(size=6) * warmth
        series = Series(day, warmth, value + 0.1 * rng.normal(size=(20, 6)), np.full((20, 6), 0.01))
        found, variance = last_by_gaussian_process(series, strengths_of(series))
        off.append((found - walked[-1]) / np.sqrt(variance))
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.15
    assert max(np.sqrt(np.mean(np.square(off), axis=1))) < 1.85


def test_the_usual_gap_is_the_median_of_days_between_sessions() -> None:
    """Series of four, two and one session; two on the same day are not apart."""
    day = np.array([[0.0, 5.0, 9.0], [2.0, 12.0, np.nan], [2.0, np.nan, np.nan], [6.0, np.nan, np.nan]])
    assert usual_gap(day) == 4.0
    assert usual_gap(day[:1]) == 1.0
    assert usual_gap(np.array([[3.0], [3.0]])) == 1.0


@pytest.mark.parametrize(
    ("strengths", "expected"),
    [
        (Strengths(0.0, 3.0, 0.0), 0.0),
        (Strengths(0.25 * 3.0, 3.0, 0.0), 4.0 * np.log(2.0)),  # over four days as much as the scatter
        (Strengths(0.0, 3.0, 3.0 / 36.0), 2.0 * np.log(2.0)),  # over 6 °C
    ],
)
def test_a_walk_or_a_slope_as_large_as_the_scatter_is_that_unlikely(strengths: Strengths, expected: float) -> None:
    assert beside_scatter(strengths, 4.0, 6.0) == pytest.approx(expected)


def test_two_sessions_of_a_series_are_compared() -> None:
    rng = np.random.default_rng(4)
    rows = [np.column_stack([[0.0, 4.0], [0.0, 0.0], rng.normal(size=2), np.full(2, 0.01)]) for _ in range(30)]
    rows.append(rows[0][:1])  # of which there is nothing to compare
    found = strengths_of(Series.of(rows), with_slope=False)
    assert 20.0 + FEW < found.freedom <= 30.0 + FEW
    assert 0.4 < found.scatter < 2.0
    assert found.slope == 0.0


def moving(seed: int, series: int = 12, sessions: int = 8) -> list[np.ndarray]:
    """Series that walk, scatter and slope, one of which steps."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(series):
        day, warmth = np.cumsum(rng.uniform(1.0, 9.0, sessions)), rng.uniform(-20.0, 10.0, sessions)
        value = 0.1 * rng.normal() * warmth + np.cumsum(0.3 * rng.normal(size=sessions)) + rng.normal(size=sessions)
        rows.append(np.column_stack([day, warmth, value + 40.0 * (k == 0) * (day > 20.0), np.full(sessions, 0.2)]))
    return rows


def test_strengths_are_the_largest_that_are_likely_by_all_that_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Innovations, of which one that starts a series anew counts 4.5², what was expected, and pairs of a session;
    minimised, and scatter and slope left where each has risen by `RISE`, by SciPy from another start; the walk is the
    mean of its variance by SciPy's quadrature over its sd."""
    monkeypatch.setattr(module, "TOLERANCES", {"fatol": 1e-7, "xatol": 1e-6})
    series = Series.of(moving(6))
    pairs = np.array([[7.0, 1.0, 0.3], [-9.0, -0.3, 0.5], [12.0, 1.1, 0.4], [11.0, -2.0, 0.2]])
    own, gap = 0.2, float(np.median(np.diff(series.day, axis=0)))
    spread = float(np.std(series.warmth_degc))
    unit = np.array([own / gap, own, own / spread**2])

    def cost(x: np.ndarray) -> float:
        walk, scatter, slope = unit * np.exp(x)
        z, variance = innovations(series, Strengths(walk, scatter, slope))
        at = np.isfinite(z)
        likelihood = np.sum(np.log(variance[at]) + z[at] ** 2) + 4.5**2 * np.sum(~at)
        expected = unlikely(scatter / own) + unlikely(slope * spread**2 / own)
        expected += beside_scatter(Strengths(walk, scatter, slope), gap, spread)
        return float(likelihood + expected + of_pairs(pairs, slope, own))

    best = minimize(cost, np.full(3, 1.0), method="Powell", options={"xtol": 1e-7, "ftol": 1e-12})

    def likely(walk_sd: float) -> float:
        x = np.r_[2.0 * np.log(walk_sd), best.x[1:]]
        return float(np.exp(0.5 * (best.fun - cost(x))))

    whole, first = (quad(lambda sd, n=n: sd**n * likely(sd), 1e-3, 20.0, limit=200)[0] for n in (0, 2))
    largest = []
    for i in (1, 2):
        way = np.eye(3)[i]
        largest.append(best.x[i] + brentq(lambda by, way=way: cost(best.x + by * way) - best.fun - 0.3, 0.0, 5.0))
    found = strengths_of(series, within=pairs)
    assert found.walk == pytest.approx(unit[0] * first / whole, rel=2e-3)
    np.testing.assert_allclose([found.scatter, found.slope], unit[1:] * np.exp(largest), rtol=2e-3)
    assert found.freedom == FEW + 12 * 7 - 1


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_in_another_unit_strengths_are_the_same(unit: float) -> None:
    rows = moving(6)
    plain = strengths_of(Series.of(rows))
    found = strengths_of(Series.of([own * [1.0, 1.0, unit, unit**2] for own in rows]))
    for each in ("walk", "scatter", "slope"):
        assert getattr(found, each) == pytest.approx(unit**2 * getattr(plain, each), rel=1e-6)


def test_another_start_and_a_nearer_end_find_the_same_strengths(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    rows = []
    for _ in range(20):
        day, warmth = np.cumsum(rng.uniform(1.0, 9.0, 12)), rng.uniform(-20.0, 10.0, 12)
        value = 0.03 * rng.normal() * warmth + np.cumsum(0.1 * rng.normal(size=12)) + rng.normal(size=12)
        rows.append(np.column_stack([day, warmth, value, np.full(12, 0.2)]))
    plain = strengths_of(Series.of(rows))
    others: tuple[tuple[str, object], ...] = (
        ("START", (0.3, 0.3, 0.3)),
        ("TIMES", (1.2, 5.0, 20.0)),
        ("LIMITS", (2.0 * np.log(1e-4), module.LIMITS[1])),
        ("TOLERANCES", {"fatol": 0.001, "xatol": 0.002}),
    )
    for name, value in others:
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            found = strengths_of(Series.of(rows))
        for each in ("walk", "scatter", "slope"):
            assert getattr(found, each) == pytest.approx(getattr(plain, each), rel=0.1), (name, each)


@pytest.mark.parametrize("power", [-61, -1, 0, 7, 40])
def test_coarse_strengths_are_the_nearest_power_of_one_and_a_quarter(power: int) -> None:
    """Within half a step of their logarithm; of none there is none, and innovations are whole."""
    exact = 1.25**power
    for within in (-0.49, 0.0, 0.49):
        near = exact * 1.25**within
        found = Strengths(near, 0.0, near, near).coarse()
        np.testing.assert_allclose([found.walk, found.scatter, found.slope], [exact, 0.0, exact], atol=0.0)
        assert found.freedom == round(exact)


def test_two_flights_of_a_session_differ_as_likely_as_a_normal_number() -> None:
    """Of variance slope · ΔT² + v, over a number of a session's own sd; of one far off the density does not count."""
    pairs = np.array([[7.0, 1.5, 0.3], [-3.0, -2.0, 0.5], [1.0, 0.2, 0.4]])
    slope, own = 0.04, 1.7
    sd = np.sqrt([0.04 * 49.0 + 0.3, 0.04 * 9.0 + 0.5, 0.04 + 0.4])
    expected = -2.0 * np.sum(norm.logpdf(pairs[:, 1], scale=sd) - norm.logpdf(0.0, scale=np.sqrt(own)))
    assert of_pairs(pairs, slope, own) == pytest.approx(expected)
    far = np.vstack([pairs, [[1.0, 100.0, 0.4]]])
    assert of_pairs(far, slope, own) == pytest.approx(expected + 4.5**2)
    assert of_pairs(np.zeros((0, 3)), slope, own) == 0.0
