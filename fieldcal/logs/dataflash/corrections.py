"""What ArduPilot does to readings before it logs them, as logged = matrix · raw + offset.

Pure functions of numbers. B turns board axes into the body's, P(T) is the offset by temperature:

    gyroscope       logged = B (raw − P(T) − OFFS)
    accelerometer   logged = B ((raw − P(T) − OFFS) ∘ SCAL)
    magnetometer    logged = M (SCALE · (B raw + OFS)) + motors      OFS is added; M symmetric of DIA and ODI

Raw readings are those that the driver gives, in its axes. (AP_InertialSensor_Backend.cpp, AP_InertialSensor_tempcal.cpp
and AP_Compass_Backend.cpp.) Firmware before 3.3 turned first and subtracted the accelerometer's offset last:

    gyroscope       logged = B raw − OFFS
    accelerometer   logged = (B raw) ∘ SCAL − OFFS
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

THERMAL_REFERENCE_DEGC = 35.0
THERMAL_SCALE = 1e-6
THERMAL_RANGE_DEGC = (0.0, 70.0)
"""INS_TCALn_TMIN and _TMAX as the firmware has them until they are set."""
COMPASS_SCALE_RANGE = (1.0 / 1.5, 1.5)
"""COMPASS_SCALE applies within these limits only; 0 stands for none."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Affine:
    """logged = matrix · raw + offset; `offset_per_degc`: slope of the offset over temperature."""

    matrix: Array
    offset: Array
    offset_per_degc: Array


@dataclass(frozen=True)
class Thermal:
    """The part of an offset that depends on temperature: P(T) = p(T) − p(T of the calibration).

    `coefficients` (3, 3): of the first, second and third power by rows, 1e-6 of the sensor's unit. p(T) =
    Σ c_k (T − 35)^k; temperatures are clamped to `low_degc` … `high_degc`.
    """

    coefficients: Array
    calibrated_degc: float
    low_degc: float
    high_degc: float

    def offset(self, temperature_degc: float) -> Array:
        """P(T), (3,)."""
        return self._polynomial(temperature_degc) - self._polynomial(self.calibrated_degc)

    def slope(self, temperature_degc: float) -> Array:
        """dP/dT, (3,); 0 beyond the limits."""
        if not self.low_degc <= temperature_degc <= self.high_degc:
            return np.zeros(3)
        d = temperature_degc - THERMAL_REFERENCE_DEGC
        return np.asarray(np.array([1.0, 2.0 * d, 3.0 * d * d]) @ self.coefficients * THERMAL_SCALE)

    def _polynomial(self, temperature_degc: float) -> Array:
        d = float(np.clip(temperature_degc, self.low_degc, self.high_degc)) - THERMAL_REFERENCE_DEGC
        return np.asarray(np.array([d, d * d, d**3]) @ self.coefficients * THERMAL_SCALE)


NO_THERMAL = Thermal(np.zeros((3, 3)), THERMAL_REFERENCE_DEGC, THERMAL_REFERENCE_DEGC, THERMAL_REFERENCE_DEGC)


def inertial(board: Array, offset: ArrayLike, scale: ArrayLike, thermal: Thermal, temperature_degc: float) -> Affine:
    """Gyroscope or accelerometer. `board` (3, 3), `offset` (3,), `scale` (3,), 1 for gyroscopes."""
    scale = np.broadcast_to(np.asarray(scale, float), 3)
    matrix = board * scale
    shift = np.asarray(offset, float) + thermal.offset(temperature_degc)
    return Affine(matrix, -matrix @ shift, -matrix @ thermal.slope(temperature_degc))


def inertial_before_3_3(board: Array, offset: ArrayLike, scale: ArrayLike) -> Affine:
    """The same as firmware before 3.3 did it."""
    scale = np.broadcast_to(np.asarray(scale, float), 3)
    return Affine(scale[:, None] * board, -np.asarray(offset, float), np.zeros(3))


def magnetometer(
    mounting: Array, offset: ArrayLike, diagonal: ArrayLike, off_diagonal: ArrayLike, scale: float
) -> Affine:
    """Magnetometer without its motors' part. `mounting` (3, 3); `offset`, `diagonal`, `off_diagonal` (xy, xz, yz) (3,).

    A diagonal of zeros stands for one of ones, as in the firmware.
    """
    diagonal, off_diagonal = np.asarray(diagonal, float), np.asarray(off_diagonal, float)
    soft = np.diag(diagonal if diagonal.any() else np.ones(3))
    soft[[0, 0, 1], [1, 2, 2]] = soft[[1, 2, 2], [0, 0, 1]] = off_diagonal
    low, high = COMPASS_SCALE_RANGE
    soft = soft * (scale if low <= scale <= high else 1.0)
    return Affine(soft @ mounting, soft @ np.asarray(offset, float), np.zeros(3))
