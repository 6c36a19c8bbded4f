"""What PX4 has loaded for a sensor: its slots, its thermal block, and what its correction makes of constants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fieldcal.exports.autopilots.affine import of_raw
from fieldcal.exports.autopilots.thermal import Curve
from fieldcal.exports.calibration import Triad
from fieldcal.logs.ulog.parameters import (
    AUTOPILOT,
    AXES,
    CALIBRATION,
    SLOTS,
    THERMAL,
    THERMAL_DEGC,
    correction,
    slot_of,
)
from fieldcal.names import Sensor

SIGNED_ABOVE = 1 << 31
"""Device ids from here on stand in parameters as negative numbers."""


@dataclass(frozen=True)
class Px4:
    """PX4's slots, as `loading` asks for them."""

    name = AUTOPILOT
    title = "PX4"
    magnetic_unit = 1.0
    mounted_by = "SENS_BOARD_ROT (CAL_MAGn_ROT)"

    def calibrates_in_body(self, sensor: Sensor) -> bool:
        """Never: it corrects before it turns."""
        return False

    def slot(self, sensor: Sensor, device_id: int, parameters: Mapping[str, float]) -> int | None:
        """Number of a device's slot."""
        return slot_of(CALIBRATION[sensor], device_id, parameters)

    def devices(self, sensor: Sensor, parameters: Mapping[str, float]) -> dict[int, int]:
        """Slot → device id, of slots that have one."""
        ids = {slot: parameters.get(f"{CALIBRATION[sensor]}{slot}_ID", 0.0) for slot in range(SLOTS)}
        return {slot: int(number) for slot, number in ids.items() if number}

    def named(self, sensor: Sensor, parameters: Mapping[str, float]) -> list[int]:
        """None: PX4 uses no slot without a device id."""
        return []

    def names_device(self, sensor: Sensor) -> str:
        """How the parameter with a slot's device id is called."""
        return f"{CALIBRATION[sensor]}n_ID"

    def parameter(self, sensor: Sensor, slot: int, what: Literal["zero", "scale"], axis: int) -> str | None:
        """The parameter that holds a sensor's constant; None where there is none."""
        if (sensor, what) == (Sensor.GYROSCOPE, "scale"):
            return None
        return f"{CALIBRATION[sensor]}{slot}_{AXES[axis]}{'OFF' if what == 'zero' else 'SCALE'}"

    def raw(self, triad: Triad, sensor: Sensor, slot: int, parameters: Mapping[str, float]) -> Triad:
        """Constants of the raw sensor in its own axes, from those of readings in body axes that PX4 had corrected."""
        device_id = self.devices(sensor, parameters)[slot]
        there = correction(sensor, device_id, parameters, triad.temperature_degc)
        return of_raw(
            triad, np.array(there.matrix), np.array(there.offset), thermal_block(sensor, device_id, parameters)
        )


def thermal_slot(sensor: Sensor, device_id: int, parameters: Mapping[str, float]) -> int | None:
    """Number of the thermal slot of a device, else of one that is free; None where the firmware has none.

    Of a compensation that is not enabled a log has nothing but that."""
    prefix = THERMAL[sensor]
    own = slot_of(prefix, device_id, parameters)
    if own is not None or f"{prefix}_ENABLE" not in parameters:
        return own
    calibrated = slot_of(CALIBRATION[sensor], device_id, parameters) or 0
    free = [slot for slot in range(SLOTS) if not parameters.get(f"{prefix}{slot}_ID", 0.0)]
    return calibrated if calibrated in free else next(iter(free), None)


def thermal_block(sensor: Sensor, device_id: int | None, parameters: Mapping[str, float]) -> Curve | None:
    """The offset over temperature that PX4 subtracts of a device's readings; None where it subtracts none."""
    prefix = THERMAL[sensor]
    slot = None if device_id is None else slot_of(prefix, device_id, parameters)
    if slot is None or parameters.get(f"{prefix}_ENABLE") != 1:
        return None
    own = f"{prefix}{slot}_"
    x = np.array([[parameters.get(f"{own}X{order}_{axis}", 0.0) for axis in range(3)] for order in range(4)])
    reference, low, high = (parameters.get(f"{own}{name}", default) for name, default in THERMAL_DEGC.items())
    return Curve(reference, low, high, x[1:], x[0])


def signed(device_id: int) -> int:
    """A device id as a parameter of 32 bits holds it."""
    number = device_id & 0xFFFFFFFF
    return number - (1 << 32) if number >= SIGNED_ABOVE else number
