"""Noise of the joint estimate: levels estimated with the fit (variance components), and readings that are not noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from fieldcal.estimation.joint.problem import Model, State, Trajectory
from fieldcal.estimation.segments import true_runs
from fieldcal.estimation.statistics import low_frequency_density, robust_sigma
from fieldcal.geometry.rotation import Array

# Length of a three-axis residual, in sd, beyond which a reading loses influence: χ²₃ exceeds it once in a thousand.
CLIP_SD = 4.0
# A magnetometer's readings of less weight are outliers; a run of them is a passing field, which extends beyond the run
# by this share of its length.
OUTLIER_WEIGHT, BURST_EDGE_SHARE = 0.25, 0.25
# Strength of the translation at the start, and the attitude's walk there over that by the gyroscope's sample-to-sample
# noise: loose, since the start is wrong by more than noise.
START_ACCELERATION_MPS2, START_WALK_RATIO = 0.2, 10.0
# The walk is at most this multiple of that by sample-to-sample noise (a band limit hides a factor of about 4): a field
# that varies from place to place would otherwise be taken for a gyroscope whose attitude walks.
LARGEST_WALK_RATIO = 10.0
LARGEST_WALK_DROP = 4.0  # factor by which the walk may fall towards that bound in one iteration
LEAST_ACCELERATION_MPS2, LEAST_WALK, LEAST_VARIANCE = 2e-3, 1e-9, 1e-8
# Bounds of the ratio of a variance to that of the iteration before, (walk, translation): the translation may vanish,
# the walk links the attitudes and may not.
SMALLEST_STEP_RATIO, LARGEST_STEP_RATIO = np.array([0.25, 0.01]), np.array([4.0, 10.0])


# Longest correlation of a residual that its density takes in, s, and the largest density over that of white noise.
COLOUR_S, LARGEST_COLOUR, LARGEST_COLOUR_WITHIN = 3.0, 400.0, 10.0
# By chance correlation over so long a time makes a density seem so many times larger.
CHANCE_COLOUR_RATIO = 1.5


@dataclass(frozen=True)
class Levels:
    """Noise levels: `variance` (r,) of each residual of a row, x²; `colour` (r,) its density at low frequency over that
    of white noise of the same variance, by correlation over seconds, and `colour_within` (r,) over half an interval;
    `walk`, density of the attitude's random walk by gyroscope noise, rad²/s;
    `strength`, stationary rms of the translation's acceleration, m/s² an axis."""

    variance: Array
    colour: Array
    colour_within: Array
    walk: float
    strength: float


def first_levels(model: Model, state: State, path: Trajectory, residual: Array) -> Levels:
    """Levels to start from: those of the residuals at the start."""
    valid = np.repeat(model.valid_rows(), 3, axis=1)
    sigma = np.array([robust_sigma(r[k]) for r, k in zip(residual.T, valid.T, strict=True)])
    variance = np.maximum(sigma**2, LEAST_VARIANCE)
    jumped = np.sum(path.jump**2) / (3.0 * np.sum(model.knots.interval_s * model.knots.joined))
    walk = max(START_WALK_RATIO * gyro_walk(model, state), float(jumped), LEAST_WALK)
    strength = START_ACCELERATION_MPS2
    if "accelerometer" in model.vectors:
        row = 3 * model.vectors.index("accelerometer")
        strength = max(strength, float(np.max(sigma[row : row + 3] * np.abs(state.values["accelerometer"][:3]))))
    return Levels(variance, np.ones(len(variance)), np.ones(len(variance)), walk, strength)


def gyro_walk(model: Model, state: State) -> float:
    """Density of the random walk, rad²/s, that the gyroscope's sample-to-sample noise makes of the integrated
    attitude."""
    noise = np.max(model.gyroscope_noise * np.abs(state.values["gyroscope"][:3]))
    return float(noise**2 * model.knots.sample_s)


def renewed_levels(
    model: Model, residual: Array, levels: Levels, absorbed: Array, squares: Array, largest_walk: float, *, slow: bool
) -> Levels:
    """Variance components: sums of squares over the degrees of freedom that the unknowns leave.

    `absorbed` (r,) degrees of freedom of each residual that the unknowns absorb, of white noise; `squares` (2, 3) of
    the joints (`joint.chain_solver.joint_squares`); `largest_walk`, rad²/s;
    `slow`: colour over seconds too."""
    weight = robust_weight(model, residual, levels)
    count = weight.sum(axis=0)
    left = np.maximum(count - levels.colour * absorbed, 0.05 * count)
    variance = np.maximum(np.sum(weight * residual**2, axis=0) / left, LEAST_VARIANCE)
    # Upwards the fixed-point iteration; downwards Newton's method, bounded: it reaches zero where there is no such
    # noise.
    square, free, information = np.maximum(squares.T, 1e-9)
    number = np.where(square < free, np.minimum(information, free), free)
    ratio = np.clip(1.0 + (square - free) / number, SMALLEST_STEP_RATIO, LARGEST_STEP_RATIO)
    walk, strength = levels.walk * ratio[0], levels.strength * np.sqrt(ratio[1])
    within = colour_within(model, residual, weight)
    return Levels(
        variance,
        slow_colour(model, residual, weight) if slow else within,
        within,
        # Attitudes that jump at the start are linked loosely first and more stiffly step by step: the linearisation
        # holds for small turns only.
        float(np.clip(walk, LEAST_WALK, max(largest_walk, levels.walk / LARGEST_WALK_DROP, LEAST_WALK))),
        max(float(strength), LEAST_ACCELERATION_MPS2),
    )


def largest_level_change(before: Levels, after: Levels, squares: Array) -> float:
    """Largest relative change of a noise variance; of walk and translation in units of their sd where that is larger
    than the level itself."""
    old, new = (np.r_[v.variance, v.walk, v.strength**2] for v in (before, after))
    change = np.abs(new / old - 1.0)
    change[-2:] *= np.minimum(1.0, np.sqrt(0.5 * squares[:, 2]))
    return float(np.max(change))


def robust_weight(model: Model, residual: Array, levels: Levels) -> Array:
    """Redescending weights (m, r): 1 up to a residual of d = CLIP_SD standard deviations, (CLIP_SD/d)⁴ beyond, 0 where
    there is no reading.

    With (CLIP_SD/d)² a wrong reading would add CLIP_SD² to its variance, however far off, and six in a hundred of them
    would inflate that until none is an outlier. A magnetometer's d is the larger one of the reading alone and of the
    mean over an interval, which shows the edges of a burst; an accelerometer's common part over an interval is
    translation."""
    out = np.empty_like(residual)
    together = max(1, len(residual) // len(model.knots.index))
    for i, name in enumerate(model.vectors):
        row = slice(3 * i, 3 * i + 3)
        square = np.sum(residual[:, row] ** 2 / levels.variance[row], axis=1)
        if name == "magnetometer":
            mean = uniform_filter1d(residual[:, row], together, axis=0)
            square = np.maximum(
                square, np.sum(mean**2 * together / (levels.variance * levels.colour_within)[row], axis=1)
            )
        weight = np.minimum(1.0, CLIP_SD**2 / np.maximum(square, 1e-12)) ** 2 * model.triads[name].valid
        out[:, row] = weight[:, None]
    return out


def passing_fields(model: Model, weight: Array) -> np.ndarray:
    """Rows (m,) at which the magnetometer reads a passing field: runs of outliers and BURST_EDGE_SHARE of their length
    on either side, since a field rises out of the noise and falls back into it within a time like that above it."""
    vectors = model.vectors
    if "magnetometer" not in vectors:
        return np.zeros(len(model.at), dtype=bool)
    valid = model.triads["magnetometer"].valid
    outlier = valid & (weight[:, 3 * vectors.index("magnetometer")] < OUTLIER_WEIGHT)
    start, stop = true_runs(outlier)
    reach = (BURST_EDGE_SHARE * (stop - start)).astype(int)
    start, stop = np.maximum(start - reach, 0)[reach > 0], np.minimum(stop + reach, len(outlier))[reach > 0]
    change = np.bincount(start, minlength=len(outlier) + 1) - np.bincount(stop, minlength=len(outlier) + 1)
    return np.asarray(valid & (np.cumsum(change)[:-1] > 0))


def colour_within(model: Model, residual: Array, weight: Array) -> Array:
    """Density at low frequency over that of white noise, (r,): from the autocorrelation over half an interval."""
    lags = int(np.clip(len(residual) / len(model.knots.index) / 2, 1, 8))
    return _colour(residual * np.sqrt(weight), lags, LARGEST_COLOUR_WITHIN)


def slow_colour(model: Model, residual: Array, weight: Array) -> Array:
    """The same over COLOUR_S: a magnetometer's residual (soft iron, a room) is coloured over seconds."""
    interval_s = float(np.sum(model.knots.interval_s * model.knots.joined)) / max(len(residual), 1)
    lags = int(np.clip(COLOUR_S / interval_s, 1, max(len(residual) // 4, 1)))
    return np.maximum(_colour(residual * np.sqrt(weight), lags, LARGEST_COLOUR), colour_within(model, residual, weight))


def _colour(x: Array, lags: int, largest: float) -> Array:
    """Of each column of x (m, r), the axes of a triad together."""
    return np.repeat(low_frequency_density(x, lags, together=3, largest=largest), 3)
