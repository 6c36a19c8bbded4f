"""PX4 parameters, as QGroundControl loads them.

Conventions (PX4-Autopilot, src/lib/sensor_calibration, src/modules/temperature_compensation): in sensor axes, before
rotation to the board,

    accelerometer  (raw − thermal − CAL_ACCn_?OFF) · CAL_ACCn_?SCALE, m/s²
    gyroscope      raw − thermal − CAL_GYROn_?OFF, rad/s; there is no scale
    magnetometer   S (raw − thermal − CAL_MAGn_?OFF), gauss; S symmetric: ?SCALE on the diagonal, XODIAG = S_xy,
                   YODIAG = S_xz, ZODIAG = S_yz
    thermal        TC_An_X0_i + TC_An_X1_i (T − TC_An_TREF) + …, T kept within TC_An_TMIN … _TMAX, only where
                   TC_A_ENABLE is 1 (gyroscope: TC_Gn; magnetometer, of newer firmware: TC_Mn)

n is the slot whose CAL_*n_ID is the sensor's device id. An offset has the sign of fieldcal's zero. A thermal block is
written whole or not at all. Scales are within 0.1 and 3. PX4 keeps parameters as float32.
"""

from __future__ import annotations

import numpy as np

from fieldcal.exports.autopilots.affine import rotation_and_symmetric
from fieldcal.exports.autopilots.loading import Loadable, Request, loadable
from fieldcal.exports.autopilots.px4_slot import Px4, signed, thermal_block, thermal_slot
from fieldcal.exports.autopilots.thermal import curve_to_load, slope_span
from fieldcal.exports.autopilots.units import SHOWN_UNIT, dropped_rotation, not_held
from fieldcal.exports.calibration import Constants, Export, Written
from fieldcal.geometry.rotation import Array
from fieldcal.logs.ulog.parameters import AXES, BY_ITSELF, CALIBRATION, THERMAL
from fieldcal.names import Sensor

REAL32, INT32 = 9, 6
AUTOPILOT_COMPONENT = 1
SCALE_LEAST, SCALE_MOST = 0.1, 3.0
Row = tuple[str, float, int]


def px4(constants: Constants, request: Request | None = None) -> Export:
    """QGroundControl's parameter file: vehicle, component, name, value, MAVLink type, separated by tabs.

    Raises
    ------
    FieldcalError
        `not_loadable`.
    """
    asked = request or Request()
    found, told = loadable(constants, Px4(), asked)
    rows: list[Row] = []
    written: list[Written] = []
    for one in found:
        own, more = _sensor(one)
        rows += own
        written += [Written(one.unit_id, str(one.sensor), name, float(value)) for name, value, _ in own]
        told += more
    rows = list(dict.fromkeys(rows))  # TC_A_ENABLE of several slots
    told += _by_itself(found)
    told.append(
        "CAL_*_ID, CAL_*_ROT and CAL_*_PRIO are not in the file and stay as they are on the vehicle. Reboot it after"
        " loading."
    )
    lines = [
        f"# {constants.heading}",
        "# Vehicle-Id Component-Id Name Value Type",
        *(
            f"{asked.system_id}\t{AUTOPILOT_COMPONENT}\t{name}\t{_number(value, kind)}\t{kind}"
            for name, value, kind in rows
        ),
    ]
    return Export("\n".join(lines) + "\n", tuple(told), tuple(written))


def _sensor(one: Loadable) -> tuple[list[Row], list[str]]:
    """Rows of a sensor's slot; none where a scale is beyond PX4's limits."""
    prefix = f"{CALIBRATION[one.sensor]}{one.slot}_"
    scale, told = np.diag(np.diagonal(one.triad.scale)), not_held(one.sensor, one.triad, "PX4")
    if one.sensor == Sensor.MAGNETOMETER:
        turn, scale = rotation_and_symmetric(one.triad.scale)
        told += dropped_rotation(one.sensor, turn, "PX4")
    diagonal = np.diagonal(scale)
    beyond = [] if one.sensor == Sensor.GYROSCOPE else [s for s in diagonal if not SCALE_LEAST <= s <= SCALE_MOST]
    if beyond:
        return [], [
            f"{one.sensor}: left out. A scale of {beyond[0]:.4g} is beyond the {SCALE_LEAST:g} to {SCALE_MOST:g} that"
            f" {prefix}?SCALE takes."
        ]
    offset, block, more = _offset(one)
    rows: list[Row] = [(f"{prefix}{axis}OFF", offset[i], REAL32) for i, axis in enumerate(AXES)]
    if one.sensor != Sensor.GYROSCOPE:
        rows += [(f"{prefix}{axis}SCALE", diagonal[i], REAL32) for i, axis in enumerate(AXES)]
    if one.sensor == Sensor.MAGNETOMETER:
        off = scale[[0, 0, 1], [1, 2, 2]]
        rows += [(f"{prefix}{axis}ODIAG", off[i], REAL32) for i, axis in enumerate(AXES)]
    return rows + block, told + more


def _offset(one: Loadable) -> tuple[Array, list[Row], list[str]]:
    """A sensor's offset (3,), and its thermal block where that changes."""
    sensor, triad, at = one.sensor, one.triad, one.triad.temperature_degc
    loaded = thermal_block(sensor, one.device_id, one.parameters)
    curve = curve_to_load(triad, loaded, at if loaded is None else loaded.reference_degc)
    kept = triad.zero if loaded is None else triad.zero - loaded.at(at)
    if curve is None:
        return kept, [], []
    slot = None if one.device_id is None else thermal_slot(sensor, one.device_id, one.parameters)
    name = THERMAL[sensor]
    if one.device_id is None or slot is None:
        left_out = (
            f"{sensor}: slopes over temperature, up to {slope_span(triad):.2g} {SHOWN_UNIT[sensor]} over what was"
            f" flown, are left out: no {name}n_ID is known for its device id. Offsets are those at {at:g} °C."
        )
        return kept, [], [left_out]
    own = f"{name}{slot}_"
    rows: list[Row] = [
        (f"{name}_ENABLE", 1, INT32),
        (f"{own}ID", signed(one.device_id), INT32),
        (f"{own}TREF", curve.reference_degc, REAL32),
        (f"{own}TMIN", curve.low_degc, REAL32),
        (f"{own}TMAX", curve.high_degc, REAL32),
    ]
    for order, terms in enumerate((curve.constant, *curve.coefficients)):
        rows += [(f"{own}X{order}_{axis}", terms[axis], REAL32) for axis in range(3)]
    return triad.zero - curve.at(at), rows, _wakes_others(one, slot)


def _wakes_others(one: Loadable, slot: int) -> list[str]:
    """A block that enables those of other devices, which were not in use."""
    name = THERMAL[one.sensor]
    if one.parameters.get(f"{name}_ENABLE") == 1:
        return []
    return [
        f"{one.sensor}: {name}_ENABLE becomes 1, for every {name}n_ID that is not 0, not for {name}{slot}_ID alone."
    ]


def _by_itself(found: list[Loadable]) -> list[str]:
    """What changes the offsets again once they are loaded."""
    told = []
    for sensor in dict.fromkeys(one.sensor for one in found):
        loaded = [one.parameters for one in found if one.sensor == sensor]
        own = [name for name in BY_ITSELF[sensor] if any(p.get(name, 1.0) != 0.0 for p in loaded)]
        told += [f"{sensor}: unless {name} is 0, PX4 changes the offsets by itself after a while." for name in own]
    return told


def _number(value: float, kind: int) -> str:
    return str(int(value)) if kind == INT32 else repr(float(value))
