"""Gyroscope and accelerometer in rows or messages of their own: joined on the gyroscope's stamps by interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldcal.geometry.intervals import interval_of
from fieldcal.logs.interface import Columns, Finding
from fieldcal.reason_codes import ReasonCode

INERTIAL = ("gyroscope", "accelerometer")
LONGEST_INTERVALS = 4
"""Readings further apart than so many usual intervals are not interpolated between."""
LEAST_ROWS = 10
SHARED = 0.5
"""Where fewer of the rows with a reading hold both sensors, the sensors have rows of their own."""


def stand_apart(gyroscope: NDArray[np.bool_], accelerometer: NDArray[np.bool_]) -> bool:
    """Whether sensors have rows of their own, or one of them is in few rows, from where (n,) each has a reading."""
    both, either = int((gyroscope & accelerometer).sum()), int((gyroscope | accelerometer).sum())
    fewer = min(int(gyroscope.sum()), int(accelerometer.sum()))
    return fewer >= LEAST_ROWS and both < SHARED * either


def imu_columns(t_ns: NDArray[np.int64], gyroscope: NDArray[np.float64], accelerometer: NDArray[np.float64]) -> Columns:
    """Columns of table "imu"."""
    return {"t_ns": t_ns, **triad("gyroscope", gyroscope), **triad("accelerometer", accelerometer)}


def triad(sensor: str, values: NDArray[np.float64]) -> Columns:
    """The three columns of a sensor from (n, 3) readings."""
    return {f"{sensor}_{axis}": np.ascontiguousarray(values[:, i], np.float64) for i, axis in enumerate("xyz")}


class SensorJoin:
    """Readings of the two sensors being gathered; `joined` gives the rows of table imu."""

    def __init__(self) -> None:
        self._gathered: dict[str, list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = {}

    def add(self, sensor: str, t_ns: NDArray[np.int64], readings: NDArray[np.float64]) -> None:
        """Take readings (n, 3) at stamps (n,)."""
        self._gathered.setdefault(sensor, []).append((t_ns, readings))

    def joined(self, name: str) -> tuple[Columns, Finding] | None:
        """The gyroscope's rows, in the log's order, between accelerometer readings, and what was done in the log
        called `name`; None where one of the sensors has fewer than two readings."""
        if len(self._gathered) < 2:
            return None
        t_ns, rates = self._whole(INERTIAL[0])
        at_ns, forces = self._whole(INERTIAL[1])
        at_ns, places = np.unique(at_ns, return_index=True)
        forces = forces[places]
        if len(at_ns) < 2:
            return None
        usual_ns = float(np.median(np.diff(at_ns)))
        inside = (t_ns >= at_ns[0]) & (t_ns < at_ns[-1])
        t_ns, rates, n = t_ns[inside], rates[inside], len(t_ns)
        i = interval_of(at_ns, t_ns)
        near = at_ns[i + 1] - at_ns[i] <= LONGEST_INTERVALS * usual_ns
        in_pauses = int((~near).sum())
        t_ns, rates, i = t_ns[near], rates[near], i[near]
        share = ((t_ns - at_ns[i]) / (at_ns[i + 1] - at_ns[i]))[:, None]
        between = (1.0 - share) * forces[i] + share * forces[i + 1]
        finding = Finding(
            ReasonCode.SENSORS_JOINED,
            len(t_ns),
            f"{name}: gyroscope and accelerometer stand apart from each other; the accelerometer was interpolated to "
            f"{len(t_ns)} stamps of the gyroscope, between readings at most "
            f"{LONGEST_INTERVALS * usual_ns * 1e-9:.3g} s apart. {n - len(t_ns)} gyroscope readings without two such "
            "readings about them were left out.",
            loses_data=in_pauses > 0,
        )
        return imu_columns(t_ns, rates, between), finding

    def _whole(self, sensor: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        stamps, readings = zip(*self._gathered[sensor], strict=True)
        return np.concatenate(stamps), np.concatenate(readings)
