"""Attitudes of a VPS as CSV files write them: quaternions in either order, found by their names; Euler angles."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

ANGLES = ("roll", "pitch", "yaw")
MATRIX = tuple(f"r{row}{column}" for column in "xyz" for row in "xyz")
"""Elements of the matrix from body to world, column by column."""
VECTOR = ("rotation_x", "rotation_y", "rotation_z")
"""A rotation vector from body to world, rad."""
TO_RAD = {"deg": np.pi / 180.0, "rad": 1.0}
_UNIT = re.compile(r"\s*[(\[{][^()\[\]{}]*[)\]}]\s*$")
_AXIS_LAST = re.compile(r"(.*?)[ _.:/-]?([wxyz])$")
_QUATERNION_STEMS = re.compile(r"(^|[^a-z])(q|quat|quaternion|orientation|rotation|rot|att|attitude)([^a-z]|$)")
_ESTIMATE = re.compile(r"(^|[^a-z])(est|estimate|estimated|ekf|kf|ahrs|filter|filtered|fused)([^a-z]|$)")
"""In the names of what the logger's own filter made: it has seen the IMU, and is no reference."""


def quaternion_by_names(names: Sequence[str]) -> tuple[int, int, int, int] | None:
    """Positions of the columns x, y, z, w of a quaternion that names tell (`q_x` … `q_w`, `pose.orientation.x` …).

    None where no set of four columns, or more than one, is so named: q0 … q3 may be in either order. An estimate of the
    logger's own (`est_quaternion_w`) is none.
    """
    found: dict[str, dict[str, list[int]]] = {}
    for place, name in enumerate(names):
        match = _AXIS_LAST.match(_UNIT.sub("", name.strip()).lower())
        if match and _QUATERNION_STEMS.search(match[1]) and not _ESTIMATE.search(match[1]):
            found.setdefault(match[1], {}).setdefault(match[2], []).append(place)
    whole = [axes for axes in found.values() if set(axes) == set("wxyz") and all(len(at) == 1 for at in axes.values())]
    if len(whole) != 1:
        return None
    return whole[0]["x"][0], whole[0]["y"][0], whole[0]["z"][0], whole[0]["w"][0]
