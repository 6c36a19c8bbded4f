"""ArduPilot parameters, as Mission Planner and MAVProxy load them.

Conventions (ArduPilot, libraries/AP_InertialSensor and AP_Compass), gyroscope and accelerometer in sensor axes, before
rotation to the board, compasses in body axes, after it:

    accelerometer  (raw − thermal − INS_ACCOFFS) · INS_ACCSCAL, m/s²
    gyroscope      raw − thermal − INS_GYROFFS, rad/s; there is no scale
    compass        M (k (raw + COMPASS_OFS)) + COMPASS_MOT · current or throttle, milligauss; k = COMPASS_SCALE within
                   1/1.5 and 1.5, else 1; M symmetric: COMPASS_DIA on the diagonal, COMPASS_ODI_X = M_xy, _Y = M_xz,
                   _Z = M_yz. **The offset is added: it has the opposite sign of fieldcal's zero**
    thermal        p(T) − p(INS_ACC1_CALTEMP), p(T) = 1e-6 (INS_TCAL1_ACC1 d + _ACC2 d² + _ACC3 d³), d = T − 35 °C, both
                   temperatures kept within INS_TCAL1_TMIN … TMAX, which must be at least 10 °C apart (gyroscope:
                   INS_TCAL1_GYR1, INS_GYR1_CALTEMP)

This is the first instance's; the second's are INS_ACC2OFFS, INS_TCAL2_…, COMPASS_OFS2, …: the instance is the one
whose INS_ACCn_ID or COMPASS_DEV_IDn is the sensor's device id. Before 3.3 the firmware turned first. An accelerometer
or compass whose offsets are all zero counts as not calibrated. Limits: INS_ACCSCAL 0.8 to 1.2, INS_ACCOFFS ±3.5,
COMPASS_OFS ±1500, COMPASS_DIA 0.8 to 1.2, COMPASS_ODI ±0.2. ArduPilot keeps parameters as float32.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fieldcal.exports.autopilots.affine import rotation_and_symmetric
from fieldcal.exports.autopilots.ardupilot_slot import KIND, ArduPilot, compass_matrix, thermal_block
from fieldcal.exports.autopilots.loading import Loadable, Request, loadable
from fieldcal.exports.autopilots.thermal import Curve, curve_to_load, slope_span
from fieldcal.exports.autopilots.units import SHOWN_UNIT, dropped_rotation, not_held
from fieldcal.exports.calibration import Constants, Export, Written
from fieldcal.geometry.rotation import Array
from fieldcal.logs.dataflash.corrections import COMPASS_SCALE_RANGE, THERMAL_REFERENCE_DEGC, THERMAL_SCALE
from fieldcal.logs.dataflash.parameters import compass_names, inertial_names
from fieldcal.names import Sensor

LEAST_SPAN_DEGC = 10.0
SCALE_LIMITS, OFFSET_LIMIT_MPS2 = (0.8, 1.2), 3.5
COMPASS_OFFSET_LIMIT_MG, DIAGONAL_LIMITS, OFF_DIAGONAL_LIMIT = 1500.0, (0.8, 1.2), 0.2
NOT_ZERO = {Sensor.ACCELEROMETER: 1e-5, Sensor.MAGNETOMETER: 1e-2}
"""An offset that is not zero to the firmware (FLT_EPSILON), and nothing to the sensor: m/s², milligauss."""
Row = tuple[str, float]


def ardupilot(constants: Constants, request: Request | None = None) -> Export:
    """NAME,VALUE lines.

    Raises
    ------
    FieldcalError
        `not_loadable`.
    """
    found, told = loadable(constants, ArduPilot(), request or Request())
    rows: list[Row] = []
    kept: list[Loadable] = []
    written: list[Written] = []
    for one in found:
        own, more = _compass(one) if one.sensor == Sensor.MAGNETOMETER else _inertial(one)
        rows += own
        written += _written(one, own)
        told += more
        kept += [one] if own else []
    for slot in sorted({one.slot for one in kept if one.sensor in KIND}):
        own_sensors = {one.sensor: one for one in kept if one.slot == slot and one.sensor in KIND}
        own, more = _thermal(slot, own_sensors)
        rows += own
        for sensor, one in own_sensors.items():
            others = {name for kind in KIND.values() if kind != KIND[sensor] for name in _terms(kind, slot)}
            written += _written(one, [row for row in own if row[0] not in others])
        told += more
    told += _by_itself(kept)
    told.append("Reboot it after loading.")
    text = "\n".join([f"# {constants.heading}", *(f"{name},{_number(value)}" for name, value in rows)])
    return Export(text + "\n", tuple(told), tuple(written))


def _inertial(one: Loadable) -> tuple[list[Row], list[str]]:
    names, triad = inertial_names(KIND[one.sensor], one.slot), one.triad
    offset, told = _not_zero(one.sensor, triad.zero), not_held(one.sensor, triad, "ArduPilot")
    rows = [] if one.device_id is None else [(names.device_id, float(one.device_id))]
    rows += [*_named(names.offset, offset), (names.calibrated_degc, triad.temperature_degc)]
    if names.scale is not None:
        scale = np.diagonal(triad.scale)
        beyond = _beyond(names.scale, scale, *SCALE_LIMITS) or _beyond(
            names.offset, offset, -OFFSET_LIMIT_MPS2, OFFSET_LIMIT_MPS2
        )
        if beyond:
            return [], [f"{one.sensor}: left out. {beyond}"]
        rows += _named(names.scale, scale)
    return rows, told


def _compass(one: Loadable) -> tuple[list[Row], list[str]]:
    names, triad = compass_names(one.slot), one.triad
    turn, matrix = rotation_and_symmetric(triad.scale)
    # Firmware of before 4.0 has no COMPASS_SCALE: what is loaded tells.
    k = float(np.diagonal(matrix).mean()) if not one.parameters or names.scale in one.parameters else 1.0
    soft, offset = matrix / k, _not_zero(one.sensor, -triad.zero)
    off = soft[[0, 0, 1], [1, 2, 2]]
    beyond = (
        _beyond((names.scale,), np.array([k]), *COMPASS_SCALE_RANGE)
        or _beyond(names.diagonal, np.diagonal(soft), *DIAGONAL_LIMITS)
        or _beyond(names.off_diagonal, off, -OFF_DIAGONAL_LIMIT, OFF_DIAGONAL_LIMIT)
        or _beyond(names.offset, offset, -COMPASS_OFFSET_LIMIT_MG, COMPASS_OFFSET_LIMIT_MG)
    )
    if beyond:
        return [], [f"{one.sensor}: left out. {beyond}"]
    told = dropped_rotation(one.sensor, turn, "ArduPilot") + not_held(one.sensor, triad, "ArduPilot")
    if span := slope_span(triad):
        told.append(
            f"{one.sensor}: ArduPilot does not correct it for temperature, over which it moved by up to {span:.2g} mG;"
            f" offsets are those at {triad.temperature_degc:g} °C."
        )
    rows = [*_named(names.offset, offset), *_named(names.diagonal, np.diagonal(soft)), *_named(names.off_diagonal, off)]
    if names.scale in one.parameters or not one.parameters:
        rows.append((names.scale, k))
    motor = np.array([one.parameters.get(name, 0.0) for name in names.motor])
    if np.any(motor):
        # It is added after the matrix: what it cancels in the raw field comes through the new matrix, not the old.
        rows += _named(names.motor, matrix @ np.linalg.solve(compass_matrix(one.slot, one.parameters), motor))
    return rows, told


def _thermal(slot: int, sensors: dict[Sensor, Loadable]) -> tuple[list[Row], list[str]]:
    """The block of an instance, of gyroscope and accelerometer together, where it changes."""
    any_names = inertial_names("ACC", slot)
    loaded: dict[Sensor, Curve | None] = {}
    curves: dict[Sensor, Curve] = {}
    for sensor in KIND:
        known = next((one.parameters for one in sensors.values() if sensor == one.sensor), {})
        known = known or next(one.parameters for one in sensors.values())
        loaded[sensor] = thermal_block(sensor, slot, known)
        if (one := sensors.get(sensor)) is not None:
            curve = curve_to_load(one.triad, loaded[sensor], THERMAL_REFERENCE_DEGC)
            if curve is not None:
                curves[sensor] = curve
    if not curves:
        return [], []
    low, high = min(c.low_degc for c in curves.values()), max(c.high_degc for c in curves.values())
    if high - low < LEAST_SPAN_DEGC:
        moved = ", ".join(f"{sensor} {slope_span(sensors[sensor].triad):.2g} {SHOWN_UNIT[sensor]}" for sensor in curves)
        return [], [
            f"Flown between {low:.1f} and {high:.1f} °C: ArduPilot wants 10 °C for a temperature calibration, so it is"
            f" left out ({moved})."
        ]
    rows: list[Row] = [
        (any_names.thermal_enable, 1.0),
        (any_names.thermal_min_degc, low),
        (any_names.thermal_max_degc, high),
    ]
    for sensor, kind in KIND.items():
        there = curves.get(sensor) or loaded[sensor]
        terms = np.zeros((3, 3)) if there is None else there.about(THERMAL_REFERENCE_DEGC)
        for names, values in zip(inertial_names(kind, slot).thermal, terms / THERMAL_SCALE, strict=True):
            rows += _named(names, values)
    return rows, []


def _by_itself(found: list[Loadable]) -> list[str]:
    """What changes the offsets again once they are loaded."""
    told = []
    gyroscopes = [one.parameters for one in found if one.sensor == Sensor.GYROSCOPE]
    if any(parameters.get("INS_GYR_CAL", 1.0) != 0.0 for parameters in gyroscopes):
        told.append("gyroscope: ArduPilot measures INS_GYROFFS anew at every start unless INS_GYR_CAL is 0.")
    compasses = [one.parameters for one in found if one.sensor == Sensor.MAGNETOMETER]
    if any(parameters.get("COMPASS_LEARN", 0.0) != 0.0 for parameters in compasses):
        told.append("magnetometer: ArduPilot learns COMPASS_OFS anew in flight unless COMPASS_LEARN is 0.")
    unknown = sorted({f"INS_{KIND[one.sensor]}n_ID" for one in found if one.sensor in KIND and one.device_id is None})
    if unknown:
        told.append(f"{' and '.join(unknown)} stay as they are: where one is 0, ArduPilot asks for a calibration.")
    return told


def _not_zero(sensor: Sensor, offset: Array) -> Array:
    """An offset that is nowhere but exactly zero would count as none."""
    if sensor in NOT_ZERO and np.all(np.abs(offset) < np.finfo(np.float32).eps):
        return np.array([NOT_ZERO[sensor], *offset[1:]])
    return offset


def _beyond(names: Iterable[str], values: Array, low: float, high: float) -> str | None:
    """A sentence on a value beyond what its parameter takes; None where all are within."""
    for name, value in zip(names, values, strict=True):
        if not low <= value <= high:
            return f"{name} of {value:.4g} is beyond the {low:.4g} to {high:.4g} that it takes."
    return None


def _terms(kind: str, slot: int) -> list[str]:
    """Parameters of a thermal block that are one sensor's alone."""
    return [name for names in inertial_names(kind, slot).thermal for name in names]


def _written(one: Loadable, rows: Iterable[Row]) -> list[Written]:
    return [Written(one.unit_id, str(one.sensor), name, value) for name, value in rows]


def _named(names: Iterable[str], values: Array) -> list[Row]:
    return [(name, float(value)) for name, value in zip(names, values, strict=True)]


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))
