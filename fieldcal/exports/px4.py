"""PX4 parameters, as QGroundControl loads them.

Conventions (PX4, src/lib/sensor_calibration and src/modules/temperature_compensation): in sensor axes, before rotation,

    accelerometer  (raw − thermal − CAL_ACC0_?OFF) · CAL_ACC0_?SCALE, m/s²
    gyroscope      raw − thermal − CAL_GYRO0_?OFF, rad/s; there is no scale
    magnetometer   S (raw − CAL_MAG0_?OFF), gauss; S symmetric: ?SCALE on the diagonal, XODIAG = S_xy,
                   YODIAG = S_xz, ZODIAG = S_yz
    thermal        TC_A0_X0_i + TC_A0_X1_i (T − TC_A0_TREF) + …, T kept within TC_A0_TMIN … _TMAX (gyroscope: TC_G0)

An offset has the sign of fieldcal's zero. The first instance of each sensor is written; PX4 keeps them as float32.
"""

from __future__ import annotations

import numpy as np

from fieldcal.exports.autopilot import in_autopilot_units, not_held, symmetric, thermal
from fieldcal.exports.calibration import Constants, Export
from fieldcal.names import Sensor

REAL32, INT32 = 9, 6
AXES = "XYZ"


def px4(constants: Constants) -> Export:
    """QGroundControl's parameter file: vehicle, component, name, value, MAVLink type, separated by tabs."""
    triads, warnings = in_autopilot_units(constants, magnetic_unit=1.0)
    rows: list[tuple[str, float | int, int]] = []
    for sensor, name, letter in ((Sensor.ACCELEROMETER, "ACC", "A"), (Sensor.GYROSCOPE, "GYRO", "G")):
        if (triad := triads.get(sensor)) is None:
            continue
        for i, axis in enumerate(AXES):
            rows.append((f"CAL_{name}0_{axis}OFF", triad.zero[i], REAL32))
            if sensor == Sensor.ACCELEROMETER:
                rows.append((f"CAL_{name}0_{axis}SCALE", triad.scale[i, i], REAL32))
        if thermal(triad) and triad.flown_degc is not None:
            rows.append((f"TC_{letter}_ENABLE", 1, INT32))
            low, high = triad.flown_degc
            rows += [
                (f"TC_{letter}0_TREF", triad.temperature_degc, REAL32),
                (f"TC_{letter}0_TMIN", min(low, triad.temperature_degc), REAL32),
                (f"TC_{letter}0_TMAX", max(high, triad.temperature_degc), REAL32),
            ]
            for i in range(3):
                slopes = (0.0, triad.zero_per_degc[i], triad.zero_per_degc2[i], triad.zero_per_degc3[i])
                rows += [(f"TC_{letter}0_X{order}_{i}", slope, REAL32) for order, slope in enumerate(slopes)]
            warnings.append(
                f"{sensor}: TC_{letter}0_ID must be the device id of this sensor, as CAL_{name}0_ID is, or PX4 ignores"
                " the temperature terms."
            )
    if (triad := triads.get(Sensor.MAGNETOMETER)) is not None:
        matrix, asymmetric = symmetric(triad, "PX4")
        warnings += asymmetric
        for i, axis in enumerate(AXES):
            rows.append((f"CAL_MAG0_{axis}OFF", triad.zero[i], REAL32))
            rows.append((f"CAL_MAG0_{axis}SCALE", matrix[i, i], REAL32))
        off = (matrix[0, 1], matrix[0, 2], matrix[1, 2])
        rows += [(f"CAL_MAG0_{axis}ODIAG", value, REAL32) for axis, value in zip(AXES, off, strict=True)]
    lines = [
        f"# {constants.heading}",
        "# Vehicle-Id Component-Id Name Value Type",
        *(f"1\t1\t{name}\t{_number(value)}\t{kind}" for name, value, kind in rows),
    ]
    return Export("\n".join(lines) + "\n", (*warnings, *not_held(triads, "PX4")))


def _number(value: float | int) -> str:
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)
