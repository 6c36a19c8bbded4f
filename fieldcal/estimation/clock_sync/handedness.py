"""Whether a VPS's attitudes are what they are said to be: body to world, scalar last.

The inverse of a quaternion, or one with the scalar first, turns as fast as the right one, so that the lengths of its
rates match the gyroscope's all the same. The map from its rates to the gyroscope's does not: it is a mirror, or none
that holds throughout. Both mistakes are one up to constant rotations (to move the scalar is to invert, and to turn
world and body by a constant), so that only the mounting tells them apart; and both at once are none but for these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.clock_sync.by_rates import SyncFit, synchronise
from fieldcal.estimation.wahba import nearest_rotation
from fieldcal.geometry.rotation import Array, conjugate

READINGS: dict[str, Callable[[Array], Array]] = {
    "inverse": conjugate,
    "scalar first": lambda q: q[..., [1, 2, 3, 0]],
}
"""What quaternions (n, 4) that are not body to world, scalar last, can be → how to make them so."""

# Shares of the variance of the VPS's rates. A mirror that fits so much better is one; mountings, cross-axis terms and
# wrong scales stay below the second.
MIRROR_SHARE, LARGEST_SHEAR = 0.05, 0.15
# Another reading is the right one where it leaves less than this share of what the given one leaves unexplained, both
# by the same readings of the gyroscope. An axis of the gyroscope that is wired the other way does the opposite.
CLEARLY = 0.97


@dataclass(frozen=True)
class Handedness:
    """How far the map of a clock's fit is from the nearest rotation, and from the nearest mirrored one, both as shares
    of the variance of the VPS's rates; the scales of the gyroscope's axes are left out."""

    from_rotation: float
    from_mirror: float

    @property
    def is_mirror(self) -> bool:
        """The rates are plainly mirrored."""
        return self.from_rotation > self.from_mirror + MIRROR_SHARE

    @property
    def is_rotation(self) -> bool:
        """The rates may be rotated against each other."""
        return not self.is_mirror and self.from_rotation <= LARGEST_SHEAR


def handedness(fit: SyncFit) -> Handedness:
    """Of the fit of a gyroscope whose axes are right-handed (polarity applied); any scale.

    Where the vehicle turned about two axes only, a mirror is a rotation as well."""
    row = np.linalg.norm(fit.matrix, axis=1)
    m = fit.matrix / np.maximum(row, 1e-300)[:, None]
    off = [_distance(m, fit.turning, sign) for sign in (1.0, -1.0)]
    return Handedness(off[0], off[1])


def _distance(m: Array, turning: Array, determinant: float) -> float:
    """Share of the rates' variance that the nearest orthogonal matrix of this determinant does not map as m does."""
    u, _, vt = np.linalg.svd(m @ turning)
    d = np.diag([1.0, 1.0, determinant * np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    off = u @ d @ vt - m
    return float(np.trace(off @ turning @ off.T) / np.trace(turning))


def mounting_deg(fit: SyncFit) -> float:
    """Angle of the rotation from the VPS's body axes to the gyroscope's, degrees, by the fit's map."""
    row = np.linalg.norm(fit.matrix, axis=1)
    rotation = nearest_rotation(fit.matrix / np.maximum(row, 1e-300)[:, None])
    return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0))))


def better_readings(
    t_imu: ArrayLike,
    rate_imu: ArrayLike,
    t_vps: ArrayLike,
    readings: Mapping[str, Array],
    explained: float,
    *,
    min_peak: float,
    max_gap_s: float,
) -> dict[str, SyncFit]:
    """Of other `readings` of the logged quaternions, name → attitudes (m, 4), those that fit as a rotation and better
    than the given one, which explains a share `explained` of the gyroscope's variance, that with the least mounting
    first. The rest as in `by_rates.synchronise`."""
    fits: dict[str, SyncFit] = {}
    for name, q in readings.items():
        try:
            fit = synchronise(t_imu, rate_imu, t_vps, q, max_lag_s=np.inf, min_peak=min_peak, max_gap_s=max_gap_s)
        except UnusableFlight:
            continue
        if handedness(fit).is_rotation and 1.0 - fit.explained < CLEARLY * (1.0 - explained):
            fits[name] = fit
    return dict(sorted(fits.items(), key=lambda found: mounting_deg(found[1])))
