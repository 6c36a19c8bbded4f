"""The joint estimator's gradient and its corrections: no bias at the truth, and traces of matrices written out.

Around one known path noise is drawn in pairs of opposite sign, of which the mean score keeps only what is quadratic in
noise: the bias, and nothing of the error that a maximum-likelihood estimate has by right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numerics_support import turning_rates
from scipy.linalg import expm, solve_continuous_lyapunov

from fieldcal.estimation.gyroscope.output_error import propagate_stretches
from fieldcal.estimation.joint.chain_solver import BRIDGE, GRADIENT, MOTION_HZ, Probe, place_knots
from fieldcal.estimation.joint.fit import linearised
from fieldcal.estimation.joint.initialise import KNOT_SPACING_S, turning
from fieldcal.estimation.joint.measurement_model import layout_of, residuals, trajectory, translation
from fieldcal.estimation.joint.problem import TRIADS, Model, Readings, State
from fieldcal.estimation.joint.score_corrections import logged_units, within_intervals
from fieldcal.estimation.joint.variance_components import Levels
from fieldcal.geometry.rotation import Array, body_from_inertial
from fieldcal.simulation.experiment import NOISE_VARIANCE, SCALE, Experiment, Motion

RATE_HZ, GRAVITY_MPS2, DIP_RAD = 185.0, 9.81, 0.0
# Translation of 0.3 m/s² rms.
EVERY_WAY, UP_AND_DOWN = np.full(3, 0.3 / np.sqrt(3.0)), np.array([0.0, 0.0, 0.3])
FIELD_NED = np.array([np.cos(DIP_RAD), 0.0, np.sin(DIP_RAD)])
AVERAGED = 3  # readings of a vector triad to a row, as `averaging_side` has it for this turning
CORRECTIONS = ("logged_units", "within_intervals", "translation left out")
# Gauss–Newton steps of the attitudes and the translation from the truth, constants held.
STEPS = 3
# Mean ÷ its standard error that one of twelve passes by chance once in a thousand (normal, Bonferroni); and "far".
BY_CHANCE, FAR = 3.9, 8.0
# How far, in its sd, a flight's scale is drawn off: at most, by the attitude's error in second order; at least, without
# a correction.
UNBIASED, WRONG = 0.15, 0.5
SECOND_ORDER = 0.01  # the same of the attitude's error over what is corrected, with a steady gyroscope
SHARP = 0.03  # standard error of a mean over probes, relative

pytestmark = pytest.mark.usefixtures("either_kernel")


@dataclass(frozen=True)
class Flight:
    """A smooth path with exact readings of it, and the levels of the noise that is drawn around it."""

    model: Model
    state: State
    levels: Levels
    sigma: dict[str, float]
    strength_mps2: Array  # of the translation, north, east and down

    @classmethod
    def of(cls, t: Array, rate: Array, *, gyro_noise: float = 1.0, strength_mps2: Array = EVERY_WAY) -> Flight:
        """Of body rates (n, 3) at t (n,), with the paper's noise, that of the gyroscope times `gyro_noise`."""
        segment = np.zeros(len(t), dtype=np.int64)
        q = propagate_stretches(t, rate, segment)
        turn = body_from_inertial(q)
        sensed = {
            "gyroscope": rate,
            "accelerometer": turn @ np.array([0.0, 0.0, GRAVITY_MPS2]),
            "magnetometer": turn @ FIELD_NED,
        }
        logged = {name: x / np.array(SCALE[name]) for name, x in sensed.items()}
        given = Readings(
            t=t,
            segment=segment,
            **logged,
            gravity_mps2=GRAVITY_MPS2,
            field_ned=FIELD_NED,
            turning=turning(t, segment, logged["gyroscope"]),
        )
        knots = place_knots(t, segment, KNOT_SPACING_S)
        model = Model.of(given, knots, side=AVERAGED // 2)
        triads = {name: replace(own, x=(logged[name] - own.centre) / own.spread) for name, own in model.triads.items()}
        rows = {name: replace(triads[name], x=triads[name].x[model.at]) for name in model.vectors}
        model = replace(model, triads={**triads, **rows})
        values = {name: triads[name].scaled(np.array(SCALE[name]), np.zeros(3)) for name in TRIADS}
        state = State(
            q[knots.index],
            np.zeros((len(knots.index), 9)),
            {**values, "dip": np.array([DIP_RAD]), "lever_arm": np.zeros(3)},
        )
        sigma = {name: float(np.sqrt(variance)) for name, variance in NOISE_VARIANCE.items()}
        sigma["gyroscope"] *= gyro_noise
        sigma |= {name: sigma[name] / np.sqrt(AVERAGED) for name in model.vectors}
        variance = np.concatenate([(sigma[name] / values[name][:3]) ** 2 for name in model.vectors])
        walk = sigma["gyroscope"] ** 2 / RATE_HZ
        white = np.ones(len(variance))
        levels = Levels(variance, white, white, walk, float(np.sqrt(np.mean(strength_mps2**2))))
        return cls(model, state, levels, sigma, strength_mps2)

    def drawn(self, rng: np.random.Generator) -> list[tuple[Model, State]]:
        """The flight with noise and a translation, and with both of them turned round; each with its true state."""
        knots, model = self.model.knots, self.model
        y = drawn_translation(rng, knots.interval_s) * self.strength_mps2
        noise = {name: rng.normal(size=x.x.shape) * self.sigma[name] for name, x in model.triads.items()}
        at, a = knots.of_sample[model.at], y[:, 1]
        share = knots.share[model.at, None]
        moved = (1.0 - share) * a[at] + share * a[np.minimum(at + 1, len(a) - 1)]
        q = trajectory(model, self.state).q[model.at]
        noise["accelerometer"] -= np.einsum("nij,nj->ni", body_from_inertial(q), moved)
        out = []
        for sign in (1.0, -1.0):
            triads = {
                name: replace(x, x=x.x + sign * noise[name] / self.state.values[name][:3])
                for name, x in model.triads.items()
            }
            out.append((replace(model, triads=triads), replace(self.state, motion=sign * y.reshape(len(y), 9))))
        return out


def stamps(duration_s: float) -> Array:
    return np.asarray(np.arange(round(duration_s * RATE_HZ)) / RATE_HZ)


def process() -> tuple[Array, Array]:
    """Rate matrix and stationary covariance of (ω0 v, a, j/ω0), unit variance of a: three equal low-passes of v."""
    omega = 2.0 * np.pi * MOTION_HZ * np.sqrt(2.0)
    rate = omega * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -3.0, -3.0]])
    stationary = solve_continuous_lyapunov(rate, -np.diag([0.0, 0.0, 1.0]))
    return rate, stationary / stationary[1, 1]


def drawn_translation(rng: np.random.Generator, interval_s: Array) -> Array:
    """States (K, 3, 3) at knots, rows (ω0 v, a, j/ω0), unit variance of a."""
    rate, stationary = process()
    y = [np.linalg.cholesky(stationary) @ rng.normal(size=(3, 3))]
    lengths, which = np.unique(np.round(interval_s, 6), return_inverse=True)
    carried = [expm(rate * length) for length in lengths]
    driven = [np.linalg.cholesky(stationary - f @ stationary @ f.T) for f in carried]
    for k in which:
        y.append(carried[k] @ y[-1] + driven[k] @ rng.normal(size=(3, 3)))
    return np.array(y)


def scores(
    flight: Flight, model: Model, state: State, probe: Probe, *, steps: int = STEPS
) -> tuple[Array, Array, Array]:
    """Gradient (p,) at the true constants, what corrects it (3, p), the information (p, p). The last correction is in
    the gradient already: the estimated translation's part of the accelerometer's sensitivity."""
    layout, p = layout_of(model, state.values, dip=True, lever_arm=False)
    weight = np.ones((len(model.at), len(flight.levels.variance)))
    for step in range(steps):
        path = trajectory(model, state)
        normal, _, reaction = linearised(model, state, path, layout, p, weight, flight.levels, probe, None)
        found = normal.eliminate()
        eliminated, information, gradient = found.solved(slice(None)), found.information, found.gradient
        if step + 1 < steps:
            state = state.moved(eliminated[:, :, p + GRADIENT], np.zeros(p), layout)
    added = np.zeros((3, p))
    walk = flight.levels.walk
    added[0, layout["gyroscope"]][:3] = logged_units(model, state, path, walk)
    added[1] = walk * within_intervals(model, state, layout, reaction, eliminated[:, :, p + BRIDGE])
    turn = body_from_inertial(path.q[model.at])
    sensed = -np.einsum("nij,nj->ni", turn, translation(model, state)) / state.values["accelerometer"][:3]
    pulled = np.sum(sensed * (residuals(model, state, path) / flight.levels.variance)[:, :3], axis=0)
    added[2, layout["accelerometer"]][:3] = pulled / state.values["accelerometer"][:3]
    return gradient[:, GRADIENT], added, information


def biases(flight: Flight, pairs: int) -> tuple[Array, Array, Array]:
    """Of pairs of opposite noise: mean gradient (pairs, p), corrections (pairs, 3, p); the information (p, p)."""
    rng, model = np.random.default_rng(2), flight.model
    gradient, added = [], []
    for pair in range(pairs):
        probe = Probe.draw(model.knots, model.readings.t, model.at, 3 * len(model.vectors), seed=pair)
        both = [scores(flight, *drawn, probe) for drawn in flight.drawn(rng)]
        gradient.append(0.5 * (both[0][0] + both[1][0]))
        added.append(0.5 * (both[0][1] + both[1][1]))
    return np.array(gradient), np.array(added), both[0][2]


def scales(flight: Flight, *names: str) -> np.ndarray:
    """Where the triads' scales stand in θ."""
    layout = layout_of(flight.model, flight.state.values, dip=True, lever_arm=False)[0]
    return np.concatenate([np.arange(3) + layout[name].start for name in names])


def over_error(x: Array) -> Array:
    """Mean of the draws x (n, c) over its standard error."""
    return np.asarray(x.mean(axis=0) / (x.std(axis=0, ddof=1) / np.sqrt(len(x))))


def slopes(changed: Callable[[Array], tuple[Array, Array]], size: int, step: float) -> tuple[Array, Array]:
    """∂(residuals, jumps)/∂(size numbers), (·, size), by central differences."""
    columns = []
    for i in range(size):
        move = step * np.eye(size)[i]
        columns.append([(a - b).ravel() / (2.0 * step) for a, b in zip(changed(move), changed(-move), strict=True)])
    return np.array([c[0] for c in columns]).T, np.array([c[1] for c in columns]).T


def at(model: Model, state: State) -> tuple[Array, Array]:
    path = trajectory(model, state)
    return residuals(model, state, path), path.jump


@dataclass(frozen=True)
class Dense:
    """Everything as matrices: `free` (N, N) is the rows' V⁻¹, translation in V, with the attitudes eliminated; `within`
    (3, N, N) their covariance by gyroscope noise about each axis, knots held."""

    free: Array
    within: Array

    @classmethod
    def of(cls, flight: Flight) -> Dense:
        model, state, levels = flight.model, flight.state, flight.levels
        k, n = len(model.knots.index), len(model.readings.t)
        none = np.zeros((k, 12))

        def turned(x: Array) -> tuple[Array, Array]:
            return at(model, state.moved(np.hstack([x.reshape(k, 3), none[:, 3:]]), np.zeros(0), {}))

        def accelerated(x: Array) -> tuple[Array, Array]:
            return at(model, replace(state, motion=np.hstack([none[:, :3], x.reshape(k, 3), none[:, :3]])))

        def noisy(x: Array) -> tuple[Array, Array]:
            gyro = model.triads["gyroscope"]
            other = replace(gyro, x=gyro.x + x.reshape(n, 3) / state.values["gyroscope"][:3])
            return at(replace(model, triads={**model.triads, "gyroscope": other}), state)

        rows, jumps = slopes(turned, 3 * k, 1e-4)
        by_motion = slopes(accelerated, 3 * k, 1e-2)[0]
        by_noise = slopes(noisy, 3 * n, 1e-2)[0].reshape(len(rows), n, 3)
        rate, stationary = process()
        t = model.readings.t[model.knots.index]
        memory = np.array([[(expm(rate * abs(a - b)) @ stationary)[1, 1] for a in t] for b in t])
        noise = np.tile(levels.variance, len(model.at))
        whole = np.diag(np.r_[noise, np.repeat(levels.walk * model.knots.interval_s, 3)])
        whole[: len(rows), : len(rows)] += by_motion @ np.kron(memory * levels.strength**2, np.eye(3)) @ by_motion.T
        sensed = np.vstack([rows, jumps])
        solved = np.linalg.solve(whole, sensed)
        free = np.linalg.inv(whole) - solved @ np.linalg.solve(sensed.T @ solved, solved.T)
        within = np.array([x @ x.T for x in by_noise.transpose(2, 0, 1)]) * levels.walk * RATE_HZ
        return cls(free[: len(rows), : len(rows)], within)

    def by_row(self, covariance: Array) -> Array:
        """tr(E_j C V⁻¹…) of each sensor axis j (6,)."""
        return np.asarray(np.einsum("ab,ba->a", covariance, self.free).reshape(-1, 6).sum(axis=0))


def test_within_intervals_is_on_average_the_traces_written_out() -> None:
    t = stamps(0.9)
    flight = Flight.of(t, turning_rates(t, np.random.default_rng(1)))
    dense, model, state = Dense.of(flight), flight.model, flight.state
    gyroscope = [dense.by_row(own).sum() for own in dense.within]
    expected = np.concatenate([gyroscope, -dense.by_row(dense.within.sum(axis=0))])
    own = scales(flight, *TRIADS)
    scale = np.concatenate([state.values[name][:3] for name in TRIADS])
    found = []
    for seed in range(250):
        probe = Probe.draw(model.knots, model.readings.t, model.at, 6, seed=seed)
        found.append(scores(flight, model, state, probe, steps=1)[1][1, own] * scale)
    apart = np.array(found) - expected
    assert (apart.std(axis=0) / np.sqrt(len(apart)) < SHARP * np.abs(expected)).all()
    assert np.abs(over_error(apart)).max() < BY_CHANCE


def test_a_flight_at_the_paper_s_noise_is_unbiased_with_them_and_far_off_without_any_one() -> None:
    t = stamps(40.0)
    flight = Flight.of(t, Motion(Experiment(), np.random.default_rng(1)).rate(t))
    gradient, added, information = biases(flight, 6)
    sd = np.sqrt(np.diagonal(np.linalg.inv(information)))
    scale = scales(flight, *TRIADS)

    def bias(score: Array) -> Array:
        return np.abs(np.linalg.solve(information, score.mean(axis=0)) / sd)[scale]

    whole = gradient + added[:, :2].sum(axis=1)
    assert bias(whole).max() < UNBIASED
    for i, name in enumerate(CORRECTIONS):
        assert bias(whole - added[:, i]).max() > WRONG, name


def test_the_gyroscope_s_score_has_no_mean() -> None:
    t = stamps(4.0)
    flight = Flight.of(t, turning_rates(t, np.random.default_rng(1)))
    own = scales(flight, "gyroscope")
    gradient, added, _ = biases(flight, 30)
    whole = (gradient + added[:, :2].sum(axis=1))[:, own]
    assert np.abs(over_error(whole)).max() < BY_CHANCE
    for i in range(2):
        assert np.abs(over_error(whole - added[:, i, own])).min() > FAR, CORRECTIONS[i]


@pytest.mark.parametrize("strength_mps2", [EVERY_WAY, UP_AND_DOWN], ids=["every way", "up and down"])
def test_the_accelerometer_s_score_has_no_mean_whichever_way_the_translation_goes(strength_mps2: Array) -> None:
    """With a steady gyroscope, whose attitude's error hardly shortens gravity."""
    t = stamps(4.0)
    flight = Flight.of(t, turning_rates(t, np.random.default_rng(1)), gyro_noise=0.1, strength_mps2=strength_mps2)
    own = scales(flight, "accelerometer")
    gradient, added, _ = biases(flight, 20)
    whole = (gradient + added[:, :2].sum(axis=1))[:, own]
    assert np.abs(whole.mean(axis=0)).max() < SECOND_ORDER * np.abs(added[:, 2, own].mean(axis=0)).max()
    assert np.abs(over_error(whole - added[:, 2, own])).min() > FAR
