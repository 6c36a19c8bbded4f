"""A start of the gyroscope that needs no attitude: how fast the field, or gravity, turns in sensor axes.

Where vectors tell no attitude to begin with, translation being as large as gravity, the field's direction still turns
with the body alone; and where there is no magnetometer, one vector tells it too.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.joint.initialise import START_CUTOFF_HZ, Constants, filled, low_passed
from fieldcal.estimation.joint.problem import Readings
from fieldcal.estimation.robust import reweighted
from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.smoothing import differentiate_samples
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

SIDE_S = 0.5
ROUNDS = 10
LEAST_TURNING = 1e-6  # smallest over largest eigenvalue of the normal equations of columns of length 1


def gyroscope_by_turning(readings: Readings, start: Mapping[str, Constants | None]) -> Constants:
    """Scale and bias of the gyroscope from the magnetometer alone; without one from the accelerometer.

    A vector v that stands still turns in body axes by dv/dt = v × ω, with ω = λ g + b: linear in λ (3,) and b (3,).
    Both sides are low-passed alike, so that no derivative is taken of noise.

    Parameters
    ----------
    readings : Readings
    start : sensor → (scale (3,), bias (3,)) or None
        Of magnetometer and accelerometer, in logged units.

    Returns
    -------
    scale (3,), bias (3,)
        rad/s per logged unit, rad/s.

    Raises
    ------
    UnusableFlight
        `no_start`: neither vector with constants, or turning about one axis only.
    """
    t, segment = readings.t, readings.segment
    magnitudes = {"magnetometer": float(np.linalg.norm(readings.field_ned)), "accelerometer": readings.gravity_mps2}
    for name, magnitude in magnitudes.items():
        logged, known = getattr(readings, name), start.get(name)
        if logged is not None and known is not None:
            v = (filled(t, logged) * known[0] + known[1]) / abs(magnitude)
            break
    else:
        raise UnusableFlight(ReasonCode.NO_START, "Neither a field nor gravity tells how fast it turned.")
    across = np.cross(v[:, None, :], np.eye(3))  # (n, 3, 3): v × eᵢ
    rows = np.concatenate([across * readings.gyroscope[:, :, None], across], axis=1)
    x = low_passed(t, segment, rows.reshape(len(t), -1), START_CUTOFF_HZ, SIDE_S).reshape(len(t), 6, 3)
    low = low_passed(t, segment, v, START_CUTOFF_HZ, SIDE_S)
    change = np.concatenate([differentiate_samples(t[a:b], low[a:b]) for a, b in run_bounds(segment)])
    columns = x.transpose(0, 2, 1)
    lengths = np.sqrt(np.sum(columns**2, axis=(0, 1)))
    unit = columns / np.maximum(lengths, 1e-300)
    spread = np.linalg.eigvalsh(np.einsum("nij,nik->jk", unit, unit))
    if spread[0] < LEAST_TURNING * spread[-1]:
        raise UnusableFlight(ReasonCode.NO_START, "What turned did so about one axis only: it tells no start.")

    def solve(weight: Array) -> tuple[Array, Array]:
        root = np.sqrt(weight)[:, None]
        theta = np.linalg.lstsq((unit * root[..., None]).reshape(-1, 6), (change * root).reshape(-1), rcond=None)[0]
        return theta, np.linalg.norm(change - unit @ theta, axis=1)

    theta = reweighted(solve, len(t), rounds=ROUNDS)[0] / lengths
    return theta[:3], theta[3:]
