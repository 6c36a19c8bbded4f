"""What PX4's and ArduPilot's parameters have in common: sensors in fixed units, positive scales, a cubic over °C.

Both correct raw readings as their drivers give them, in the sensor's own axes, before rotation to the board:
accelerometer (raw − offset) · scale in m/s², gyroscope raw − offset in rad/s without a scale, magnetometer by a
symmetric matrix. Raw is what fieldcal read from the log, so a log in counts has no such constants.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldcal.exports.calibration import Constants, Triad
from fieldcal.names import Sensor

UNIT = {
    "gyroscope": {"rad/s": 1.0, "deg/s": float(np.pi / 180.0)},
    "accelerometer": {"m/s^2": 1.0, "g": 9.80665},
    "magnetometer": {"T": 1e4, "uT": 1e-2, "G": 1.0},
}
"""Units of a log as rad/s, m/s² and gauss."""
SYMMETRY = 1e-9
"""A matrix is symmetric when its halves differ by less than this share of it."""


def in_autopilot_units(constants: Constants, magnetic_unit: float) -> tuple[dict[str, Triad], list[str]]:
    """Triads with zeros in rad/s, m/s² and gauss / `magnetic_unit`, scales without unit; and why one is left out."""
    triads, warnings = {}, []
    for sensor, triad in constants.triads.items():
        known = UNIT[sensor]
        if triad.logged_unit not in known or triad.unit not in known:
            what = triad.logged_unit if triad.logged_unit not in known else triad.unit
            warnings.append(
                f"{sensor}: left out. Its constants are in {what}; an autopilot corrects readings in"
                f" {' or '.join(known)}, so they must come from a log in such units."
            )
            continue
        logged, calibrated = known[triad.logged_unit], known[triad.unit]
        if sensor == Sensor.MAGNETOMETER:
            logged, calibrated = logged / magnetic_unit, calibrated / magnetic_unit
        own = replace(
            triad,
            scale=triad.scale * calibrated / logged,
            scale_per_degc=triad.scale_per_degc * calibrated / logged,
            zero=triad.zero * logged,
            zero_per_degc=triad.zero_per_degc * logged,
            zero_per_degc2=triad.zero_per_degc2 * logged,
            zero_per_degc3=triad.zero_per_degc3 * logged,
        )
        if np.any(np.diagonal(own.scale) <= 0.0):
            warnings.append(
                f"{sensor}: left out. An axis has a negative scale: the autopilot expects that its driver or"
                " its rotation parameter puts axes right, not its calibration."
            )
            continue
        triads[sensor] = own
    return triads, warnings


def not_held(triads: dict[str, Triad], target: str, thermal_magnetometer: bool = False) -> list[str]:
    """Sentences on what the targets' common model leaves out."""
    warnings = []
    if (gyroscope := triads.get(Sensor.GYROSCOPE)) is not None:
        off = np.abs(gyroscope.scale - np.eye(3)).max()
        warnings.append(
            f"gyroscope: {target} has no gyroscope scale. Only the zero is exported; rates stay wrong by up to"
            f" {100.0 * off:.3g} %."
        )
    if (accelerometer := triads.get(Sensor.ACCELEROMETER)) is not None and not accelerometer.diagonal:
        warnings.append(f"accelerometer: {target} has no cross-axis terms; only the diagonal is exported.")
    for sensor, triad in triads.items():
        if np.any(triad.scale_per_degc != 0.0) and sensor != Sensor.GYROSCOPE:
            warnings.append(
                f"{sensor}: {target} has no slope of the scale on temperature; it is that at"
                f" {triad.temperature_degc:g} °C."
            )
        if sensor == Sensor.MAGNETOMETER and not thermal_magnetometer and np.any(triad.zero_per_degc != 0.0):
            warnings.append(
                f"magnetometer: {target} does not correct it for temperature; offsets are those at"
                f" {triad.temperature_degc:g} °C."
            )
    return warnings


def symmetric(triad: Triad, target: str) -> tuple[np.ndarray, list[str]]:
    """The scale matrix as a symmetric one, and a warning where it is not."""
    half = 0.5 * (triad.scale + triad.scale.T)
    if np.abs(half - triad.scale).max() > SYMMETRY * np.abs(triad.scale).max():
        return half, [f"magnetometer: {target} holds a symmetric matrix; the mean of both halves is exported."]
    return half, []


def thermal(triad: Triad) -> bool:
    """Whether there is a slope or bend of the zero to export."""
    return triad.flown_degc is not None and any(
        bool(np.any(part != 0.0)) for part in (triad.zero_per_degc, triad.zero_per_degc2, triad.zero_per_degc3)
    )
