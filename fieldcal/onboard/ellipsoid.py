"""Adjusted least-squares ellipsoid from moments: scale and bias of a triad with their sd, or a refusal.

Least squares of a quadric on noisy readings is biased, the more the less of the sphere was seen. Kukush, Markovsky and
Van Huffel (2004) take what noise adds off the moments, and the bias is gone. How the axes share the noise their third
differences say; how much there is, the residuals, so that whatever scatters evenly counts, and not the sensor's own
noise alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldcal.geometry.rotation import Array
from fieldcal.names import Triple
from fieldcal.onboard.moments import DEGREE, PLACE, noise_slope, translate, without_noise
from fieldcal.onboard.noise import variance_of
from fieldcal.reason_codes import ReasonCode

FEWEST_SAMPLES = 50
CHANCE = 3.0
"""Sd of `excess` that are taken for chance."""
LEAST_EXCESS = 0.01
"""Of readings that no noise is seen of, but their converter's."""
MOST_STEPS = 40
"""Newton's take four to six."""

TERMS = ((2, 0, 0), (0, 2, 0), (0, 0, 2), (0, 1, 1), (1, 0, 1), (1, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
"""xx yy zz yz xz xy x y z 1, of which a quadric is the sum."""
PRODUCT = np.array([[PLACE[tuple(np.add(a, b).tolist())] for b in TERMS] for a in TERMS])
"""Where the moment of the product of two terms stands."""
MIXED = (3, 4, 5)
JOINS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""The axes that a scale joins: xx yy zz yz xz xy."""
SYMMETRIC = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
"""The scale that joins two axes."""


@dataclass(frozen=True)
class Limits:
    """What is asked of a triad.

    Attributes
    ----------
    magnitude : float
        Length of the sensed vector, in the unit wanted for the result.
    polarity : (3,) of ±1
        Lengths cannot tell it.
    full : bool
        A symmetric scale matrix instead of three scales.
    correlated_samples : float
        Over how many samples what is not the sensor's own noise stays alike.
    max_condition, max_scale_sd, max_residual : float
        Refused beyond: condition number, relative sd of a scale, rms of length over magnitude − 1.

    Examples
    --------
    >>> Limits(magnitude=9.80665).max_condition
    50.0
    """

    magnitude: float
    polarity: Triple = (1.0, 1.0, 1.0)
    full: bool = False
    correlated_samples: float = 30.0
    max_condition: float = 50.0
    max_scale_sd: float = 0.05
    max_residual: float = 0.1


@dataclass(frozen=True)
class MomentsFit:
    """z = scale · logged + bias from moments.

    Attributes
    ----------
    reason_code : ReasonCode or None
        Why it is refused. What could be computed stands beside it, the rest is NaN.
    scale, scale_sd : (3, 3) arrays
    bias, bias_sd : (3,) arrays
    covariance : (6, 6) array
        Of the scales xx, yy, zz and the bias.
    condition : float
        Of the column-normalised sensitivities; infinite where they are dependent.
    residual_rms : float
        Of length over magnitude − 1.
    noise_sd : (3,) array
        Of a reading, logged units.
    excess : float
        Variance that the residuals show over that of the readings' noise where it is averaged: 1 for white noise, less
        for noise behind a low-pass filter, more where another acceleration or field was sensed.
    n_samples : int

    Examples
    --------
    >>> import numpy as np
    >>> from fieldcal.onboard import Limits, Moments
    >>> u = np.random.default_rng(1).normal(size=(1000, 3))
    >>> moments = Moments()
    >>> moments.feed(u / np.linalg.norm(u, axis=1, keepdims=True) * 0.5 + 3.0)
    >>> moments.solve(Limits(magnitude=1.0)).bias.round(6)
    array([-6., -6., -6.])
    """

    reason_code: ReasonCode | None
    scale: Array
    scale_sd: Array
    bias: Array
    bias_sd: Array
    covariance: Array
    condition: float
    residual_rms: float
    noise_sd: Array
    excess: float
    n_samples: int


def fit_moments(moments: Array, centre: Array, noise: Array, differences: int, limits: Limits) -> MomentsFit:
    """The ellipsoid that readings draw, from their moments (35,) about `centre` (3,).

    Parameters
    ----------
    moments : (35,) array
        Number and sums of the readings less centre (`moments.EXPONENTS`); the last ten are used by a full fit only.
    centre : (3,) array
        What was taken off the readings.
    noise : (3,) array
        Sums of the readings' squared third differences (`noise.NoiseStream`), of which there are `differences`.
    limits : Limits

    Returns
    -------
    MomentsFit
        Judged: `reason_code` is `too_few_samples`, `ellipsoid_degenerate`, `too_little_motion`, `scale_uncertain`,
        `not_a_sphere` or None.

    Raises
    ------
    ValueError
        The magnitude is not positive.

    Notes
    -----
    The standard deviations are of noise as averaging sees it (`noise`); what the residuals show beyond it, more than by
    chance, is taken to stay alike over `limits.correlated_samples`.

    References
    ----------
    Kukush, Markovsky & Van Huffel (2004), Consistent estimation in the ellipsoid fitting problem; Eq. 5–8.
    """
    if not limits.magnitude > 0:
        raise ValueError(f"magnitude must be positive, got {limits.magnitude}")
    n = int(moments[0])
    if n < FEWEST_SAMPLES:
        return _refused(ReasonCode.TOO_FEW_SAMPLES, n)
    mean = moments[1:4] / n
    m = translate(moments, mean)
    spread = float(np.sqrt(max(float(np.sum(m[4:7])) / (3.0 * n), 0.0)))
    if not spread > 0.0:
        return _refused(ReasonCode.ELLIPSOID_DEGENERATE, n)
    m = m / (n * spread ** DEGREE.astype(float))
    own = variance_of(noise, differences)
    v = np.full(3, 1e-6) if own is None else np.maximum(own / spread**2, 1e-12)
    found = _adjusted_quadric(m, v, limits.full)
    triad = None if found is None else _triad_of(found[0])
    if found is None or triad is None:
        return _refused(ReasonCode.ELLIPSOID_DEGENERATE, n)
    quadric, clean, factor = found
    scale, bias = triad
    excess = 1.0 if own is None else float(factor)
    v = v * factor
    covariance, condition = _covariance(m, clean, v, limits.full, scale, bias)
    residual = np.sqrt(max(float(quadric @ m[PRODUCT] @ quadric), 0.0)) * float(np.sum(scale * scale)) / 6.0
    if covariance is None:
        return _refused(ReasonCode.TOO_LITTLE_MOTION, n, float(residual), np.sqrt(v) * spread, excess)
    beyond = 0.0 if own is None else max(excess - 1.0 - CHANCE * np.sqrt(2.0 / n + 1.54 / differences), 0.0)
    level = max(excess - beyond, 1.0) + beyond * max(limits.correlated_samples, 1.0)
    covariance = covariance * level / (n * max(excess, LEAST_EXCESS))
    values = _in_logged_units(limits, spread, centre + mean, scale, bias, covariance)
    relative = np.diagonal(values[1]) / np.abs(np.diagonal(values[0]))
    code = None
    if not condition <= limits.max_condition:
        code = ReasonCode.TOO_LITTLE_MOTION
    elif not (relative <= limits.max_scale_sd).all():
        code = ReasonCode.SCALE_UNCERTAIN
    elif not residual <= limits.max_residual:
        code = ReasonCode.NOT_A_SPHERE
    return MomentsFit(code, *values, condition, float(residual), np.sqrt(v) * spread, float(excess), n)


def _refused(
    code: ReasonCode, n: int, residual: float = np.nan, noise_sd: Array | None = None, excess: float = np.nan
) -> MomentsFit:
    """A refusal without constants."""
    square, three = np.full((3, 3), np.nan), np.full(3, np.nan)
    own_noise = three if noise_sd is None else noise_sd
    six = np.full((6, 6), np.nan)
    return MomentsFit(code, square, square, three, three, six, np.inf, residual, own_noise, excess, n)


def _directions(full: bool) -> Array:
    """The quadric's free directions (p, 10): the trace of its square part is held, an axis-aligned one has no mixed
    terms."""
    rows = np.eye(10)
    rows[:2, 2] = -1.0
    return rows[[k for k in range(10) if k != 2 and (full or k not in MIXED)]]


def _adjusted_quadric(m: Array, v: Array, full: bool) -> tuple[Array, Array, float] | None:
    """Quadric (10,), the moments without noise, and the factor of v at which nothing of the least mean square is left.

    It is concave in the factor: Newton's steps, halved where they leave too little of the moments. None where there is
    no quadric even at 0."""
    free = _directions(full)
    sphere = np.zeros(10)
    sphere[:3] = 1.0
    factor, least, most = 0.0, 0.0, np.inf
    for step in range(MOST_STEPS):
        clean = without_noise(m, factor * v)
        matrix = clean[PRODUCT]
        h = free @ matrix @ free.T
        following = 0.5 * (least + factor)
        if _positive(h):
            quadric = sphere - free.T @ np.linalg.solve(h, free @ matrix @ sphere)
            left = float(quadric @ matrix @ quadric)
            slope = float(quadric @ noise_slope(clean, v)[PRODUCT] @ quadric)
            least, most = (factor, most) if left >= 0.0 else (least, factor)
            following = max(factor - left / slope, least)
            if abs(following - factor) <= 1e-9 * following or step == MOST_STEPS - 1:
                return quadric, clean, following
        elif step == 0:
            return None
        else:
            most = factor
        factor = following if following < most else 0.5 * (least + most)
    return None


def _positive(matrix: Array) -> bool:
    """Whether a symmetric matrix is positive definite, by its pivots."""
    own = np.array(matrix)
    diagonal = np.diagonal(matrix).copy()
    for j in range(len(own)):
        if not own[j, j] > 1e-13 * diagonal[j]:
            return False
        own[j + 1 :, j + 1 :] -= np.outer(own[j + 1 :, j], own[j, j + 1 :]) / own[j, j]
    return True


def _triad_of(quadric: Array) -> tuple[Array, Array] | None:
    """Λ (3, 3) and b (3,) for unit length of yᵀAy + bᵀy + d = 0; None where it is no ellipsoid."""
    a = np.array([[quadric[k] * (1.0 if k < 3 else 0.5) for k in row] for row in SYMMETRIC])
    lengths, axes = np.linalg.eigh(a)
    if not lengths[0] > 1e-6:  # of a trace of 3
        return None
    along = -0.5 * axes.T @ quadric[6:9]
    g = float(np.sum(along**2 / lengths) - quadric[9])
    if not g > 0.0:
        return None
    scale = (axes * np.sqrt(lengths / g)) @ axes.T
    if not quadric[list(MIXED)].any():
        scale = np.diag(np.diagonal(scale))
    return scale, -scale @ (axes @ (along / lengths))


def _product(a: Array, b: Array) -> Array:
    """Product of two linear functions (x, y, z, 1) as a quadric."""
    both = np.outer(a, b)
    both = both + both.T
    i, j = [1, 0, 0], [2, 2, 1]
    return np.concatenate([0.5 * np.diagonal(both)[:3], both[i, j], both[:3, 3], [0.5 * both[3, 3]]])


def _covariance(
    raw: Array, clean: Array, v: Array, full: bool, scale: Array, bias: Array
) -> tuple[Array | None, float]:
    """n times the covariance (p, p) of the scales, then the bias, for unit length, and the condition number.

    N⁻¹ V N⁻¹: N are the moments of the sensitivities of r = (‖h‖² − 1)/2, h = Λy + b, without noise; V is the variance
    of the estimating equations by noise of y, in its square and fourth power."""
    h = np.column_stack([scale, bias])
    gradient = scale @ h  # ∂r/∂y
    variance = sum(v[i] * (_product(gradient[i], gradient[i]) @ raw[PRODUCT[9]]) for i in range(3))
    unit = np.eye(4)
    joins = JOINS if full else JOINS[:3]
    rows = [_product(h[i], unit[j]) + (_product(h[j], unit[i]) if i != j else 0.0) for i, j in joins]
    rows += [_product(h[i], unit[3]) for i in range(3)]
    sensitivity = np.array(rows)
    n = sensitivity @ clean[PRODUCT] @ sensitivity.T
    diagonal = np.diagonal(n)
    if not (diagonal > 0).all():
        return None, np.inf
    eigenvalues = np.linalg.eigvalsh(n / np.sqrt(np.outer(diagonal, diagonal)))
    if not eigenvalues[0] > 0 or not _positive(n):
        return None, np.inf
    # What noise does to a sensitivity goes with what it does to r.
    second = np.array([sum(v[i] * _product(_derivative(row, i), gradient[i]) for i in range(3)) for row in sensitivity])
    middle = variance * sensitivity @ raw[PRODUCT] @ sensitivity.T + second @ raw[PRODUCT] @ second.T
    inverse = np.linalg.inv(n)
    return inverse @ middle @ inverse.T, float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))


def _derivative(quadric: Array, axis: int) -> Array:
    """Of a quadric by an axis, a linear function (4,)."""
    out = np.append(quadric[SYMMETRIC[axis]], quadric[6 + axis])
    out[axis] *= 2.0
    return out


def _in_logged_units(
    limits: Limits, spread: float, centre: Array, scale: Array, bias: Array, covariance: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """scale, scale_sd, bias, bias_sd and covariance (6, 6) for y = (z − centre)/spread."""
    p = len(covariance)
    sign = np.asarray(limits.polarity, dtype=float)
    own = limits.magnitude / spread
    transform = np.zeros((9, p))
    for i in range(3):
        transform[i, i] = sign[i] * own
        transform[3 + i, p - 3 + i] = sign[i] * limits.magnitude
        for j in range(3):
            if SYMMETRIC[i, j] < p - 3:
                transform[3 + i, SYMMETRIC[i, j]] -= sign[i] * own * centre[j]
        if p > 6:
            transform[6 + i, 3 + i] = own
    out = transform @ covariance @ transform.T
    sd = np.sqrt(np.diagonal(out))
    scale_sd = np.where(np.eye(3, dtype=bool), sd[SYMMETRIC], sd[np.minimum(SYMMETRIC + 3, 8)])
    logged = sign[:, None] * scale * own
    return logged, scale_sd, sign * limits.magnitude * bias - logged @ centre, sd[3:6], out[:6, :6]
