"""What is known of a flight before any stage runs: configuration over the log's own word over the paper's defaults.

Each stage takes the part that it names (`fieldcal.config.stage_settings`), and only that enters its run key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

import numpy as np

from fieldcal.config.configuration import Vehicle, VehicleTable
from fieldcal.config.loaded import Loaded
from fieldcal.config.parameters import Parameters
from fieldcal.geometry.earth_field import UNIT_IN_TESLA, in_unit, world_magnetic_model
from fieldcal.geometry.rotation import Array
from fieldcal.names import FIELD_ASSUMED, SENSORS, Approach, Rotation, Sensor, Signs, Triple

DATE_WHEN_UNKNOWN = datetime(2025, 1, 1, tzinfo=UTC)
STANDARD_GRAVITY_MPS2 = 9.80665
ACCELEROMETER_IN_MPS2 = {"m/s^2": 1.0, "g": STANDARD_GRAVITY_MPS2}
GYROSCOPE_IN_RADPS = {"rad/s": 1.0, "deg/s": float(np.pi / 180.0)}


@dataclass(frozen=True)
class FlightSettings:
    """All that any stage may need to know of one flight beside its readings.

    parameters : the stages' own, profile worked in
    method : how each sensor is calibrated; units : of its logged readings, "counts" where nobody says
    world, body, gravity_sign : "ned" or "enu", "frd" or "flu", "gravity" or "specific_force"
    gravity_mps2 : local gravity, m/s²
    field_ned : local magnetic field, north east down, in field_unit; field_source : where it is known from
    rotation_body_from_sensor : rows of the (3, 3) matrix; lever_arm_m : centre of mass to IMU, body axes, m
    polarity : signs of the axes as wired
    nominal_scale : |scale| from logged to calibrated unit, None where nobody knows it (counts)
    reference_reading : d0 of `zero_bias`, None leaves it to the readings
    applied_matrix, applied_offset : what an autopilot had made of raw readings before it logged them (`logs.applied`),
        whether that is known whole, how far it changed within the flight, and how the offset follows the temperature;
        None where they are raw
    loaded : what an autopilot had loaded for a sensor, None where no autopilot wrote the log
    own_sensors : those of the unit that is calibrated; the others only help
    """

    parameters: Parameters
    method: Mapping[Sensor, Approach]
    units: Mapping[Sensor, str]
    world: str
    body: str
    gravity_sign: str
    gravity_mps2: float
    field_ned: Triple
    field_unit: str
    field_source: str
    rotation_body_from_sensor: Rotation
    lever_arm_m: Triple | None
    polarity: Mapping[Sensor, Signs]
    nominal_scale: Mapping[Sensor, Triple | None]
    reference_reading: Mapping[Sensor, Triple | None]
    applied_matrix: Mapping[Sensor, Rotation | None] = field(default_factory=lambda: dict.fromkeys(SENSORS))
    applied_offset: Mapping[Sensor, Triple | None] = field(default_factory=lambda: dict.fromkeys(SENSORS))
    applied_known: Mapping[Sensor, bool | None] = field(default_factory=lambda: dict.fromkeys(SENSORS))
    applied_matrix_sd: Mapping[Sensor, float | None] = field(default_factory=lambda: dict.fromkeys(SENSORS))
    applied_offset_sd: Mapping[Sensor, Triple | None] = field(default_factory=lambda: dict.fromkeys(SENSORS))
    applied_offset_per_degc: Mapping[Sensor, Triple | None] = field(default_factory=lambda: dict.fromkeys(SENSORS))
    loaded: Mapping[Sensor, Loaded | None] = field(default_factory=lambda: dict.fromkeys(SENSORS))
    own_sensors: tuple[Sensor, ...] = SENSORS

    def changed(self, **changes: object) -> FlightSettings:
        """These settings with others for some, parameters of the stages among them.

        Raises
        ------
        pydantic.ValidationError
            A parameter is not allowed.
        """
        own = {name: changes.pop(name) for name in list(changes) if name in Parameters.model_fields}
        parameters = Parameters.model_validate({**dict(self.parameters), **own})
        if "method" in changes:
            changes["method"] = VehicleTable.model_validate({"method": changes["method"]}).method
        return replace(self, parameters=parameters, **changes)  # type: ignore[arg-type]


def flight_settings(
    vehicle: Vehicle,
    *,
    units: Mapping[str, str],
    world: str | None = None,
    body: str | None = None,
    gravity_sign: str | None = None,
    position: tuple[float, float, float] | None = None,
    started_at: datetime | None = None,
) -> FlightSettings:
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
    (north, east, down), field_unit, source = _local_field(vehicle, unit[Sensor.MAGNETOMETER], position, started_at)
    return FlightSettings(
        parameters=vehicle.parameters,
        method=vehicle.method,
        units=unit,
        world=vehicle.world or world or "ned",
        body=vehicle.body or body or "frd",
        gravity_sign=vehicle.gravity_sign or gravity_sign or "gravity",
        gravity_mps2=vehicle.gravity_mps2,
        field_ned=(float(north), float(east), float(down)),
        field_unit=field_unit,
        field_source=source,
        rotation_body_from_sensor=vehicle.rotation_body_from_sensor,
        lever_arm_m=vehicle.lever_arm_m,
        polarity=vehicle.polarity,
        nominal_scale={s: _nominal_scale(vehicle, s, unit[s], field_unit) for s in SENSORS},
        reference_reading={s: vehicle.reference_reading.get(s) for s in SENSORS},
    )


def _local_field(
    vehicle: Vehicle, logged_unit: str, position: tuple[float, float, float] | None, started_at: datetime | None
) -> tuple[Array, str, str]:
    """North, east, down; its unit; where it comes from."""
    configured = vehicle.field
    if configured is not None and configured.north_east_down is not None:
        return np.array(configured.north_east_down, dtype=float), configured.unit, "configured"
    if configured is not None and configured.latitude_deg is not None and configured.longitude_deg is not None:
        place = configured.latitude_deg, configured.longitude_deg, configured.altitude_m
        unit: str = configured.unit
        source = "configured place"
    elif position is not None:
        place, unit, source = position, logged_unit if logged_unit in UNIT_IN_TESLA else "uT", "logged place"
    else:
        return np.array([1.0, 0.0, 0.0]), "norm", FIELD_ASSUMED
    dated = "" if started_at is not None else ", date unknown: 2025-01-01"
    field = world_magnetic_model(*place, started_at or DATE_WHEN_UNKNOWN)
    return in_unit(field, unit), unit, f"World Magnetic Model at the {source}{dated}"


def _nominal_scale(vehicle: Vehicle, sensor: Sensor, unit: str, field_unit: str) -> Triple | None:
    """Nominal |scale| from logged to calibrated unit, or None where nobody knows it (counts)."""
    if sensor in vehicle.nominal_scale:
        return vehicle.nominal_scale[sensor]
    if unit == "counts":
        return None
    if sensor == Sensor.ACCELEROMETER:
        factor = ACCELEROMETER_IN_MPS2[unit]
    elif sensor == Sensor.GYROSCOPE:
        factor = GYROSCOPE_IN_RADPS[unit]
    elif unit == "norm" or field_unit == "norm":
        if unit != field_unit:
            return None
        factor = 1.0
    else:
        factor = UNIT_IN_TESLA[unit] / UNIT_IN_TESLA[field_unit]
    return factor, factor, factor
