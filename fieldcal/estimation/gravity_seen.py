"""Whether an accelerometer's readings hold gravity at all: by the gyroscope, in whose turned axes gravity stands still.

Two numbers, each as a share of gravity. Averaged over seconds in axes that do not turn, specific force is gravity and
little else, for no vehicle accelerates one way for long. And what of the readings turns against the body as gravity
must, beside a constant in body axes, is gravity where the vehicle is turned by hand; a multirotor, whose thrust stays
with the body, hides it from this one. Readings from which gravity was taken off show it in neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from fieldcal.estimation.faults import MPS2_UNITS, Fault
from fieldcal.geometry.rotation import IDENTITY, Array, body_from_inertial, from_rotation_vector, multiply
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode

WINDOW_S, STEP_S = 5.0, 0.02
FEWEST_WINDOWS = 2
LARGEST_COHERENCE = 0.95
"""Mean length of a body direction over a window in axes that stand still: nearer one the vehicle hardly tilted."""
LEAST_LENGTH = LEAST_MEAN = 0.9
"""Shorter than this share of gravity are readings, and their mean in axes that stand still, only in another unit."""
LEAST_TURNING = 0.7


@dataclass(frozen=True)
class GravitySeen:
    """Gravity in accelerometer readings, in their unit: `mean` by the average, `turning` by what turns."""

    mean: float
    turning: float


def gravity_removed(t: Array, rate_radps: Array, force_mps2: Array, gravity_mps2: float) -> Fault | None:
    """A fault where readings (n, 3), m/s², show no gravity beside rates (n, 3), rad/s, at stamps t (n,), s.

    None where they do, in this unit or in another that they may be in, or where the motion does not tell.
    """
    if float(np.median(np.linalg.norm(force_mps2, axis=1))) >= LEAST_LENGTH * gravity_mps2:
        return None
    seen = gravity_seen(t, rate_radps, force_mps2)
    if seen is None or seen.mean >= LEAST_MEAN * gravity_mps2 or seen.turning >= LEAST_TURNING * gravity_mps2:
        return None
    for in_mps2 in MPS2_UNITS.values():
        mean, turning = (x * in_mps2 / gravity_mps2 for x in (seen.mean, seen.turning))
        if LEAST_MEAN <= mean <= 1 / LEAST_MEAN or LEAST_TURNING <= turning <= 1 / LEAST_TURNING:
            return None
    share = seen.turning / gravity_mps2
    return Fault(
        Sensor.ACCELEROMETER,
        "",
        ReasonCode.GRAVITY_REMOVED,
        share,
        LEAST_TURNING,
        True,
        f"Gravity has been taken off the accelerometer's readings: of it {100 * share:.0f} % turn with the vehicle, "
        f"and {100 * seen.mean / gravity_mps2:.0f} % remain on average. Log the acceleration with gravity (raw, not "
        "linear).",
    )


def gravity_seen(t: Array, rate_radps: Array, force: Array) -> GravitySeen | None:
    """Gravity in readings `force` (n, 3) beside rotation rates (n, 3), rad/s, at stamps t (n,), s.

    The medians over windows, the larger over every combination of signs of the gyroscope's axes, which may be wired
    otherwise. None where there are too few windows, or the vehicle hardly tilted.
    """
    rate, force = (_windows(t, x) for x in (rate_radps - np.median(rate_radps, axis=0), force))
    if len(force) < FEWEST_WINDOWS:
        return None
    direction = force.mean(axis=1)
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-300)
    means, turnings, coherences = [], [], []
    for signs in product((1.0, -1.0), repeat=3):
        body_from_still = _turned(rate * np.array(signs))
        still = np.einsum("wkji,wkj->wki", body_from_still, force).mean(axis=1)
        coherence = np.einsum("wkji,wj->wki", body_from_still, direction).mean(axis=1)
        coherences.append(float(np.quantile(np.linalg.norm(coherence, axis=1), 0.1)))
        means.append(float(np.median(np.linalg.norm(still, axis=1))))
        turnings.append(_turning(body_from_still, force, still))
    if min(coherences) > LARGEST_COHERENCE:
        return None
    return GravitySeen(max(means), max(turnings))


def _windows(t: Array, x: Array) -> Array:
    """Readings x (n, 3) at stamps t (n,) on an even grid, in whole windows (w, k, 3)."""
    k = round(WINDOW_S / STEP_S)
    starts = t[0] + WINDOW_S * np.unique(((t - t[0]) // WINDOW_S).astype(np.int64))
    starts = starts[starts + WINDOW_S <= t[-1]]
    grid = (starts[:, None] + STEP_S * np.arange(k)).ravel()
    return np.stack([np.interp(grid, t, column) for column in x.T], axis=1).reshape(-1, k, 3)


def _turned(rate_radps: Array) -> Array:
    """Rotation matrices (w, k, 3, 3), axes that stand still to body, from rates (w, k, 3); the identity first."""
    step = from_rotation_vector(rate_radps * STEP_S)
    q = np.empty_like(step)
    q[:, 0] = IDENTITY
    for k in range(1, step.shape[1]):
        q[:, k] = multiply(q[:, k - 1], step[:, k - 1])
    return body_from_inertial(q)


def _turning(body_from_still: Array, force: Array, still: Array) -> float:
    """Median length of the vectors, one a window, that stand still beside a constant in body axes, by least squares.

    The windows' vectors are eliminated: each is its window's mean less the constant, both in axes that stand still.
    """
    mean_turn = body_from_still.transpose(0, 1, 3, 2).mean(axis=1)
    normal = np.eye(3) - np.mean(mean_turn.transpose(0, 2, 1) @ mean_turn, axis=0)
    right = np.mean(force.mean(axis=1) - np.einsum("wji,wj->wi", mean_turn, still), axis=0)
    constant = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    return float(np.median(np.linalg.norm(still - mean_turn @ constant, axis=1)))
