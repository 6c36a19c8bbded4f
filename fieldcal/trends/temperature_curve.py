"""The zero of a gyroscope as a curve over temperature: flights that warmed up, and flights at different temperatures.

    zero(T) − zero(25 °C) = c1 (T − 25 °C) + c2 (T − 25 °C)² + c3 (T − 25 °C)³

which is what autopilots hold. Every source states c with its information (inverse covariance), so a flight between 10
and 15 °C says what it can of the three and no more; information adds up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from fieldcal.geometry.rotation import Array
from fieldcal.schemas.reference import REFERENCE_DEGC

ORDER = 3
SIGNIFICANT_SIGMAS = 4.0
"""A bend is believed beyond this: its sd comes from few flights."""
CONTRADICTION = 0.003
"""Chance of sources that disagree more; below it they are not combined."""
NEGLIGIBLE = 1e-10
"""Share of the largest information below which a direction of c counts as unknown."""


@dataclass(frozen=True)
class Curve:
    """c (3,) with its information (3, 3), in any unit per °C, °C² and °C³; what is not significant is 0.

    `order`: the highest power in use. `agrees`: whether warm-up flights and sessions do; None with one source alone.
    """

    coefficients: Array
    information: Array
    order: int
    agrees: bool | None

    @property
    def sd(self) -> Array:
        """Standard deviations (3,), 0 for what is not in use."""
        used = slice(0, self.order)
        sd = np.zeros(ORDER)
        sd[used] = np.sqrt(np.diagonal(np.linalg.pinv(self.information[used, used], hermitian=True)))
        return sd


def about_reference(
    coefficients: Array, covariance: Array, centre_degc: float, width_degc: float
) -> tuple[Array, Array]:
    """(c, information) at 25 °C of a cubic in (T − centre)/width, level left out: b (3,) with covariance (3, 3)."""
    d = REFERENCE_DEGC - centre_degc
    powers = width_degc ** np.arange(1.0, 4.0)
    shift = np.array([[1.0, 2.0 * d, 3.0 * d * d], [0.0, 1.0, 3.0 * d], [0.0, 0.0, 1.0]])
    back = np.array([[1.0, -2.0 * d, 3.0 * d * d], [0.0, 1.0, -3.0 * d], [0.0, 0.0, 1.0]]) * powers[:, None]
    return shift @ (coefficients / powers), back.T @ np.linalg.inv(covariance) @ back


def together(coefficients: Array, information: Array) -> tuple[Array, Array, float, int]:
    """(c, information, χ² of the sources about it, its degrees of freedom) of k sources, (k, 3) and (k, 3, 3)."""
    total = information.sum(axis=0)
    mean = _solved(total, np.einsum("kij,kj->i", information, coefficients))
    off = coefficients - mean
    return mean, total, float(np.einsum("ki,kij,kj->", off, information, off)), ORDER * (len(coefficients) - 1)


def of_sessions(temperature_degc: Array, time_day: Array, value: Array, variance: Array) -> tuple[Array, Array] | None:
    """(c, information) of one history: value (n,) with variance (n,) against temperature, level and drift fitted along;
    None where there are too few flights for a cubic and something left to judge it by."""
    n = len(value)
    dt, time = temperature_degc - REFERENCE_DEGC, time_day - time_day.mean()
    width, span = max(float(np.abs(dt).max()), 1e-9), float(np.abs(time).max())
    x = np.column_stack([(dt / width) ** k for k in (1, 2, 3)])
    nuisance = np.column_stack([np.ones(n), time / span]) if span > 0.0 else np.ones((n, 1))
    if n < ORDER + nuisance.shape[1] + 3:
        return None
    root = 1.0 / np.sqrt(variance)
    level = np.linalg.qr(nuisance * root[:, None])[0]
    weighted, y = x * root[:, None], value * root
    weighted, y = weighted - level @ (level.T @ weighted), y - level @ (level.T @ y)
    powers = width ** np.arange(1.0, 4.0)
    normal = weighted.T @ weighted
    b = _solved(normal, weighted.T @ y)
    residual = y - weighted @ b
    scale = max(1.0, float(residual @ residual) / (n - ORDER - nuisance.shape[1]))
    return b / powers, normal * np.outer(powers, powers) / scale


def widening(temperature_degc: Array, time_day: Array, variance: Array, warm: Array | None) -> tuple[float, float]:
    """By how much the sd of the value at 25 °C as of the last flight, and of the slope there, are larger for a bend
    estimated along than for a known one, from flights (n,) and the warm-up flights' information."""
    dt, time = temperature_degc - REFERENCE_DEGC, time_day - time_day.max()
    x = np.column_stack([np.ones(len(dt)), dt, time, dt**2, dt**3])
    x = x[:, [True, True, bool(np.ptp(time) > 0.0), True, True]]
    size = np.sqrt(np.mean(x**2, axis=0))
    normal = (x / size).T @ ((x / size) / variance[:, None])
    if warm is not None:
        powers = [1, x.shape[1] - 2, x.shape[1] - 1]
        normal[np.ix_(powers, powers)] += warm / np.outer(size[powers], size[powers])
    whole, given = (np.linalg.pinv(n, rcond=NEGLIGIBLE, hermitian=True) for n in (normal, normal[:-2, :-2]))
    ratio = np.sqrt(np.maximum(np.diagonal(whole)[:2] / np.diagonal(given)[:2], 1.0))
    return float(ratio[0]), float(ratio[1])


def combined(warm: tuple[Array, Array] | None, sessions: tuple[Array, Array] | None) -> Curve | None:
    """The curve of both sources by their information where they agree; where they do not, the sessions' alone, for a
    warm-up's gradients inside the IMU are in its curve. None: no source, or no bend that is significant."""
    sources = [s for s in (warm, sessions) if s is not None]
    if not sources:
        return None
    agrees = None
    if len(sources) == 2:
        (a, n_a), (b, n_b) = sources
        squares = together(np.stack([a, b]), np.stack([n_a, n_b]))[2]
        agrees = bool(special.chdtrc(ORDER, squares) >= CONTRADICTION)
        if not agrees:
            sources = sources[1:]
    c, information, _, _ = together(np.stack([s[0] for s in sources]), np.stack([s[1] for s in sources]))
    right = information @ c
    for order in (3, 2):
        part = information[:order, :order]
        estimate = _solved(part, right[:order])
        sd = np.sqrt(np.maximum(np.diagonal(np.linalg.pinv(part, hermitian=True))[order - 1], 0.0))
        if sd > 0.0 and abs(estimate[order - 1]) > SIGNIFICANT_SIGMAS * sd:
            return Curve(np.r_[estimate, np.zeros(ORDER - order)], information, order, agrees)
    return None


def _solved(normal: Array, right: Array) -> Array:
    """N⁻¹ r where directions of no information are 0; powers of °C are brought to one size first."""
    size = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=NEGLIGIBLE, hermitian=True)
    return np.asarray(inverse @ (right / size)) / size
