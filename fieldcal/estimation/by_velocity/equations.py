"""Residuals of the estimate by velocity and their normal equations: knots in a chain, bordered by the constants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fieldcal.estimation.by_velocity.problem import Epochs, Knots, Levels, State
from fieldcal.estimation.by_velocity.strapdown import Integrated
from fieldcal.estimation.joint.chain_solver import chain_solve
from fieldcal.geometry.rotation import (
    Array,
    body_from_inertial,
    conjugate,
    multiply,
    normalise,
    parallel_to_quaternion,
    skew,
    to_rotation_vector,
)

STATES = 6  # of a knot: attitude error, rad, and velocity, m/s, NED
ATTITUDE_PER_RAD2, VELOCITY_PER_M2S2 = 1e-2, 1e-6  # keep what nothing observes from being singular
# Groups of rows whose noise has a level of its own.
TURN, PUSH, LEVEL, VERTICAL, FIELD = GROUPS = range(5)


@dataclass(frozen=True)
class Rows:
    """Rows of one kind, linearised: `residual` (m, r), found less predicted; `here`, `there` (m, r, 6) on a knot and
    the next, `theta` (m, r, p); `knot` (m,) the former; `variance` (m, r); `group` (r,)."""

    residual: Array
    here: Array
    there: Array | None
    theta: Array
    knot: np.ndarray
    variance: Array
    group: tuple[int, ...]


@dataclass(frozen=True)
class Setting:
    """What the rows are made of beside the state: knots, epochs, `gravity` (3,) m/s² NED, `field` (3,) NED as it is
    configured, and which intervals have readings of the magnetometer that count, `lit` (K−1,) bool."""

    knots: Knots
    epochs: Epochs
    gravity: Array
    field: Array
    lit: np.ndarray


def field_at(field: Array, turned: Array) -> tuple[Array, Array]:
    """Field (3,) of the same strength with dip and declination larger by `turned` (2,), rad, and ∂/∂ of them (3, 2)."""
    strength = float(np.linalg.norm(field))
    level = float(np.hypot(field[0], field[1]))
    heading, dip = np.arctan2(field[1], field[0]) + turned[1], np.arctan2(field[2], level) + turned[0]
    (sh, ch), (sd, cd) = (np.sin(heading), np.cos(heading)), (np.sin(dip), np.cos(dip))
    value = strength * np.array([cd * ch, cd * sh, sd])
    slopes = strength * np.array([[-sd * ch, -cd * sh], [-sd * sh, cd * ch], [cd, 0.0]])
    return value, slopes


def rows_of(
    setting: Setting, state: State, path: Integrated, levels: Levels, layout: Mapping[str, slice]
) -> list[Rows]:
    """Everything that is compared: where an interval's integral ends and the next knot; the receiver; the field."""
    p = max(columns.stop for columns in layout.values())
    attitude = body_from_inertial(state.q).transpose(0, 2, 1)
    frame = attitude @ path.turned.transpose(0, 2, 1)
    out = [_links(setting, state, path, levels, layout, p, frame)]
    out.append(_receiver(setting, state, path, levels, layout, p, attitude, frame))
    if "magnetometer" in layout:
        out.append(_field(setting, state, path, levels, layout, p, frame))
    return out


def _links(
    setting: Setting,
    state: State,
    path: Integrated,
    levels: Levels,
    layout: Mapping[str, slice],
    p: int,
    frame: Array,
) -> Rows:
    """Attitude and velocity of the next knot against the integral from this one. Noise that the gyroscope adds to the
    attitude within an interval is half in its velocity, which is therefore compared with the mean of both."""
    joined = np.flatnonzero(setting.knots.joined)
    interval = setting.knots.interval_s[joined]
    m = len(joined)
    push = np.einsum("nij,nj->ni", frame[joined], path.push[joined])
    turn = path.turned[joined].transpose(0, 2, 1) @ path.turned[joined + 1]
    predicted = multiply(state.q[joined], normalise(parallel_to_quaternion(turn.transpose(0, 2, 1))))
    jump = to_rotation_vector(multiply(state.q[joined + 1], conjugate(predicted)))
    change = state.velocity[joined + 1] - state.velocity[joined]
    cross = skew(push)
    kick = change - push - setting.gravity * interval[:, None] + 0.5 * np.einsum("nij,nj->ni", cross, jump)
    here, there, theta = np.zeros((m, 6, 6)), np.zeros((m, 6, 6)), np.zeros((m, 6, p))
    eye = np.eye(3)
    here[:, :3, :3], there[:, :3, :3] = -eye, eye
    here[:, 3:, :3] = there[:, 3:, :3] = 0.5 * cross
    here[:, 3:, 3:], there[:, 3:, 3:] = -eye, eye
    turned = frame[joined] @ path.turn_by_gyroscope[joined]
    gyroscope = slice(layout["gyroscope"].start, layout["drift"].stop)
    theta[:, :3, gyroscope] = -turned
    theta[:, 3:, gyroscope] = -frame[joined] @ path.push_by_gyroscope[joined] - 0.5 * cross @ turned
    theta[:, 3:, layout["accelerometer"]] = -frame[joined] @ path.push_by_accelerometer[joined]
    within = levels.turn * interval * np.sum(push**2, axis=1) / 12.0
    variance = np.repeat(np.column_stack([levels.turn * interval, levels.push * interval + within]), 3, axis=1)
    return Rows(np.hstack([jump, kick]), here, there, theta, joined, variance, (*[TURN] * 3, *[PUSH] * 3))


def _receiver(
    setting: Setting,
    state: State,
    path: Integrated,
    levels: Levels,
    layout: Mapping[str, slice],
    p: int,
    attitude: Array,
    frame: Array,
) -> Rows:
    """Velocity of the antenna as the receiver has it less that of the state, v + R (ω × r), with the lag: a lag longer
    by δ shows the velocity of a time earlier by δ."""
    knot = np.flatnonzero(setting.knots.epoch >= 0)
    epoch = setting.knots.epoch[knot]
    arm, rate = state.values["arm"], path.rate[knot]
    swung = np.einsum("nij,nj->ni", attitude[knot], np.cross(rate, arm))
    jerk = np.einsum("nij,nj->ni", frame[knot], path.jerk[knot])
    residual = state.velocity[knot] + swung + state.values["smoothing"] * jerk - setting.epochs.velocity[epoch]
    here, theta = np.zeros((len(knot), 3, 6)), np.zeros((len(knot), 3, p))
    here[:, :, 3:], here[:, :, :3] = np.eye(3), -skew(swung)
    theta[:, :, layout["arm"]] = attitude[knot] @ skew(rate)
    acceleration = np.einsum("nij,nj->ni", frame[knot], path.force[knot]) + setting.gravity
    swing = np.cross(path.rate_change[knot], arm) + np.cross(rate, np.cross(rate, arm))
    acceleration += np.einsum("nij,nj->ni", attitude[knot], swing)
    theta[:, :, layout["lag"]] = -acceleration[:, :, None]
    theta[:, :, layout["smoothing"]] = jerk[:, :, None]
    by_rate = -attitude[knot] @ skew(arm)
    gyroscope = layout["gyroscope"]
    theta[:, :, gyroscope.start : gyroscope.start + 3] += by_rate * path.rate_logged[knot][:, None, :]
    theta[:, :, gyroscope.start + 3 : gyroscope.stop] += by_rate
    of_axis = np.array([levels.receiver[0] * levels.colour[0]] * 2 + [levels.receiver[1] * levels.colour[1]])
    variance = setting.epochs.sd[epoch, None] ** 2 * of_axis
    return Rows(residual, here, None, theta, knot, variance, (LEVEL, LEVEL, VERTICAL))


def _field(
    setting: Setting,
    state: State,
    path: Integrated,
    levels: Levels,
    layout: Mapping[str, slice],
    p: int,
    frame: Array,
) -> Rows:
    """Mean reading of the magnetometer over an interval less gain · (mean of A) h + zero, with its sign turned."""
    knot = np.flatnonzero(setting.lit)
    field, slopes = field_at(setting.field, state.values["field"])
    gain, zero = state.values["magnetometer"][:3], state.values["magnetometer"][3:]
    back = frame[knot].transpose(0, 2, 1)
    seen = path.axes[knot] @ back
    sensed = seen @ field
    here, theta = np.zeros((len(knot), 3, 6)), np.zeros((len(knot), 3, p))
    here[:, :, :3] = gain[:, None] * (seen @ skew(field))
    columns = layout["magnetometer"]
    theta[:, range(3), range(columns.start, columns.start + 3)] = sensed
    theta[:, range(3), range(columns.start + 3, columns.stop)] = 1.0
    theta[:, :, layout["field"]] = gain[:, None] * (seen @ slopes)
    turned = path.axes[knot] @ skew(np.einsum("nij,j->ni", back, field)) @ path.axes_by_gyroscope[knot]
    theta[:, :, layout["gyroscope"].start : layout["drift"].stop] = gain[:, None] * turned
    # What is late by δ shows the field of axes that were turned by ω δ less.
    passing = gain * np.cross(path.axes_rate[knot], sensed)
    theta[:, :, layout["delay"]] = passing[:, :, None]
    residual = gain * sensed + zero + state.values["delay"] * passing - path.reading[knot]
    variance = np.full(residual.shape, levels.field * levels.colour[2])
    return Rows(residual, here, None, theta, knot, variance, (FIELD,) * 3)


def noise_in_readings(
    links: Rows, state: State, layout: Mapping[str, slice], turn_share: float, push_share: float
) -> Array:
    """What is added to the gradient (p,) because readings, by which the sensitivity to a scale is made, have the noise
    that makes the attitude and velocity jump: without it a noisy gyroscope's scale comes out too small (as in
    `joint.score_corrections`). Of both walks' variance only a share is that of readings: what a receiver errs for
    seconds is in the velocity's walk, and in no reading."""
    out = np.zeros(links.theta.shape[2])
    back = body_from_inertial(state.q[links.knot])
    triads = (("gyroscope", slice(None, 3), turn_share), ("accelerometer", slice(3, None), push_share))
    for name, rows, of_readings in triads:
        jump = np.einsum("nij,nj->ni", back, links.residual[:, rows])
        share = np.sum(jump**2 / links.variance[:, rows], axis=0)
        first = layout[name].start
        # Jumps larger than their noise are the start's errors.
        out[first : first + 3] = of_readings * np.where(share < len(jump), share, 0.0) / state.values[name][:3]
    return out


@dataclass(frozen=True)
class Solved:
    """A step of Gauss and Newton: `theta` (p,), `knots` (K, 6).

    `information` (p, p) of the constants, knots eliminated, without the prior, and its gradient `pull` (p,);
    `covariance` (p, p) with the prior; `probes`: the same step for the probe of each group of rows, what of it the
    unknowns take, `theta` (p, 5), `knots` (K, 6, 5); `followed` (K, 6, p): by how much the knots follow the
    constants."""

    theta: Array
    knots: Array
    information: Array
    covariance: Array
    pull: Array
    probes: tuple[Array, Array]
    followed: Array


def solve(
    rows: list[Rows], weight: list[Array], knots: int, known: tuple[Array, Array], score: Array, signs: list[Array]
) -> Solved:
    """Normal equations of all rows, weighted (m, r) by robustness beside their variance, and their solution.

    `known`: information (p, p) of the prior and its pull (p,) at the state; `score` (p,): what the rows' gradient lacks
    (`noise_in_readings`); `signs`: ±1 for each residual, the probe of the trace of the hat matrix."""
    prior, pulled = known
    p = len(prior)
    rights = 1 + len(GROUPS)
    diagonal, below = np.zeros((knots, STATES, STATES)), np.zeros((knots - 1, STATES, STATES))
    right, own, own_right = np.zeros((knots, STATES, p + rights)), np.zeros((p, p)), np.zeros((p, rights))
    for one, robust, sign in zip(rows, weight, signs, strict=True):
        w = robust / one.variance
        drawn = np.zeros((*w.shape, rights))
        drawn[..., 0] = -w * one.residual
        for r, group in enumerate(one.group):
            drawn[:, r, 1 + group] = np.sqrt(w[:, r]) * sign[:, r]
        weighted = one.theta * w[..., None]
        flat = one.theta.reshape(-1, p)
        own += flat.T @ weighted.reshape(-1, p)
        own_right += flat.T @ drawn.reshape(-1, rights)
        both = np.concatenate([weighted, drawn], axis=2)
        back = one.here.transpose(0, 2, 1)
        # A knot is first of one link, and has one epoch and one mean at most.
        diagonal[one.knot] += back @ (one.here * w[..., None])
        right[one.knot] += back @ both
        if one.there is not None:
            forth = one.there.transpose(0, 2, 1)
            diagonal[one.knot + 1] += forth @ (one.there * w[..., None])
            below[one.knot] += forth @ (one.here * w[..., None])
            right[one.knot + 1] += forth @ both
    diagonal[:, range(3), range(3)] += ATTITUDE_PER_RAD2
    diagonal[:, range(3, 6), range(3, 6)] += VELOCITY_PER_M2S2
    carried = chain_solve(diagonal, below, right)
    flat_right = right.reshape(-1, p + rights)
    absorbed = flat_right.T @ carried.reshape(-1, p + rights)
    information, gradient = own - absorbed[:p, :p], own_right - absorbed[:p, p:]
    information = 0.5 * (information + information.T)
    total = information + prior
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    inverse = np.linalg.inv(total * np.outer(scale, scale)) * np.outer(scale, scale)
    gradient[:, 0] += pulled + score
    theta = inverse @ gradient
    whole = carried[:, :, p:] - carried[:, :, :p] @ theta
    probes = theta[:, 1:], whole[..., 1:]
    return Solved(theta[:, 0], whole[..., 0], information, inverse, gradient[:, 0] - pulled, probes, -carried[:, :, :p])


def pulls(one: Rows, weight: Array, residual: Array, followed: Array) -> Array:
    """What each row (m,) does to the gradient of the constants, knots eliminated, (m, p): `residual` (m, r) over its
    sd and √`weight`."""
    sensitivity = one.theta + one.here @ followed[one.knot]
    if one.there is not None:
        sensitivity = sensitivity + one.there @ followed[one.knot + 1]
    return np.asarray(np.einsum("mrp,mr->mp", sensitivity, residual * np.sqrt(weight / one.variance)))


def predicted(one: Rows, theta: Array, knots: Array) -> Array:
    """What a step θ (p, c), knots (K, 6, c) changes of the residuals, (m, r, c)."""
    out = one.here @ knots[one.knot] + one.theta @ theta
    return out if one.there is None else out + one.there @ knots[one.knot + 1]
