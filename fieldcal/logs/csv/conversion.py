"""What the numbers of a CSV file are multiplied by: units with a prefix, temperatures that are not in °C, angles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fieldcal.config.configuration import CsvMap
from fieldcal.errors import UnreadableLog
from fieldcal.geometry.rotation import (
    body_from_inertial,
    from_euler,
    from_rotation_vector,
    multiply,
    normalise,
    parallel_to_quaternion,
)
from fieldcal.logs.csv.attitude import ANGLES, MATRIX, TO_RAD, VECTOR
from fieldcal.logs.csv.columns import Columns
from fieldcal.logs.csv.dialect import Dialect
from fieldcal.logs.csv.units import TO_DEGC, angle_unit, prefixed_unit, temperature_unit
from fieldcal.logs.interface import LogSummary
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode

QUATERNION, POSITION = ("qx", "qy", "qz", "qw"), ("px_m", "py_m", "pz_m")
ROTATION_TOLERANCE = 0.05
"""Of a matrix's determinant from 1: more than rounding to two digits makes."""


def sensor_factors(
    units: Mapping[str, str], configured: Mapping[Sensor, str], summary: LogSummary, log_name: str
) -> tuple[dict[str, str], dict[str, float]]:
    """Unit of each sensor once its readings are converted, and the factors that do it. Each one is told.

    Where the configuration gives a sensor's unit, nothing is converted: it is followed.
    """
    kept, factors = dict(units), {}
    for sensor, unit in units.items():
        prefixed = prefixed_unit(sensor, unit)
        if prefixed and Sensor(sensor) not in configured:
            kept[sensor], factors[sensor] = prefixed
            summary.add(
                ReasonCode.UNIT_CONVERTED,
                1,
                f"{log_name}: the {sensor} is logged in {unit}; its readings were converted to {kept[sensor]}.",
            )
    return kept, factors


def temperature_scale(dialect: Dialect, columns: Columns, summary: LogSummary, log_name: str) -> tuple[float, float]:
    """Factor and offset from the temperature column to °C; a conversion is told."""
    place = columns.values["temperature"][0]
    unit = temperature_unit(dialect.names[place], dialect.unit_row[place] if dialect.unit_row else None)
    if unit != "degC":
        summary.add(
            ReasonCode.UNIT_CONVERTED, 1, f"{log_name}: the temperature is logged in {unit}; it was converted to °C."
        )
    return TO_DEGC[unit]


def radians(csv: CsvMap, dialect: Dialect, columns: Columns, log_name: str) -> float:
    """Factor from the angles of a VPS to radians.

    Raises
    ------
    UnreadableLog
        `unit_not_supported`: neither file nor configuration gives their unit.
    """
    row = dialect.unit_row
    places = columns.values["roll_pitch_yaw"]
    found = {angle_unit(dialect.names[place], row[place] if row else None) for place in places}
    unit = csv.vps_angle_unit or (found.pop() if len(found) == 1 else None)
    if unit is None:
        raise UnreadableLog(
            ReasonCode.UNIT_NOT_SUPPORTED,
            f"{log_name} does not say in which unit its angles {', '.join(dialect.names[p] for p in places)} are. Set "
            "csv.vps_angle_unit to deg or rad.",
        )
    return TO_RAD[unit]


def with_quaternion(values: Mapping[str, NDArray[np.float64]], to_rad: float) -> dict[str, NDArray[np.float64]]:
    """Columns of a VPS with its attitude, if it is none yet, turned into a quaternion: angles, body to world (yaw, then
    pitch, then roll), a rotation vector, or a matrix. A matrix that is no rotation becomes the zero quaternion, which
    is no attitude."""
    if "qx" in values:
        return dict(values)
    if ANGLES[0] in values:
        q = np.asarray(from_euler(np.stack([values[name] * to_rad for name in ANGLES], axis=1)))
    elif VECTOR[0] in values:
        q = np.asarray(from_rotation_vector(np.stack([values[name] for name in VECTOR], axis=1)))
    else:
        # Column by column body to world is row by row world to body.
        matrices = np.stack([values[name] for name in MATRIX], axis=1).reshape(-1, 3, 3)
        proper = np.abs(np.linalg.det(matrices) - 1.0) < ROTATION_TOLERANCE
        q = np.zeros((len(matrices), 4))
        q[proper] = normalise(parallel_to_quaternion(matrices[proper]))
    turned = _named(QUATERNION, q)
    return turned | {name: column for name, column in values.items() if name not in (*ANGLES, *VECTOR, *MATRIX)}


def in_world(
    values: Mapping[str, NDArray[np.float64]], turn: tuple[float, float, float, float] | None, metre: float
) -> dict[str, NDArray[np.float64]]:
    """Poses, with a quaternion, in another world: turned by the quaternion `turn`, positions times `metre` in m."""
    moved = dict(values)
    if POSITION[0] in moved:
        p = np.stack([moved[name] for name in POSITION], axis=1) * metre
        if turn is not None:
            p = p @ body_from_inertial(turn)
        moved |= _named(POSITION, p)
    if turn is not None:
        q = multiply(turn, np.stack([moved[name] for name in QUATERNION], axis=1))
        moved |= _named(QUATERNION, q)
    return moved


def _named(names: tuple[str, ...], values: NDArray[np.floating]) -> dict[str, NDArray[np.float64]]:
    return {name: values[:, k].astype(np.float64) for k, name in enumerate(names)}
