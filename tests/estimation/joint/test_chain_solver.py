"""The chain of knots against matrices written out: its solution, its normal equations, its noise, its probes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import expm
from small_record import Small, small
from test_measurement_model import dense
from test_score_corrections import process

from fieldcal.errors import EstimationError
from fieldcal.estimation.joint import chain_solver, measurement_model
from fieldcal.estimation.joint.chain_solver import (
    BRIDGE,
    GRADIENT,
    JUMP,
    MOTION,
    MOTION_HZ,
    SENSORS,
    Joints,
    Normal,
    Probe,
    add_joints,
    chain_solve,
    joint_squares,
    place_knots,
    solve_scaled,
    whitened_joints,
    whitened_motion,
)
from fieldcal.estimation.joint.fit import linearised
from fieldcal.estimation.joint.measurement_model import layout_of, sensitivities, trajectory
from fieldcal.geometry.rotation import Array

ROUNDING = 1e-8  # relative, of solutions of some hundred equations
PRIOR_PER_RAD2 = 1e-2
SHARP = 0.06  # four standard errors of a variance over some ten thousand signs

pytestmark = pytest.mark.usefixtures("either_kernel")


def blocks(k: int, m: int, columns: int, seed: int = 1) -> tuple[Array, Array, Array, Array]:
    """Diagonal and lower blocks and right-hand sides of a positive chain, and the whole matrix."""
    rng = np.random.default_rng(seed)
    below = rng.normal(size=(k - 1, m, m))
    diagonal = rng.normal(size=(k, m, m))
    diagonal = diagonal @ diagonal.transpose(0, 2, 1) + 10.0 * m * np.eye(m)
    whole = np.zeros((k * m, k * m))
    for i in range(k):
        whole[i * m : i * m + m, i * m : i * m + m] = diagonal[i]
        if i:
            whole[i * m : i * m + m, i * m - m : i * m] = below[i - 1]
            whole[i * m - m : i * m, i * m : i * m + m] = below[i - 1].T
    return diagonal, below, rng.normal(size=(k, m, columns)), whole


@pytest.mark.parametrize("at_once", [1, 2, 3, 128])
def test_a_chain_is_solved_as_its_matrix_is(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chain_solver, "KNOTS_AT_ONCE", at_once)
    for k in range(1, 18):
        diagonal, below, right, whole = blocks(k, 3, 2, seed=k)
        expected = np.linalg.solve(whole, right.reshape(-1, 2)).reshape(right.shape)
        np.testing.assert_allclose(chain_solve(diagonal, below, right), expected, atol=1e-12)


def test_a_chain_that_is_not_positive_is_refused() -> None:
    diagonal, below, right, _ = blocks(5, 3, 2)
    diagonal[3, 0, 0] = -1.0
    with pytest.raises(EstimationError) as error:
        chain_solve(diagonal, below, right)
    assert error.value.reason_code == "joint_singular"


def test_knots_are_eliminated_by_the_schur_complement() -> None:
    k, p = 6, 4
    diagonal, below, _, _ = blocks(k, 12, 1)
    rng = np.random.default_rng(2)
    normal = Normal.empty(k, p, 3)
    assert [x.shape for x in vars(normal).values()] == [(6, 12, 12), (5, 12, 12), (6, 12, 7), (4, 4), (4, 3)]
    assert not any(x.any() for x in vars(normal).values())
    right, outer = rng.normal(size=(k, 12, p + 3)), 1e3 * np.eye(p) + rng.normal(size=(p, p))
    outer = outer + outer.T
    normal = Normal(diagonal, below, right, outer, rng.normal(size=(p, 3)))
    found = normal.eliminate()
    eliminated, information, gradient = found.solved(slice(None)), found.information, found.gradient
    whole = blocks(k, 12, 1)[3]
    flat = right.reshape(-1, p + 3)
    solved = np.linalg.solve(whole, flat)
    np.testing.assert_allclose(eliminated.reshape(-1, p + 3), solved, atol=1e-12)
    np.testing.assert_allclose(information, outer - flat[:, :p].T @ solved[:, :p], rtol=1e-9)
    np.testing.assert_allclose(gradient, normal.parameters_right - flat[:, :p].T @ solved[:, p:], rtol=1e-9)
    assert (information == information.T).all()


def test_directions_without_information_do_not_move() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3)) * [1.0, 1e6, 1e-6]
    information, gradient = root.T @ root, rng.normal(size=(3, 2)) * np.array([[1.0], [1e6], [1e-6]])
    np.testing.assert_allclose(solve_scaled(information, gradient), np.linalg.inv(information) @ gradient, rtol=1e-6)
    wide = np.zeros((4, 4))
    wide[:3, :3] = information
    found = solve_scaled(wide, np.vstack([gradient, np.zeros((1, 2))]))
    np.testing.assert_allclose(found[:3], np.linalg.inv(information) @ gradient, rtol=1e-6)
    assert not found[3].any()


@pytest.mark.parametrize("spacing_s", [0.08, 0.25, 3.0])
def test_knots_cut_every_segment_into_equal_parts(spacing_s: float) -> None:
    """Stamps in sixty-fourths of a second, two segments a second apart, the second of one sample alone."""
    tick = 1.0 / 64.0
    t = tick * np.r_[np.arange(65), 65 + 64 + np.arange(33), 400.0]
    segment = np.repeat([0, 1, 2], [65, 33, 1])
    knots = place_knots(t, segment, spacing_s)
    parts = [max(1, int(np.ceil(length / spacing_s))) for length in (1.0, 0.5)]
    assert [int((segment[knots.index] == s).sum()) for s in (0, 1, 2)] == [parts[0] + 1, parts[1] + 1, 1]
    assert {0, 64, 65, 97, 98} <= set(knots.index.tolist())
    assert knots.joined.tolist() == [
        segment[a] == segment[b] for a, b in zip(knots.index, knots.index[1:], strict=False)
    ]
    step = np.diff(t[knots.index])
    assert knots.interval_s.tolist() == np.where(knots.joined, step, 1.0).tolist()
    for s, n in zip((0, 1), parts, strict=True):
        own = step[knots.joined & (segment[knots.index[1:]] == s)]
        assert np.abs(own - (1.0, 0.5)[s] / n).max() <= tick  # equal but for a sample
    for s, n, begin, samples in ((0, parts[0], 0, 64), (1, parts[1], 65, 32)):
        own = knots.index[segment[knots.index] == s]
        assert own.tolist() == [begin + -(-samples * i // n) for i in range(n + 1)]  # the sample at an edge or after it
    assert knots.sample_s == tick
    for i, (knot, share) in enumerate(zip(knots.of_sample, knots.share, strict=True)):
        assert knots.index[knot] <= i
        assert knot == len(knots.index) - 1 or knots.index[knot + 1] > i
        length = t[knots.index[knot + 1]] - t[knots.index[knot]] if knot + 1 < len(knots.index) else 1.0
        length = length if knot + 1 < len(knots.index) and knots.joined[knot] else 1.0
        assert share == (t[i] - t[knots.index[knot]]) / length


def test_the_translation_is_three_low_passes_that_peak_at_their_frequency() -> None:
    """Its whitener makes unit noise of y_{k+1} − F y_k, by transition and stationary covariance written out; the
    acceleration's density ω²/(ω² + ω0²)³ peaks at 0.7 Hz."""
    rate, stationary = process()
    omega0 = rate[0, 1]
    f = np.linspace(0.1, 3.0, 29001)
    density = (2.0 * np.pi * f) ** 2 / ((2.0 * np.pi * f) ** 2 + omega0**2) ** 3
    assert f[np.argmax(density)] == pytest.approx(0.7, abs=1e-3)
    assert MOTION_HZ == 0.7
    at_quarter = np.interp([0.175, 2.8], f, density) / density.max()
    assert (at_quarter < 0.2).all()
    t = np.cumsum(np.r_[0.0, np.full(8, 0.0102), np.full(8, 0.0402)])
    motion = place_knots(t, np.zeros(17, dtype=np.int64), 0.01).motion
    for k, length in enumerate(np.diff(t)):
        transition = expm(rate * round(length, 3))
        noise = stationary - transition @ stationary @ transition.T
        whitener = motion.whitener[k]
        np.testing.assert_allclose(whitener @ noise @ whitener.T, np.eye(3), atol=1e-5)
        np.testing.assert_allclose(motion.whitened_transition[k], whitener @ transition, rtol=1e-6, atol=1e-6)
    fast = place_knots(t * 0.02, np.zeros(17, dtype=np.int64), 0.0001).motion
    transition = expm(rate * 1e-3)  # what is faster is taken for a millisecond
    np.testing.assert_allclose(fast.whitened_transition[0], fast.whitener[0] @ transition, rtol=1e-6, atol=1e-6)
    start = motion.start_whitener
    np.testing.assert_allclose(start @ stationary @ start.T, np.eye(3), atol=1e-9)


@dataclass(frozen=True)
class Whole:
    """Everything as one matrix: whitened derivatives of rows, jumps and translation by (12 K + p) unknowns, their
    whitened residuals, the probes' signs, and which is which."""

    flight: Small
    rows: Array
    jumps: Array
    process: Array
    residual: tuple[Array, Array, Array]
    signs: tuple[Array, Array, Array]
    joints: Joints
    probe: Probe
    weight: Array
    p: int

    @property
    def jacobian(self) -> Array:
        return np.vstack([self.rows, self.jumps, self.process])

    @property
    def normal(self) -> Array:
        return self.jacobian.T @ self.jacobian + np.diag(self.prior)

    @property
    def prior(self) -> Array:
        k = len(self.flight.model.knots.index)
        return np.r_[np.tile(np.r_[np.full(3, PRIOR_PER_RAD2), np.zeros(9)], k), np.zeros(self.p)]


def whole(flight: Small, *, seed: int = 3) -> Whole:
    """Of the record at a state that is off, with weights of which some are none."""
    model, levels = flight.model, flight.levels
    rng = np.random.default_rng(seed)
    k, m, r = len(model.knots.index), len(model.at), 3 * len(model.vectors)
    off = np.hstack([1e-3 * rng.normal(size=(k, 3)), np.zeros((k, 9))])
    state = flight.state.moved(off, np.zeros(0), {})
    flight = replace(flight, state=state)
    by_knot, by_parameter, ends, _ = dense(flight)
    p = by_parameter.shape[2]
    weight = rng.uniform(0.2, 1.0, size=(m, r)) * model.valid_rows().repeat(3, axis=1)
    path = trajectory(model, state)
    root = np.sqrt(weight / (levels.variance * levels.colour))
    rows = np.zeros((m, r, 12 * k + p))
    for knot in range(k):
        rows[..., 12 * knot : 12 * knot + 3] = by_knot[:, :, knot, :3]
        rows[..., 12 * knot + 6 : 12 * knot + 9] = by_knot[:, :, knot, 3:]
    rows[..., 12 * k :] = by_parameter
    rows *= root[..., None]
    left = measurement_model.residuals(model, state, path) * root
    joints = Joints(path.jump, ends[:-1], levels.walk, state.motion, levels.strength)
    probe = Probe.draw(model.knots, model.readings.t, model.at, r, seed=seed)
    jumps, jumped, jump_signs = [], [], []
    steps, stepped, step_signs = [], [], []
    rate, stationary = process()

    def step(derivative: Array, residual: Array, signs: Array) -> None:
        steps.append(derivative)
        stepped.append(residual)
        step_signs.append(signs)

    y = state.motion.reshape(k, 3, 3)
    for i in range(k):
        begins = i == 0 or not model.knots.joined[i - 1]
        if begins:
            whitener = np.linalg.inv(np.linalg.cholesky(stationary)) / levels.strength
        else:
            length = float(model.knots.interval_s[i - 1])
            by = np.zeros((3, 12 * k + p))
            by[:, 12 * i : 12 * i + 3], by[:, 12 * i - 12 : 12 * i - 9] = np.eye(3), -np.eye(3)
            by[:, 12 * k :] = -ends[i - 1]
            sd = np.sqrt(levels.walk * length)
            jumps.append(by / sd)
            jumped.append(-path.jump[i - 1] / sd)
            jump_signs.append(probe.jump[i - 1])
            transition = expm(rate * round(length, 3))
            noise = stationary - transition @ stationary @ transition.T
            whitener = np.linalg.inv(np.linalg.cholesky(noise)) / levels.strength
        for axis in range(3):
            own = slice(12 * i + 3 + axis, 12 * i + 12, 3)
            by = np.zeros((3, 12 * k + p))
            by[:, own] = whitener
            if begins:
                step(by, -whitener @ y[i, :, axis], probe.start[i, :, axis])
            else:
                before = slice(own.start - 12, own.stop - 12, 3)
                by[:, before] = -whitener @ transition
                step(by, -whitener @ (y[i, :, axis] - transition @ y[i - 1, :, axis]), probe.motion[i - 1, :, axis])
    signs = probe.sensors * (weight > 0.0)
    return Whole(
        flight, rows.reshape(m * r, 12 * k + p), np.vstack(jumps), np.vstack(steps),
        (left.ravel(), np.concatenate(jumped), np.concatenate(stepped)),
        (signs.ravel(), np.concatenate(jump_signs), np.concatenate(step_signs)), joints, probe, weight, p,
    )  # fmt: skip


def assembled(normal: Normal) -> tuple[Array, Array]:
    """The normal equations' matrix and right-hand sides."""
    k, s, p = len(normal.diagonal), normal.diagonal.shape[1], len(normal.parameters)
    out = np.zeros((k * s + p, k * s + p))
    for i in range(k):
        out[i * s : i * s + s, i * s : i * s + s] = normal.diagonal[i]
        if i:
            out[i * s : i * s + s, i * s - s : i * s] = normal.below[i - 1]
            out[i * s - s : i * s, i * s : i * s + s] = normal.below[i - 1].T
    flat = normal.right.reshape(k * s, -1)
    out[: k * s, k * s :], out[k * s :, : k * s] = flat[:, :p], flat[:, :p].T
    out[k * s :, k * s :] = normal.parameters
    return out, np.vstack([flat[:, p:], normal.parameters_right])


def alike(found: Array, expected: Array, what: str = "") -> None:
    np.testing.assert_allclose(found, expected, atol=ROUNDING * max(1.0, float(np.abs(expected).max())), err_msg=what)


FLIGHTS = {
    "both": {},
    "accelerometer alone, other sign": {"vectors": ("accelerometer",), "sign": -1.0},
    "coarse": {"rate_hz": 30.0, "spacing_s": 0.05, "missing": False},
    "none": {"vectors": ()},
}


@pytest.mark.parametrize("chunk_rows", [512, 20])
@pytest.mark.parametrize("name", FLIGHTS)
def test_normal_equations_and_probes_are_those_of_the_whole_matrix(
    name: str, chunk_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measurement_model, "CHUNK_ROWS", chunk_rows)
    w = whole(small(**FLIGHTS[name]))
    flight, probe = w.flight, w.probe
    model, state = flight.model, flight.state
    layout, p = layout_of(model, state.values, dip=True, lever_arm=True)
    path = trajectory(model, state)
    normal, joints, reaction = linearised(model, state, path, layout, p, w.weight, flight.levels, probe, None)
    matrix, right = assembled(normal)
    alike(matrix, w.normal)
    alike(right[:, GRADIENT], w.jacobian.T @ np.concatenate(w.residual), "gradient")
    for column, by, signs in (
        (SENSORS, w.rows, w.signs[0]),
        (JUMP, w.jumps, w.signs[1]),
        (MOTION, w.process, w.signs[2]),
    ):
        alike(right[:, column], by.T @ signs, str(column))
    alike(joints.moved, w.joints.moved)
    # Gyroscope noise within intervals: what it does to every whitened row, about each body axis.
    m, r, k = len(model.at), 3 * len(model.vectors), len(model.knots.index)
    noise = np.zeros((m, r, 3))
    root = np.sqrt(w.weight / (flight.levels.variance * flight.levels.colour))
    for _, rows, _ in sensitivities(model, state, path, layout, p):
        noise[rows.span] = rows.by_rotation * (root[rows.span][..., None] * probe.bridge[rows.span][:, None])
    flat = noise.reshape(-1, 3)
    alike(right[:, BRIDGE], w.rows.T @ flat.sum(axis=1), "bridge")
    # Reactions: by each residual's signs, by each axis' noise, by the noise in each residual.
    at_knots, at_parameters = reaction
    by = w.rows.reshape(m, r, 12 * k + p)
    signs = w.signs[0].reshape(m, r)
    expected = [by[:, i].T @ signs[:, i] for i in range(r)]
    expected += [w.rows.T @ flat[:, i] for i in range(3)]
    expected += [by[:, i].T @ noise[:, i].sum(axis=1) for i in range(r)]
    for i, column in enumerate(expected):
        knots = column[: 12 * k].reshape(k, 12)[:, [0, 1, 2, 6, 7, 8]]
        alike(at_knots[..., i], knots, f"reaction {i}")
        if i < r:
            alike(at_parameters[:p, i], column[12 * k :], f"reaction {i}")
    own = np.r_[np.zeros(r), [flat[:, i] @ flat.sum(axis=1) for i in range(3)], np.sum(noise.sum(axis=2) ** 2, axis=0)]
    alike(at_parameters[p], own)


@pytest.mark.parametrize("name", ["both", "coarse"])
def test_squares_expectations_and_information_are_traces_of_the_whole_matrix(name: str) -> None:
    """For jumps and for translation: the sum of squares, zᵀMz and ‖Mz‖² for M = I − A N⁻¹Aᵀ of the group's rows A."""
    w = whole(small(**FLIGHTS[name]))
    model = w.flight.model
    k, p = len(model.knots.index), w.p
    strong = w.normal + np.diag(np.r_[np.zeros(12 * k), np.ones(p)])  # as a prior does
    columns = np.zeros((12 * k + p, 5))
    groups = ((w.jumps, w.signs[1], w.residual[1]), (w.process, w.signs[2], w.residual[2]))
    for column, (by, signs, _) in zip((JUMP, MOTION), groups, strict=True):
        columns[:, column] = np.linalg.solve(strong, by.T @ signs)
    found = joint_squares(model.knots, w.joints, columns[: 12 * k].reshape(k, 12, 5), columns[12 * k :], w.probe)
    for row, (by, signs, residual) in zip(found, groups, strict=True):
        left = signs - by @ np.linalg.solve(strong, by.T @ signs)
        np.testing.assert_allclose(row, [residual @ residual, signs @ left, left @ left], rtol=1e-6)


def test_whitened_joints_are_the_residuals_of_jumps_and_steps() -> None:
    w = whole(small())
    model = w.flight.model
    k = len(model.knots.index)
    found = whitened_motion(model.knots, w.joints.strength, w.joints.motion)
    order = w.residual[2].reshape(k, 3, 3).transpose(0, 2, 1).reshape(k, 9)  # by axis there, by order here
    alike(found, -order)
    links = whitened_joints(model.knots, w.joints)
    np.testing.assert_allclose(links[:, 3:], found[1:], rtol=1e-12)
    np.testing.assert_allclose(links[model.knots.joined, :3].ravel(), -w.residual[1], rtol=1e-12)
    assert not links[~model.knots.joined, :3].any()
    stacked = np.stack([w.joints.motion, 2.0 * w.joints.motion], axis=2)
    both = whitened_motion(model.knots, w.joints.strength, stacked)
    np.testing.assert_allclose(both[..., 0], found, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(both[..., 1], 2.0 * found, rtol=1e-9, atol=1e-12)


def test_probes_are_signs_and_bridges_between_the_knots() -> None:
    """A random walk of unit density, tied down at both ends of every interval."""
    n, step_s = 40_002, 1.0 / 128.0
    t, segment = np.arange(n) * step_s, (np.arange(n) >= 20_001).astype(np.int64)
    knots = place_knots(t, segment, 10.0 * step_s)
    at = np.arange(1, n - 1)
    probe = Probe.draw(knots, t, at, 6)
    assert probe.sensors.shape == (len(at), 6)
    k = len(knots.index)
    assert [x.shape for x in (probe.jump, probe.motion, probe.start)] == [(k - 1, 3), (k - 1, 3, 3), (k, 3, 3)]
    for signs in (probe.sensors, probe.jump, probe.motion, probe.start):
        assert set(np.unique(signs)) == {-1.0, 1.0}
        assert abs(signs.mean()) < 4.0 / np.sqrt(signs.size)
    inside = knots.joined[np.minimum(knots.of_sample[at], k - 2)]
    for place in range(10):
        own = probe.bridge[inside & ((at - knots.index[knots.of_sample[at]]) == place)]
        share = place / 10.0
        # By trapezoids: half of the noise at either end of the walk, and of that where it stands.
        walked = np.r_[0.5, np.ones(place - 1), 0.5, np.zeros(10 - place)] if place else np.zeros(11)
        whole = np.r_[0.5, np.ones(9), 0.5]
        expected = step_s * np.sum((walked - share * whole) ** 2)
        assert np.mean(own**2) == pytest.approx(expected, rel=SHARP, abs=1e-20), place
    assert not probe.bridge[~inside].any()
    other = Probe.draw(knots, t, at, 6, seed=1)
    assert (other.jump != probe.jump).any()
    assert (Probe.draw(knots, t, at, 6, seed=0).jump == probe.jump).all()


def test_a_bridge_is_none_where_all_the_time_of_an_interval_has_passed_or_none() -> None:
    """In every interval the sixth step is long and the others take no time: before it and after it the walk stands
    where a knot does. In the last interval too."""
    step = np.tile(np.where(np.arange(10) == 5, 1.0, 1e-9), 30)
    t = np.concatenate([[0.0], np.cumsum(step)])
    every = place_knots(np.arange(301.0), np.zeros(301, dtype=np.int64), 10.0)
    share = (t - t[every.index[every.of_sample]]) / np.r_[np.full(30, 1.0 + 9e-9), 1.0][every.of_sample]
    probe = Probe.draw(replace(every, share=share), t, np.arange(301), 3)
    assert np.abs(probe.bridge).max() < 1e-3


def test_an_attitude_that_nothing_tells_is_known_to_ten_radians() -> None:
    flight = small()
    knots = flight.model.knots
    k = len(knots.index)
    normal, probe = Normal.empty(k, 2, 5), Probe.draw(knots, flight.model.readings.t, flight.model.at, 6)
    joints = Joints(np.zeros((k - 1, 3)), np.zeros((k - 1, 3, 2)), 1e12, np.zeros((k, 9)), 1e12)
    add_joints(normal, knots, joints, probe)
    np.testing.assert_allclose(normal.diagonal[:, :3, :3], np.tile(np.eye(3) / 10.0**2, (k, 1, 1)), atol=1e-8)
