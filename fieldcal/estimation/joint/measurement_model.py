"""Measurement model of the joint estimator: residuals of the vector triads in logged units and their sensitivities,
added to the normal equations interval by interval.

A row is one sample at which the vector triads are compared; it has r residuals, three for each of them. Rows are worked
on in chunks of whole intervals: `span` is a chunk's slice of the rows, `knot_span` that of the knots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fieldcal import compiled
from fieldcal.estimation.joint import kernel
from fieldcal.estimation.joint.chain_solver import BRIDGE, GRADIENT, SENSORS, Knots, Normal, Probe
from fieldcal.estimation.joint.problem import (
    CROSS,
    OPTIONAL,
    TERMS,
    Model,
    State,
    Trajectory,
    corrected,
    slow_rate,
    turning_at_rows,
)
from fieldcal.geometry.rotation import (
    IDENTITY,
    Array,
    body_from_inertial,
    conjugate,
    from_rotation_vector,
    multiply,
    rotation_steps,
    skew,
    to_rotation_vector,
)

CHUNK_ROWS = 512  # at a time: a few megabytes with all intermediate arrays, what a core holds in its cache
ACCELERATION = slice(3, 6)  # of a knot's translation
SENSED = np.array([0, 1, 2, 6, 7, 8])  # states of a knot in which a reading has a derivative: attitude and acceleration
# The same as pairs of slices: of the states, of SENSED.
BLOCKS = ((slice(0, 3), slice(0, 3)), (slice(6, 9), slice(3, 6)))


def trajectory(model: Model, state: State) -> Trajectory:
    """Integrate the gyroscope from every knot and spread the jump to the next one evenly over the interval."""
    knots, t = model.knots, model.readings.t
    gyro = state.values["gyroscope"]
    rate = gyro[:3] * corrected(model, state.values, "gyroscope") + gyro[3:]
    if (library := compiled.LIBRARY) is not None:
        q, jump = kernel.trajectory(library, model, state, rate)
        return Trajectory(q, rate, jump)
    since, ends = _since_knots(knots, from_rotation_vector(rotation_steps(t, rate)))
    jump = to_rotation_vector(multiply(state.q[1:], conjugate(multiply(state.q[:-1], ends))))
    jump[~knots.joined] = 0.0
    spread = knots.share[:, None] * np.r_[jump, np.zeros((1, 3))][knots.of_sample]
    return Trajectory(multiply(from_rotation_vector(spread), multiply(state.q[knots.of_sample], since)), rate, jump)


def body_jumps(state: State, path: Trajectory) -> Array:
    """The jumps (K−1, 3), rad, about the sensor axes at the start of each interval: the gyroscope's error over it."""
    return np.einsum("kij,kj->ki", body_from_inertial(state.q[:-1]), path.jump)


def _since_knots(knots: Knots, steps: Array) -> tuple[Array, Array]:
    """Rotation (n, 4) since the knot before each sample, and over each interval (K−1, 4), from the steps (n−1, 4)
    between samples: one running product for all intervals side by side."""
    count = np.diff(knots.index)
    step = np.arange(int(count.max()))[:, None]
    by_interval = steps[np.minimum(knots.index[:-1] + step, len(steps) - 1)]  # what is behind an interval is not read
    total = np.empty((len(step) + 1, len(count) + 1, 4))
    total[0] = IDENTITY
    for i in range(len(step)):
        total[i + 1, :-1] = multiply(total[i, :-1], by_interval[i])
    offset = np.arange(len(steps) + 1) - knots.index[knots.of_sample]
    return total[offset, knots.of_sample], total[count, np.arange(len(count))]


@dataclass(frozen=True)
class Rows:
    """A chunk of rows, `span` of all: `residual` (m, r), units of x, and minus its derivatives: `by_knot` (m, r, 6) by
    attitude (3) and acceleration (3), `by_parameter` (m, r, p), `by_rotation` (m, r, 3) by a rotation about the sensor
    axes."""

    span: slice
    residual: Array
    by_knot: Array
    by_parameter: Array
    by_rotation: Array


def lever_arm_geometry(model: Model, state: State, span: slice) -> Array:
    """Acceleration of the sensor about the centre of mass per metre of lever arm, (m, 3, 3): S(ω̇) + S(ω)²."""
    rate, change = turning_at_rows(model, state, span)
    turn = skew(rate)
    return np.asarray(skew(change) + turn @ turn)


def residuals(model: Model, state: State, path: Trajectory) -> Array:
    """Logged minus predicted, (m, r), units of x; 0 where there is no reading."""
    if (library := compiled.LIBRARY) is not None:
        return kernel.residuals(library, model, state, path)
    out = np.empty((len(model.at), 3 * len(model.vectors)))
    for span, _ in chunks(model):
        turn = body_from_inertial(path.q[model.at[span]])
        for i, name in enumerate(model.vectors):
            sensed, _ = _sensed(model, state, path, span, turn, name)
            out[span, 3 * i : 3 * i + 3] = _residual(model, state, span, name, sensed)
    return out


def _sensed(model: Model, state: State, path: Trajectory, span: slice, turn: Array, name: str) -> tuple[Array, Array]:
    """Prediction for a triad, SI, sensor axes (m, 3), and the sensed vector in inertial axes, (m, 3) or (3,)."""
    sensed, vector = _sensed_at_once(model, state, span, turn, name)
    delay = state.values.get(f"{name}_delay")
    if delay is not None:
        turned = from_rotation_vector(-delay * slow_rate(model, path, span))
        sensed = np.einsum("nij,nj->ni", body_from_inertial(turned), sensed)
    return sensed, vector


def _sensed_at_once(model: Model, state: State, span: slice, turn: Array, name: str) -> tuple[Array, Array]:
    """`_sensed` of a triad without a delay."""
    if name == "magnetometer":
        vector = model.field(float(state.values["dip"][0]))[0]
        return np.einsum("nij,j->ni", turn, vector), vector
    sign, g = np.sign(model.readings.gravity_mps2), abs(model.readings.gravity_mps2)
    vector = sign * (np.array([0.0, 0.0, g]) - translation(model, state, span))
    sensed = np.einsum("nij,nj->ni", turn, vector)
    arm = state.values["lever_arm"]
    if arm.any():
        sensed = sensed - sign * np.einsum("nij,j->ni", lever_arm_geometry(model, state, span), arm)
    return sensed, vector


def translation(model: Model, state: State, span: slice = slice(None)) -> Array:
    """Acceleration of the centre of mass, inertial axes, m/s² (m, 3), linear between knots."""
    at = model.at[span]
    k, share = model.knots.of_sample[at], model.knots.share[at, None]
    a = state.motion[:, ACCELERATION]
    return np.asarray((1.0 - share) * a[k] + share * a[np.minimum(k + 1, len(a) - 1)])


def _residual(model: Model, state: State, span: slice, name: str, sensed: Array) -> Array:
    triad, constants = model.triads[name], state.values[name]
    x = corrected(model, state.values, name, span)
    return np.where(triad.valid[span, None], x - (sensed - constants[3:]) / constants[:3], 0.0)


def chunks(model: Model) -> Iterator[tuple[slice, slice]]:
    """(span, knot_span) of chunks of whole intervals, so that sensitivities of an hour fit in memory."""
    starts = np.searchsorted(model.at, model.knots.index)  # first row of each interval
    first = 0
    while first < len(starts):
        last = int(np.searchsorted(starts, starts[first] + CHUNK_ROWS))
        if last == len(starts) or starts[last] == len(model.at):  # knots after the last row go with it
            last = len(starts)
        end = len(model.at) if last == len(starts) else int(starts[last])
        yield slice(int(starts[first]), end), slice(first, last)
        first = last


def sensitivities(
    model: Model, state: State, path: Trajectory, layout: Mapping[str, slice], parameters: int
) -> Iterator[tuple[slice, Rows, Array]]:
    """Chunk by chunk: knot_span, rows, and ∂(integrated attitude at the end of each interval)/∂θ (knots, 3, p)."""
    for span, knot_span in chunks(model):
        turn = body_from_inertial(path.q[model.at[span]])
        moved, ends = _turned_by_gyroscope(model, state, path, span, knot_span, layout)
        by_gyroscope = slice(0, moved.shape[2])
        m, r = span.stop - span.start, 3 * len(model.vectors)
        residual, by_knot, by_parameter = np.empty((m, r)), np.zeros((m, r, 6)), np.zeros((m, r, parameters))
        for i, name in enumerate(model.vectors):
            row = slice(3 * i, 3 * i + 3)
            constants, valid = state.values[name], model.triads[name].valid[span].astype(float)
            sensed, vector = _sensed(model, state, path, span, turn, name)
            residual[:, row] = _residual(model, state, span, name, sensed)
            gain = valid[:, None, None] / constants[:3, None]
            by_knot[:, row, :3] = gain * (turn @ skew(vector))
            by_parameter[:, row, by_gyroscope] = by_knot[:, row, :3] @ moved
            column = layout[name].start
            # Translation and the lever arm's part are noise to the scale, and a noisy regressor would bias it: gravity
            # alone determines it.
            steady = sensed
            if name == "accelerometer":
                steady = model.readings.gravity_mps2 * turn[:, :, 2]
            for axis in range(3):
                scaled = (steady[:, axis] - constants[3 + axis]) / constants[axis]
                by_parameter[:, 3 * i + axis, column + axis] = -valid * scaled / constants[axis]
                by_parameter[:, 3 * i + axis, column + 3 + axis] = -valid / constants[axis]
            if f"{name}_cross" in layout:
                first = layout[f"{name}_cross"].start
                for k, (axis, other) in enumerate(CROSS[name]):
                    by_parameter[:, 3 * i + axis, first + k] = -valid * model.triads[name].x[span, other]
            if f"{name}_delay" in layout:
                late = np.cross(slow_rate(model, path, span), sensed)
                by_parameter[:, row, layout[f"{name}_delay"]] = (gain[..., 0] * late)[..., None]
            if name == "magnetometer" and "dip" in layout:
                turned = model.field(float(state.values["dip"][0]))[1]
                by_parameter[:, row, layout["dip"]] = gain * (turn @ turned)[..., None]
            if name == "accelerometer":
                sign = np.sign(model.readings.gravity_mps2)
                by_knot[:, row, 3:] = -sign * gain * turn
                if "lever_arm" in layout:
                    by_parameter[:, row, layout["lever_arm"]] = -sign * gain * lever_arm_geometry(model, state, span)
        end = np.zeros((knot_span.stop - knot_span.start, 3, parameters))
        end[:, :, by_gyroscope] = ends
        yield knot_span, Rows(span, residual, by_knot, by_parameter, by_knot[..., :3] @ turn.transpose(0, 2, 1)), end


def _turned_by_gyroscope(
    model: Model, state: State, path: Trajectory, span: slice, knot_span: slice, layout: Mapping[str, slice]
) -> tuple[Array, Array]:
    """∂(attitude error)/∂(λ', b', optional terms) of the gyroscope: at the rows (m, 3, g), less the share of the jump
    that has passed there, and at the ends of the chunk's intervals (knots, 3, g).

    ∫ R_nb [diag x, I, …] dτ from the knot before, trapezoidal."""
    knots, t = model.knots, model.readings.t
    first = int(knots.index[knot_span.start])
    last = int(
        knots.index[min(knot_span.stop, len(knots.index) - 1)]
    )  # the last interval ends at the next chunk's knot
    reach = slice(first, last + 1)
    scale = state.values["gyroscope"][:3]
    r_nb = body_from_inertial(path.q[reach]).transpose(2, 1, 0)
    optional = [name for name in layout if name.startswith("gyroscope_")]
    integrand = np.empty((3, 6 + sum(TERMS[name] for name in optional), r_nb.shape[2]))  # samples last: contiguous
    np.multiply(r_nb, corrected(model, state.values, "gyroscope", reach).T, out=integrand[:, :3])
    integrand[:, 3:6] = r_nb
    if "gyroscope_cross" in layout:
        at, x = layout["gyroscope_cross"].start, model.triads["gyroscope"].x[reach].T
        for k, (axis, other) in enumerate(CROSS["gyroscope"]):
            integrand[:, at + k] = r_nb[:, axis] * (scale[axis] * x[other])
    if "gyroscope_temperature" in layout and model.readings.warmth is not None:
        integrand[:, layout["gyroscope_temperature"]] = r_nb * (scale[:, None] * model.readings.warmth[reach])
    if "gyroscope_g_sensitivity" in layout and model.readings.force is not None:
        at, force = layout["gyroscope_g_sensitivity"].start, model.readings.force[reach].T
        for axis in range(3):
            for other in range(3):
                integrand[:, at + 3 * axis + other] = r_nb[:, axis] * (scale[axis] * force[other])
    area = integrand[..., 1:] + integrand[..., :-1]
    area *= 0.5 * np.diff(t[reach])
    total = np.zeros_like(integrand)
    np.cumsum(area, axis=2, out=total[..., 1:])
    at_knots = total[..., knots.index[knot_span] - first]
    following = np.r_[knots.index[knot_span][1:] - first, r_nb.shape[2] - 1]
    ends = total[..., following] - at_knots
    ends[..., ~np.r_[knots.joined, False][knot_span]] = 0.0
    at = model.at[span]
    k = knots.of_sample[at] - knot_span.start
    moved = total[..., at - first] - at_knots[..., k] - knots.share[at] * ends[..., k]
    return np.ascontiguousarray(moved.transpose(2, 0, 1)), ends.transpose(2, 0, 1)


def accumulate(
    normal: Normal, model: Model, rows: Rows, knot_span: slice, weight: Array, probe: Probe, groups: tuple[Array, Array]
) -> None:
    """Add a chunk's rows, whitened by `weight` (m, r) = 1/σ² including robust weights, to the normal equations.

    `groups` ((K, 6, 2r + 3), (p + 1, 2r + 3)) collect the right-hand sides of the probes, by knot and by parameter: of
    each residual's signs (r); of gyroscope noise within an interval, all residuals together by body axis (3) and each
    residual (r). The last line holds, for the noise within an interval, products of the whitened probe: of a residual
    with itself, of an axis with all axes."""
    p, (m, r) = len(normal.parameters), weight.shape
    root = np.sqrt(weight)
    share = model.knots.share[model.at[rows.span], None, None]
    # Columns, all whitened: derivatives by the knot before and after, by the parameters; residual; attitude error by
    # gyroscope noise about the three axes; probe of the residual's signs, and that of gyroscope noise.
    columns = np.empty((m + 1, r, 6 + 6 + p + 1 + 3 + 2))
    columns[m] = 0.0  # a row of zeros, to fill shorter intervals with
    before, after, others, probes_of_row = np.split(columns[:m], [6, 12, 16 + p], axis=2)
    np.multiply(rows.by_knot, root[..., None], out=before)
    np.multiply(before, share, out=after)
    before -= after
    np.multiply(rows.by_parameter, root[..., None], out=others[..., :p])
    np.multiply(rows.residual, root, out=others[..., p])
    np.multiply(rows.by_rotation * root[..., None], probe.bridge[rows.span, None], out=others[..., p + 1 :])
    probes_of_row[..., 0] = probe.sensors[rows.span]
    np.sum(others[..., p + 1 :], axis=2, out=probes_of_row[..., 1])
    by_interval = np.take(columns, _padded(model, rows.span, knot_span), axis=0)  # (knots, most rows, r, 18 + p)
    by_row = by_interval.transpose(0, 2, 3, 1)
    alone, together = (by_row[:, :, :12] @ by_row[:, :, 16 + p :].transpose(0, 1, 3, 2)).transpose(3, 0, 2, 1)
    by_interval = by_interval.reshape(len(by_interval), by_interval.shape[1] * r, 18 + p)
    product = by_interval[..., :12].transpose(0, 2, 1) @ by_interval[..., : 16 + p]  # (knots, 12, 16 + p)
    flat = columns[:m].reshape(m * r, columns.shape[2])[:, 12 : 16 + p]
    total = flat.T @ flat
    by_signs = (others[..., :p].transpose(1, 2, 0) @ probes_of_row[..., :1].transpose(1, 0, 2))[..., 0].T
    normal.parameters += total[:p, :p]
    normal.parameters_right[:, GRADIENT] += total[:p, p]
    normal.parameters_right[:, SENSORS] += by_signs.sum(axis=1)
    normal.parameters_right[:, BRIDGE] += total[:p, p + 1 :].sum(axis=1)
    groups[1][:p, :r] += by_signs
    groups[1][p, r:] += np.r_[total[p + 1 :, p + 1 :].sum(axis=1), np.sum(probes_of_row[..., 1] ** 2, axis=0)]
    probed = np.concatenate([alone, product[:, :, 13 + p :], together], axis=2)
    # Blocks of the chain: the rows of an interval have derivatives by the knot before it and, where there is one, after
    # it.
    last = min(knot_span.stop, len(normal.diagonal) - 1)
    inside, following = slice(0, last - knot_span.start), slice(knot_span.start + 1, last + 1)
    for knot, part, here in ((knot_span, slice(0, 6), slice(None)), (following, slice(6, 12), inside)):
        groups[0][knot] += probed[here, part]
        probes = np.stack([probed[here, part, :r].sum(axis=2), probed[here, part, r : r + 3].sum(axis=2)], axis=2)
        for state, state_part in BLOCKS:
            normal.right[knot, state, : p + 1] += product[here, part, 12 : 13 + p][:, state_part]
            normal.right[knot, state, p + SENSORS] += probes[:, state_part, 0]
            normal.right[knot, state, p + BRIDGE] += probes[:, state_part, 1]
            for other, other_part in BLOCKS:
                block = slice(part.start + other_part.start, part.start + other_part.stop)
                normal.diagonal[knot, state, other] += product[here, part, block][:, state_part]
    for state, state_part in BLOCKS:
        for other, other_part in BLOCKS:
            rows_after = slice(6 + state_part.start, 6 + state_part.stop)
            normal.below[knot_span.start : last, state, other] += product[inside, rows_after, other_part]


def _padded(model: Model, span: slice, knot_span: slice) -> np.ndarray:
    """Index of the rows of each of a chunk's intervals, (knots, largest number of rows); intervals with fewer rows are
    filled up with the index one past the last row."""
    starts = np.searchsorted(model.at[span], model.knots.index[knot_span])
    counts = np.diff(np.r_[starts, span.stop - span.start])
    step = np.arange(max(int(counts.max()), 1))
    return np.where(step < counts[:, None], starts[:, None] + step, span.stop - span.start)


def sums_by_interval(model: Model, x: Array, span: slice, knot_span: slice) -> Array:
    """Sums of x (m, c) over the rows of each of a chunk's intervals, (knots, c)."""
    starts = np.searchsorted(model.at[span], model.knots.index[knot_span])
    some = np.diff(np.r_[starts, len(x)]) > 0
    sums = np.zeros((len(starts), x.shape[1]))
    sums[some] = np.add.reduceat(x, starts[some], axis=0)
    return sums


def layout_of(model: Model, values: Mapping[str, Array], *, dip: bool, lever_arm: bool) -> tuple[dict[str, slice], int]:
    """Slice of each free parameter in θ, and the length of θ: optional terms where `values` has them."""
    layout, at = {}, 0
    optional = [name for name in OPTIONAL if name in values]
    by_gyroscope = [name for name in optional if name.startswith("gyroscope_")]  # one block, at the front
    free = ["gyroscope", *by_gyroscope, *model.vectors]
    if dip and len(model.vectors) == 2:
        free.append("dip")
    if lever_arm and "accelerometer" in model.vectors:
        free.append("lever_arm")
    free += [name for name in optional if name not in free]
    for name in free:
        size = {"dip": 1, "lever_arm": 3, **OPTIONAL}.get(name, 6)
        layout[name] = slice(at, at + size)
        at += size
    return layout, at
