"""Zeros that bend with temperature: least squares on all sessions at once, polynomials, and units drawn with truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pooled import NAMES, SCATTER, Truth, drawn
from scipy.stats import norm
from scipy.stats import t as t_distribution

from fieldcal.estimation.normal_equations import NormalEquations
from fieldcal.estimation.pooled.changes import pool, surest_bend
from fieldcal.estimation.pooled.movement import strengths, within_sessions
from fieldcal.estimation.pooled.strengths import BENT, Strengths, is_bent
from fieldcal.estimation.pooled.unit import Flight, Kinds, Unit, smoothed
from fieldcal.geometry.rotation import Array

RTOL = 1e-6
ZERO, SLOPE = ("gyroscope", "zero", "x"), ("gyroscope", "zero_per_degc", "x")
LEVER, GAIN = ("gyroscope", "lever", "x"), ("gyroscope", "gain", "x")

WARMTH = (-12.0, -3.0, 4.0, 4.0, 9.0, -8.0, 15.0)
SESSION = (0, 0, 1, 2, 3, 3, 4)
DAY = np.array([0.0, 1.0, 3.0, 3.5, 9.0])
ONE = Strengths(0.3, 0.5, 0.04)
KINDS: Kinds = {ZERO[:2]: ONE}


def dense(read: Array, slopes: Array, *, bent: bool) -> tuple[Array, Array]:
    """Levels (5,) and scatters (5,) of sessions, slope and bend, of readings of variance 1 of the zero and of its
    derivative: estimate and covariance. By rows of one least-squares problem."""
    n = 12 if bent else 11
    rows, right = [], []

    def row(value: float, variance: float, **at: float) -> None:
        own = np.zeros(12)
        for name, weight in at.items():
            own[int(name[1:])] = weight
        rows.append(own[:n] / np.sqrt(variance))
        right.append(value / np.sqrt(variance))

    for y, d, w, s in zip(read, slopes, WARMTH, SESSION, strict=True):
        row(y, 1.0, **{f"_{s}": 1.0, f"_{5 + s}": 1.0, "_10": w, "_11": w**2})
        row(d, 1.0, _10=1.0, _11=2.0 * w)
    for s in range(5):
        row(0.0, ONE.scatter, **{f"_{5 + s}": 1.0})
        if s:
            row(0.0, ONE.walk * (DAY[s] - DAY[s - 1]), **{f"_{s}": 1.0, f"_{s - 1}": -1.0})
    row(0.0, ONE.slope, _10=1.0)
    design = np.array(rows)
    covariance = np.linalg.inv(design.T @ design)
    return covariance @ design.T @ np.array(right), covariance


def small(seed: int) -> tuple[Unit, Array, Array]:
    read, slopes = np.random.default_rng(seed).normal(size=(2, len(WARMTH)))
    flights = [
        Flight(NormalEquations((ZERO, SLOPE), np.zeros(2), np.array([y, d]), np.eye(2)), s, w)
        for y, d, s, w in zip(read, slopes, SESSION, WARMTH, strict=True)
    ]
    return Unit(tuple(flights), DAY), read, slopes


@pytest.mark.parametrize("seed", range(2))
def test_a_bent_zero_is_least_squares_of_all_sessions_at_once(seed: int) -> None:
    """At any temperature, at the last session and at one before."""
    unit, read, slopes = small(seed)
    state, covariance = dense(read, slopes, bent=True)
    found = smoothed(unit, KINDS, (), (), (), (0,))
    for session in (1, 4):
        own = found.at(float(DAY[session]))
        for warmth in (-30.0, -15.0, 0.0, 15.0):
            value, variance = own.of(found.combination(0, warmth))
            at = np.zeros(12)
            at[[session, 10, 11]] = 1.0, warmth, warmth**2
            assert value == pytest.approx(at @ state, rel=RTOL)
            assert variance == pytest.approx(at @ covariance @ at, rel=RTOL)
    assert found.bend_of() == pytest.approx([state[11]], rel=RTOL)
    assert found.bends() == {}


@pytest.mark.parametrize("seed", range(2))
def test_the_bend_of_a_straight_zero_is_that_of_least_squares_in_which_it_is_bent(seed: int) -> None:
    unit, read, slopes = small(seed)
    straight, covariance = dense(read, slopes, bent=False)
    found = smoothed(unit, KINDS, (), (), ())
    assert found.at().state == pytest.approx([straight[4], straight[10]], rel=RTOL)
    assert found.bend_of() == pytest.approx([0.0])
    state, covariance = dense(read, slopes, bent=True)
    (bend,) = found.bends().values()
    assert bend.value == pytest.approx(state[11], rel=RTOL)
    assert bend.sd == pytest.approx(np.sqrt(covariance[11, 11]), rel=RTOL)
    assert bend.z == pytest.approx(state[11] / np.sqrt(covariance[11, 11]), rel=RTOL)


def test_zeros_of_two_axes_are_each_least_squares_by_itself() -> None:
    """That share nothing: both bent, and each asked where the other is bent."""
    other, other_slope = ("gyroscope", "zero", "y"), ("gyroscope", "zero_per_degc", "y")
    (one, *told), (two, *told_two) = small(5), small(6)
    flights = []
    for a, b in zip(one.flights, two.flights, strict=True):
        right = np.r_[a.equations.right, b.equations.right]
        equations = NormalEquations((ZERO, SLOPE, other, other_slope), np.zeros(4), right, np.eye(4))
        flights.append(replace(a, equations=equations))
    unit, expected = Unit(tuple(flights), DAY), [dense(*own, bent=True) for own in (told, told_two)]
    both = smoothed(unit, KINDS, (), (), (), (1, 0))
    for place, (state, covariance) in enumerate(expected):
        at = np.zeros(12)
        at[[4, 10, 11]] = 1.0, 7.0, 49.0
        value, variance = both.at().of(both.combination(place, 7.0))
        assert (value, variance) == (pytest.approx(at @ state, rel=RTOL), pytest.approx(at @ covariance @ at, rel=RTOL))
        assert both.bend_of()[place] == pytest.approx(state[11], rel=RTOL)
        bends = smoothed(unit, KINDS, (), (), (), (1 - place,)).bends()
        assert list(bends) == [place]
        assert bends[place].value == pytest.approx(state[11], rel=RTOL)
        assert bends[place].sd == pytest.approx(np.sqrt(covariance[11, 11]), rel=RTOL)


def curve(warmth: Array, value: Array, scatter: float, session: Array | None = None) -> Unit:
    """A zero that each flight knows far better than it scatters, beside a gain and a lever that nothing bends."""
    names = (ZERO, GAIN, LEVER)
    session = np.arange(len(warmth)) if session is None else session
    tell = np.array([1e6 / scatter, 1.0, 1.0])
    flights = [
        Flight(NormalEquations(names, np.zeros(3), tell * np.array([v, w**2, w**2]), np.diag(tell)), int(k), float(w))
        for v, w, k in zip(value, warmth, session, strict=True)
    ]
    return Unit(tuple(flights), np.arange(session[-1] + 1.0))


def only_zero(scatter: float) -> Kinds:
    other = Strengths(0.0, 1.0, 0.0)
    return {ZERO[:2]: Strengths(0.0, scatter, 1e12), GAIN[:2]: other, LEVER[:2]: other}


@pytest.mark.parametrize(("degrees", "named"), [((0, 10, 20, 30), False), ((0, 10, 20, 30, 31), True)])
def test_it_takes_five_temperatures_to_name_a_bend(degrees: tuple[float, ...], named: bool) -> None:
    """Of twenty sessions."""
    warmth = np.resize(degrees, 20) - 15.0
    found = smoothed(curve(warmth, 10.0 * warmth**2, 1.0), only_zero(1.0), (), (), ())
    told = surest_bend(found, np.full(3, 1e8))
    assert (told is not None) == named
    if told is not None:
        assert found.names[told[1]] == ZERO, "gains do not bend"


def test_flights_of_one_session_are_of_one_temperature() -> None:
    warmth, session = np.linspace(-20.0, 20.0, 20), np.repeat(np.arange(4), 5)
    found = smoothed(curve(warmth, 10.0 * warmth**2, 1.0, session), only_zero(1.0), (), (), ())
    assert surest_bend(found, np.full(3, 1e8)) is None


@pytest.mark.parametrize(("sag", "named"), [(0.95, False), (1.05, True)])
def test_a_bend_that_moves_a_zero_less_than_sessions_scatter_is_not_named_however_sure(sag: float, named: bool) -> None:
    """By how far its middle is off the line between its ends."""
    warmth = np.linspace(-20.0, 10.0, 400)
    unit = curve(warmth, 2.0 * sag / 15.0**2 * warmth**2, 4.0)
    assert (surest_bend(smoothed(unit, only_zero(4.0), (), (), ()), np.full(3, 1e8)) is not None) == named


@pytest.mark.parametrize("share", [0.995, 1.005])
def test_a_bend_is_named_where_one_in_five_hundred_units_would_have_one(share: float) -> None:
    """The coefficient of the square of nine sessions of scatter 1, by its sd in a polynomial."""
    warmth = np.linspace(-20.0, 10.0, 9)
    sd = np.sqrt(np.linalg.inv(np.vander(warmth, 3).T @ np.vander(warmth, 3))[0, 0])
    size = share * float(norm.isf(0.5 * 0.002)) * sd
    found = smoothed(curve(warmth, size * warmth**2, 1.0), only_zero(1.0), (), (), ())
    assert (surest_bend(found, np.full(3, 1e8)) is not None) == (share > 1.0)


@pytest.mark.parametrize("share", [0.995, 1.005])
def test_a_second_bend_is_as_sure_as_the_first_had_to_be(share: float) -> None:
    """One among two zeros."""
    warmth, other = np.linspace(-20.0, 10.0, 9), ("gyroscope", "zero", "y")
    sd = np.sqrt(np.linalg.inv(np.vander(warmth, 3).T @ np.vander(warmth, 3))[0, 0])
    size = share * float(norm.isf(0.5 * 0.002 / 2)) * sd
    flights = [
        Flight(NormalEquations((ZERO, other), np.zeros(2), 1e6 * np.array([w**2, size * w**2]), 1e6 * np.eye(2)), k, w)
        for k, w in enumerate(map(float, warmth))
    ]
    found = smoothed(Unit(tuple(flights), np.arange(9.0)), only_zero(1.0), (), (), (), (0,))
    told = surest_bend(found, np.full(2, 1e8))
    assert (told is not None and told[1] == 1) == (share > 1.0)


SESSIONS, PLACE, PER_DEGC2 = 12, NAMES.index(ZERO), 4e-5
"""A bend of eighteen scatters amid 5 to 35 °C."""
KNOWN: Kinds = {
    kind: Strengths((0.05 * sd) ** 2, sd**2, (1e-4 if kind != ("accelerometer", "zero") else 2e-3) ** 2)
    for kind, sd in SCATTER.items()
}


def bending(unit: Unit, per_degc2: float) -> Unit:
    flights = []
    for flight in unit.flights:
        own, warmth = flight.equations, flight.warmth_degc or 0.0
        by = per_degc2 * warmth**2 * (np.arange(18) == PLACE)
        flights.append(replace(flight, equations=replace(own, right=own.right + own.information @ by)))
    return replace(unit, flights=tuple(flights))


def test_a_bend_is_named_and_its_zero_is_as_far_from_the_truth_as_claimed_at_any_temperature() -> None:
    """40 °C is beyond what was flown; there it is known less well."""
    z, sd = [], []
    for seed in range(50):
        rngs = [np.random.default_rng([41, seed]) for _ in range(2)]
        truth = Truth(rngs[0], SESSIONS)
        found = pool(bending(drawn(rngs[1], SESSIONS, seen=14), PER_DEGC2), KNOWN)
        place = found.names.index(ZERO)
        assert (found.bent, found.left_out, found.drifting) == ((place,), (), ())
        assert ZERO not in [step.name for step in found.steps]
        for degc in (10.0, 25.0, 40.0):
            warmth = degc - 25.0
            value, variance = found.at().of(found.combination(place, warmth))
            true = truth.walked[-1, PLACE] + truth.slope[PLACE] * warmth + PER_DEGC2 * warmth**2
            z.append((value - true) / np.sqrt(variance))
            sd.append(np.sqrt(variance))
    assert np.median(sd[2::3]) > 1.5 * np.median(sd[::3])
    of_degc = np.sqrt(np.mean(np.square(np.reshape(z, (-1, 3))), axis=0))
    assert ((of_degc > 0.8) & (of_degc < 1.2)).all(), of_degc
    assert np.abs(z).max() < 4.5


def test_a_straight_zero_gets_no_bend() -> None:
    bent = sum(bool(pool(drawn(np.random.default_rng([42, k]), SESSIONS, seen=14), KNOWN).bent) for k in range(100))
    assert bent <= 1


def test_bends_are_no_scatter() -> None:
    """Of a fleet whose gyroscopes all bend by thirty scatters: as a line leaves them, they scattered by nine."""
    units = [
        bending(drawn(np.random.default_rng([43, k]), SESSIONS, seen=14), 30.0 * SCATTER[ZERO[:2]] / 15.0**2)
        for k in range(6)
    ]
    kinds = strengths(units)
    assert 0.5 < np.sqrt(kinds[ZERO[:2]].scatter) / SCATTER[ZERO[:2]] < 1.6
    assert all(found.bent == (found.names.index(ZERO),) for found in (pool(unit, kinds) for unit in units))


def test_five_temperatures_tell_that_a_bend_is_no_scatter() -> None:
    """Twelve units, of whose five values each a curve takes three; as lines, each session would be a series anew."""
    units = []
    for seed in range(12):
        rng = np.random.default_rng([44, seed])
        warmth = rng.permutation([-20.0, -12.0, -5.0, 4.0, 10.0])
        units.append(curve(warmth, warmth**2 + 0.3 * rng.normal(size=5), 1.0))
    assert 0.1 < strengths(units)[ZERO[:2]].scatter / 0.3**2 < 2.0


def test_flights_of_a_session_differ_by_slope_alone_where_the_zero_bends() -> None:
    """Two a session; of a bend that is known nothing is left in what they differ by."""
    warmth, session = np.linspace(-20.0, 20.0, 12), np.repeat(np.arange(6), 2)
    found = smoothed(curve(warmth, 0.5 * warmth + 0.1 * warmth**2, 1.0, session), only_zero(1e-3), (), (), (), (2,))
    assert found.names[2] == ZERO
    pairs = within_sessions(found)[2]
    assert len(pairs) == 6
    np.testing.assert_allclose(pairs[:, 1], 0.5 * pairs[:, 0], atol=1e-3)


@pytest.mark.parametrize("seed", [15, 16])
@pytest.mark.parametrize("scatter", [0.0, 3.0])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_series_is_bent_where_a_polynomials_own_scatter_says_so(share: float, scatter: float, seed: int) -> None:
    """The coefficient over its sd, by the weighted residuals, is put to either side of the limit."""
    rng = np.random.default_rng(seed)
    warmth, value, variance = rng.uniform(-20.0, 10.0, 9), rng.normal(size=9), rng.uniform(0.5, 2.0, 9)
    weight = 1.0 / np.sqrt(variance + scatter)
    (square, *_), covariance = np.polyfit(warmth, value, 2, w=weight, cov=True)
    limit = t_distribution.isf(0.5 * BENT, 6) * np.sqrt(covariance[0, 0])
    value += (share * limit - square) * warmth**2
    series = np.column_stack([np.arange(9.0), warmth, value, variance])
    assert is_bent(series, scatter) == (share > 1.0)
