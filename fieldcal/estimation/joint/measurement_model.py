"""What the joint estimator expects of the sensors: residuals in logged units and their sensitivities, interval by
interval (see `joint` for the whole)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fieldcal.estimation.joint.chain_solver import BRIDGE, GRADIENT, SENSORS, Knots, Normal, Probe
from fieldcal.estimation.joint.problem import CROSS, OPTIONAL, TERMS, Model, State, corrected
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

CHUNK_ROWS = 512  # a few megabytes with all that is made of them: what a core holds in its cache
RATE_SIDE_S = 0.03
ACCELERATION = slice(3, 6)  # of a knot's translation
SENSED = np.array([0, 1, 2, 6, 7, 8])  # of a knot's states: attitude and acceleration
BLOCKS = ((slice(0, 3), slice(0, 3)), (slice(6, 9), slice(3, 6)))  # the same by slices: of the states, of SENSED


@dataclass(frozen=True)
class Trajectory:
    """The record under a state: attitude `q` (n, 4) of the sensor axes and `rate` (n, 3), rad/s, as the gyroscope says;
    `jump` (K−1, 3) at the joints, rad, inertial axes, already spread over the intervals in q."""

    q: Array
    rate: Array
    jump: Array


def trajectory(model: Model, state: State) -> Trajectory:
    """Integrate the gyroscope from every knot and spread the jump to the next one evenly over the interval."""
    knots, t = model.knots, model.readings.t
    gyro = state.values["gyroscope"]
    rate = gyro[:3] * corrected(model, state.values, "gyroscope") + gyro[3:]
    since, ends = _since_knots(knots, from_rotation_vector(rotation_steps(t, rate)))
    jump = to_rotation_vector(multiply(state.q[1:], conjugate(multiply(state.q[:-1], ends))))
    jump[~knots.joined] = 0.0
    spread = knots.share[:, None] * np.r_[jump, np.zeros((1, 3))][knots.of_sample]
    return Trajectory(multiply(from_rotation_vector(spread), multiply(state.q[knots.of_sample], since)), rate, jump)


def body_jumps(state: State, path: Trajectory) -> Array:
    """The jumps (K−1, 3), rad, about the sensor axes at each interval's start: the gyroscope's error over it."""
    return np.einsum("kij,kj->ki", body_from_inertial(state.q[:-1]), path.jump)


def _since_knots(knots: Knots, steps: Array) -> tuple[Array, Array]:
    """Rotation (n, 4) since the knot before each sample and over each interval (K−1, 4) from steps (n−1, 4) between
    samples: a scan in step over all intervals."""
    count = np.diff(knots.index)
    step = np.arange(int(count.max()))[:, None]
    own = np.where(
        ((step < count) & knots.joined)[..., None], steps[np.minimum(knots.index[:-1] + step, len(steps) - 1)], IDENTITY
    )
    total = np.empty((len(step) + 1, len(count) + 1, 4))
    total[0], total[:, -1] = IDENTITY, IDENTITY
    for i in range(len(step)):
        total[i + 1, :-1] = multiply(total[i, :-1], own[i])
    offset = np.arange(len(steps) + 1) - knots.index[knots.of_sample]
    return total[offset, knots.of_sample], total[count, np.arange(len(count))]


@dataclass(frozen=True)
class Rows:
    """Residuals of samples `own` and what moves them, in units of x: `residual` (m, r), `by_knot` (m, r, 6) for
    attitude (3) and acceleration (3), `by_parameter` (m, r, p), `by_rotation` (m, r, 3) about the body's axes."""

    own: slice
    residual: Array
    by_knot: Array
    by_parameter: Array
    by_rotation: Array


def lever_arm_geometry(model: Model, state: State, own: slice) -> Array:
    """Acceleration of the sensor about the centre of mass per metre of lever arm, (m, 3, 3): S(ω̇) + S(ω)²."""
    scaled = state.values["gyroscope"]
    gyro = model.triads["gyroscope"]
    scale = scaled[:3] / gyro.spread
    low_passed, change = np.take(model.readings.turning, model.at[own], axis=1)
    rate = scale * (low_passed - gyro.centre) + scaled[3:]
    turn = skew(rate)
    return np.asarray(skew(scale * change) + turn @ turn)


def residuals(model: Model, state: State, path: Trajectory) -> Array:
    """Logged minus predicted, (m, r), units of x; 0 where there is no reading."""
    out = np.empty((len(model.at), 3 * len(model.rows)))
    for own, _ in chunks(model):
        turn = body_from_inertial(path.q[model.at[own]])
        for i, name in enumerate(model.rows):
            sensed, _ = _sensed(model, state, path, own, turn, name)
            out[own, 3 * i : 3 * i + 3] = _residual(model, state, own, name, sensed)
    return out


def _sensed(model: Model, state: State, path: Trajectory, own: slice, turn: Array, name: str) -> tuple[Array, Array]:
    """What a triad should sense, SI, sensor axes (m, 3), and the inertial vector (m, 3) or (3,) behind it."""
    sensed, vector = _sensed_at_once(model, state, own, turn, name)
    delay = state.values.get(f"{name}_delay")
    if delay is not None:
        turned = from_rotation_vector(-delay * _slow_rate(model, path, own))
        sensed = np.einsum("nij,nj->ni", body_from_inertial(turned), sensed)
    return sensed, vector


def _slow_rate(model: Model, path: Trajectory, own: slice) -> Array:
    """Running mean of the rate over 2 RATE_SIDE_S at rows `own`, (m, 3): the gyroscope's noise would be the delay's."""
    at = model.at[own]
    side = max(1, round(RATE_SIDE_S / model.knots.sample_s))
    first, last = max(int(at[0]) - side, 0), min(int(at[-1]) + side + 1, len(path.rate))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(path.rate[first:last], axis=0)])
    low, high = np.maximum(at - side - first, 0), np.minimum(at + side + 1 - first, len(total) - 1)
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def _sensed_at_once(model: Model, state: State, own: slice, turn: Array, name: str) -> tuple[Array, Array]:
    """The same of a triad without a delay of its own."""
    if name == "magnetometer":
        vector = model.field(float(state.values["dip"][0]))[0]
        return np.einsum("nij,j->ni", turn, vector), vector
    sign, g = np.sign(model.readings.gravity_mps2), abs(model.readings.gravity_mps2)
    vector = sign * (np.array([0.0, 0.0, g]) - translation(model, state, own))
    sensed = np.einsum("nij,nj->ni", turn, vector)
    arm = state.values["lever_arm"]
    if arm.any():
        sensed = sensed - sign * np.einsum("nij,j->ni", lever_arm_geometry(model, state, own), arm)
    return sensed, vector


def translation(model: Model, state: State, own: slice = slice(None)) -> Array:
    """Acceleration of the centre of mass at rows `own`, inertial, m/s² (m, 3)."""
    at = model.at[own]
    k, share = model.knots.of_sample[at], model.knots.share[at, None]
    a = state.motion[:, ACCELERATION]
    return np.asarray((1.0 - share) * a[k] + share * a[np.minimum(k + 1, len(a) - 1)])


def _residual(model: Model, state: State, own: slice, name: str, sensed: Array) -> Array:
    triad, constants = model.triads[name], state.values[name]
    x = corrected(model, state.values, name, own)
    return np.where(triad.known[own, None], x - (sensed - constants[3:]) / constants[:3], 0.0)


def chunks(model: Model) -> Iterator[tuple[slice, slice]]:
    """Rows and knots in runs of whole intervals, so that sensitivities of an hour fit in memory."""
    starts = np.searchsorted(model.at, model.knots.index)  # first row of every interval
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
    """Chunk by chunk: its knots, its rows, and ∂(attitude at the interval's end)/∂θ (knots, 3, p)."""
    for own, ties in chunks(model):
        turn = body_from_inertial(path.q[model.at[own]])
        moved, ends = _turned_by_gyroscope(model, state, path, own, ties, layout)
        by_gyroscope = slice(0, moved.shape[2])
        m, r = own.stop - own.start, 3 * len(model.rows)
        residual, by_knot, by_parameter = np.empty((m, r)), np.zeros((m, r, 6)), np.zeros((m, r, parameters))
        for i, name in enumerate(model.rows):
            row = slice(3 * i, 3 * i + 3)
            constants, known = state.values[name], model.triads[name].known[own].astype(float)
            sensed, vector = _sensed(model, state, path, own, turn, name)
            residual[:, row] = _residual(model, state, own, name, sensed)
            gain = known[:, None, None] / constants[:3, None]
            by_knot[:, row, :3] = gain * (turn @ skew(vector))
            by_parameter[:, row, by_gyroscope] = by_knot[:, row, :3] @ moved
            column = layout[name].start
            # Translation, in the residuals too, would draw λ off: gravity and lever arm alone tell it.
            steady = sensed
            if name == "accelerometer":
                steady = sensed + np.sign(model.readings.gravity_mps2) * np.einsum(
                    "nij,nj->ni", turn, translation(model, state, own)
                )
            for axis in range(3):
                scaled = (steady[:, axis] - constants[3 + axis]) / constants[axis]
                by_parameter[:, 3 * i + axis, column + axis] = -known * scaled / constants[axis]
                by_parameter[:, 3 * i + axis, column + 3 + axis] = -known / constants[axis]
            if f"{name}_cross" in layout:
                first = layout[f"{name}_cross"].start
                for k, (axis, other) in enumerate(CROSS[name]):
                    by_parameter[:, 3 * i + axis, first + k] = -known * model.triads[name].x[own, other]
            if f"{name}_delay" in layout:
                late = np.cross(_slow_rate(model, path, own), sensed)
                by_parameter[:, row, layout[f"{name}_delay"]] = (gain[..., 0] * late)[..., None]
            if name == "magnetometer" and "dip" in layout:
                turned = model.field(float(state.values["dip"][0]))[1]
                by_parameter[:, row, layout["dip"]] = gain * (turn @ turned)[..., None]
            if name == "accelerometer":
                sign = np.sign(model.readings.gravity_mps2)
                by_knot[:, row, 3:] = -sign * gain * turn
                if "lever_arm" in layout:
                    by_parameter[:, row, layout["lever_arm"]] = -sign * gain * lever_arm_geometry(model, state, own)
        end = np.zeros((ties.stop - ties.start, 3, parameters))
        end[:, :, by_gyroscope] = ends
        yield ties, Rows(own, residual, by_knot, by_parameter, by_knot[..., :3] @ turn.transpose(0, 2, 1)), end


def _turned_by_gyroscope(
    model: Model, state: State, path: Trajectory, own: slice, ties: slice, layout: Mapping[str, slice]
) -> tuple[Array, Array]:
    """∂(attitude error)/∂(λ', b', optional terms) of the gyroscope at rows (m, 3, g), the jump's share taken off, and
    at the ends of the chunk's intervals (knots, 3, g): ∫ R_nb [diag x, I, …] dτ from the knot before, trapezoidal."""
    knots, t = model.knots, model.readings.t
    first = int(knots.index[ties.start])
    last = int(knots.index[min(ties.stop, len(knots.index) - 1)])  # the last interval ends at the next chunk's knot
    reach = slice(first, last + 1)
    scale = state.values["gyroscope"][:3]
    r_nb = body_from_inertial(path.q[reach]).transpose(2, 1, 0)
    optional = [name for name in layout if name.startswith("gyroscope_")]
    integrand = np.empty((3, 6 + sum(TERMS[name] for name in optional), r_nb.shape[2]))  # samples last: long runs
    np.multiply(r_nb, corrected(model, state.values, "gyroscope", reach).T, out=integrand[:, :3])
    integrand[:, 3:6] = r_nb
    if "gyroscope_cross" in layout:
        at, x = layout["gyroscope_cross"].start, model.triads["gyroscope"].x[reach].T
        for k, (axis, other) in enumerate(CROSS["gyroscope"]):
            integrand[:, at + k] = r_nb[:, axis] * (scale[axis] * x[other])
    if "gyroscope_temperature" in layout and model.readings.warmth is not None:
        integrand[:, layout["gyroscope_temperature"]] = r_nb * (scale[:, None] * model.readings.warmth[reach])
    area = integrand[..., 1:] + integrand[..., :-1]
    area *= 0.5 * np.diff(t[reach])
    total = np.zeros_like(integrand)
    np.cumsum(area, axis=2, out=total[..., 1:])
    at_knots = total[..., knots.index[ties] - first]
    following = np.r_[knots.index[ties][1:] - first, r_nb.shape[2] - 1]
    ends = total[..., following] - at_knots
    ends[..., ~np.r_[knots.joined, False][ties]] = 0.0
    at = model.at[own]
    k = knots.of_sample[at] - ties.start
    moved = total[..., at - first] - at_knots[..., k] - knots.share[at] * ends[..., k]
    return np.ascontiguousarray(moved.transpose(2, 0, 1)), ends.transpose(2, 0, 1)


def accumulate(
    normal: Normal, model: Model, rows: Rows, ties: slice, weight: Array, probe: Probe, groups: tuple[Array, Array]
) -> None:
    """Add a chunk's rows, whitened by `weight` (m, r) = 1/σ² with robust weights in, to the normal equations.

    `groups` ((K, 6, 2r + 3), (p + 1, 2r + 3)) collect what reacts to the probes, at knots and parameters: each row to
    its own sign (r), and to gyroscope noise within an interval the rows together, by body axis (3), and each row (r);
    the last line is a reaction's product with all that react to the same noise."""
    p, (m, r) = len(normal.parameters), weight.shape
    root = np.sqrt(weight)
    share = model.knots.share[model.at[rows.own], None, None]
    # Columns: pull at the knot before and after, parameters, residual, turns about the body's axes, both probes.
    met = np.empty((m + 1, r, 6 + 6 + p + 1 + 3 + 2))
    met[m] = 0.0  # one row of nothing, to fill shorter intervals with
    before, after, given, drawn = np.split(met[:m], [6, 12, 16 + p], axis=2)
    np.multiply(rows.by_knot, root[..., None], out=before)
    np.multiply(before, share, out=after)
    before -= after
    np.multiply(rows.by_parameter, root[..., None], out=given[..., :p])
    np.multiply(rows.residual, root, out=given[..., p])
    np.multiply(rows.by_rotation * root[..., None], probe.bridge[rows.own, None], out=given[..., p + 1 :])
    np.multiply(probe.sensors[rows.own], root > 0, out=drawn[..., 0])
    np.sum(given[..., p + 1 :], axis=2, out=drawn[..., 1])
    by_interval = np.take(met, _padded(model, rows.own, ties), axis=0)  # (knots, most rows, r, 18 + p)
    by_row = by_interval.transpose(0, 2, 3, 1)
    alone, together = (by_row[:, :, :12] @ by_row[:, :, 16 + p :].transpose(0, 1, 3, 2)).transpose(3, 0, 2, 1)
    by_interval = by_interval.reshape(ties.stop - ties.start, -1, 18 + p)
    product = by_interval[..., :12].transpose(0, 2, 1) @ by_interval[..., : 16 + p]  # (knots, 12, 16 + p)
    flat = met[:m].reshape(m * r, -1)[:, 12 : 16 + p]
    total = flat.T @ flat
    own = (given[..., :p].transpose(1, 2, 0) @ drawn[..., :1].transpose(1, 0, 2))[..., 0].T
    normal.parameters += total[:p, :p]
    normal.parameters_right[:, GRADIENT] += total[:p, p]
    normal.parameters_right[:, SENSORS] += own.sum(axis=1)
    normal.parameters_right[:, BRIDGE] += total[:p, p + 1 :].sum(axis=1)
    groups[1][:p, :r] += own
    groups[1][p, r:] += np.r_[total[p + 1 :, p + 1 :].sum(axis=1), np.sum(drawn[..., 1] ** 2, axis=0)]
    pulled = np.concatenate([alone, product[:, :, 13 + p :], together], axis=2)
    # Chain blocks: an interval's rows pull at the knot before it and, where the record goes on, at the one after.
    last = min(ties.stop, len(normal.diagonal) - 1)
    inside, following = slice(0, last - ties.start), slice(ties.start + 1, last + 1)
    for knot, part, here in ((ties, slice(0, 6), slice(None)), (following, slice(6, 12), inside)):
        groups[0][knot] += pulled[here, part]
        probes = np.stack([pulled[here, part, :r].sum(axis=2), pulled[here, part, r : r + 3].sum(axis=2)], axis=2)
        for state, own_part in BLOCKS:
            normal.right[knot, state, : p + 1] += product[here, part, 12 : 13 + p][:, own_part]
            normal.right[knot, state, p + SENSORS] += probes[:, own_part, 0]
            normal.right[knot, state, p + BRIDGE] += probes[:, own_part, 1]
            for other, other_part in BLOCKS:
                columns = slice(part.start + other_part.start, part.start + other_part.stop)
                normal.diagonal[knot, state, other] += product[here, part, columns][:, own_part]
    for state, own_part in BLOCKS:
        for other, other_part in BLOCKS:
            rows_after = slice(6 + own_part.start, 6 + own_part.stop)
            normal.below[ties.start : last, state, other] += product[inside, rows_after, other_part]


def _padded(model: Model, own: slice, ties: slice) -> np.ndarray:
    """Rows of each of a chunk's intervals (knots, most rows); one past the last row where there are fewer."""
    starts = np.searchsorted(model.at[own], model.knots.index[ties])
    counts = np.diff(np.r_[starts, own.stop - own.start])
    step = np.arange(max(int(counts.max()), 1))
    return np.where(step < counts[:, None], starts[:, None] + step, own.stop - own.start)


def sums_by_interval(model: Model, x: Array, own: slice, ties: slice) -> Array:
    """Sums of the rows x (m, c) of a chunk over each of its intervals, (knots, c)."""
    starts = np.searchsorted(model.at[own], model.knots.index[ties])
    some = np.diff(np.r_[starts, len(x)]) > 0
    sums = np.zeros((len(starts), x.shape[1]))
    sums[some] = np.add.reduceat(x, starts[some], axis=0)
    return sums


def layout_of(model: Model, values: Mapping[str, Array], *, dip: bool, lever_arm: bool) -> tuple[dict[str, slice], int]:
    """Where each free parameter stands in θ, and how many there are: optional terms where `values` has them."""
    layout, at = {}, 0
    optional = [name for name in OPTIONAL if name in values]
    by_gyroscope = [name for name in optional if name.startswith("gyroscope_")]  # one block, from the start
    free = ["gyroscope", *by_gyroscope, *model.rows]
    if dip and len(model.rows) == 2:
        free.append("dip")
    if lever_arm and "accelerometer" in model.rows:
        free.append("lever_arm")
    free += [name for name in optional if name not in free]
    for name in free:
        size = {"dip": 1, "lever_arm": 3, **OPTIONAL}.get(name, 6)
        layout[name] = slice(at, at + size)
        at += size
    return layout, at
