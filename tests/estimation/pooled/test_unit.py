"""Units drawn with known truth: steps, spoiled flights, how much constants move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pooled import NAMES, PER_DEGC, SCATTER, Truth, alarms, drawn, of_names

from fieldcal.estimation.normal_equations import NormalEquations
from fieldcal.estimation.pooled.chain import Known
from fieldcal.estimation.pooled.changes import contradiction, pool
from fieldcal.estimation.pooled.movement import said_beside, strengths
from fieldcal.estimation.pooled.strengths import Series, Strengths, innovations, strengths_of
from fieldcal.estimation.pooled.unit import LEAST_SHARE, Flight, Kinds, Unit

SESSIONS = 12
KNOWN: Kinds = {
    kind: Strengths((0.05 * sd) ** 2, sd**2, (1e-4 if kind != ("accelerometer", "zero") else 2e-3) ** 2)
    for kind, sd in SCATTER.items()
}


def ratios(units: int, seen: int) -> np.ndarray:
    out = []
    for seed in range(units):
        rng = np.random.default_rng([5, seed])
        unit = drawn(rng, SESSIONS, seen=seen)
        truth = Truth(np.random.default_rng([5, seed]), SESSIONS).walked[-1]
        found = pool(unit, KNOWN)
        assert not found.steps
        assert not found.left_out
        now, order = found.at(), [NAMES.index(name) for name in found.names]
        out.append((now.state[:18] - truth[order]) / np.sqrt(np.diagonal(now.covariance)[:18]))
    return np.array(out)


@pytest.mark.parametrize("seen", [4, 12])
def test_errors_are_as_large_as_claimed(seen: int) -> None:
    """Flights of four combinations of 18 constants among them."""
    z = ratios(12, seen)
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15
    assert np.abs(z).max() < 4.5


def test_a_step_of_ten_scatters_is_found_in_its_session_and_named() -> None:
    for place in (0, 4, 9, 17):
        found = pool(drawn(np.random.default_rng(place), SESSIONS, seen=12, step=(7, place, 10.0)), KNOWN)
        assert [(step.name, step.after) for step in found.steps] == [(NAMES[place], 7)]
        size = 10.0 * SCATTER[NAMES[place][:2]]
        assert abs(found.steps[0].size - size) < 5.0 * found.steps[0].sd
        assert found.steps[0].z == pytest.approx(found.steps[0].size / found.steps[0].sd)
        assert not found.left_out


def moving(unit: Unit, place: int, per_day: float) -> Unit:
    """A unit one constant of which moves steadily."""
    flights = []
    for flight in unit.flights:
        own = flight.equations
        by = per_day * unit.day[flight.session] * (np.arange(18) == place)
        flights.append(replace(flight, equations=replace(own, right=own.right + own.information @ by)))
    return replace(unit, flights=tuple(flights))


def test_a_steady_drift_is_named_with_its_rate_and_is_no_step() -> None:
    """A scatter and a half a session, of sessions five days apart in the mean: one in twenty may look like a step."""
    named, z = 0, []
    for place in range(18):
        rng = np.random.default_rng([9, place])
        unit = drawn(rng, SESSIONS, seen=14)
        truth = Truth(np.random.default_rng([9, place]), SESSIONS)
        rate = 0.3 * SCATTER[NAMES[place][:2]]
        found = pool(moving(unit, place, rate), KNOWN)
        if found.steps or [found.names[i] for i in found.drifting] != [NAMES[place]]:
            continue
        named += 1
        (i,) = found.drifting
        told = found.rates()[i]
        assert told is not None
        z.append((told.value - rate) / told.sd)
        for session in (0, SESSIONS // 2, SESSIONS - 1):
            then = found.at(float(unit.day[session]))
            true = truth.walked[session, place] + rate * unit.day[session]
            assert abs(then.state[i] - true) < 4.5 * np.sqrt(then.covariance[i, i])
    assert named >= 16
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_what_does_not_move_has_rates_within_their_sd_and_none_is_named() -> None:
    z = []
    for seed in range(8):
        found = pool(drawn(np.random.default_rng([11, seed]), SESSIONS, seen=14), KNOWN)
        assert not found.drifting
        z += [rate.z for rate in found.rates() if rate is not None]
    assert len(z) == 8 * 18
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_one_rate_among_others_is_least_squares() -> None:
    """Of a constant that all sessions show alone, without walk or temperature: the slope of a straight line."""
    name, rng = ("gyroscope", "lever", "x"), np.random.default_rng(3)
    day, value = np.arange(9.0) * 4.0, rng.normal(size=9)
    one = [
        Flight(NormalEquations((name,), np.zeros(1), np.array([v]), np.eye(1)), k, None) for k, v in enumerate(value)
    ]
    found = pool(Unit(tuple(one), day), {name[:2]: Strengths(0.0, 0.5, 0.0)}, tested=False)
    (rate,) = found.rates()
    (slope, _), covariance = np.polyfit(day, value, 1, cov="unscaled")
    assert rate is not None
    assert rate.value == pytest.approx(slope)
    assert rate.sd == pytest.approx(np.sqrt(1.5 * covariance[0, 0]))
    z = found.last_z()[0]
    off = value[-1] - value[:-1].mean()
    assert z == pytest.approx(off / np.sqrt(1.5 + 1.5 / 8), rel=1e-6)


def spoiled(unit: Unit, flight: int) -> Unit:
    """One flight whose accelerometer reads as if x and z were off by twenty scatters."""
    own = unit.flights[flight].equations
    moved = own.information @ (20.0 * of_names(SCATTER) * np.isin(np.arange(18), (0, 5)))
    flights = list(unit.flights)
    flights[flight] = replace(flights[flight], equations=replace(own, right=own.right + moved))
    return replace(unit, flights=tuple(flights))


@pytest.mark.parametrize("flight", [0, 5, SESSIONS - 1])
def test_a_spoiled_flight_is_left_out(flight: int) -> None:
    unit = drawn(np.random.default_rng(2), SESSIONS, seen=12)
    found = pool(spoiled(unit, flight), KNOWN)
    assert [one.flight for one in found.left_out] == [flight]
    assert not found.steps
    clean = pool(unit, KNOWN)
    difference = (found.at().state - clean.at().state)[:18] / np.sqrt(np.diagonal(found.at().covariance)[:18])
    assert np.abs(difference).max() < 2.0, "as if it had not been flown"
    assert not found.contributions()[flight].any()


def test_a_fifth_of_the_flights_may_be_left_out() -> None:
    unit = drawn(np.random.default_rng(2), 10, seen=12)
    assert {one.flight for one in pool(spoiled(spoiled(unit, 2), 8), KNOWN).left_out} == {2, 8}
    three = pool(spoiled(spoiled(spoiled(unit, 2), 5), 8), KNOWN)
    assert len(three.left_out) == 2


@pytest.mark.parametrize(("sessions", "told"), [(2, False), (3, True)])
def test_of_two_that_contradict_each_other_neither_is_left_out(sessions: int, told: bool) -> None:
    unit = spoiled(drawn(np.random.default_rng(2), sessions, seen=40), 0)
    assert [one.flight for one in pool(unit, KNOWN).left_out] == [0] * told


def test_a_parallel_shift_of_the_reference_point_changes_nothing() -> None:
    unit = drawn(np.random.default_rng(3), SESSIONS, seen=4)
    moved = [
        replace(flight, equations=flight.equations.moved(flight.equations.reference + 0.01 * (k - 5)))
        for k, flight in enumerate(unit.flights)
    ]
    one, other = (pool(u, KNOWN).at() for u in (unit, replace(unit, flights=tuple(moved))))
    np.testing.assert_allclose(one.state, other.state, rtol=1e-6, atol=1e-9)


def test_a_slope_within_a_flight_is_one_of_the_constant() -> None:
    """A flight that warmed up says how the zero follows the temperature, and nothing of the zero itself."""
    names = (("gyroscope", "zero", "x"), ("gyroscope", "zero_per_degc", "x"))
    flights = tuple(
        Flight(NormalEquations(names, np.array([z, 1e-3]), np.zeros(2), np.diag([1e6, 1e10])), k, 0.0)
        for k, z in enumerate((0.01, 0.0101, 0.0099))
    )
    kinds = {("gyroscope", "zero"): Strengths(0.0, 1e-8, 1e-2)}
    now = pool(Unit(flights, np.arange(3.0)), kinds).at()
    assert now.state[1] == pytest.approx(1e-3, rel=1e-6)
    assert now.covariance[1, 1] == pytest.approx(1.0 / 3e10, rel=1e-3)


@pytest.mark.parametrize("others", [0.0, 5.0])
@pytest.mark.parametrize("information", [1e-3, 1.0, 1e3])
def test_what_a_part_says_by_itself_is_what_it_brought(others: float, information: float) -> None:
    """`others` times as much is known without it, of another value."""
    before = Known(np.diag([others * information]), np.array([others * information * 7.0]))
    with_it = before + Known(np.diag([information]), np.array([information * 3.0]))
    said = said_beside(before.estimate(), with_it.estimate(), np.ones(1))
    assert said == (pytest.approx(3.0), pytest.approx(1.0 / information))


@pytest.mark.parametrize(("share", "says"), [(0.9 * LEAST_SHARE, False), (1.1 * LEAST_SHARE, True)])
@pytest.mark.parametrize("information", [1e-3, 1.0, 1e3])
def test_a_part_that_brings_next_to_nothing_says_nothing(share: float, says: bool, information: float) -> None:
    before = Known(np.diag([information * (1.0 - share)]), np.zeros(1))
    with_it = Known(np.diag([information]), np.zeros(1))
    assert (said_beside(before.estimate(), with_it.estimate(), np.ones(1)) is not None) == says


def test_of_what_is_not_determined_no_part_says_anything() -> None:
    nothing = Known.nothing(1).estimate()
    assert said_beside(nothing, nothing, np.ones(1)) is None


def test_flights_contribute_as_much_as_they_know() -> None:
    """Of a constant that does not move: of what is known with a flight, the share that is not known without it."""
    names = (("gyroscope", "zero", "x"),)
    told = np.array([1.0, 2.0, 5.0]) * 1e6
    flights = [
        Flight(NormalEquations(names, np.zeros(1), np.zeros(1), np.diag([n])), k, 0.0) for k, n in enumerate(told)
    ]
    still = {("gyroscope", "zero"): Strengths(0.0, 0.0, 0.0)}
    found = pool(Unit(tuple(flights), np.arange(3.0)), still).contributions()
    np.testing.assert_allclose(found[:, 0], told / told.sum(), rtol=1e-6)
    alone = pool(Unit(tuple(flights[:1]), np.arange(1.0)), still).contributions()
    np.testing.assert_allclose(alone[:, 0], 1.0)


def test_what_is_not_known_by_both_cannot_contradict() -> None:
    own = Known(np.diag([1.0, 0.0]), np.array([100.0, 0.0]))
    assert contradiction(own, Known(np.diag([0.0, 5.0]), np.zeros(2))) == (0.0, 0)
    chi2, count = contradiction(own, Known(np.diag([4.0, 5.0]), np.zeros(2)))
    assert count == 1
    assert chi2 == pytest.approx(100.0**2 / (1.0 + 0.25), rel=1e-3)


def drawn_series(rng: np.random.Generator, strengths: Strengths, own_sd: float, series: int, sessions: int) -> Series:
    rows = []
    for _ in range(series):
        day, warmth = np.cumsum(rng.uniform(1.0, 9.0, sessions)), rng.uniform(-20.0, 10.0, sessions)
        walk = np.cumsum(rng.normal(size=sessions) * np.sqrt(strengths.walk * np.diff(day, prepend=day[0])))
        value = 5.0 + walk + np.sqrt(strengths.slope) * rng.normal() * warmth
        value += np.sqrt(strengths.scatter + own_sd**2) * rng.normal(size=sessions)
        rows.append(np.column_stack([day, warmth, value, np.full(sessions, own_sd**2)]))
    return Series.of(rows)


def test_strengths_are_found_where_there_is_enough_to_tell() -> None:
    true = Strengths(1e-3, 0.5, 4e-4)
    found = strengths_of(drawn_series(np.random.default_rng(1), true, 0.5, 60, 24))
    for name in ("walk", "scatter", "slope"):
        assert 0.6 < getattr(found, name) / getattr(true, name) < 1.7, name
    assert found.freedom > 60 * 20


@pytest.mark.parametrize("sessions", [3, 12])
@pytest.mark.parametrize("own_sd", [0.02, 0.3])
def test_strengths_are_found_where_sessions_are_known_far_better_than_they_scatter(
    own_sd: float, sessions: int
) -> None:
    """Were every innovation taken for a restart, the scatter would be half of `own_sd`."""
    true = Strengths(1e-3, 1.0, 4e-3)
    found = strengths_of(drawn_series(np.random.default_rng(6), true, own_sd, 18, sessions))
    assert 0.5 < found.scatter < 2.5
    assert found.walk < 0.2, "what may be either is scatter"


def test_flights_of_a_session_tell_slopes_that_its_scatter_hides() -> None:
    """Two a session at other temperatures, known a hundred times better than sessions scatter; none is left out."""
    units = []
    for number in range(4):
        rng = np.random.default_rng([21, number])
        truth = Truth(rng, 6)
        flights = []
        for k in range(12):
            degc = float(rng.uniform(5.0, 35.0))
            sd = 0.01 * of_names(SCATTER)
            reading = truth.of_flight(k // 2, degc) + sd * rng.normal(size=18)
            information = np.diag(sd**-2)
            flights.append(
                Flight(NormalEquations(NAMES, np.zeros(18), information @ reading, information), k // 2, degc - 25.0)
            )
        units.append(Unit(tuple(flights), truth.day))
    kinds = strengths(units)
    for kind in SCATTER:
        assert 0.5 < np.sqrt(kinds[kind].slope) / PER_DEGC[kind] < 2.0, kind
        assert 0.6 < np.sqrt(kinds[kind].scatter) / SCATTER[kind] < 1.6, kind
    assert not any(found.left_out or found.steps for found in (pool(unit, kinds) for unit in units))


def test_innovations_of_the_right_strengths_are_white() -> None:
    true = Strengths(1e-3, 0.5, 4e-4)
    z, _ = innovations(drawn_series(np.random.default_rng(2), true, 0.5, 60, 24), true)
    assert np.isnan(z[0]).all()
    assert np.nanmean(z**2) == pytest.approx(1.0, abs=0.1)
    assert np.nanmean(z[1:-1] * z[2:]) == pytest.approx(0.0, abs=0.1)


def test_a_step_does_not_pass_for_a_walk() -> None:
    series = drawn_series(np.random.default_rng(3), Strengths(0.0, 0.5, 0.0), 0.5, 30, 20)
    value = series.value.copy()
    value[10:, 0] += 50.0
    one, other = (strengths_of(s, with_slope=False) for s in (series, replace(series, value=value)))
    assert other.walk == pytest.approx(one.walk, rel=1.0)
    assert other.scatter == pytest.approx(one.scatter, rel=0.2)


def test_of_single_sessions_the_scatter_is_half_of_their_own_sd() -> None:
    found = strengths_of(drawn_series(np.random.default_rng(4), Strengths(0.0, 0.0, 0.0), 2.0, 5, 1))
    assert (found.walk, found.scatter) == (0.0, pytest.approx(1.0))


def test_units_without_a_fault_are_told_of_none() -> None:
    """A thinned run of `benchmarks/pooled.py alarms`."""
    ((wrong, _, hits),) = alarms(1, counts=(8,)).values()
    assert (wrong, hits) == (0, 1)


def test_a_series_that_starts_anew_keeps_its_slope() -> None:
    """Of one a degree, then a step at 5 °C: at −5 °C the value is ten less than after the step."""
    warmth = np.array([-10.0, 10.0, -10.0, 10.0, 5.0, -5.0])
    value = warmth + np.array([0.0, 0.0, 0.0, 0.0, 100.0, 100.0])
    series = Series.of([np.column_stack([np.arange(6.0), warmth, value, np.full(6, 1e-4)])])
    z, variance = innovations(series, Strengths(0.0, 1e-4, 4.0))
    assert np.isnan(z[[0, 4], 0]).all()
    assert abs(z[5, 0]) < 0.1
    assert variance[5, 0] < 1e-3


def test_strengths_are_told_apart_by_a_quarter() -> None:
    """Nothing stays nothing; a thousandth more is the same; a half more is not."""
    coarse = Strengths(0.0, 3e-7, 2e-3, 1084.0).coarse()
    assert coarse.walk == 0.0
    assert coarse.scatter == pytest.approx(3e-7, rel=0.12)
    assert coarse.slope == pytest.approx(2e-3, rel=0.12)
    assert coarse.freedom == round(1.25**31)
    assert Strengths(0.0, 3.003e-7, 2.002e-3, 1085.0).coarse() == coarse
    assert Strengths(0.0, 4.5e-7, 2e-3, 1084.0).coarse().scatter > 1.2 * coarse.scatter
    assert coarse.coarse() == coarse
