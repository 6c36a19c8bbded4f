"""Trends over temperature and time, steps, bad flights and siblings, on histories whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drift_support import PER_DEGC, SD, TAU, VALUE, fleet
from numerics_support import ROUNDING
from scipy import optimize

from fieldcal.trends.random_effects import Grouping, fit_random_effects
from fieldcal.trends.regression import FALSE_ALARMS, FALSE_OUTLIERS, Trends, alarms, analyse, statuses
from fieldcal.trends.series import ENOUGH_SESSIONS, Histories
from fieldcal.trends.siblings import moderated_variance, outliers, sibling_distance

HONEST = (0.8, 1.25)
STEP = 10.0 * TAU
EXACT = 1e-8
"""Relative; what solving scaled normal equations leaves."""


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def judged(h: Histories) -> np.ndarray:
    trends = analyse(h)
    return statuses(trends, np.ones(len(trends.value)))


def test_without_noise_the_truth_comes_back() -> None:
    f = fleet(1, rows=3, tau=0.0, sd=0.0, per_day=0.03)
    stepped = f.value + np.array([[0.0], [STEP], [0.0]]) * (f.session >= 15)
    trends = analyse(replace(f, value=stepped).histories())
    assert trends.value == pytest.approx([VALUE, VALUE + STEP, VALUE], rel=EXACT)
    assert trends.slope_per_degc == pytest.approx([PER_DEGC] * 3, rel=EXACT)
    assert trends.slope_per_day == pytest.approx([0.03] * 3, rel=EXACT)
    assert trends.change_size[1] == pytest.approx(STEP, rel=EXACT)
    assert trends.change_day[1] == 15 * 7.0
    assert np.isnan(trends.change_day[[0, 2]]).all()
    assert trends.n_flights.tolist() == [24, 24, 24]


@pytest.mark.parametrize(
    ("sessions", "flights", "tau", "phi"), [(24, 1, TAU, 0.0), (8, 1, TAU, 0.0), (24, 1, 0.0, 0.0), (12, 3, TAU, 0.8)]
)
def test_standard_deviations_are_honest(sessions: int, flights: int, tau: float, phi: float) -> None:
    f = fleet(2, 600, sessions, flights, tau=tau, phi=phi, per_day=0.01)
    trends = analyse(f.histories())
    low, high = HONEST
    # With 8 sessions there are 5 degrees of freedom: a t variable's own rms is √(5/3).
    freedom = sessions - 3
    high = max(high, 1.05 * np.sqrt(freedom / (freedom - 2)))
    assert low < rms((trends.slope_per_degc - PER_DEGC) / trends.slope_per_degc_sd) < high
    assert low < rms((trends.slope_per_day - 0.01) / trends.slope_per_day_sd) < high
    assert low < rms((trends.value - VALUE) / trends.sd) < high
    assert low < rms(trends.last_z) < high
    # τ² cannot be negative, so where there is none the mean of its estimates is a little above.
    assert np.mean(trends.session_sd**2) == pytest.approx(tau**2, abs=0.1 * TAU**2)


def test_value_at_another_temperature_is_honest() -> None:
    f = fleet(3)
    cold = replace(f, temperature_degc=f.temperature_degc - 60.0, value=f.value - 60.0 * PER_DEGC)
    trends = analyse(cold.histories())
    for at in (-60.0, -30.0, 25.0):
        value = trends.value + trends.slope_per_degc * (at - 25.0)
        best_variance = trends.sd**2 - trends.slope_per_degc_sd**2 * (25.0 - trends.best_degc) ** 2
        sd = np.sqrt(best_variance + trends.slope_per_degc_sd**2 * (at - trends.best_degc) ** 2)
        assert HONEST[0] < rms((value - VALUE - PER_DEGC * (at - 25.0)) / sd) < HONEST[1]


def test_false_alarms_are_rare_among_stable_units() -> None:
    """The procedure names at most FALSE_ALARMS of what it names falsely; with nothing to name, a whole fleet raises
    an alarm of one kind that often."""
    fleets = 40
    alarmed = sum(bool((judged(fleet(100 + seed, 200).histories()) != "stable").any()) for seed in range(fleets))
    kinds = 2
    assert alarmed <= 3 + fleets * kinds * FALSE_ALARMS


def test_a_step_is_dated_and_sized_and_nothing_else_moves() -> None:
    f = fleet(4, 300)
    at = np.random.default_rng(4).integers(4, 21, 300)
    h = replace(f, value=f.value + STEP * (f.session >= at[:, None])).histories()
    trends = analyse(h)
    assert (statuses(trends, np.ones(300)) == "step").mean() > 0.99
    found = np.isfinite(trends.change_day)
    assert np.mean(np.abs(trends.change_day / 7.0 - at)[found] <= 1) > 0.99
    assert np.mean(np.abs(trends.change_size / STEP - 1.0)[found] <= 0.15) > 0.95
    assert HONEST[0] < rms(((trends.change_size - STEP) / trends.change_size_sd)[found]) < HONEST[1]
    assert HONEST[0] < rms(((trends.value - VALUE - STEP) / trends.sd)[found]) < HONEST[1]
    assert HONEST[0] < rms(((trends.slope_per_degc - PER_DEGC) / trends.slope_per_degc_sd)[found]) < HONEST[1]
    assert HONEST[0] < rms((trends.slope_per_day / trends.slope_per_day_sd)[found]) < HONEST[1]


def test_the_latest_of_two_steps_counts() -> None:
    f = fleet(5, 60)
    h = replace(f, value=f.value + STEP * (f.session >= 8) - 2 * STEP * (f.session >= 16)).histories()
    trends = analyse(h)
    assert np.median(trends.change_size) == pytest.approx(-2 * STEP, rel=0.1)
    assert np.mean(np.abs(trends.change_day / 7.0 - 16) <= 1) > 0.95


def test_a_drift_is_no_step_and_a_step_no_drift() -> None:
    drifting = fleet(6, 200, per_day=0.04)  # 6.4 session sds over the record
    status = judged(drifting.histories())
    assert (status == "drifting").mean() > 0.97
    assert (status == "step").mean() <= 0.02
    small = fleet(7, 200, tau=0.05, sd=0.02, per_day=2e-4)  # well beyond its sd, yet within what a flight scatters
    assert (judged(small.histories()) == "drifting").mean() <= 0.05


def test_bad_single_flights_are_set_aside() -> None:
    f = fleet(8, 300)
    clean = analyse(f.histories())
    value = f.value.copy()
    value[:, 5] += 40.0 * TAU
    value[:, 14] -= 25.0 * TAU
    value[:, 15] += 60.0 * TAU
    spoiled = analyse(replace(f, value=value).histories())
    assert (spoiled.n_flights <= 21).mean() > 0.97
    assert not spoiled.kept.reshape(300, 24)[:, [5, 14, 15]].any(axis=0).all()
    assert rms((spoiled.slope_per_degc - PER_DEGC) / spoiled.slope_per_degc_sd) < HONEST[1]
    assert np.median(spoiled.session_sd) == pytest.approx(np.median(clean.session_sd), rel=0.1)
    assert (statuses(spoiled, np.ones(300)) == "stable").mean() > 0.97


def test_a_spoiled_session_of_several_flights_is_set_aside() -> None:
    f = fleet(9, 200, sessions=12, flights=3, phi=0.3)
    spoiled = analyse(replace(f, value=f.value + 30.0 * TAU * (f.session == 6)).histories())
    assert (spoiled.n_sessions == 11).mean() > 0.97
    assert (statuses(spoiled, np.ones(200)) == "stable").mean() > 0.97


def test_the_last_flight_is_measured_against_the_others() -> None:
    f = fleet(10, 300)
    value = f.value.copy()
    value[:, -1] += STEP
    trends = analyse(replace(f, value=value).histories())
    assert np.median(trends.last_z) == pytest.approx(STEP / np.sqrt(1.15 * (TAU**2 + 1.7 * SD**2)), rel=0.1)
    assert (statuses(trends, np.ones(300)) == "stable").mean() > 0.97


def test_units_origins_and_labels_do_not_matter() -> None:
    f = fleet(11, 20, sessions=10, flights=2, per_day=0.02)
    h = f.histories()
    one = analyse(h)
    other = analyse(
        replace(
            h,
            value=-1e-5 * h.value,
            sd=1e-5 * h.sd,
            time_day=h.time_day + 20_000.0,
            session=900 - 3 * h.session,
        )
    )
    assert -1e5 * other.value == pytest.approx(one.value, rel=EXACT)
    assert 1e5 * other.sd == pytest.approx(one.sd, rel=1e-6)
    assert -1e5 * other.slope_per_day == pytest.approx(one.slope_per_day, rel=1e-6, abs=1e-9)
    assert -other.last_z == pytest.approx(one.last_z, rel=1e-5, abs=1e-7)
    # A history by itself is the same history.
    alone = analyse(replace(f, **{name: getattr(f, name)[4:5] for name in f.__dataclass_fields__}).histories())
    assert alone.value[0] == pytest.approx(one.value[4], rel=ROUNDING)
    assert alone.slope_per_degc_sd[0] == pytest.approx(one.slope_per_degc_sd[4], rel=1e-9)


def test_random_effects_agree_with_dense_matrices() -> None:
    """An independent solution: the whole covariance written out, τ² where the session means' Q equals its
    expectation."""
    f = fleet(12, 1, sessions=9, flights=2)
    h = f.histories()
    x = np.column_stack([np.ones(18), (f.temperature_degc[0] - 20.0) / 15.0])
    y, s2 = h.value, h.sd**2
    grouping = Grouping(h.row, h.session, np.zeros(9, dtype=int), 1)
    fit = fit_random_effects(grouping, x, y, s2, np.ones(18, dtype=bool))
    same = np.kron(np.eye(9), np.ones((2, 2)))

    diagonal = s2 + fit.flight_variance[0]
    mean = same / diagonal / (same @ (1.0 / diagonal))[:, None]  # flights → their session's weighted mean
    mean = mean[::2]

    def gls(tau2: float) -> tuple[np.ndarray, np.ndarray, float]:
        v = np.diag(diagonal) + tau2 * same
        covariance = np.linalg.inv(x.T @ np.linalg.inv(v) @ x)
        hat = x @ covariance @ x.T @ np.linalg.inv(v)
        residual = mean @ (y - hat @ y)
        inverse = np.linalg.inv(mean @ v @ mean.T)
        off = mean @ (np.eye(18) - hat)
        return hat @ y, covariance, float(residual @ inverse @ residual - np.trace(inverse @ off @ v @ off.T))

    tau2 = optimize.brentq(lambda t: gls(t)[2], 0.0, 100.0, xtol=1e-14)
    fitted, covariance, _ = gls(tau2)
    assert fit.session_variance[0] == pytest.approx(tau2, rel=1e-8)
    assert x @ fit.coefficients[0] == pytest.approx(fitted, rel=1e-9)
    assert fit.covariance[0] == pytest.approx(covariance, rel=1e-7)


def test_a_slope_known_from_warm_up_flights_is_combined() -> None:
    f = fleet(13, 300)
    rng = np.random.default_rng(13)
    sd = np.full(300, 0.01)
    known = PER_DEGC + sd * rng.normal(size=300)
    alone = analyse(f.histories())
    both = analyse(f.histories(slope_per_degc=known, slope_per_degc_sd=sd))
    expected = 1.0 / np.sqrt(1.0 / alone.slope_per_degc_sd**2 + 1.0 / sd**2)
    assert np.median(both.slope_per_degc_sd / expected) == pytest.approx(1.0, abs=0.02)
    assert HONEST[0] < rms((both.slope_per_degc - PER_DEGC) / both.slope_per_degc_sd) < HONEST[1]
    assert HONEST[0] < rms((both.value - VALUE) / both.sd) < HONEST[1]


def test_what_cannot_be_told_is_not_told() -> None:
    few = analyse(fleet(14, 5, sessions=ENOUGH_SESSIONS - 1).histories())
    assert set(statuses(few, np.zeros(5))) == {"insufficient"}
    assert np.isnan(few.slope_per_degc).all()
    assert np.isnan(few.slope_per_day).all()
    assert np.isnan(few.last_z).all()
    assert np.isfinite(few.value).all()
    one = analyse(fleet(14, 5, sessions=1, flights=4).histories())
    assert set(statuses(one, np.zeros(5))) == {"insufficient"}
    assert np.isnan(one.session_sd).all()
    f = fleet(15, 5)
    nothing = np.full(f.value.size, np.nan)
    unknown = analyse(f.histories(time_day=nothing, temperature_degc=nothing, sd=nothing))
    assert np.isnan(unknown.slope_per_degc).all()
    assert np.isnan(unknown.slope_per_day).all()
    assert unknown.sd == pytest.approx(f.value.std(axis=1, ddof=1) / np.sqrt(24), rel=1e-6)
    same = analyse(f.histories(temperature_degc=np.full(f.value.size, 21.0)))
    assert np.isnan(same.slope_per_degc).all()
    assert same.best_degc == pytest.approx([21.0] * 5)
    constant = analyse(f.histories(value=np.full(f.value.size, 3.0), sd=np.zeros(f.value.size)))
    assert constant.value == pytest.approx([3.0] * 5)


def test_wrong_calls_are_refused() -> None:
    h = fleet(16, 2).histories()
    with pytest.raises(ValueError, match="ascending rows"):
        analyse(replace(h, row=h.row[::-1]))
    with pytest.raises(ValueError, match="finite values"):
        analyse(replace(h, value=np.full(len(h.value), np.nan)))


ROSNER = (
    "-0.25 0.68 0.94 1.15 1.20 1.26 1.26 1.34 1.38 1.43 1.49 1.49 1.55 1.56 1.58 1.65 1.69 1.70 1.76 1.77 1.81 1.91"
    " 1.94 1.96 1.99 2.06 2.09 2.10 2.14 2.15 2.23 2.24 2.26 2.35 2.37 2.40 2.47 2.54 2.62 2.64 2.90 2.92 2.92 2.93"
    " 3.21 3.26 3.30 3.59 3.68 4.30 4.64 5.34 5.42 6.01"
)


def test_siblings_reproduce_rosners_example() -> None:
    """54 values of Rosner (1983), as in the NIST handbook: three outliers at 5 %, though the first alone is none."""
    value = np.array([float(v) for v in ROSNER.split()])
    assert value[outliers(value, np.zeros(54), 0.05)].tolist() == [5.34, 5.42, 6.01]


def test_p_values_of_siblings_are_uniform() -> None:
    rng = np.random.default_rng(21)
    n, group = 12, np.repeat(np.arange(400), 12)
    sd = 0.3 * np.ones(400 * n)
    _, p = sibling_distance(group, np.hypot(1.0, sd) * rng.normal(size=400 * n), sd)
    for level in (0.05, 0.5):
        assert np.mean(p < level) == pytest.approx(level, rel=0.25)


def test_an_odd_sibling_is_named_and_few_siblings_are_not_judged() -> None:
    rng = np.random.default_rng(17)
    value = rng.normal(size=60)
    value[12] += 25.0
    group = np.repeat(np.arange(5), 12)
    z, p = sibling_distance(group, value, np.full(60, 0.1))
    assert np.flatnonzero(p < 1e-5).tolist() == [12]
    assert z[12] > 10.0
    # The same distance with an uncertainty as large says nothing.
    uncertain = np.full(60, 0.1)
    uncertain[12] = 25.0
    assert sibling_distance(group, value, uncertain)[1][12] > 0.1
    z, p = sibling_distance(np.zeros(2, dtype=int), value[:2], np.ones(2))
    assert np.isnan(z).all()
    assert (p == 1.0).all()


def like_axes(seed: int, units: int, moved: int) -> tuple[np.ndarray, ...]:
    """(group, kind, value, sd, doubtful): 16 kinds of three axes, units that scatter by 3 %; the first is 30 % off on
    one axis of two kinds, the next `moved` are on four kinds and known to have moved."""
    rng = np.random.default_rng([seed, units])
    group, who = np.repeat(np.arange(48), units), np.tile(np.arange(units), 48)
    value = 1.0 + 0.03 * rng.normal(size=len(group))
    doubtful = (who >= 1) & (who <= moved) & (group < 12)
    value[doubtful] += 0.3 * rng.choice([-1.0, 1.0], doubtful.sum())
    value[(who == 0) & np.isin(group, (0, 3))] += 0.3
    return group, group // 3, value, np.full(len(group), 0.003), doubtful


@pytest.mark.parametrize(
    ("units", "moved", "share"), [(3, 0, 0.0), (4, 0, 0.2), (5, 0, 0.5), (6, 2, 0.5), (8, 2, 0.9), (12, 3, 0.99)]
)
def test_units_that_moved_do_not_hide_an_odd_sibling(units: int, moved: int, share: float) -> None:
    """30 % is ten times what siblings scatter; in small fleets even that is not always beyond chance."""
    named, wrong = [], []
    for seed in range(40):
        group, kind, value, sd, doubtful = like_axes(seed, units, moved)
        odd = (np.tile(np.arange(units), 48) == 0) & np.isin(group, (0, 3))
        _, p = sibling_distance(group, value, sd, doubtful=doubtful, kind=kind)
        found = alarms(p, FALSE_OUTLIERS)
        named.append(found[odd].mean())
        wrong.append(found[~odd & ~doubtful].mean())
        _, p = sibling_distance(group, value, sd)
        if moved and units == 6:
            assert not alarms(p, FALSE_OUTLIERS)[odd].all()  # what hid it
    assert np.mean(named) >= share
    assert np.mean(wrong) < 0.01


def test_siblings_lend_their_scatter() -> None:
    """With five sessions there are two degrees of freedom and a unit's own sd is next to worthless; its siblings' say
    what is usual. Units whose scatter is really their own keep it."""
    f = fleet(18, 120, sessions=5, sd=0.1)
    kind = np.repeat(np.arange(10), 12)
    alone = analyse(f.histories())
    among = analyse(f.histories(kind=kind))
    whole = alone.n_sessions == 5
    assert whole.mean() > 0.97
    assert rms(((alone.slope_per_degc - PER_DEGC) / alone.slope_per_degc_sd)[whole]) > 1.5
    assert HONEST[0] < rms(((among.slope_per_degc - PER_DEGC) / among.slope_per_degc_sd)[whole]) < HONEST[1]
    assert HONEST[0] < rms((among.value - VALUE) / among.sd) < HONEST[1]
    own = np.geomspace(0.1, 10.0, 12)
    f = fleet(19, 12, sessions=60, tau=0.0, sd=0.0)
    scattered = f.value + own[:, None] * np.random.default_rng(19).normal(size=f.value.shape)
    kept = analyse(replace(f, value=scattered).histories(kind=np.zeros(12, dtype=int)))
    assert kept.session_sd == pytest.approx(own, rel=0.3)


def test_moderated_variance_is_smyths() -> None:
    """Variances drawn from the model that it assumes: its d0 and s0² come back, and so does their posterior mean."""
    rng = np.random.default_rng(20)
    d, d0, s0 = 4.0, 10.0, 3.0
    true = d0 * s0 / rng.chisquare(d0, 4000)
    found = true * rng.chisquare(d, 4000) / d
    moderated, freedom = moderated_variance(np.zeros(4000, dtype=int), found, np.full(4000, d))
    assert freedom - d == pytest.approx(d0, rel=0.15)
    assert moderated == pytest.approx((d0 * s0 + d * found) / (d0 + d), rel=0.1)
    assert np.mean((np.log(moderated) - np.log(true)) ** 2) < 0.5 * np.mean((np.log(found) - np.log(true)) ** 2)
    few, _ = moderated_variance(np.zeros(5, dtype=int), found[:5], np.full(5, d))
    assert few.tolist() == found[:5].tolist()


def test_without_times_there_is_no_order_to_find_a_step_in() -> None:
    f = fleet(22, 20)
    stepped = f.value + STEP * (f.session >= 12)
    trends = analyse(replace(f, value=stepped).histories(time_day=np.full(f.value.size, np.nan)))
    assert np.isnan(trends.change_size).all()
    assert np.isnan(trends.last_z).all()
    assert np.isfinite(trends.value).all()


@pytest.mark.parametrize("sd", [0.0, np.nan, 1e-3])
def test_a_row_of_nothing_but_zeros_is_a_row(sd: float) -> None:
    """As of an agreement that is perfect: others are judged as without it."""
    others = np.random.default_rng(1).normal(size=(2, 12))
    days = 7.0 * np.arange(12)

    def trends(values: np.ndarray) -> Trends:
        n = len(values)
        row, when = np.repeat(np.arange(n), 12), np.tile(days, n)
        warm, sds = np.full(12 * n, 25.0), np.full(12 * n, sd)
        return analyse(Histories(row, when.astype(int), when, warm, values.ravel(), sds, kind=np.arange(n)))

    whole, without = trends(np.vstack([np.zeros(12), others])), trends(others)
    assert whole.value[0] == 0.0
    assert 0.0 < whole.sd[0] <= 1e-3
    np.testing.assert_allclose(whole.value[1:], without.value, rtol=EXACT)
    np.testing.assert_allclose(whole.sd[1:], without.sd, rtol=EXACT)
