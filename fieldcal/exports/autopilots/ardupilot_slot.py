"""What ArduPilot has loaded for a sensor: its slots, its thermal block, and what its correction makes of constants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fieldcal.errors import FieldcalError
from fieldcal.exports.autopilots.affine import of_raw
from fieldcal.exports.autopilots.thermal import Curve
from fieldcal.exports.calibration import Triad
from fieldcal.logs.dataflash.applied import (
    THERMAL_ON,
    Temperatures,
    inertial_corrections,
    magnetometer_corrections,
)
from fieldcal.logs.dataflash.corrections import THERMAL_RANGE_DEGC, THERMAL_REFERENCE_DEGC, THERMAL_SCALE
from fieldcal.logs.dataflash.parameters import (
    AUTOPILOT,
    CompassNames,
    InertialNames,
    Parameters,
    compass_names,
    inertial_names,
)
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode

IMUS, COMPASSES = 5, 3
KIND = {Sensor.GYROSCOPE: "GYR", Sensor.ACCELEROMETER: "ACC"}
MILLIGAUSS = 1e-3
"""Gauss in the unit of its magnetometers' parameters."""


@dataclass(frozen=True)
class ArduPilot:
    """ArduPilot's slots, as `loading` asks for them."""

    name = AUTOPILOT
    title = "ArduPilot"
    magnetic_unit = MILLIGAUSS
    mounted_by = "AHRS_ORIENTATION (COMPASS_ORIENT)"

    def calibrates_in_body(self, sensor: Sensor) -> bool:
        """Its compasses: it turns them before it corrects."""
        return sensor == Sensor.MAGNETOMETER

    def slot(self, sensor: Sensor, device_id: int, parameters: Mapping[str, float]) -> int | None:
        """Number of a device's slot, from 0."""
        found = self.devices(sensor, parameters)
        return next((slot for slot, number in found.items() if number == device_id), None)

    def devices(self, sensor: Sensor, parameters: Mapping[str, float]) -> dict[int, int]:
        """Slot → device id, of slots that have one."""
        ids = {slot: parameters.get(one.device_id, 0.0) for slot, one in _names(sensor).items()}
        return {slot: int(number) for slot, number in ids.items() if number}

    def named(self, sensor: Sensor, parameters: Mapping[str, float]) -> list[int]:
        """Slots that have an offset: older firmware has no device ids."""
        return [slot for slot, one in _names(sensor).items() if one.offset[0] in parameters]

    def names_device(self, sensor: Sensor) -> str:
        """How the parameter with a slot's device id is called."""
        return "COMPASS_DEV_IDn" if sensor == Sensor.MAGNETOMETER else f"INS_{KIND[sensor]}n_ID"

    def parameter(self, sensor: Sensor, slot: int, what: Literal["zero", "scale"], axis: int) -> str | None:
        """The parameter that holds a sensor's constant; None where there is none."""
        if sensor == Sensor.MAGNETOMETER:
            compass = compass_names(slot)
            return (compass.offset if what == "zero" else compass.diagonal)[axis]
        names = inertial_names(KIND[sensor], slot)
        own = names.offset if what == "zero" else names.scale
        return None if own is None else own[axis]

    def raw(self, triad: Triad, sensor: Sensor, slot: int, parameters: Mapping[str, float]) -> Triad:
        """Constants of the raw sensor in its own axes, of a compass in the body's, from those of readings in body axes
        that ArduPilot had corrected."""
        if sensor == Sensor.MAGNETOMETER:
            added = np.array([parameters.get(name, 0.0) for name in compass_names(slot).offset])
            matrix = compass_matrix(slot, parameters)
            return of_raw(triad, matrix, matrix @ added, None)
        at = Temperatures(np.zeros(1, np.int64), np.array([triad.temperature_degc]))
        found = inertial_corrections(KIND[sensor], slot, Parameters.of(parameters), 0, at)
        if not found:
            missing = ", ".join(inertial_names(KIND[sensor], slot).offset)
            raise FieldcalError(
                ReasonCode.NOT_LOADABLE,
                f"{sensor}: {missing} or a usable AHRS_ORIENTATION are not among the parameters.",
            )
        there = found[0]
        return of_raw(triad, np.array(there.matrix), np.array(there.offset), thermal_block(sensor, slot, parameters))


def thermal_block(sensor: Sensor, slot: int, parameters: Mapping[str, float]) -> Curve | None:
    """The offset over temperature that ArduPilot subtracts of a sensor's readings; None where it subtracts none.

    Its constant is 0 at 35 °C: what it subtracts is the difference to the temperature of the calibration."""
    names = inertial_names(KIND[sensor], slot)
    if parameters.get(names.thermal_enable) != THERMAL_ON:
        return None
    x = THERMAL_SCALE * np.array([[parameters.get(name, 0.0) for name in power] for power in names.thermal])
    low = parameters.get(names.thermal_min_degc, THERMAL_RANGE_DEGC[0])
    high = parameters.get(names.thermal_max_degc, THERMAL_RANGE_DEGC[1])
    return Curve(THERMAL_REFERENCE_DEGC, low, high, x, np.zeros(3))


def compass_matrix(slot: int, parameters: Mapping[str, float]) -> np.ndarray:
    """Of a compass D k, (3, 3): DIA and ODI times COMPASS_SCALE, as the firmware takes them."""
    held = Parameters.of({**parameters, "AHRS_ORIENTATION": 0.0, compass_names(slot).external: 0.0})
    found = magnetometer_corrections(slot, held, np.zeros(1, np.int64), np.zeros((1, 3)))
    return np.array(found[0].matrix)


def _names(sensor: Sensor) -> dict[int, InertialNames | CompassNames]:
    if sensor == Sensor.MAGNETOMETER:
        return {slot: compass_names(slot) for slot in range(COMPASSES)}
    return {slot: inertial_names(KIND[sensor], slot) for slot in range(IMUS)}
