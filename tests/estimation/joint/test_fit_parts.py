"""Parts of the joint fit by themselves: what is known beforehand, how far a step goes, published constants and their
covariance by finite differences, what a lever arm does to the sd, which fit is made when."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numerics_support import turning_rates
from small_record import ARM, CENTRE, PLACES, SPREAD, VALUES, Small, mixed, size_of, small
from test_chain_solver import whole
from test_score_corrections import Flight, stamps

from fieldcal.errors import EstimationError
from fieldcal.estimation.joint import fit as joint_fit
from fieldcal.estimation.joint.chain_solver import BRIDGE, GRADIENT, Normal, Probe, whitened_motion
from fieldcal.estimation.joint.covariance import Noise
from fieldcal.estimation.joint.fit import JointFit, Options, fit_joint, linearised
from fieldcal.estimation.joint.measurement_model import body_jumps, layout_of, residuals, trajectory
from fieldcal.estimation.joint.problem import TRIADS, Model, PriorConstants, State
from fieldcal.estimation.joint.score_corrections import logged_units, within_intervals
from fieldcal.estimation.joint.variance_components import robust_weight
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply
from fieldcal.reason_codes import ReasonCode

TERMS = tuple(f"{name}_cross" for name in TRIADS)
STEP = 1e-6
SETTLED_SD = 0.1  # a step below this share of its sd is none


def made(flight: Small | Flight, *, covariance: Array | None = None, **changes: Any) -> JointFit:
    """A fit of the record at its truth with a covariance as given."""
    layout, p = layout_of(flight.model, flight.state.values, dip=True, lever_arm=True)
    root = np.random.default_rng(1).normal(size=(p, p))
    own = root @ root.T if covariance is None else covariance
    weight = np.ones((len(flight.model.at), 3 * len(flight.model.vectors)))
    path = trajectory(flight.model, flight.state)
    known = np.zeros((p, p)), np.zeros(p), None, np.zeros((p, p))
    solution = flight.model, flight.state, path, flight.levels, weight, layout, own, np.linalg.inv(own), 3
    found = JointFit(*solution, *known)
    return replace(found, **changes)


@pytest.mark.parametrize("name", TRIADS)
def test_published_constants_and_their_covariance_by_finite_differences(name: str) -> None:
    """calibrated = λ′ (x + E x) + b′ with x = (logged − centre)/spread."""
    fit = made(small(TERMS))
    layout, values = fit.layout, fit.state.values

    def of(theta: Array) -> Array:
        own = {n: values[n] + theta[columns] for n, columns in layout.items()}
        matrix = own[name][:3, None] * mixed(name, own[f"{name}_cross"]) / SPREAD[name]
        return np.r_[matrix.ravel(), own[name][3:] - matrix @ CENTRE[name]]

    p = len(fit.covariance)
    jacobian = np.stack([(of(e) - of(-e)) / (2.0 * STEP) for e in STEP * np.eye(p)], axis=1)
    matrix, bias, covariance = fit.full_constants(name)
    np.testing.assert_allclose(np.r_[matrix.ravel(), bias], of(np.zeros(p)), rtol=1e-12)
    expected = jacobian @ fit.covariance @ jacobian.T
    np.testing.assert_allclose(covariance, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("name", TRIADS)
def test_constants_without_cross_axis_terms_are_the_diagonal_of_the_full_ones(name: str) -> None:
    fit = made(small())
    scale, bias, covariance = fit.constants(name)
    np.testing.assert_allclose(scale, VALUES[name][:3] / SPREAD[name])
    np.testing.assert_allclose(bias, VALUES[name][3:] - scale * CENTRE[name])
    matrix, same_bias, full = fit.full_constants(name)
    np.testing.assert_allclose(matrix, np.diag(scale))
    np.testing.assert_allclose(same_bias, bias)
    at = [0, 4, 8, 9, 10, 11]
    np.testing.assert_allclose(covariance, full[np.ix_(at, at)], rtol=1e-9)


def test_little_is_known_beforehand() -> None:
    """Scales to a half, biases to half of what is sensed, anything else to one of its unit; no lever arm."""
    flight = small(("magnetometer_delay",))
    layout, p = layout_of(flight.model, flight.state.values, dip=True, lever_arm=True)
    prior = joint_fit._Prior.at(flight.model, flight.state, layout, p, {})
    assert (prior.information == np.diag(np.diagonal(prior.information))).all()
    sd = 1.0 / np.sqrt(np.diagonal(prior.information))
    for name, columns in layout.items():
        value = flight.state.values[name]
        if name in TRIADS:
            np.testing.assert_allclose(sd[columns], 0.5 * np.abs(np.r_[value[:3], value[:3]]))
        else:
            np.testing.assert_allclose(sd[columns], 1.0)
        np.testing.assert_allclose(prior.mean[columns], 0.0 if name == "lever_arm" else value)
    normal = Normal.empty(3, p, 5)
    off = replace(flight.state, values={**flight.state.values, "dip": flight.state.values["dip"] + 0.1})
    prior.add(normal, off, layout)
    assert (normal.parameters == prior.information).all()
    expected = np.zeros(p)
    expected[layout["dip"]] = -0.1
    expected[layout["lever_arm"]] = -ARM
    np.testing.assert_allclose(normal.parameters_right[:, GRADIENT], expected, atol=1e-12)
    assert not np.delete(normal.parameters_right, GRADIENT, axis=1).any()


def test_what_is_known_of_a_triad_counts_in_its_own_units() -> None:
    """The quadratic form of the prior is that of the logged constants."""
    flight = small()
    layout, p = layout_of(flight.model, flight.state.values, dip=False, lever_arm=False)
    root = 0.1 * np.random.default_rng(2).normal(size=(6, 6))
    known = PriorConstants(np.array([0.5, -0.2, 0.1]), np.array([1.0, 2.0, 3.0]), root @ root.T)
    prior = joint_fit._Prior.at(flight.model, flight.state, layout, p, {"gyroscope": known, "nothing": known})
    columns = layout["gyroscope"]
    scaled = VALUES["gyroscope"]
    logged = np.r_[
        scaled[:3] / SPREAD["gyroscope"], scaled[3:] - scaled[:3] / SPREAD["gyroscope"] * CENTRE["gyroscope"]
    ]
    off = logged - np.r_[known.scale, known.bias]
    away = scaled - prior.mean[columns]
    expected = off @ np.linalg.solve(known.covariance, off)
    assert away @ prior.information[columns, columns] @ away == pytest.approx(expected)
    others = np.delete(np.arange(p), np.arange(p)[columns])
    assert np.allclose(prior.mean[others], np.concatenate([VALUES[n] for n in TRIADS[1:]]))


@pytest.mark.parametrize(
    ("turn_rad", "relative", "share"),
    [(0.5, 0.0, 1.0), (-1.0, 0.0, 0.5), (0.1, 0.0, 1.0), (0.0, 0.3, 1.0), (0.0, -0.6, 0.5), (1.0, 1.2, 0.25)],
)
def test_a_step_is_shortened_to_half_a_radian_and_three_tenths(turn_rad: float, relative: float, share: float) -> None:
    flight = small()
    layout, p = layout_of(flight.model, flight.state.values, dip=True, lever_arm=True)
    for name in TRIADS:
        for axis in range(3):
            step, theta = np.zeros((len(flight.state.q), 12)), np.zeros(p)
            step[3, axis], step[2, 3:] = turn_rad, 100.0
            theta[layout[name].start + axis] = relative * abs(VALUES[name][axis])
            theta[layout[name].start + 4], theta[layout["dip"]] = 50.0, 60.0
            assert joint_fit._step_share(flight.state, step, theta, layout) == pytest.approx(share)


def test_axes_that_read_noise_are_named_where_there_is_no_minimum() -> None:
    """More than 0.4 of the rms from sample to sample: ± a in turn has second differences of 4 a, those of white noise
    are √6 of its sd, and the median of |x| is 0.6745 of it. Readings that are none do not count."""
    flight = small(missing=True)
    triads = dict(flight.model.triads)
    for name, axis, sd in (("gyroscope", 1, 0.404), ("magnetometer", 2, 0.404), ("accelerometer", 0, 0.396)):
        triad = triads[name]
        x = np.zeros_like(triad.x)
        turn = sd / (1.4826 * 4.0 / np.sqrt(6.0)) * (-1.0) ** np.arange(triad.valid.sum())
        x[triad.valid, axis] = turn
        triads[name] = replace(triad, x=x)
    error = joint_fit._no_minimum(replace(flight.model, triads=triads), 7)
    assert error.reason_code == "axis_not_turned"
    assert error.measured == {"iterations": 7, "still": ["gyroscope y", "magnetometer z"]}
    assert "gyroscope y, magnetometer z read hardly more than noise" in str(error)
    error = joint_fit._no_minimum(flight.model, 9)
    assert (error.reason_code, error.measured["iterations"]) == ("joint_diverged", 9)


def test_half_of_what_a_lever_arm_changes_is_in_the_accelerometer_s_sd() -> None:
    flight = small()
    fit = made(flight)
    change = np.arange(1.0, 7.0)
    other = replace(flight.state, values={**flight.state.values, "accelerometer": VALUES["accelerometer"] + change})
    found = joint_fit._or_without_arm(fit, made(replace(flight, state=other)))
    expected = fit.covariance.copy()
    expected[fit.layout["accelerometer"], fit.layout["accelerometer"]] += np.outer(change, change) / 4.0
    np.testing.assert_allclose(found.covariance, expected)
    assert found.state is fit.state


def test_the_lever_arm_s_test_is_its_square_over_its_covariance() -> None:
    fit = made(small())
    columns = fit.layout["lever_arm"]
    expected = ARM @ np.linalg.inv(fit.covariance[columns, columns]) @ ARM
    assert joint_fit._lever_arm_test(fit) == pytest.approx(expected)


def test_without_a_lever_arm_everything_starts_where_its_covariance_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """The conditional mean of the others given an arm of zero; the knots follow by their response."""
    flight = small()
    fit = made(flight)
    seen: list[tuple[State, Options, int]] = []

    def iterate(model: Any, state: State, levels: Any, spent: int, how: Options) -> tuple[JointFit, Array]:
        seen.append((state, how, spent))
        return fit, np.zeros(0)

    monkeypatch.setattr(joint_fit, "_iterate", iterate)
    p, k = len(fit.covariance), len(flight.state.q)
    response = 1e-3 * np.random.default_rng(4).normal(size=(k, 12, p))
    joint_fit._without_lever_arm(fit, response, Options())
    ((state, how, spent),) = seen
    assert (how.lever_arm, spent) == (False, fit.iterations)
    assert not state.values["lever_arm"].any()
    arm = np.arange(p)[fit.layout["lever_arm"]]
    others = np.setdiff1d(np.arange(p), arm)
    c = fit.covariance
    change = np.zeros(p)
    change[others] = -c[np.ix_(others, arm)] @ np.linalg.inv(c[np.ix_(arm, arm)]) @ ARM
    change[arm] = -ARM
    for name, columns in fit.layout.items():
        expected = flight.state.values[name] + change[columns]
        np.testing.assert_allclose(state.values[name], expected, rtol=1e-8, atol=1e-12)
    # The normal equations' knots are N⁻¹(b − N_xθ θ): they follow by minus their response.
    np.testing.assert_allclose(state.motion, flight.state.motion - (response @ change)[:, 3:], atol=1e-9)


class Script:
    """Stands for the iterations: fits that are handed out in turn, and what they were asked for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, flight: Small, *, fails: int = 0, passing: int = 0) -> None:
        self.flight, self.asked, self.fails, self.passing = flight, [], fails, passing
        self.slow = False
        self.test = {True: 100.0, False: 0.0}
        monkeypatch.setattr(joint_fit, "_iterate", self.iterate)
        monkeypatch.setattr(joint_fit, "passing_fields", self.passing_fields)
        monkeypatch.setattr(joint_fit, "_is_slow", lambda fit: self.slow)
        monkeypatch.setattr(joint_fit, "_enlarged", lambda fit, response: replace(fit, bias_walk=fit.bias_walk + 1.0))
        monkeypatch.setattr(joint_fit, "_without_lever_arm", self.without)
        monkeypatch.setattr(joint_fit, "_or_without_arm", lambda fit, without: replace(fit, iterations=777))
        monkeypatch.setattr(joint_fit, "_lever_arm_test", lambda fit: self.test[fit.bias_walk > 0.0])

    asked: list[tuple[Any, Any, int, Options]]

    def iterate(self, model: Any, state: Any, levels: Any, spent: int, how: Options) -> tuple[JointFit, Array]:
        self.asked.append((model, levels, spent, how))
        if len(self.asked) <= self.fails:
            raise EstimationError(ReasonCode.JOINT_DIVERGED, "no")
        return made(self.flight, iterations=spent + 5, options=how), np.zeros(0)

    def passing_fields(self, model: Any, weight: Array) -> np.ndarray:
        self.passing -= 1
        return (np.arange(len(model.at)) % 3 == 0) & (self.passing >= 0)

    def without(self, fit: JointFit, response: Array, how: Options) -> tuple[JointFit, Array]:
        return replace(fit, iterations=555), response

    def run(self, **how: Any) -> JointFit:
        return fit_joint(self.flight.model, self.flight.state, **how)


def test_a_lever_arm_is_kept_where_both_covariances_show_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for plain, coloured, kept, told in ((16.4, 16.4, True, 16.4), (16.2, 99.0, False, 16.2), (16.4, 16.2, False, 16.2)):
        script = Script(monkeypatch, small())
        script.test = {False: plain, True: coloured}
        found = script.run()
        assert found.iterations == (777 if kept else 555)
        assert found.lever_arm_test == told
    script.test = {False: 16.3, True: 16.3}
    assert script.run().iterations == 777
    script.test = {False: 16.3, True: 1.0}
    assert script.run().iterations == 555


def test_no_lever_arm_is_tried_where_none_is_asked_for_or_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(monkeypatch, small())
    assert script.run(try_lever_arm=False).lever_arm_test is None
    alone = Script(monkeypatch, small(vectors=("magnetometer",)))
    assert alone.run().lever_arm_test is None
    assert [how.lever_arm for *_, how in (*script.asked, *alone.asked)] == [False, False]


def test_a_fit_that_fails_is_made_again_with_colour_over_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(monkeypatch, small(), fails=1)
    script.slow = True
    script.run()
    assert [(spent, how.slow, how.dip) for *_, spent, how in script.asked] == [(0, False, True), (0, True, True)]
    assert Options() == Options(dip=True, lever_arm=True, vps=None, walk_ratio=10.0, priors={}, slow=False)
    with pytest.raises(EstimationError):
        Script(monkeypatch, small(), fails=2).run()
    alone = Script(monkeypatch, small(vectors=()), fails=1)
    with pytest.raises(EstimationError):
        alone.run()
    assert len(alone.asked) == 1


def test_rows_of_a_slow_colour_are_fitted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(monkeypatch, small())
    script.slow = True
    script.run()
    assert [(spent, how.slow, how.walk_ratio) for *_, spent, how in script.asked] == [(0, False, 10.0), (5, True, 10.0)]
    alone = Script(monkeypatch, small(vectors=()))
    alone.slow = True
    alone.run()
    assert [how.slow for *_, how in alone.asked] == [False]


@pytest.mark.parametrize(("passing", "rounds"), [(0, 1), (1, 2), (3, 4), (9, 4)])
def test_passing_fields_are_searched_for_three_times(
    monkeypatch: pytest.MonkeyPatch, passing: int, rounds: int
) -> None:
    script = Script(monkeypatch, small(), passing=passing)
    script.run()
    assert len(script.asked) == rounds
    assert [spent for _, _, spent, _ in script.asked] == [5 * i for i in range(rounds)]
    for model, *_ in script.asked[1:]:
        expected = script.flight.model.triads["magnetometer"].valid & (np.arange(len(model.at)) % 3 != 0)
        assert model.triads["magnetometer"].valid.tolist() == expected.tolist()


@pytest.mark.parametrize(("ratio", "slow"), [(1.45, False), (1.55, True)])
def test_slow_is_half_more_than_the_colour_that_was_fitted_with(
    monkeypatch: pytest.MonkeyPatch, ratio: float, slow: bool
) -> None:
    fit = made(small())
    colour = fit.levels.colour * np.where(np.arange(6) == 4, ratio, 1.0)
    monkeypatch.setattr(joint_fit, "slow_colour", lambda *given: colour)
    assert joint_fit._is_slow(fit) == slow


def test_places_and_sizes_are_those_of_the_layout() -> None:
    """What these tests take for granted."""
    layout: Mapping[str, slice] = made(small(TERMS)).layout
    assert all(columns.stop - columns.start == size_of(name) for name, columns in layout.items())
    assert all(len(PLACES[name]) == size_of(f"{name}_cross") for name in TRIADS)


def flown(seconds: float = 6.0, seed: int = 1) -> tuple[Flight, Model, State]:
    """A record of every motion with noise and translation, and its true state."""
    t = stamps(seconds)
    flight = Flight.of(t, turning_rates(t, np.random.default_rng(seed), peak=1.5), gyro_noise=0.5)
    model, state = flight.drawn(np.random.default_rng(seed))[0]
    return flight, model, state


def off_from(model: Model, state: State, *, turn_rad: float, relative: float) -> State:
    """Every attitude turned, every scale longer, no translation: where a fit may start."""
    rng = np.random.default_rng(7)
    turns = turn_rad * rng.normal(size=(len(state.q), 3))
    values = dict(state.values)
    for name in TRIADS:
        values[name] = values[name] * np.r_[np.full(3, 1.0 + relative), np.ones(3)]
    return State(multiply(from_rotation_vector(turns), state.q), 0.0 * state.motion, values)


def test_another_start_ends_at_the_same_place_and_the_noise_is_what_was_drawn() -> None:
    """To a tenth of the sd, at which steps count for none; levels to what a few hundred residuals tell."""
    flight, model, state = flown()
    fits = [
        fit_joint(model, off_from(model, state, turn_rad=turn, relative=relative), try_lever_arm=False)
        for turn, relative in ((0.0, 0.0), (0.1, 0.05), (0.05, -0.1))
    ]
    one = fits[0]
    for other in fits[1:]:
        for name in TRIADS:
            sd = np.sqrt(np.diagonal(one.covariance))[one.layout[name]]
            assert np.abs((other.state.values[name] - one.state.values[name]) / sd).max() < 2.0 * SETTLED_SD, name
    np.testing.assert_allclose(np.sqrt(one.levels.variance / flight.levels.variance), 1.0, atol=0.25)
    assert np.sqrt(one.levels.walk / flight.levels.walk) == pytest.approx(1.0, abs=0.5)
    assert one.levels.strength == pytest.approx(flight.levels.strength, rel=0.5)
    true = np.concatenate([state.values[name] for name in TRIADS])
    found = np.concatenate([one.state.values[name] for name in TRIADS])
    sd = np.sqrt(np.diagonal(one.covariance))[:18]
    assert np.abs((found - true) / sd).max() < 4.0
    assert np.sqrt(np.mean(((found - true) / sd) ** 2)) < 1.6


@pytest.mark.parametrize(("turn_rad", "relative"), [(0.1, 0.1), (0.2, -0.15), (0.01, 0.01)])
def test_what_has_settled_is_within_a_tenth_of_an_sd_and_where_the_corrected_score_is_none(
    monkeypatch: pytest.MonkeyPatch, turn_rad: float, relative: float
) -> None:
    """Against the same iterations carried on until nothing moves: there the gradient and its two corrections cancel,
    of which either alone would move a scale."""
    _, model, state = flown()
    how = Options(lever_arm=False)
    start = off_from(model, state, turn_rad=turn_rad, relative=relative)
    found, _ = joint_fit._iterate(model, start, None, 0, how)
    monkeypatch.setattr(joint_fit, "CONVERGED_STEP_SD", 1e-5)
    last, _ = joint_fit._iterate(model, found.state, found.levels, 0, how)
    sd = 1.0 / np.sqrt(np.diagonal(last.information))
    for name, columns in last.layout.items():
        off = (found.state.values[name] - last.state.values[name]) / sd[columns]
        assert np.abs(off).max() < 1.5 * SETTLED_SD, name
    np.testing.assert_allclose(found.levels.variance, last.levels.variance, rtol=1.5 * SETTLED_SD)
    layout, p = layout_of(model, last.state.values, dip=True, lever_arm=False)
    probe = Probe.draw(model.knots, model.readings.t, model.at, 6)
    weight = robust_weight(model, residuals(model, last.state, last.path), last.levels)
    normal, _, reaction = linearised(model, last.state, last.path, layout, p, weight, last.levels, probe, None)
    joint_fit._Prior.at(model, found.state, layout, p, {}).add(normal, last.state, layout)
    found = normal.eliminate()
    eliminated, information, gradient = found.solved(slice(None)), found.information, found.gradient
    units, within = np.zeros(p), np.zeros(p)
    units[:3] = logged_units(model, last.state, last.path, last.levels.walk)
    within += last.levels.walk * within_intervals(model, last.state, layout, reaction, eliminated[:, :, p + BRIDGE])

    def step(by: Array) -> float:
        return float(np.abs(np.linalg.solve(information, by) / sd).max())

    assert step(gradient[:, GRADIENT] + units + within) < 1e-3
    assert step(units) > 0.01
    assert step(within) > 0.01


class Looked(Exception):
    """Raised where the noise levels would be renewed."""


def test_what_the_unknowns_absorb_of_each_residual_is_that_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    """z_rᵀ A_r N⁻¹ Aᵀ z, of each residual's rows A_r and signs z_r, with the prior in N."""
    flight = small()
    w = whole(flight)
    seen: list[Array] = []

    def renewed(model: Any, residual: Any, levels: Any, absorbed: Array, *others: Any, **how: Any) -> None:
        seen.append(absorbed)
        raise Looked

    monkeypatch.setattr(joint_fit, "renewed_levels", renewed)
    monkeypatch.setattr(joint_fit, "robust_weight", lambda *given: w.weight)
    monkeypatch.setattr(joint_fit.Probe, "draw", lambda *given, **how: w.probe)
    with pytest.raises(Looked):
        joint_fit._iterate(w.flight.model, w.flight.state, w.flight.levels, 0, Options())
    model = w.flight.model
    layout, p = layout_of(model, w.flight.state.values, dip=True, lever_arm=True)
    prior = joint_fit._Prior.at(model, w.flight.state, layout, p, {})
    matrix = w.normal
    matrix[-p:, -p:] += prior.information
    m, r = w.weight.shape
    rows, signs = w.rows.reshape(m, r, len(matrix)), w.signs[0].reshape(m, r)
    response = np.linalg.solve(matrix, w.rows.T @ w.signs[0])
    expected = [(rows[:, i].T @ signs[:, i]) @ response for i in range(r)]
    np.testing.assert_allclose(seen[0], expected, rtol=1e-5)
    parameters = [(rows[:, i, -p:].T @ signs[:, i]) @ response[-p:] for i in range(r)]
    assert np.abs(parameters).max() > 0.1


def test_a_residual_that_is_no_number_ends_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    _, model, state = flown(2.0)
    calls = []

    def broken(*given: Any) -> Array:
        calls.append(given)
        left = residuals(*given)
        if len(calls) > 1:
            left[3, 2] = np.nan
        return left

    monkeypatch.setattr(joint_fit, "residuals", broken)
    with pytest.raises(EstimationError) as error:
        joint_fit._iterate(model, state, None, 0, Options())
    assert error.value.measured["iterations"] == 1


def test_no_minimum_within_the_iterations_is_told_with_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    _, model, state = flown(2.0)
    monkeypatch.setattr(joint_fit, "MAX_ITERATIONS", 2)
    with pytest.raises(EstimationError) as error:
        fit_joint(model, off_from(model, state, turn_rad=0.1, relative=0.2), try_lever_arm=False)
    assert error.value.measured["iterations"] == 2


def test_a_fit_that_has_not_settled_by_then_starts_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    _, model, state = flown(2.0)
    called: list[State] = []

    def anew(given: Model, at: State) -> State:
        called.append(at)
        return State(state.q, 0.0 * state.motion, at.values)

    monkeypatch.setattr(joint_fit.initialise, "anew", anew)
    monkeypatch.setattr(joint_fit, "RESTART_AFTER_ITERATIONS", 3)
    start = off_from(model, state, turn_rad=0.1, relative=0.1)
    found = fit_joint(model, start, try_lever_arm=False)
    assert len(called) == 1
    assert called[0].values["gyroscope"] != pytest.approx(start.values["gyroscope"])
    assert np.abs(found.state.values["magnetometer"] / state.values["magnetometer"] - 1.0)[:3].max() < 0.05
    assert found.iterations > 3


def test_iterations_of_a_fit_and_of_what_it_follows_are_added(monkeypatch: pytest.MonkeyPatch) -> None:
    _, model, state = flown(2.0)
    start = off_from(model, state, turn_rad=0.01, relative=0.01)
    counted: list[None] = []

    def linearised_once(*given: Any) -> Any:
        counted.append(None)
        return linearised(*given)

    monkeypatch.setattr(joint_fit, "linearised", linearised_once)
    one, response = joint_fit._iterate(model, start, None, 0, Options(lever_arm=False))
    assert one.iterations == len(counted)
    other, _ = joint_fit._iterate(model, start, None, 100, Options(lever_arm=False))
    assert other.iterations == one.iterations + 100
    assert response.shape == (len(model.knots.index), 12, len(one.information))
    again, _ = joint_fit._iterate(model, one.state, one.levels, 0, Options(lever_arm=False))
    assert again.iterations < one.iterations
    np.testing.assert_allclose(one.covariance @ one.information, np.eye(len(one.information)), atol=1e-6)


def test_the_bias_walk_over_the_record_is_in_the_bias_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bias that is the mean over T and walks by q from it: q² T/3 at either end and between them."""
    flight = small()
    later = replace(flight.model.readings, t=flight.model.readings.t + 100.0)
    flight = replace(flight, model=replace(flight.model, readings=later))
    fit = made(flight)
    k, p = len(flight.state.q), len(fit.covariance)
    asked: list[Any] = []

    def noise_of(model: Any, rows: Any, response: Any, *others: Any) -> Noise:
        asked.append(others)
        return Noise(np.zeros((p, p)), np.zeros((k, p)), np.arange(float(k)))

    whitened: list[Array] = []
    rates: list[Any] = []

    def bias_walk(*given: Any) -> float:
        rates.append(given)
        return 0.3

    monkeypatch.setattr(joint_fit.compiled, "LIBRARY", None)
    monkeypatch.setattr(joint_fit, "sums_of_rows", lambda *given: whitened.append(given[3]))
    monkeypatch.setattr(joint_fit, "noise_of", noise_of)
    monkeypatch.setattr(joint_fit, "bias_walk", bias_walk)
    response = np.random.default_rng(8).normal(size=(k, 12, p))
    found = joint_fit._enlarged(fit, response)
    added = np.zeros(p)
    t = flight.model.readings.t
    added[3:6] = 0.09 * (t[-1] - t[0]) / 3.0
    np.testing.assert_allclose(found.covariance - fit.covariance, np.diag(added), atol=1e-9)
    np.testing.assert_array_equal(found.doubt, np.diag(added))
    assert found.bias_walk == 0.3
    knots, levels = flight.model.knots, flight.levels
    (whitening,) = whitened
    np.testing.assert_allclose(whitening, fit.weight / (levels.variance * levels.colour))
    jumps, process, poses = asked[0]
    assert jumps[0] is fit.path.jump
    np.testing.assert_allclose(jumps[1], knots.joined / np.sqrt(levels.walk * knots.interval_s))
    np.testing.assert_allclose(process[0], whitened_motion(knots, levels.strength, response[:, 3:]))
    np.testing.assert_allclose(process[1], whitened_motion(knots, levels.strength, flight.state.motion))
    assert poses is None
    rate, interval_s, joined = rates[0]
    np.testing.assert_allclose(rate, body_jumps(flight.state, fit.path) / knots.interval_s[:, None])
    assert interval_s is knots.interval_s
    assert joined is knots.joined
