"""Axes conversions against where each axis must go, and against SciPy's rotations."""

from __future__ import annotations

import numpy as np
from numerics_support import ROUNDING
from scipy.spatial.transform import Rotation

from fieldcal.geometry.frames import FRD_FROM_FLU, FRD_FROM_FLU_QUATERNION, NED_FROM_ENU_QUATERNION

EAST, NORTH, UP = np.eye(3)
NOSE, LEFT, ABOVE = np.eye(3)


def test_world_axes() -> None:
    to_ned = Rotation.from_quat(NED_FROM_ENU_QUATERNION).as_matrix()
    np.testing.assert_allclose(to_ned @ NORTH, [1.0, 0.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(to_ned @ EAST, [0.0, 1.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(to_ned @ UP, [0.0, 0.0, -1.0], atol=ROUNDING)


def test_body_axes() -> None:
    np.testing.assert_array_equal(FRD_FROM_FLU @ NOSE, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(FRD_FROM_FLU @ LEFT, [0.0, -1.0, 0.0])
    np.testing.assert_array_equal(FRD_FROM_FLU @ ABOVE, [0.0, 0.0, -1.0])
    np.testing.assert_allclose(Rotation.from_quat(FRD_FROM_FLU_QUATERNION).as_matrix(), FRD_FROM_FLU, atol=ROUNDING)
