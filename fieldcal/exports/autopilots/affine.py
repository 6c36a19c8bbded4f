"""Constants of readings that an autopilot had corrected, brought back before its correction and its mounting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import polar

from fieldcal.exports.autopilots.thermal import Curve
from fieldcal.exports.calibration import Triad
from fieldcal.geometry.rotation import Array
from fieldcal.geometry.sensor_model import through


def of_raw(triad: Triad, matrix: Array, offset: Array, thermal: Curve | None) -> Triad:
    """Constants of the raw readings, in their own axes.

    With logged = matrix · raw + offset, matrix = R S, z = A (logged − b) is turned back, A' = Rᵀ A R and b' = Rᵀ b, and
    composed: Rᵀ z = A' S (raw − zero), zero = S⁻¹ b' − matrix⁻¹ offset.

    Parameters
    ----------
    triad : Triad
        Of the logged readings.
    matrix, offset : (3, 3), (3,) array
        Of the autopilot, at the triad's temperature.
    thermal : Curve or None
        What of the offset follows the temperature, in raw readings.
    """
    turn, scale = polar(matrix, side="right")
    own = triad.turned(np.asarray(turn).T)
    inverse = np.linalg.inv(scale)
    there = np.zeros((3, 3)) if thermal is None else thermal.about(triad.temperature_degc)
    return replace(
        own,
        scale=own.scale @ scale,
        scale_per_degc=own.scale_per_degc @ scale,
        zero=inverse @ own.zero - np.linalg.solve(matrix, offset),
        zero_per_degc=inverse @ own.zero_per_degc + there[0],
        zero_per_degc2=inverse @ own.zero_per_degc2 + there[1],
        zero_per_degc3=inverse @ own.zero_per_degc3 + there[2],
        scale_sd=own.scale_sd * np.abs(np.diagonal(scale)),
        zero_sd=np.sqrt(through(inverse**2, own.zero_sd**2)),
        zero_per_degc_sd=np.sqrt(through(inverse**2, own.zero_per_degc_sd**2)),
    )


def rotation_and_symmetric(matrix: Array) -> tuple[Array, Array]:
    """M = Q H: the rotation, and the symmetric matrix with the same length of every result: H = (Mᵀ M)^½."""
    turn, stretch = polar(matrix, side="right")
    return np.asarray(turn), np.asarray(0.5 * (stretch + stretch.T))


def angle_deg(turn: Array) -> float:
    """The angle of a rotation matrix, degrees."""
    sine = 0.5 * np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return float(np.rad2deg(np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0))))
