"""Between ROS's axes and the paper's: the world east-north-up to n (NED), the body nose-left-up to b (FRD).

Each is a half turn, and so its own inverse: about the horizontal bisector of north and east, and about the nose.
"""

from __future__ import annotations

import numpy as np

from fieldcal.geometry.rotation import Array

FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
"""Components of a vector, (3, 3)."""
FRD_FROM_FLU_QUATERNION = np.array([1.0, 0.0, 0.0, 0.0])
"""The same as a rotation: q ⊗ this is the attitude of the FRD axes where q is that of the FLU axes."""
NED_FROM_ENU_QUATERNION = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
"""This ⊗ q is an attitude in NED where q is one in ENU."""


def in_ned(vectors: Array, world: str) -> Array:
    """Vectors (n, 3) of a world that is "ned" or "enu", in NED."""
    return vectors[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0]) if world == "enu" else vectors
