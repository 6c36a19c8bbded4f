"""What is known of a flight before any stage runs: configuration over the log's own word over the paper's defaults.

One flat, plain-JSON dictionary of settings: stages name the entries that they use, and only those enter their run key.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np

from fieldcal.config.configuration import Vehicle
from fieldcal.geometry.earth_field import UNIT_IN_TESLA, in_unit, world_magnetic_model

SENSORS = ("magnetometer", "accelerometer", "gyroscope")
DATE_WHEN_UNKNOWN = datetime(2025, 1, 1, tzinfo=UTC)
STANDARD_GRAVITY_MPS2 = 9.80665
ACCELEROMETER_IN_MPS2 = {"m/s^2": 1.0, "g": STANDARD_GRAVITY_MPS2}
GYROSCOPE_IN_RADPS = {"rad/s": 1.0, "deg/s": float(np.pi / 180.0)}


def flight_settings(
    vehicle: Vehicle,
    *,
    units: dict[str, str],
    world: str | None = None,
    body: str | None = None,
    gravity_sign: str | None = None,
    position: tuple[float, float, float] | None = None,
    started_at: datetime | None = None,
) -> dict[str, Any]:
    """Settings of one flight.

    Parameters
    ----------
    vehicle : Vehicle
        The configuration; what it says wins.
    units, world, body, gravity_sign
        What the log declares (`LogSummary`); "unknown" units are treated as counts.
    position : (latitude_deg, longitude_deg, altitude_m), optional
        Where the log says it was flown: with no configured field, its World Magnetic Model field is used.
    started_at : datetime, optional
        UTC; without one the model is evaluated for the start of 2025 and `field_source` says so.

    Raises
    ------
    ConfigurationError
        The World Magnetic Model does not cover place or date.
    """
    unit = {s: "counts" if units.get(s, "unknown") == "unknown" else units[s] for s in SENSORS}
    field, field_unit, source = _local_field(vehicle, unit["magnetometer"], position, started_at)
    return {
        **vehicle.parameters,
        "method": vehicle.method,
        "units": unit,
        "world": vehicle.world or world or "ned",
        "body": vehicle.body or body or "frd",
        "gravity_sign": vehicle.gravity_sign or gravity_sign or "gravity",
        "gravity_mps2": vehicle.gravity_mps2,
        "field_ned": [float(v) for v in field],
        "field_unit": field_unit,
        "field_source": source,
        "rotation_body_from_sensor": [list(row) for row in vehicle.rotation_body_from_sensor],
        "lever_arm_m": None if vehicle.lever_arm_m is None else list(vehicle.lever_arm_m),
        "polarity": {s: list(vehicle.polarity.get(s, (1, 1, 1))) for s in SENSORS},
        "nominal_scale": {s: _nominal_scale(vehicle, s, unit[s], field_unit) for s in SENSORS},
        "reference_reading": {s: _reference_reading(vehicle, s) for s in SENSORS},
    }


def _local_field(
    vehicle: Vehicle, logged_unit: str, position: tuple[float, float, float] | None, started_at: datetime | None
) -> tuple[np.ndarray, str, str]:
    """North, east, down; its unit; where it comes from."""
    configured = vehicle.field
    if configured is not None and configured.north_east_down is not None:
        return np.array(configured.north_east_down, dtype=float), configured.unit, "configured"
    if configured is not None and configured.latitude_deg is not None and configured.longitude_deg is not None:
        place, unit, source = (
            (configured.latitude_deg, configured.longitude_deg, configured.altitude_m),
            configured.unit,
            "configured place",
        )
    elif position is not None:
        place, unit, source = position, logged_unit if logged_unit in UNIT_IN_TESLA else "uT", "logged place"
    else:
        return np.array([1.0, 0.0, 0.0]), "norm", "north and down assumed"
    dated = "" if started_at is not None else ", date unknown: 2025-01-01"
    field = world_magnetic_model(*place, started_at or DATE_WHEN_UNKNOWN)
    return in_unit(field, unit), unit, f"World Magnetic Model at the {source}{dated}"


def _nominal_scale(vehicle: Vehicle, sensor: str, unit: str, field_unit: str) -> list[float] | None:
    """Nominal |scale| from logged to calibrated unit, or None where nobody knows it (counts)."""
    if sensor in vehicle.nominal_scale:
        return [abs(float(v)) for v in vehicle.nominal_scale[sensor]]
    if unit == "counts":
        return None
    if sensor == "accelerometer":
        return [ACCELEROMETER_IN_MPS2[unit]] * 3
    if sensor == "gyroscope":
        return [GYROSCOPE_IN_RADPS[unit]] * 3
    if unit == "norm" or field_unit == "norm":
        return [1.0] * 3 if unit == field_unit else None
    return [UNIT_IN_TESLA[unit] / UNIT_IN_TESLA[field_unit]] * 3


def _reference_reading(vehicle: Vehicle, sensor: str) -> list[float] | None:
    """d0 of `zero_bias`: as configured; None leaves it to the readings (`sensor_model.default_reference_reading`)."""
    return list(vehicle.reference_reading[sensor]) if sensor in vehicle.reference_reading else None
