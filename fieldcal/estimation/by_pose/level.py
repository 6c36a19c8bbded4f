"""From a VPS's world to NED: its vertical by the accelerometer, its heading by the magnetometer."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.geometry.rotation import Array, body_from_inertial, from_matrix


def mean_in_world(q: ArrayLike, vectors: ArrayLike) -> Array:
    """Mean (3,) of vectors (n, 3), sensor axes, in the world of the attitudes q (n, 4); rows with NaN are left out."""
    v = np.asarray(vectors, dtype=float)
    whole = np.isfinite(v).all(axis=1)
    turn = body_from_inertial(np.asarray(q, dtype=float)[whole])
    return np.asarray(np.einsum("nij,ni->nj", turn, v[whole]) / max(int(whole.sum()), 1)).sum(axis=0)


def ned_from_world(down: ArrayLike | None, field: ArrayLike | None, field_ned: ArrayLike) -> Array:
    """The rotation p (4,) that brings attitudes from the VPS's world to NED: multiply(p, q).

    `down` (3,): gravity in the VPS's world, any length; None: it is taken for level. `field` (3,): the magnetic field
    there; None: north is left where it is. `field_ned` (3,): the local field, of which the heading counts."""
    total = np.eye(3)
    if down is not None:
        d = np.asarray(down, dtype=float) / np.linalg.norm(down)
        if d[2] < 0.0:  # upside down: half a turn about x first, since no arc is the shortest from there
            total = np.diag([1.0, -1.0, -1.0])
            d = total @ d
        axis = np.cross(d, [0.0, 0.0, 1.0])
        # The shortest turn that brings d to the vertical (Rodrigues).
        s = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
        total = (np.eye(3) + s + s @ s / (1.0 + d[2])) @ total
    if field is not None:
        seen, true = total @ np.asarray(field, dtype=float), np.asarray(field_ned, dtype=float)
        turn = np.arctan2(true[1], true[0]) - np.arctan2(seen[1], seen[0])
        c, s1 = np.cos(turn), np.sin(turn)
        total = np.array([[c, -s1, 0.0], [s1, c, 0.0], [0.0, 0.0, 1.0]]) @ total
    return from_matrix(total.T)
