"""Attitudes to start from: what turns some seconds of integrated readings onto what receiver and field say."""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.by_velocity.equations import Setting
from fieldcal.estimation.by_velocity.strapdown import Integrated
from fieldcal.geometry.rotation import Array, continuous, normalise, parallel_to_quaternion

# Of a difference of velocities, m/s, and of the field's direction; both sides within WINDOW_S: the longer, the less the
# receiver's noise disturbs, and the more the gyroscope's zero does. Without a magnetometer heading is in the
# accelerations alone.
VELOCITY_SD_MPS, FIELD_SD, WINDOW_S, WINDOW_WITHOUT_FIELD_S = 0.2, 0.1, 4.0, 10.0


def velocities_at_knots(setting: Setting) -> Array:
    """The receiver's velocity (K, 3) at the knots, linear between epochs."""
    knots, epochs = setting.knots, setting.epochs
    own = knots.epoch >= 0
    return np.column_stack([np.interp(knots.offset, knots.offset[own], c) for c in epochs.velocity[knots.epoch[own]].T])


def attitudes(setting: Setting, path: Integrated, magnetometer: Array | None) -> Array:
    """Attitude (K, 4) of the sensor axes at the knots; `magnetometer` (6,) gain and zero, None without one.

    Wahba's problem over each knot's neighbourhood: changes of velocity less gravity against integrated specific force,
    and the field against its readings."""
    knots = setting.knots
    change = np.diff(velocities_at_knots(setting), axis=0) - setting.gravity * np.diff(knots.offset)[:, None]
    both = knots.joined[:, None, None] * np.einsum("ni,nj->nij", change, path.push) / VELOCITY_SD_MPS**2
    window_s = WINDOW_WITHOUT_FIELD_S
    if magnetometer is not None and setting.lit.any():
        window_s = WINDOW_S
        sensed = (path.reading - magnetometer[3:]) / magnetometer[:3]
        inertial = np.einsum("nji,nj->ni", path.axes, sensed) * setting.lit[:, None]
        strength = float(setting.field @ setting.field)
        both = both + np.einsum("i,nj->nij", setting.field, inertial) / (strength * FIELD_SD**2)
    total = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(both, axis=0)])
    stretch = np.r_[0, np.cumsum(~knots.joined)]
    first, last = np.searchsorted(stretch, stretch), np.searchsorted(stretch, stretch, side="right") - 1
    low = np.maximum(np.searchsorted(knots.offset, knots.offset - window_s), first)
    high = np.minimum(np.searchsorted(knots.offset, knots.offset + window_s), last)
    left, _, right = np.linalg.svd(total[high] - total[low])
    sign = np.ones((len(left), 3))
    sign[:, 2] = np.linalg.det(left @ right)
    attitude = (left * sign[:, None, :]) @ right @ path.turned
    return continuous(normalise(parallel_to_quaternion(attitude.transpose(0, 2, 1))))
