"""Offsets that follow the temperature, where an autopilot has one already or is to get one.

Both autopilots subtract a cubic of the temperature, clamped to a range. A block that is loaded stays as it is unless
the history says something else of its sensor; then it is written whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldcal.exports.calibration import Triad, cubic_about
from fieldcal.geometry.rotation import Array

ROUNDING = 1e-9
"""Bends that differ by this share of themselves are one."""


@dataclass(frozen=True)
class Curve:
    """offset(T) = constant + Σ coefficients[k − 1] dᵏ, d = T − reference_degc, T clamped to low_degc … high_degc.

    `coefficients` (3, 3): of d, d² and d³ by rows, the sensor's axes by columns; `constant` (3,).
    """

    reference_degc: float
    low_degc: float
    high_degc: float
    coefficients: Array
    constant: Array

    def at(self, temperature_degc: float) -> Array:
        """The offset (3,) at a temperature."""
        d = float(np.clip(temperature_degc, self.low_degc, self.high_degc)) - self.reference_degc
        return np.asarray(self.constant + np.array([d, d * d, d**3]) @ self.coefficients)

    def about(self, reference_degc: float) -> Array:
        """The same coefficients (3, 3) about another temperature."""
        first, second, third = self.coefficients
        return np.array(cubic_about(first, second, third, reference_degc - self.reference_degc))


def curve_to_load(triad: Triad, loaded: Curve | None, reference_degc: float) -> Curve | None:
    """The curve of a sensor's zero about a temperature, its constant 0; None where what is loaded may stay.

    An axis has the history's where that differs from what is loaded (nothing: 0) by its standard deviation, else what
    is loaded. A history that tells a slope only does not replace a bend.
    """
    if triad.flown_degc is None:
        return None
    found = np.array([triad.zero_per_degc, triad.zero_per_degc2, triad.zero_per_degc3])
    there = np.zeros((3, 3)) if loaded is None else loaded.about(triad.temperature_degc)
    bent = np.abs(found - there)[1:] > ROUNDING * np.maximum(np.abs(found), np.abs(there))[1:]
    straight = ~np.any(found[1:], axis=0) & np.any(there[1:], axis=0)
    known = np.isfinite(triad.zero_per_degc_sd)
    differs = known & ~straight & ((np.abs(found - there)[0] > triad.zero_per_degc_sd) | np.any(bent, axis=0))
    if not np.any(differs):
        return None
    low, high = min(triad.flown_degc[0], triad.temperature_degc), max(triad.flown_degc[1], triad.temperature_degc)
    if loaded is not None:
        low, high = min(low, loaded.low_degc), max(high, loaded.high_degc)
    own = Curve(triad.temperature_degc, low, high, np.where(differs, found, there), np.zeros(3))
    return Curve(reference_degc, low, high, own.about(reference_degc), np.zeros(3))


def slope_span(triad: Triad) -> float:
    """How far the zero moves over the temperatures flown, the largest of the axes."""
    if triad.flown_degc is None:
        return 0.0
    span = triad.flown_degc[1] - triad.flown_degc[0]
    known = np.abs(triad.zero_per_degc) > triad.zero_per_degc_sd
    return float(np.max(np.where(known, np.abs(triad.zero_per_degc), 0.0)) * span)
