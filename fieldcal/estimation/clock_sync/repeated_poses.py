"""Poses that a visual positioning system repeats: it lost its target, or is slower than its rows.

Trackers that lose their target repeat the last pose or send a default one; loggers write a row each time they look,
new pose or not. No measured pose comes out the same to the last bit while the vehicle turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldcal.estimation.faults import resolution
from fieldcal.estimation.segments import run_starts
from fieldcal.geometry.rotation import Array, normalise

FEWEST_FROZEN, FROZEN_RATIO = 5, 3  # rows alike that are a frozen tracker, and times the usual number
SPEED_OVER_S = 0.05  # what the vehicle turned just before and after a run of poses alike
# Less than this has not turned: a tracker's noise, or a few steps of rounded quaternions.
LEAST_TURN_RAD, ROUNDING_STEPS = float(np.radians(0.2)), 4
# No vehicle comes to rest, to the last bit, at more than this; nor by steps as long as it otherwise makes (quantiles
# of those: of a run between two others, and of one at the end, where only the one before is known).
FASTEST_STOP_RADPS2, SHORT_STEPS, SHORT_LAST_STEPS = 10.0, 0.2, 0.5
# A default pose: so many rows of one value, which is left or reached by a jump that no ordinary step comes near.
FEWEST_DEFAULT, JUMP_RATIO, LEAST_JUMP_RAD = 10, 5.0, float(np.radians(5.0))


@dataclass(frozen=True)
class Repeats:
    """Which rows (n,) are repeats: `held` of a tracker slower than its rows, of which `rows_a_pose` bring one pose;
    `frozen` while the vehicle turned; `default` of a value that stands for no pose. Those of rest are none of them."""

    held: NDArray[np.bool_]
    frozen: NDArray[np.bool_]
    default: NDArray[np.bool_]
    rows_a_pose: int


def find_repeats(t: ArrayLike, q: ArrayLike) -> Repeats:
    """Repeated poses at stamps t (n,), s, ascending, by their attitudes q (n, 4), exactly as logged."""
    t, q = np.asarray(t, dtype=float), np.asarray(q, dtype=float)
    n = len(t)
    nothing = np.zeros(n, dtype=bool)
    if n < FEWEST_FROZEN:
        return Repeats(nothing, nothing, nothing, 1)
    value = _numbered(q)
    start = run_starts(value)
    length = np.diff(np.r_[start, n])
    usual = int(np.median(length))
    # Angle that is no rounding.
    rounding = ROUNDING_STEPS * 2.0 * max(resolution(c[np.isfinite(c)]) for c in q.T)
    least = max(LEAST_TURN_RAD, rounding)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = normalise(q)
    step = _angle(unit[start[:-1]], unit[start[1:]])
    default = _default(value, start, step, least, q)
    frozen_run = _frozen_runs(t, unit, start, length, step, least, rounding)
    frozen_run &= length >= max(FEWEST_FROZEN, FROZEN_RATIO * usual)
    row = np.repeat(np.arange(len(start)), length)
    in_run = np.arange(n) - start[row]
    frozen = frozen_run[row] & (in_run > 0) & ~default
    held = (in_run % usual > 0) & ~frozen & ~default
    return Repeats(held, frozen, default, usual)


def _numbered(q: Array) -> np.ndarray:
    """A number (n,) for each different row of q (n, 4); one that is not a number is like no other."""
    rows = np.ascontiguousarray(q + 0.0).view(f"V{q.itemsize * q.shape[1]}")[:, 0].tolist()  # −0 is 0
    last = dict(zip(rows, range(len(rows)), strict=True))
    value = np.fromiter(map(last.__getitem__, rows), dtype=np.int64, count=len(rows))
    return np.where(np.isnan(q).any(axis=1), np.arange(len(q)), value)


def _angle(a: Array, b: Array) -> Array:
    """Between unit quaternions (n, 4), rad; 0 where one is no rotation."""
    cosine = np.abs(np.einsum("ij,ij->i", a, b))
    return np.asarray(2.0 * np.arccos(np.clip(np.nan_to_num(cosine, nan=1.0), 0.0, 1.0)))


def _frozen_runs(
    t: Array, q: Array, start: np.ndarray, length: np.ndarray, step: Array, least: float, rounding: float
) -> NDArray[np.bool_]:
    """Runs of one pose during which the vehicle turned, by how it turned before and after."""
    n, last = len(t), start + length - 1
    # Just before the run: from a pose some hundredths of a second earlier to its own; after it likewise.
    earlier = np.clip(np.searchsorted(t, t[start] - SPEED_OVER_S), 0, np.maximum(start - 1, 0))
    after = np.minimum(last + 1, n - 1)
    later = np.minimum(np.maximum(np.searchsorted(t, t[after] + SPEED_OVER_S), after + 1), n - 1)
    before_radps, after_radps = _speed(t, q, earlier, start), _speed(t, q, after, later)
    # Out of a rest a vehicle starts no faster than it then goes on.
    into, out = np.r_[0.0, step], np.r_[step, 0.0]
    ordinary = np.maximum(before_radps, after_radps) * (t[after] - t[last])
    jumped = out > 2.0 * ordinary + least
    # What is left of the speed at the run's ends, if it was braked that long, and the way to its stop.
    slowed = [
        v - 0.5 * FASTEST_STOP_RADPS2 * d
        for v, d in ((before_radps, t[start] - t[earlier]), (after_radps, t[later] - t[after]))
    ]
    too_fast = np.maximum(*(np.maximum(v, 0.0) for v in slowed)) ** 2 / (2.0 * FASTEST_STOP_RADPS2) > least
    short, short_last = np.quantile(step, [SHORT_STEPS, SHORT_LAST_STEPS]) if len(step) else (0.0, 0.0)
    by_steps = np.minimum(into, out) > max(float(short), rounding)
    by_last_step = (last == n - 1) & (into > max(float(short_last), rounding))
    return np.asarray(jumped | too_fast | by_steps | by_last_step)


def _speed(t: Array, q: Array, a: np.ndarray, b: np.ndarray) -> Array:
    """Rate of turn from poses a to b (indices), rad/s."""
    return np.asarray(_angle(q[a], q[b]) / np.maximum(t[b] - t[a], 1e-6))


def _default(value: np.ndarray, start: np.ndarray, step: Array, least: float, q: Array) -> NDArray[np.bool_]:
    """Rows of a value that comes again and again, or of the identity, where one of its runs is reached by a jump."""
    rows, runs = np.bincount(value), np.bincount(value[start])
    again = (rows >= FEWEST_DEFAULT) & (runs >= 2)
    suspect = again[value] | np.all(np.abs(q) == np.array([0.0, 0.0, 0.0, 1.0]), axis=1)
    known = ~suspect[start]
    ordinary = step[known[:-1] & known[1:]]
    limit = JUMP_RATIO * float(np.quantile(ordinary, 0.95)) + least if len(ordinary) else least
    jumps = np.maximum(np.r_[0.0, step], np.r_[step, 0.0]) > max(limit, LEAST_JUMP_RAD)
    return np.asarray(suspect & np.isin(value, value[start[jumps]]))
