"""How a board or a magnetometer is mounted, by the numbers of AHRS_ORIENTATION and COMPASS_ORIENT."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fieldcal.geometry.rotation import body_from_inertial, from_euler
from fieldcal.names import Triple

ROLL_PITCH_YAW_DEG: tuple[Triple, ...] = (
    (0, 0, 0),
    (0, 0, 45),
    (0, 0, 90),
    (0, 0, 135),
    (0, 0, 180),
    (0, 0, 225),
    (0, 0, 270),
    (0, 0, 315),
    (180, 0, 0),
    (180, 0, 45),
    (180, 0, 90),
    (180, 0, 135),
    (0, 180, 0),
    (180, 0, 225),
    (180, 0, 270),
    (180, 0, 315),
    (90, 0, 0),
    (90, 0, 45),
    (90, 0, 90),
    (90, 0, 135),
    (270, 0, 0),
    (270, 0, 45),
    (270, 0, 90),
    (270, 0, 135),
    (0, 90, 0),
    (0, 270, 0),
    (0, 180, 90),
    (0, 180, 270),
    (90, 90, 0),
    (180, 90, 0),
    (270, 90, 0),
    (90, 180, 0),
    (270, 180, 0),
    (90, 270, 0),
    (180, 270, 0),
    (270, 270, 0),
    (90, 180, 90),
    (90, 0, 270),
    (90, 68.8, 293.3),
    (0, 315, 0),
    (90, 315, 0),
    (0, 7, 0),
    (45, 0, 0),
    (315, 0, 0),
)
"""By number (ArduPilot, libraries/AP_Math/rotations.h). 38, named pitch 68, yaw 293, is 68.8 and 293.3 in its code."""

CUSTOM_ANGLES = {
    100: ("AHRS_CUSTOM_ROLL", "AHRS_CUSTOM_PIT", "AHRS_CUSTOM_YAW"),
    101: ("CUST_ROT1_ROLL", "CUST_ROT1_PITCH", "CUST_ROT1_YAW"),
    102: ("CUST_ROT2_ROLL", "CUST_ROT2_PITCH", "CUST_ROT2_YAW"),
}
"""Numbers whose angles, degrees, are parameters of their own."""


def orientation_matrix(number: int, parameter: Callable[[str], float]) -> NDArray[np.float64] | None:
    """The matrix (3, 3) that turns mounted axes into the body's; None for a number that is none.

    `parameter` gives the value of a parameter by its name, for custom angles.
    """
    if 0 <= number < len(ROLL_PITCH_YAW_DEG):
        return from_roll_pitch_yaw(ROLL_PITCH_YAW_DEG[number])
    if number in CUSTOM_ANGLES:
        roll, pitch, yaw = (parameter(name) for name in CUSTOM_ANGLES[number])
        return from_roll_pitch_yaw((roll, pitch, yaw))
    return None


def from_roll_pitch_yaw(degrees: Triple) -> NDArray[np.float64]:
    """Rz(yaw) · Ry(pitch) · Rx(roll), (3, 3)."""
    matrix = body_from_inertial(from_euler(np.deg2rad(degrees))).T
    return np.where(np.abs(matrix - np.round(matrix)) < 1e-12, np.round(matrix), matrix)
