"""Parts of the pooling of a unit's flights in closed form, or against one dense least-squares problem."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from fieldcal.estimation.normal_equations import NormalEquations
from fieldcal.estimation.pooled.chain import Estimate, Known
from fieldcal.estimation.pooled.changes import contradiction, jumps, pool, surest_drift, surest_step
from fieldcal.estimation.pooled.movement import first_strengths, said_beside, series_of_sessions, within_sessions
from fieldcal.estimation.pooled.strengths import Strengths
from fieldcal.estimation.pooled.unit import Flight, LeftOut, Pooled, Step, Unit, smoothed, state_of
from fieldcal.geometry.rotation import Array

RTOL = 1e-6


def told(rng: np.random.Generator, size: int, rows: int | None = None) -> tuple[Known, Array, Array]:
    """Known by as many readings (or `rows`) of unit variance as there are elements, its estimate and covariance."""
    h, y = rng.normal(size=(rows or size, size)), rng.normal(size=rows or size)
    known = Known(h.T @ h, h.T @ y)
    covariance = np.linalg.pinv(known.information)
    return known, covariance @ known.right, covariance


@pytest.mark.parametrize("seed", range(3))
def test_what_contradicts_is_the_distance_of_two_estimates_by_the_sum_of_their_covariances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (own, x, v), (expected, y, w) = told(rng, 4), told(rng, 4)
    chi2, count = contradiction(own, expected)
    assert count == 4
    assert chi2 == pytest.approx((x - y) @ np.linalg.solve(v + w, x - y), rel=1e-5)


def test_of_a_flight_that_sees_two_combinations_of_four_two_can_contradict() -> None:
    """Readings A x of unit variance against what is expected of them, A y with covariance A W Aᵀ."""
    rng = np.random.default_rng(4)
    a, read = rng.normal(size=(2, 4)), rng.normal(size=2)
    expected, y, w = told(rng, 4)
    chi2, count = contradiction(Known(a.T @ a, a.T @ read), expected)
    off = read - a @ y
    assert count == 2
    assert chi2 == pytest.approx(off @ np.linalg.solve(np.eye(2) + a @ w @ a.T, off), rel=1e-5)
    assert contradiction(Known.nothing(4), expected) == (0.0, 0)
    for unit in (1e-4, 1.0, 1e4):
        assert contradiction(Known(unit**2 * np.eye(4), np.ones(4)), Known.nothing(4)) == (0.0, 0)


def test_only_what_others_know_of_can_be_contradicted() -> None:
    """Of two readings the others expect one, with as large a variance."""
    chi2, count = contradiction(Known(np.eye(2), np.array([5.0, 7.0])), Known(np.diag([1.0, 0.0]), np.zeros(2)))
    assert count == 1
    assert chi2 == pytest.approx(5.0**2 / 2.0, rel=1e-5)


@pytest.mark.parametrize(("variance", "count"), [(0.9e4, 1), (1.1e4, 0)])
def test_what_is_expected_ten_thousand_times_as_vaguely_cannot_be_contradicted(variance: float, count: int) -> None:
    own = Known(np.diag([4.0]), np.array([4.0 * 7.0]))
    chi2, tested = contradiction(own, Known(np.diag([4.0 / variance]), np.zeros(1)))
    assert tested == count
    assert chi2 == pytest.approx(count * 4.0 * 7.0**2 / (1.0 + variance), rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_jump_of_one_element_is_least_squares(seed: int) -> None:
    """Past and future of one state but that element, which differs by an unknown more."""
    rng = np.random.default_rng(seed)
    (past, *_), (future, *_) = told(rng, 3), told(rng, 3)
    size, information = jumps(past, future)
    for i in range(3):
        design = np.hstack([np.eye(3), np.eye(3)[:, [i]]])
        n = design.T @ future.information @ design
        g = design.T @ future.right
        n[:3, :3] += past.information
        g[:3] += past.right
        covariance = np.linalg.inv(n)
        assert size[i] == pytest.approx((covariance @ g)[3], rel=RTOL)
        assert information[i] == pytest.approx(1.0 / covariance[3, 3], rel=RTOL)


def test_what_past_and_future_do_not_share_is_no_jump() -> None:
    size, information = jumps(Known(np.diag([2.0, 0.0, 3.0]), np.ones(3)), Known(np.diag([2.0, 5.0, 0.0]), np.zeros(3)))
    assert (size[0], information[0]) == (pytest.approx(-0.5), pytest.approx(1.0))
    assert not size[1:].any()
    assert not information[1:].any()


GAIN, ZERO, LEVER = ("gyroscope", "gain", "x"), ("gyroscope", "zero", "x"), ("gyroscope", "lever", "x")
SLOPE = ("gyroscope", "zero_per_degc", "x")
NAMES = (GAIN, LEVER, ZERO)


@pytest.mark.parametrize(("warmth", "counted"), [(6.0, 6.0), (None, -2.5)])
def test_a_flights_constants_are_those_of_the_state_at_its_temperature_and_day(
    warmth: float | None, counted: float
) -> None:
    """The state: three constants, slopes of the gain and the zero, their rates, as of the last day."""
    rng = np.random.default_rng(7)
    own, x, _ = told(rng, 3)
    reference = rng.normal(size=3)
    equations = NormalEquations((ZERO, SLOPE, GAIN), reference, own.right, own.information)
    found = state_of(Flight(equations, 0, warmth), NAMES, (0, 2), -2.5, (0, 2), -40.0)
    design = np.array(
        [
            [0.0, 0.0, 1.0, 0.0, counted, 0.0, -40.0],  # zero
            [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0],  # its slope
            [1.0, 0.0, 0.0, counted, 0.0, -40.0, 0.0],  # gain
        ]
    )
    np.testing.assert_allclose(found.information, design.T @ own.information @ design)
    np.testing.assert_allclose(found.right, design.T @ own.information @ (x + reference))
    now = state_of(Flight(equations, 0, warmth), NAMES, (0, 2), -2.5, (0, 2))
    design[:, 5:] = 0.0  # unless it is said, on the last day
    np.testing.assert_allclose(now.information, design.T @ own.information @ design, atol=1e-12)


def sessions_of(rng: np.random.Generator, days: Array) -> tuple[Unit, list[tuple[Array, Array]]]:
    """Three levers (constants without a slope), all seen by every session; and each one's estimate and covariance."""
    names = tuple(("gyroscope", "lever", axis) for axis in "xyz")
    flights, alone = [], []
    for k in range(len(days)):
        own, x, v = told(rng, 3, 5)
        flights.append(Flight(NormalEquations(names, np.zeros(3), own.right, own.information), k, None))
        alone.append((x, v))
    return Unit(tuple(flights), days), alone


DAYS = np.array([0.0, 1.0, 3.0, 3.5, 6.0, 11.0])
WALK, SCATTER = 0.3, 0.5
LEVERS = {("gyroscope", "lever"): Strengths(WALK, SCATTER, 0.0)}


def with_rates(
    alone: list[tuple[Array, Array]], drifting: list[int], step: tuple[int, int] | None = None
) -> tuple[Array, Array]:
    """States (6, 3) and rates of some, of all sessions at once: state and covariance, states first. `step`: before this
    session this element steps."""
    m, r = len(alone), len(drifting)
    n, g = np.zeros((3 * m + r, 3 * m + r)), np.zeros(3 * m + r)
    for k, (x, v) in enumerate(alone):
        h = np.zeros((3, 3 * m + r))
        h[:, 3 * k : 3 * k + 3] = np.eye(3)
        h[drifting, 3 * m + np.arange(r)] = DAYS[k] - DAYS[-1]
        w = np.linalg.inv(v + SCATTER * np.eye(3))
        n += h.T @ w @ h
        g += h.T @ w @ x
        if k:
            h = np.zeros((3, 3 * m + r))
            h[:, 3 * k : 3 * k + 3], h[:, 3 * k - 3 : 3 * k] = np.eye(3), -np.eye(3)
            told = np.array([step != (k, i) for i in range(3)])
            n += h[told].T @ h[told] / (WALK * (DAYS[k] - DAYS[k - 1]))
    covariance = np.linalg.inv(n)
    return covariance @ g, covariance


def test_the_rate_of_each_constant_is_that_of_least_squares_in_which_it_alone_drifts() -> None:
    unit, alone = sessions_of(np.random.default_rng(8), DAYS)
    rates = pool(unit, LEVERS, tested=False).rates()
    for place, rate in enumerate(rates):
        state, covariance = with_rates(alone, [place])
        assert rate is not None
        assert rate.value == pytest.approx(state[-1], rel=RTOL)
        assert rate.sd == pytest.approx(np.sqrt(covariance[-1, -1]), rel=RTOL)
        assert rate.z == pytest.approx(state[-1] / np.sqrt(covariance[-1, -1]), rel=RTOL)


def test_rates_beside_a_step_are_least_squares_too() -> None:
    unit, alone = sessions_of(np.random.default_rng(8), DAYS)
    step = Step(unit.names[0], 2, 0.0, 1.0, 0.0)
    for place, rate in enumerate(smoothed(unit, LEVERS, (step,), (), ()).rates()):
        state, covariance = with_rates(alone, [place], (2, 0))
        assert rate is not None
        assert rate.value == pytest.approx(state[-1], rel=RTOL)
        assert rate.sd == pytest.approx(np.sqrt(covariance[-1, -1]), rel=RTOL)


def test_the_last_session_against_all_others() -> None:
    unit, alone = sessions_of(np.random.default_rng(9), DAYS)
    z = pool(unit, LEVERS, tested=False).last_z()
    vague = [*alone[:-1], (np.zeros(3), 1e10 * np.eye(3))]
    state, covariance = with_rates(vague, [])
    before, v = state[-3:], covariance[-3:, -3:] + SCATTER * np.eye(3)  # as the session met them
    (x, w) = alone[-1]
    gain = v @ np.linalg.inv(v + w)
    moved, gained = gain @ (x - before), gain @ v
    np.testing.assert_allclose(z, moved / np.sqrt(np.diagonal(gained)), rtol=1e-5)


def drifting_unit(warmth: list[float | None], session: list[int], read: list[Array], variance: list[Array]) -> Pooled:
    """Flights that each see a gain and a zero by themselves; both may slope on temperature, the zero walks."""
    flights = tuple(
        Flight(NormalEquations((GAIN, ZERO), np.zeros(2), x / v, np.diag(1.0 / v)), s, t)
        for t, s, x, v in zip(warmth, session, read, variance, strict=True)
    )
    kinds = {GAIN[:2]: Strengths(0.0, 0.0, 0.0), ZERO[:2]: Strengths(0.2, 0.1, 0.01)}
    return pool(Unit(flights, 2.0 * np.arange(max(session) + 1.0)), kinds, tested=False)


def test_a_session_by_itself_says_what_its_flights_read() -> None:
    """Of two flights in the first session the mean."""
    rng = np.random.default_rng(10)
    read, variance = [rng.normal(size=2) for _ in range(4)], [np.full(2, v) for v in (0.1, 0.1, 0.3, 0.2)]
    found = drifting_unit([6.0, 6.0, -3.0, None], [0, 0, 1, 2], read, variance)
    gain, zero = series_of_sessions(found)
    expected = [
        [0.0, 6.0, 0.5 * (read[0][0] + read[1][0]), 0.05],
        [2.0, -3.0, read[2][0], 0.3],
        [4.0, 3.0, read[3][0], 0.2],  # nobody knows its temperature: the usual one
    ]
    np.testing.assert_allclose(gain, expected, rtol=1e-5)
    expected = [
        [0.0, 6.0, 0.5 * (read[0][1] + read[1][1]), 0.05],
        [2.0, -3.0, read[2][1], 0.3],
        [4.0, 3.0, read[3][1], 0.2],
    ]
    np.testing.assert_allclose(zero, expected, rtol=1e-5)
    found = drifting_unit([4.0, 8.0, -3.0, None], [0, 0, 1, 2], read, variance)
    np.testing.assert_allclose(series_of_sessions(found)[0][:, 1], [6.0, -3.0, 3.0])


def test_two_flights_of_a_session_differ_by_what_they_read() -> None:
    rng = np.random.default_rng(11)
    read, variance = [rng.normal(size=2) for _ in range(6)], [np.full(2, v) for v in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)]
    found = drifting_unit([4.0, 9.0, None, 2.0, -3.0, 5.0], [0, 0, 0, 0, 1, 2], read, variance)
    for place, pairs in enumerate(within_sessions(found)):
        expected = [
            [5.0, read[1][place] - read[0][place], 0.3],
            [-7.0, read[3][place] - read[1][place], 0.6],  # after one whose temperature nobody knows
        ]
        np.testing.assert_allclose(pairs, expected, rtol=1e-5)


def test_to_begin_with_constants_move_as_much_as_a_flight_is_uncertain() -> None:
    names = (GAIN, ZERO, SLOPE)
    units = [
        Unit((Flight(NormalEquations(names, np.zeros(3), np.zeros(3), np.diag([n, 0.0, 9.0])), 0, None),), np.zeros(1))
        for n in (1.0, 4.0, 10.0)
    ]
    found = first_strengths(units)
    assert found == {GAIN[:2]: Strengths(0.0, 0.25, 0.25), ZERO[:2]: Strengths(0.0, 0.0, 0.0)}


def test_a_rate_that_was_named_is_of_the_state_and_takes_it_to_any_day() -> None:
    """A straight line without walk: its value at any day, before the first and after the last too."""
    name, rng = LEVER, np.random.default_rng(12)
    day = np.arange(9.0) * 4.0
    value = 3.0 + 0.5 * day + rng.normal(size=9)
    flights = [
        Flight(NormalEquations((name,), np.zeros(1), np.array([v]), np.eye(1)), k, None) for k, v in enumerate(value)
    ]
    found = pool(Unit(tuple(flights), day), {name[:2]: Strengths(0.0, 0.5, 0.0)})
    assert found.drifting == (0,)
    assert not found.steps
    (slope, level), covariance = np.polyfit(day, value, 1, cov="unscaled")
    for at in (None, -7.0, 0.0, 10.0, 32.0, 50.0):
        then = day[-1] if at is None else at
        own = found.at(at)
        assert own.state[0] == pytest.approx(level + slope * then, rel=RTOL)
        design = np.array([then, 1.0])
        assert own.covariance[0, 0] == pytest.approx(1.5 * design @ covariance @ design, rel=1e-5)
    (rate,) = found.rates()
    assert rate is not None
    assert (rate.value, rate.sd) == (
        pytest.approx(slope, rel=RTOL),
        pytest.approx(np.sqrt(1.5 * covariance[0, 0]), rel=1e-5),
    )


def line(day: Array, value: Array, scatter: float) -> Pooled:
    """Sessions of one constant without a walk, each known far better than it scatters."""
    flights = [
        Flight(NormalEquations((LEVER,), np.zeros(1), np.array([1e6 * v]), 1e6 * np.eye(1)), k, None)
        for k, v in enumerate(value)
    ]
    return pool(Unit(tuple(flights), day), {LEVER[:2]: Strengths(0.0, scatter, 0.0)}, tested=False)


@pytest.mark.parametrize(("sessions", "named"), [(4, False), (5, True)])
def test_it_takes_five_sessions_to_name_a_drift(sessions: int, named: bool) -> None:
    day = 100.0 + np.arange(float(sessions))
    assert (surest_drift(line(day, 20.0 * day, 1.0), np.array([1e6])) is not None) == named


@pytest.mark.parametrize(("moved", "named"), [(0.95, False), (1.05, True)])
def test_a_drift_that_moved_less_than_sessions_scatter_is_not_named_however_sure(moved: float, named: bool) -> None:
    day = 100.0 + np.r_[0.0, np.linspace(30.0, 300.0, 300)]
    found = line(day, 2.0 * moved * day / 300.0, 4.0)
    assert (surest_drift(found, np.array([1e6])) is not None) == named


def test_one_session_tells_no_rate() -> None:
    assert line(np.zeros(1), np.ones(1), 1.0).rates() == [None]


@pytest.mark.parametrize("slope", [0.0, 0.04])
def test_of_a_slope_that_no_flight_shows_its_siblings_are_known(slope: float) -> None:
    """Flights at the reference temperature alone; without siblings nothing is."""
    flight = Flight(NormalEquations((ZERO,), np.zeros(1), np.ones(1), np.eye(1)), 0, 0.0)
    now = pool(Unit((flight,), np.zeros(1)), {ZERO[:2]: Strengths(0.0, 0.0, slope)}, tested=False).at()
    assert now.covariance[1, 1] == pytest.approx(slope or np.inf)


def test_what_neither_past_nor_future_tells_alone_is_no_jump_in_any_unit() -> None:
    """Each knows one combination of two: whatever they are, there is a state that has both."""
    for seed in range(20):
        past, future = 1e4 * np.random.default_rng(seed).normal(size=(2, 2))
        size, information = jumps(Known(np.outer(past, past), past), Known(np.outer(future, future), future))
        assert not size.any()
        assert not information.any()


def test_of_a_constant_that_one_flight_of_a_session_does_not_see_there_is_no_difference() -> None:
    def flight(names: tuple[tuple[str, str, str], ...], session: int, degc: float) -> Flight:
        return Flight(
            NormalEquations(names, np.zeros(len(names)), np.ones(len(names)), np.eye(len(names))), session, degc
        )

    flights = (flight((GAIN, ZERO), 0, 1.0), flight((GAIN,), 0, 5.0), flight((GAIN, ZERO), 1, 3.0))
    kinds = {GAIN[:2]: Strengths(0.0, 0.1, 0.01), ZERO[:2]: Strengths(0.2, 0.1, 0.01)}
    gain, zero = within_sessions(pool(Unit(flights, np.arange(2.0)), kinds, tested=False))
    assert (gain.shape, zero.shape) == ((1, 3), (0, 3))


@pytest.mark.parametrize(("after", "named"), [(1, False), (2, True), (4, True), (5, False)])
def test_it_takes_two_sessions_on_either_side_of_a_step(after: int, named: bool) -> None:
    found = surest_step(line(np.arange(6.0), 100.0 * (np.arange(6) >= after), 1.0), np.array([1e6]))
    assert (found is not None and found[1].after == after) == named
    if found is not None and named:
        assert found[1].size == pytest.approx(100.0, rel=1e-5)
        assert found[1].sd == pytest.approx(np.sqrt(1.0 / after + 1.0 / (6 - after)), rel=1e-5)


def test_a_step_of_what_walks_is_that_of_generalised_least_squares() -> None:
    """Sessions whose errors share the walk since the first of them: a level and a step."""
    day, walk, after = np.array([0.0, 1.0, 4.0, 4.5, 9.0, 12.0]), 0.3, 3
    value = np.random.default_rng(14).normal(size=6) + 30.0 * (np.arange(6) >= after)
    flights = [
        Flight(NormalEquations((LEVER,), np.zeros(1), np.array([v]), np.eye(1)), k, None) for k, v in enumerate(value)
    ]
    unit, kinds = Unit(tuple(flights), day), {LEVER[:2]: Strengths(walk, 0.5, 0.0)}
    found = surest_step(smoothed(unit, kinds, (), (), ()), np.array([1e6]))
    weight = np.linalg.inv(1.5 * np.eye(6) + walk * np.minimum.outer(day, day))
    design = np.column_stack([np.ones(6), np.arange(6) >= after])
    covariance = np.linalg.inv(design.T @ weight @ design)
    assert found is not None
    assert found[1].after == after
    assert found[1].size == pytest.approx((covariance @ design.T @ weight @ value)[1], rel=RTOL)
    assert found[1].sd == pytest.approx(np.sqrt(covariance[1, 1]), rel=RTOL)


def test_of_a_constant_of_which_the_last_session_says_next_to_nothing_there_is_no_distance() -> None:
    """Of two that each session sees by themselves; nor do both have to be seen for a drift of one to be named."""
    gain = ("gyroscope", "lever", "y")
    flights = [
        Flight(NormalEquations((LEVER, gain), np.zeros(2), n * v * np.ones(2), np.diag(n)), k, None)
        for k, (v, n) in enumerate(
            zip(50.0 * np.arange(6.0), [np.full(2, 9.0)] * 5 + [np.array([9.0, 1e-7])], strict=True)
        )
    ]
    found = pool(Unit(tuple(flights), np.arange(6.0)), {LEVER[:2]: Strengths(0.0, 1.0, 0.0)}, tested=False)
    assert list(np.isfinite(found.last_z())) == [True, False]
    assert surest_drift(found, np.full(2, 1e6)) is not None


@pytest.mark.parametrize("share", [0.995, 1.005])
def test_a_step_a_drift_and_a_contradiction_are_named_where_one_in_five_hundred_units_would_have_one(
    share: float,
) -> None:
    """By what a normal number exceeds, among all that are looked at: three places of a step, one rate, nine flights.
    Sessions of scatter 1: the mean of m of them has sd √(1/m), a straight line's slope √(1/Σ(t − t̄)²), and one of eight
    is √(1 + 1/7) from the mean of the others; the ninth flight sees nothing."""
    sure = np.array([1e8])

    def beyond(among: int) -> float:
        return share * float(norm.isf(0.5 * 0.002 / among))

    day = np.arange(6.0)
    step = beyond(3) * np.sqrt(2.0 / 3.0) * (day >= 3)
    assert (surest_step(line(day, step, 1.0), sure) is not None) == (share > 1.0)
    rate = beyond(1) / np.sqrt(np.sum((day - 2.5) ** 2))
    assert (surest_drift(line(day, rate * day, 1.0), sure) is not None) == (share > 1.0)
    off = np.where(np.arange(8) == 3, beyond(9) * np.sqrt((1.0 + 1e-3) * (1.0 + 1.0 / 7.0)), 0.0)
    flights = [
        Flight(NormalEquations((LEVER,), np.zeros(1), np.array([1e3 * v]), 1e3 * np.eye(1)), k, None)
        for k, v in enumerate(off)
    ]
    silent = Flight(NormalEquations((LEVER,), np.zeros(1), np.zeros(1), np.zeros((1, 1))), 4, None)
    kinds = {LEVER[:2]: Strengths(0.0, 1.0, 0.0, 1e8)}
    found = pool(Unit((*flights[:7], silent, flights[7]), np.arange(8.0)), kinds)
    assert [one.flight for one in found.left_out] == ([3] if share > 1.0 else [])


def test_what_a_session_expects_of_a_flight_is_said_by_no_flight_that_was_left_out() -> None:
    """Three flights of a session, of which one was: by the others, at its time and without more scatter."""
    day, rng = np.arange(3.0), np.random.default_rng(13)
    flights = [
        Flight(NormalEquations((LEVER,), np.zeros(1), rng.normal(size=1), np.array([[1.0 + k]])), s, None)
        for k, s in enumerate([0, 1, 1, 1, 2])
    ]
    kinds = {LEVER[:2]: Strengths(0.7, 0.0, 0.0)}
    whole = smoothed(Unit(tuple(flights), day), kinds, (), (LeftOut(2, 9.0, 1),), ())
    few = smoothed(Unit((flights[0], flights[3], flights[4]), day), kinds, (), (), ())
    found, expected = whole.expected(1).estimate(), few.at(1.0)
    np.testing.assert_allclose(found.state, expected.state, rtol=RTOL)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=RTOL)


@pytest.mark.parametrize(("share", "told_something"), [(0.95e-4, False), (1.05e-4, True)])
def test_a_part_that_adds_less_than_a_ten_thousandth_says_nothing(share: float, told_something: bool) -> None:
    """Value and variance of the part are those whose weighted mean with the rest is what both know."""
    one = np.ones(1)
    together, before = (Estimate(v * one, v * np.eye(1)) for v in (2.0, 2.0 / (1.0 - share)))
    said = said_beside(before, together, one)
    assert (said is not None) == told_something
    if said is not None:
        value, variance = said
        assert variance == pytest.approx(2.0 / share, rel=RTOL)
        rest = before.covariance[0, 0]
        assert (value / variance + before.state[0] / rest) * 2.0 == pytest.approx(2.0, rel=RTOL)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_the_last_sessions_distance_is_the_same_in_any_unit(unit: float) -> None:
    value = np.array([3.0, 4.0, 2.0, 9.0])
    flights = [
        Flight(NormalEquations((LEVER,), np.zeros(1), np.array([v / unit]), np.eye(1) / unit**2), k, None)
        for k, v in enumerate(value)
    ]
    (z,) = pool(
        Unit(tuple(flights), np.arange(4.0)), {LEVER[:2]: Strengths(0.0, 0.5 * unit**2, 0.0)}, tested=False
    ).last_z()
    assert z == pytest.approx(6.0 / np.sqrt(1.5 + 0.5), rel=1e-6)
