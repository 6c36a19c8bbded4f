"""A start of the gyroscope that needs no accelerometer: how fast the field turns in sensor axes.

Where vectors tell no attitude to begin with, translation being as large as gravity, the field's direction still turns
with the body alone.
"""

from __future__ import annotations

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


def gyroscope_by_field(readings: Readings, magnetometer: Constants | None) -> Constants:
    """Scale and bias of the gyroscope from the magnetometer alone.

    A field that stands still turns in body axes by dm/dt = m × ω, with ω = λ g + b: linear in λ (3,) and b (3,). Both
    sides are low-passed alike, so that no derivative is taken of noise.

    Parameters
    ----------
    readings : Readings
    magnetometer : (scale (3,), bias (3,)), optional
        In logged units.

    Returns
    -------
    scale (3,), bias (3,)
        rad/s per logged unit, rad/s.

    Raises
    ------
    UnusableFlight
        `no_start`: no magnetometer or none of its constants, or turning about one axis only.
    """
    if readings.magnetometer is None or magnetometer is None:
        raise UnusableFlight(ReasonCode.NO_START, "Without a magnetometer no field tells how fast it turned.")
    t, segment = readings.t, readings.segment
    m = filled(t, readings.magnetometer) * magnetometer[0] + magnetometer[1]
    m = m / np.linalg.norm(readings.field_ned)
    across = np.cross(m[:, None, :], np.eye(3))  # (n, 3, 3): m × eᵢ
    rows = np.concatenate([across * readings.gyroscope[:, :, None], across], axis=1)
    x = low_passed(t, segment, rows.reshape(len(t), -1), START_CUTOFF_HZ, SIDE_S).reshape(len(t), 6, 3)
    low = low_passed(t, segment, m, START_CUTOFF_HZ, SIDE_S)
    change = np.concatenate([differentiate_samples(t[a:b], low[a:b]) for a, b in run_bounds(segment)])
    columns = x.transpose(0, 2, 1)
    lengths = np.sqrt(np.sum(columns**2, axis=(0, 1)))
    unit = columns / np.maximum(lengths, 1e-300)
    spread = np.linalg.eigvalsh(np.einsum("nij,nik->jk", unit, unit))
    if spread[0] < LEAST_TURNING * spread[-1]:
        raise UnusableFlight(ReasonCode.NO_START, "The field turned about one axis only: it tells no start.")

    def solve(weight: Array) -> tuple[Array, Array]:
        root = np.sqrt(weight)[:, None]
        theta = np.linalg.lstsq((unit * root[..., None]).reshape(-1, 6), (change * root).reshape(-1), rcond=None)[0]
        return theta, np.linalg.norm(change - unit @ theta, axis=1)

    theta = reweighted(solve, len(t), rounds=ROUNDS)[0] / lengths
    return theta[:3], theta[3:]
