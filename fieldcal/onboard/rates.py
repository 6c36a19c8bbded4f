"""Gyroscope by recursive least squares on the four kinematic equations, in information form: its normal equations.

A block of attitudes gives one equation an axis, y = λ x + b: y the body rate 2 Ξᵀ q̇ of the block's slope (Eq. 10–11,
where the axes decouple), x the mean of its readings with the weights that a slope gives to what it is the slope of.
Blocks do not overlap, so that white attitudes leave white residuals. The same sums as in `c/fieldcal_onboard.c`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldcal.geometry.rotation import Array, body_rate
from fieldcal.names import Triple
from fieldcal.onboard.noise import variance_of
from fieldcal.reason_codes import ReasonCode

SUMS = 33
"""weight, weight², pairs, then of each axis `OF_AXIS`."""
WEIGHT, SQUARES, PAIRS, AXIS = 0, 1, 2, 3
OF_AXIS = 10
X, Y, XX, XY, YY, LAG_X, LAG_Y, LAG_XX, LAG_YY, LAG_XY = range(OF_AXIS)
FEWEST_BLOCKS = 10
MOST_CORRELATION = 0.95
MOST_LEFT = 0.4
"""Residual over what the gyroscope explains, rms: on hand-turned recordings whose attitudes were spoilt by other
accelerations it was 0.45 to 24 and constants up to half off, on flights that were good 0.1."""


@dataclass(frozen=True)
class RatesFit:
    """z = scale · logged + bias of the gyroscope, an axis each.

    Attributes
    ----------
    reason_code : tuple of ReasonCode or None
        Why an axis is refused.
    scale, scale_sd, bias, bias_sd : (3,) arrays
    covariance : (3,) array
        Of scale and bias of an axis.
    residual_rms : (3,) array
        Of the equations, rad/s.
    correlation : (3,) array
        Of neighbouring residuals.
    n_samples : int

    Examples
    --------
    >>> from fieldcal.onboard import RateEquations
    >>> RateEquations(block_samples=10).solve().reason_code[0]
    <ReasonCode.TOO_FEW_SAMPLES: 'too_few_samples'>
    """

    reason_code: tuple[ReasonCode | None, ReasonCode | None, ReasonCode | None]
    scale: Array
    scale_sd: Array
    bias: Array
    bias_sd: Array
    covariance: Array
    residual_rms: Array
    correlation: Array
    n_samples: int


def shares(block_samples: int) -> Array:
    """Weights (m,) of a block's readings, of sum 1: the parabola that a least-squares slope over m samples averages
    with."""
    k = np.arange(block_samples)
    parabola = 0.25 * (k * (block_samples - k) + (k + 1) * (block_samples - 1 - k))
    return parabola / (block_samples * (block_samples**2 - 1) / 12.0)


def noise_kept(block_samples: int) -> float:
    """Share of a reading's noise variance that its mean over a block keeps."""
    return float(np.sum(shares(block_samples) ** 2))


def equations_of_blocks(t_s: Array, q: Array, x: Array) -> tuple[Array, Array, Array]:
    """Readings' means x (k, 3) and body rates y (k, 3), rad/s, of blocks: stamps (k, m), attitudes (k, m, 4), readings
    (k, m, 3); and whether each block could be used (k,)."""
    m = t_s.shape[1]
    flips = np.cumsum(np.sum(q[:, 1:] * q[:, :-1], axis=2) < 0, axis=1) % 2 == 1
    q = q.copy()
    q[:, 1:][flips] *= -1.0
    from_middle = np.arange(m) - 0.5 * (m - 1)
    interval = (t_s[:, -1] - t_s[:, 0]) / (m - 1)
    length = np.linalg.norm(q.sum(axis=1), axis=1)
    usable = (interval > 0) & (length > 0.5 * m)
    slope = np.einsum("k,nki->ni", from_middle, q) / (m * (m**2 - 1) / 12.0)
    mean = q.sum(axis=1) / np.where(usable, length, 1.0)[:, None]
    rate = body_rate(mean, slope / np.where(usable, interval, 1.0)[:, None])
    return np.einsum("k,nki->ni", shares(m), x), rate, usable


def terms_of(x: Array, y: Array, follows: np.ndarray, before: tuple[Array, Array]) -> Array:
    """What equations x, y (k, 3) add to the sums, (k, 33); `follows` (k,): the one before, for the first `before`, was
    of the block before."""
    k = len(x)
    out = np.zeros((k, SUMS))
    out[:, WEIGHT] = out[:, SQUARES] = 1.0
    out[:, PAIRS] = follows
    x0 = np.concatenate([before[0][None], x[:-1]]) if k else x
    y0 = np.concatenate([before[1][None], y[:-1]]) if k else y
    own = follows[:, None]
    columns = [x, y, x * x, x * y, y * y]
    columns += [own * c for c in (x + x0, y + y0, x * x0, y * y0, x * y0 + y * x0)]
    out[:, AXIS:] = np.stack(columns, axis=2).reshape(k, 3 * OF_AXIS)
    return out


def recentred(sums: Array, by: Array) -> Array:
    """Sums (…, 33) of readings that are `by` (…, 3) larger: exact."""
    out = np.array(sums, dtype=float)
    s = out[..., AXIS:].reshape(*out.shape[:-1], 3, OF_AXIS)
    step = np.asarray(by, dtype=float)
    weight, pairs = out[..., None, WEIGHT], out[..., None, PAIRS]
    s[..., XX] += step * (2.0 * s[..., X] + step * weight)
    s[..., XY] += step * s[..., Y]
    s[..., LAG_XX] += step * (s[..., LAG_X] + step * pairs)
    s[..., LAG_XY] += step * s[..., LAG_Y]
    s[..., X] += step * weight
    s[..., LAG_X] += 2.0 * step * pairs
    return out


def fit_rates(
    sums: Array,
    centre: Array,
    noise: Array,
    differences: int,
    *,
    noise_kept: float,
    n_samples: int,
    polarity: Triple = (1.0, 1.0, 1.0),
    max_scale_sd: float = 0.05,
) -> RatesFit:
    """Scale and bias of the gyroscope's axes from the sums (33,) of readings less `centre` (3,).

    Parameters
    ----------
    sums : (33,) array
        Of the blocks' equations.
    centre : (3,) array
        What was taken off the readings.
    noise : (3,) array
        Sums of the readings' squared third differences (`noise.NoiseStream`), of which there are `differences`: their
        noise would pull the scales towards zero.
    noise_kept : float
        Share of a reading's noise that its mean over a block keeps (`noise_kept`).
    n_samples : int
    polarity : (3,) of ±1
    max_scale_sd : float
        Greatest relative sd of a scale.

    Returns
    -------
    RatesFit
        Axis by axis `too_few_samples`, `gyro_not_excited`, `scale_uncertain`, `gyro_contradicts_attitude`,
        `polarity_contradiction` or None.

    Notes
    -----
    Attitudes are taken as unbiased: what uncertain vector triads do to them is not in the standard deviations. Colour
    of the residuals is, by the correlation of neighbouring ones.

    References
    ----------
    Grauer et al., AIAA 2009-2064, Eq. 10–15.
    """
    weight, pairs = float(sums[WEIGHT]), float(sums[PAIRS])
    codes: list[ReasonCode | None] = [ReasonCode.TOO_FEW_SAMPLES] * 3
    out = np.full((7, 3), np.nan)
    own = variance_of(noise, differences)
    for i in range(3) if weight >= FEWEST_BLOCKS and pairs > 1 else ():
        s = sums[AXIS + OF_AXIS * i : AXIS + OF_AXIS * (i + 1)]
        mean_x, mean_y = s[X] / weight, s[Y] / weight
        xx, xy, yy = s[XX] / weight - mean_x**2, s[XY] / weight - mean_x * mean_y, s[YY] / weight - mean_y**2
        clean = xx - (0.0 if own is None else own[i] * noise_kept)
        if not (clean > 0.5 * xx and xx > 0):
            codes[i] = ReasonCode.GYRO_NOT_EXCITED
            continue
        slope = xy / clean
        offset = mean_y - slope * mean_x
        variance = max(yy - 2 * slope * xy + slope**2 * xx, 0.0) * weight / (weight - 2.0)
        neighbours = (
            s[LAG_YY] - slope * s[LAG_XY] + slope**2 * s[LAG_XX] - offset * s[LAG_Y] + slope * offset * s[LAG_X]
        )
        alike = (neighbours / pairs + offset**2) / variance if variance > 0 else 0.0
        alike = float(np.clip(alike, -MOST_CORRELATION, MOST_CORRELATION))
        colour = max((1.0 + alike) / (1.0 - alike), 1.0)
        per_weight = variance * colour * sums[SQUARES] / weight**2
        scale_variance = per_weight * xx / clean**2
        at = mean_x + centre[i]
        out[:, i] = (
            slope,
            np.sqrt(scale_variance),
            offset - slope * centre[i],
            np.sqrt(per_weight + at**2 * scale_variance),
            -at * scale_variance,
            np.sqrt(variance),
            alike,
        )
        if not out[1, i] <= max_scale_sd * abs(slope):
            codes[i] = ReasonCode.SCALE_UNCERTAIN
        elif variance > MOST_LEFT**2 * slope**2 * clean:
            codes[i] = ReasonCode.GYRO_CONTRADICTS_ATTITUDE
        elif slope * polarity[i] < 0:
            codes[i] = ReasonCode.POLARITY_CONTRADICTION
        else:
            codes[i] = None
    scale, scale_sd, bias, bias_sd, covariance, residual_rms, correlation = out
    by_axis = (codes[0], codes[1], codes[2])
    return RatesFit(by_axis, scale, scale_sd, bias, bias_sd, covariance, residual_rms, correlation, n_samples)
