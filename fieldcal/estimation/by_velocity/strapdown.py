"""Readings integrated between knots, and how that depends on the constants: preintegration.

Everything is integrated once over the record, in the axes that the sensor had at its beginning; what an interval adds
is the difference of two cumulative sums, turned to the knot's attitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldcal.estimation.by_velocity.problem import Knots
from fieldcal.estimation.joint.problem import Readings
from fieldcal.geometry.rotation import IDENTITY, Array, body_from_inertial, propagate, skew

NEAR_S = 0.03  # on either side of an epoch: rate and acceleration there are means over this


@dataclass(frozen=True)
class Grid:
    """Samples and knots in one order of time: `t` (N,) s; `gyroscope`, `accelerometer` (N, 3) logged, interpolated at
    the knots; `knot` (K,) their places; `seen` (m,) places of the magnetometer's readings `magnetometer` (m, 3), each
    in interval `interval` (m,)."""

    t: Array
    gyroscope: Array
    accelerometer: Array
    knot: np.ndarray
    seen: np.ndarray
    magnetometer: Array
    interval: np.ndarray


def grid_of(readings: Readings, knots: Knots, lag_s: float) -> Grid:
    """Samples between the first knot and the last of each stretch, and the knots at this lag. `readings` have an
    accelerometer."""
    at = knots.offset - lag_s
    span = np.searchsorted(at, readings.t, side="right") - 1
    inside = (span >= 0) & (span < len(at) - 1)
    inside[inside] = knots.joined[span[inside]]
    samples = np.flatnonzero(inside)
    t = np.concatenate([readings.t[samples], at])
    order = np.argsort(t, kind="stable")
    place = np.empty(len(t), dtype=np.int64)
    place[order] = np.arange(len(t))
    assert readings.accelerometer is not None
    both = []
    for x in (readings.gyroscope, readings.accelerometer):
        known = np.isfinite(x).all(axis=1)
        columns = [np.interp(t[order], readings.t[known], column) for column in x[known].T]
        both.append(np.column_stack(columns))
    logged = readings.magnetometer
    field = np.full((len(samples), 3), np.nan) if logged is None else logged[samples]
    valid = np.isfinite(field).all(axis=1)
    seen, knot = place[: len(samples)][valid], place[len(samples) :]
    interval = np.searchsorted(knot, seen, side="right") - 1
    return Grid(t[order], both[0], both[1], knot, seen, field[valid], interval)


@dataclass(frozen=True)
class Integrated:
    """A record integrated with some constants, axes of its beginning ("frame 0"); parameters (λ, b) of a triad, of the
    gyroscope the drift of its bias too.

    At knots: `turned` (K, 3, 3) sensor axes there to frame 0; `rate` (K, 3) rad/s, sensor axes, and its derivative
    `rate_change` (K, 3) rad/s²; `force` (K, 3) m/s² and its
    derivative `jerk` (K, 3) m/s³, frame 0.
    Over intervals: `push` (K−1, 3) m/s, integral of specific force; `turn_by_gyroscope` (K−1, 3, 9) ∂(rotation vector
    of the end's attitude), `push_by_gyroscope` (K−1, 3, 9), `push_by_accelerometer` (K−1, 3, 6) ∂push.
    Of the magnetometer over intervals: `count` (K−1,) readings, `reading` (K−1, 3) their mean, `axes` (K−1, 3, 3) mean
    of frame 0 to sensor axes, `axes_by_gyroscope` (K−1, 3, 9) mean rotation since the knot by the constants, and
    `axes_rate` (K−1, 3) mean rate, rad/s, sensor axes.
    `rate_logged` (K, 3): the gyroscope's reading at the knots."""

    turned: Array
    rate: Array
    rate_change: Array
    rate_logged: Array
    force: Array
    jerk: Array
    push: Array
    turn_by_gyroscope: Array
    push_by_gyroscope: Array
    push_by_accelerometer: Array
    count: Array
    reading: Array
    axes: Array
    axes_by_gyroscope: Array
    axes_rate: Array


def integrate(
    grid: Grid, gyroscope: Array, drift: Array, accelerometer: Array, gravity_sign: float, middle_s: float
) -> Integrated:
    """Integrate with constants (λ, b) (6,) of both triads and the drift (3,) of the gyroscope's bias about `middle_s`;
    `gravity_sign` 1 for an accelerometer that reads gravity.

    Trapezoids between samples; the attitude with the second-order term of a linear rate."""
    since_middle = (grid.t - middle_s)[:, None]
    rate = grid.gyroscope * gyroscope[:3] + gyroscope[3:] + drift * since_middle
    force = -gravity_sign * (grid.accelerometer * accelerometer[:3] + accelerometer[3:])
    turned = body_from_inertial(propagate(grid.t, rate, IDENTITY)).transpose(0, 2, 1)
    in_frame = np.einsum("nij,nj->ni", turned, force)
    half = 0.5 * np.diff(grid.t)

    def total(x: Array) -> Array:
        out = np.zeros_like(x)
        np.cumsum((x[1:] + x[:-1]) * half.reshape(-1, *[1] * (x.ndim - 1)), axis=0, out=out[1:])
        return out

    drifted = turned * since_middle[..., None]
    by_gyroscope = total(np.concatenate([turned * grid.gyroscope[:, None, :], turned, drifted], axis=2))
    of_force = total(-gravity_sign * np.concatenate([turned * grid.accelerometer[:, None, :], turned], axis=2))
    moved = total(in_frame)
    turned_away = total(skew(in_frame) @ by_gyroscope)
    knot = grid.knot
    push = np.diff(moved[knot], axis=0)
    by_push = -np.diff(turned_away[knot], axis=0) + skew(push) @ by_gyroscope[knot][:-1]
    intervals = len(knot) - 1
    count = np.bincount(grid.interval, minlength=intervals).astype(float)[:intervals]

    def mean(x: Array) -> Array:
        flat = x.reshape(len(x), int(np.prod(x.shape[1:])))
        sums = np.stack([np.bincount(grid.interval, c, minlength=intervals)[:intervals] for c in flat.T], axis=1)
        return np.asarray(sums / np.maximum(count, 1.0)[:, None]).reshape(intervals, *x.shape[1:])

    since = by_gyroscope[grid.seen] - by_gyroscope[knot[grid.interval]]
    angle, at = total(rate), grid.t[knot]
    return Integrated(
        turned=turned[knot],
        rate=_slope(grid.t, angle, at),
        rate_change=_bend(grid.t, angle, at),
        rate_logged=_slope(grid.t, total(grid.gyroscope), at),
        force=_slope(grid.t, moved, at),
        jerk=_bend(grid.t, moved, at),
        push=push,
        turn_by_gyroscope=np.diff(by_gyroscope[knot], axis=0),
        push_by_gyroscope=by_push,
        push_by_accelerometer=np.diff(of_force[knot], axis=0),
        count=count,
        reading=mean(grid.magnetometer),
        axes=mean(turned[grid.seen].transpose(0, 2, 1)),
        axes_by_gyroscope=mean(since),
        axes_rate=mean(rate[grid.seen]),
    )


def _slope(t: Array, x: Array, at: Array) -> Array:
    """Mean slope of x (N, 3) over NEAR_S on either side of `at` (K,), within the samples."""
    low, high = np.maximum(at - NEAR_S, t[0]), np.minimum(at + NEAR_S, t[-1])
    change = np.column_stack([np.interp(high, t, c) - np.interp(low, t, c) for c in x.T])
    return np.asarray(change / (high - low)[:, None])


def _bend(t: Array, x: Array, at: Array) -> Array:
    """Change of the mean slope of x (N, 3) from NEAR_S before `at` (K,) to NEAR_S after it, a second; at the ends of
    the record that of the nearest place with so much on either side."""
    inner = np.clip(at, t[0] + 2.0 * NEAR_S, t[-1] - 2.0 * NEAR_S)
    return (_slope(t, x, inner + NEAR_S) - _slope(t, x, inner - NEAR_S)) / (2.0 * NEAR_S)
