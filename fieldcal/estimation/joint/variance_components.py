"""Noise of the joint estimate: levels found beside the fit (variance components), and readings that are not noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from fieldcal.estimation.joint.measurement_model import Trajectory
from fieldcal.estimation.joint.problem import Model, State
from fieldcal.estimation.segments import true_runs
from fieldcal.estimation.statistics import robust_sigma, white_noise_sigma
from fieldcal.geometry.rotation import Array

# Residual length, sd of a three-axis reading, beyond which a reading loses influence: χ²₃ passes it once in a thousand.
CLIP = 4.0
# A magnetometer's readings of less weight are lost; a run of them is a field that passes, whose edges reach beyond by
# this share of its length.
LOST, BURST_EDGE = 0.25, 0.25
# The translation at the start, and the gyroscope's walk there over what its sample-to-sample noise makes: loose, since
# the start is wrong by more than noise.
ACCELERATION_START_MPS2, WALK_START = 0.2, 10.0
# The walk is at most this multiple of what that noise makes (a band limit hides a factor of about 4): a field that
# varies from place to place would otherwise be taken for a gyroscope that walks.
MOST_WALK = 10.0
STIFFENING = 4.0
LEAST_ACCELERATION_MPS2, LEAST_WALK, LEAST_VARIANCE = 2e-3, 1e-9, 1e-8
# Bounds of a step of a variance: the translation may vanish, the walk is what ties the attitudes.
LEAST_RATIO, MOST_RATIO = np.array([0.25, 0.01]), np.array([4.0, 10.0])


@dataclass(frozen=True)
class Levels:
    """Noise: `variance` (r,) of each sensor row a sample, units of x; `colour` (r,) its density at low frequency over
    that of white noise of the same variance; `walk` of the attitude by gyroscope noise, rad²/s; `strength` of the
    translation, m/s² an axis."""

    variance: Array
    colour: Array
    walk: float
    strength: float


def first_levels(model: Model, state: State, path: Trajectory, residual: Array) -> Levels:
    """Levels to start from, of a start's own residuals."""
    known = np.repeat(np.column_stack([model.triads[name].known for name in model.rows]), 3, axis=1)
    sigma = np.array([robust_sigma(r[k]) for r, k in zip(residual.T, known.T, strict=True)])
    variance = np.maximum(sigma**2, LEAST_VARIANCE)
    jumped = np.sum(path.jump**2) / (3.0 * np.sum(model.knots.interval_s * model.knots.joined))
    walk = max(WALK_START * gyro_walk(model, state), float(jumped), LEAST_WALK)
    strength = ACCELERATION_START_MPS2
    if "accelerometer" in model.rows:
        row = 3 * model.rows.index("accelerometer")
        strength = max(strength, float(np.max(sigma[row : row + 3] * np.abs(state.values["accelerometer"][:3]))))
    return Levels(variance, np.ones(len(variance)), walk, strength)


def gyro_walk(model: Model, state: State) -> float:
    """Walk of the integrated attitude, rad²/s, that the gyroscope's sample-to-sample noise makes."""
    noise = np.max(white_noise_sigma(model.triads["gyroscope"].x) * np.abs(state.values["gyroscope"][:3]))
    return float(noise**2 * model.knots.sample_s)


def renewed_levels(
    model: Model, residual: Array, levels: Levels, absorbed: Array, squares: Array, sensor_walk: float
) -> Levels:
    """Variance components: squares over what the unknowns leave of their number; `absorbed` (r,) by the rows of each
    sensor axis, `squares` (2, 3) of the joints (`joint.chain_solver.joint_squares`), `sensor_walk` by `gyro_walk`."""
    weight = robust_weight(model, residual, levels)
    count = weight.sum(axis=0)
    left = np.maximum(count - levels.colour * absorbed, 0.05 * count)
    variance = np.maximum(np.sum(weight * residual**2, axis=0) / left, LEAST_VARIANCE)
    # Upwards the fixed point; downwards Newton's method, bounded: it gets to nothing where there is nothing.
    square, free, information = np.maximum(squares.T, 1e-9)
    number = np.where(square < free, np.minimum(information, free), free)
    ratio = np.clip(1.0 + (square - free) / number, LEAST_RATIO, MOST_RATIO)
    walk, strength = levels.walk * ratio[0], levels.strength * np.sqrt(ratio[1])
    return Levels(
        variance,
        _colour(model, residual, weight),
        # A start that jumps is loose at first and stiffens by steps: the linear equations hold for small turns only.
        float(np.clip(walk, LEAST_WALK, max(MOST_WALK * sensor_walk, levels.walk / STIFFENING, LEAST_WALK))),
        max(float(strength), LEAST_ACCELERATION_MPS2),
    )


def unsettled_by(before: Levels, after: Levels, squares: Array) -> float:
    """Largest relative change of a noise variance; of walk and translation in standard deviations where one could claim
    less than their own size."""
    old, new = (np.r_[v.variance, v.walk, v.strength**2] for v in (before, after))
    change = np.abs(new / old - 1.0)
    change[-2:] *= np.minimum(1.0, np.sqrt(0.5 * squares[:, 2]))
    return float(np.max(change))


def robust_weight(model: Model, residual: Array, levels: Levels) -> Array:
    """Redescending weights (m, r): 1 up to CLIP standard deviations of the reading, (CLIP/d)⁴ beyond, 0 for none.

    With the square alone a wrong reading adds CLIP² to its variance, however far off, and six in a hundred of them
    inflate that until none is an outlier. A magnetometer's d is of the reading alone or of the mean over an interval,
    which shows the edges of a burst; what an accelerometer has in common over one is translation."""
    out = np.empty_like(residual)
    together = max(1, len(residual) // len(model.knots.index))
    for i, name in enumerate(model.rows):
        row = slice(3 * i, 3 * i + 3)
        square = np.sum(residual[:, row] ** 2 / levels.variance[row], axis=1)
        if name == "magnetometer":
            mean = uniform_filter1d(residual[:, row], together, axis=0)
            square = np.maximum(square, np.sum(mean**2 * together / (levels.variance * levels.colour)[row], axis=1))
        weight = np.minimum(1.0, CLIP**2 / np.maximum(square, 1e-12)) ** 2 * model.triads[name].known
        out[:, row] = weight[:, None]
    return out


def passing_fields(model: Model, weight: Array) -> np.ndarray:
    """Magnetometer rows (m,) of fields that pass: runs of lost readings and BURST_EDGE of their length on either side,
    since a field rises out of the noise, and falls back into it, no faster than it stays above."""
    rows = model.rows
    if "magnetometer" not in rows:
        return np.zeros(len(model.at), dtype=bool)
    known = model.triads["magnetometer"].known
    lost = known & (weight[:, 3 * rows.index("magnetometer")] < LOST)
    first, past = true_runs(lost)
    reach = (BURST_EDGE * (past - first)).astype(int)
    first, past = np.maximum(first - reach, 0)[reach > 0], np.minimum(past + reach, len(lost))[reach > 0]
    change = np.bincount(first, minlength=len(lost) + 1) - np.bincount(past, minlength=len(lost) + 1)
    return np.asarray(known & (np.cumsum(change)[:-1] > 0))


def _colour(model: Model, residual: Array, weight: Array) -> Array:
    """Density at low frequency over the white one, (r,): from the autocorrelation within half an interval."""
    lags = int(np.clip(len(residual) / len(model.knots.index) / 2, 1, 8))
    x = residual * np.sqrt(weight)
    zero = np.maximum(np.sum(x * x, axis=0), 1e-300)
    colour = np.ones(x.shape[1])
    for lag in range(1, lags + 1):
        colour += 2.0 * (1.0 - lag / (lags + 1)) * np.sum(x[lag:] * x[:-lag], axis=0) / zero
    return np.clip(np.repeat(colour.reshape(-1, 3).mean(axis=1), 3), 1.0, 10.0)
