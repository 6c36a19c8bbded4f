"""How PX4 numbers the rotations of boards and sensors: roll, pitch, yaw in degrees, yaw turned first.

Source: PX4-Autopilot, src/lib/conversion/rotation.h. From number 26 on older firmware had others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

CUSTOM = 100
"""The angles are parameters of their own."""
FIRST_OF_MAVLINK = 0x010C0000
"""Release (v1.12) from which on the numbers are those of MAVLink."""

_COMMON = (
    *((0, 0, yaw) for yaw in range(0, 360, 45)),
    *((180, 0, 0), (180, 0, 45), (180, 0, 90), (180, 0, 135)),
    *((0, 180, 0), (180, 0, 225), (180, 0, 270), (180, 0, 315)),
    *((90, 0, 0), (90, 0, 45), (90, 0, 90), (90, 0, 135)),
    *((270, 0, 0), (270, 0, 45), (270, 0, 90), (270, 0, 135)),
    *((0, 90, 0), (0, 270, 0)),
)
_MAVLINK = (
    *((0, 180, 90), (0, 180, 270), (90, 90, 0), (180, 90, 0), (270, 90, 0), (90, 180, 0), (270, 180, 0)),
    *((90, 270, 0), (180, 270, 0), (270, 270, 0), (90, 180, 90), (90, 0, 270), (90, 68, 293)),
    *((0, 315, 0), (90, 315, 0)),
)
_OLDER = (
    *((270, 0, 270), (180, 270, 0), (0, 90, 180), (90, 90, 0), (90, 68, 293), (270, 90, 0)),
    *((0, 9, 180), (0, 45, 0), (0, 315, 0), (90, 0, 270)),
)


def from_euler(roll_deg: float, pitch_deg: float, yaw_deg: float) -> NDArray[np.float64]:
    """PX4's Dcm(Euler(roll, pitch, yaw)), shape (3, 3): turns a sensor's components into the board's."""
    angles = np.nan_to_num([yaw_deg, pitch_deg, roll_deg], posinf=0.0, neginf=0.0)
    return np.asarray(Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())


def rotation(number: float, release: int | None = None) -> NDArray[np.float64]:
    """The rotation of a number, shape (3, 3); none for a number that there is not, as PX4 does.

    `release`: the firmware's, as `ver_sw_release` has it; None for a recent one.
    """
    later = _MAVLINK if release is None or release >= FIRST_OF_MAVLINK else _OLDER
    table = (*_COMMON, *later)
    index = int(number)
    return from_euler(*table[index]) if 0 <= index < len(table) else np.eye(3)
