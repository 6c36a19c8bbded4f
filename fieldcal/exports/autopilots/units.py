"""What PX4's and ArduPilot's parameters have in common: sensors in fixed units, positive scales, a cubic over °C.

Both correct raw readings as their drivers give them, in the sensor's own axes, before rotation to the board:
accelerometer (raw − offset) · scale in m/s², gyroscope raw − offset in rad/s without a scale, magnetometer by a
symmetric matrix. A log in counts has no such constants.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldcal.config.flight_settings import ACCELEROMETER_IN_MPS2, GYROSCOPE_IN_RADPS
from fieldcal.exports.autopilots.affine import angle_deg
from fieldcal.exports.calibration import Triad
from fieldcal.geometry.earth_field import UNIT_IN_TESLA
from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor

UNIT = {
    "gyroscope": GYROSCOPE_IN_RADPS,
    "accelerometer": ACCELEROMETER_IN_MPS2,
    "magnetometer": {unit: tesla / UNIT_IN_TESLA["G"] for unit, tesla in UNIT_IN_TESLA.items()},
}
"""Units of a log in rad/s, m/s² and gauss."""
SHOWN_UNIT = {Sensor.GYROSCOPE: "rad/s", Sensor.ACCELEROMETER: "m/s²", Sensor.MAGNETOMETER: "G"}
"""The same, for people."""
ROUNDING = 1e-9
"""A cross-axis term that is none."""
LEAST_ANGLE_DEG = 1e-6
"""Rotations below it are rounding."""


def in_autopilot_units(sensor: str, triad: Triad, magnetic_unit: float) -> Triad | str:
    """The triad with its zero in rad/s, m/s² or gauss / `magnetic_unit`, its scale without unit; or why that fails."""
    known = UNIT[sensor]
    if triad.logged_unit not in known or triad.unit not in known:
        what = triad.logged_unit if triad.logged_unit not in known else triad.unit
        return (
            f"Its constants are in {what}; an autopilot corrects readings in"
            f" {' or '.join(known)}, so they must come from a log in such units."
        )
    logged, calibrated = known[triad.logged_unit], known[triad.unit]
    if sensor == Sensor.MAGNETOMETER:
        logged, calibrated = logged / magnetic_unit, calibrated / magnetic_unit
    return replace(
        triad,
        scale=triad.scale * calibrated / logged,
        scale_per_degc=triad.scale_per_degc * calibrated / logged,
        scale_sd=triad.scale_sd * calibrated / logged,
        zero=triad.zero * logged,
        zero_sd=triad.zero_sd * logged,
        zero_per_degc=triad.zero_per_degc * logged,
        zero_per_degc2=triad.zero_per_degc2 * logged,
        zero_per_degc3=triad.zero_per_degc3 * logged,
        zero_per_degc_sd=triad.zero_per_degc_sd * logged,
    )


def not_held(sensor: str, triad: Triad, target: str) -> list[str]:
    """What the targets' common model leaves out, with its size."""
    told = []
    cross = np.abs(triad.scale - np.diag(np.diagonal(triad.scale))).max()
    if sensor == Sensor.GYROSCOPE:
        off = np.abs(np.diagonal(triad.scale) - 1.0).max()
        told.append(
            f"gyroscope: {target} has no gyroscope scale. Only the zero is exported; rates stay wrong by up to"
            f" {100.0 * off:.3g} %."
        )
    if sensor != Sensor.MAGNETOMETER and cross > ROUNDING:
        told.append(f"{sensor}: {target} has no cross-axis terms; those of up to {100.0 * cross:.3g} % are left out.")
    if np.any(triad.scale_per_degc != 0.0) and sensor != Sensor.GYROSCOPE:
        told.append(
            f"{sensor}: {target} has no slope of the scale on temperature (up to"
            f" {100.0 * np.abs(triad.scale_per_degc).max():.2g} % per °C); it is that at {triad.temperature_degc:g} °C."
        )
    return told


def dropped_rotation(sensor: str, turn: Array, target: str) -> list[str]:
    """What a symmetric matrix leaves out of one that is not."""
    angle = angle_deg(turn)
    if angle < LEAST_ANGLE_DEG:
        return []
    return [
        f"{sensor}: {target} holds a symmetric matrix; the nearest one is exported, which leaves out a rotation of"
        f" {angle:.2g}°."
    ]
