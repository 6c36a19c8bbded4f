"""What PX4 did to a sensor's readings before it logged them, from the parameters in the log.

Accelerometer: R ((raw - T - OFF) * SCALE). Gyroscope: R (raw - T - OFF), firmware of before 2020 with a SCALE too.
Magnetometer: R S (raw + power * COMP - OFF), S symmetric; its part that follows the current is not in a `Correction`.
R turns the sensor as the board is mounted, or as an external sensor is. T is the thermal compensation, a polynomial of
third degree. Parameters are those of the slot whose ID is the sensor's device id.

Source: PX4-Autopilot, src/lib/sensor_calibration, src/modules/sensors/temperature_compensation.cpp.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.interface import Correction
from fieldcal.logs.ulog.file import Change
from fieldcal.logs.ulog.rotations import CUSTOM, from_euler, rotation
from fieldcal.names import Sensor

AUTOPILOT: Final = "px4"
SLOTS = 4
AXES = "XYZ"
CALIBRATION = {Sensor.GYROSCOPE: "CAL_GYRO", Sensor.ACCELEROMETER: "CAL_ACC", Sensor.MAGNETOMETER: "CAL_MAG"}
THERMAL = {Sensor.GYROSCOPE: "TC_G", Sensor.ACCELEROMETER: "TC_A", Sensor.MAGNETOMETER: "TC_M"}
THERMAL_DEGC = {"TREF": 25.0, "TMIN": 0.0, "TMAX": 100.0}
"""Temperatures of a thermal slot as the firmware has them until they are set."""
BOARD = "SENS_BOARD_"
BY_ITSELF = {
    Sensor.GYROSCOPE: ("IMU_GYRO_CAL_EN", "SENS_IMU_AUTOCAL"),
    Sensor.ACCELEROMETER: ("SENS_IMU_AUTOCAL",),
    Sensor.MAGNETOMETER: ("SENS_MAG_AUTOCAL",),
}
"""Where one of these is not 0, PX4 changes a sensor's offsets by itself: at rest, or after a flight."""
_DEGREES = 4
_ID_MASK = 0xFFFFFFFF

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class History:
    """Parameters over a log: their values at its start, at `start_us`, and what was set since, in order of time.

    `release`: the firmware's, as `ver_sw_release` has it.
    """

    initial: Mapping[str, float]
    changes: Sequence[Change] = ()
    start_us: int = 0
    release: int | None = None

    @property
    def last(self) -> Mapping[str, float]:
        """All values as they stand at the end of the log."""
        return {**self.initial, **{change.name: change.value for change in self.changes}}

    def states(self, *prefixes: str) -> Iterator[tuple[int, Mapping[str, float]]]:
        """(from when, in µs, all values): at the start, and whenever a parameter with one of these prefixes was set."""
        values = dict(self.initial)
        yield self.start_us, dict(values)
        for t_us, group in itertools.groupby(self.changes, key=lambda change: change.t_us):
            together = {change.name: change.value for change in group}
            values |= together
            if any(name.startswith(prefixes) for name in together):
                yield t_us, dict(values)


@dataclass(frozen=True)
class _Found:
    """Values that were looked at."""

    values: Mapping[str, float]
    used: dict[str, float] = field(default_factory=dict)

    def __call__(self, name: str, default: float = 0.0) -> float:
        value = self.values.get(name)
        if value is not None:
            self.used[name] = value
        return default if value is None or not np.isfinite(value) else value

    def vector(self, name: str, default: float = 0.0) -> Vector:
        """One value an axis; `name` has a place for its letter."""
        return np.array([self(name.format(axis), default) for axis in AXES])


def slot_of(prefix: str, device_id: int, values: Mapping[str, float]) -> int | None:
    """Number of the slot that has the calibration of a device; ids are logged signed here and unsigned there."""
    for slot in range(SLOTS):
        number = values.get(f"{prefix}{slot}_ID")
        if device_id and number is not None and np.isfinite(number) and int(number) & _ID_MASK == device_id & _ID_MASK:
            return slot
    return None


def corrections(
    sensor: Sensor, device_id: int | None, history: History, temperature_degc: float | None = None, offset_ns: int = 0
) -> tuple[Correction, ...]:
    """What PX4 had done to a sensor's readings, piece by piece in time.

    Parameters
    ----------
    sensor : Sensor
    device_id : int or None
        None where the log does not tell: then nothing but the board's rotation is known.
    history : History
    temperature_degc : float, optional
        At which the thermal compensation is told; its reference temperature.
    offset_ns : int
        Stamps in the log's clock less time since boot.
    """
    found: list[Correction] = []
    for t_us, values in history.states(CALIBRATION[sensor], THERMAL[sensor], BOARD):
        piece = correction(
            sensor, device_id, values, temperature_degc, from_ns=t_us * 1000 + offset_ns, release=history.release
        )
        if found and _same(found[-1], piece):
            continue
        if found and found[-1].from_ns >= piece.from_ns:
            found.pop()
        found.append(piece)
    return tuple(found)


def correction(
    sensor: Sensor,
    device_id: int | None,
    values: Mapping[str, float],
    temperature_degc: float | None = None,
    *,
    from_ns: int = 0,
    release: int | None = None,
) -> Correction:
    """What PX4 does to a sensor's readings under these parameters."""
    get = _Found(values)
    board = from_euler(*get.vector(f"{BOARD}{{}}_OFF")) @ rotation(get(f"{BOARD}ROT"), release)
    slot = None if device_id is None else slot_of(CALIBRATION[sensor], device_id, values)
    turn, scale, zero = board, np.eye(3), np.zeros(3)
    if slot is not None:
        prefix = f"{CALIBRATION[sensor]}{slot}_"
        get(f"{prefix}ID")
        zero = get.vector(f"{prefix}{{}}OFF")
        scale = np.diag(get.vector(f"{prefix}{{}}SCALE", 1.0))
        if sensor == Sensor.MAGNETOMETER:
            get.vector(f"{prefix}{{}}COMP")
            xy, xz, yz = get.vector(f"{prefix}{{}}ODIAG")
            scale = scale + np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
        mounted = get(f"{prefix}ROT", -1.0)
        if mounted == CUSTOM:
            turn = from_euler(*(get(f"{prefix}{angle}") for angle in ("ROLL", "PITCH", "YAW")))
        elif mounted >= 0:
            turn = rotation(mounted, release)
    thermal, slope, reference = _thermal(sensor, device_id, get, temperature_degc)
    matrix = turn @ scale
    offset, per_degc = -matrix @ (thermal + zero), -matrix @ slope
    return Correction(from_ns, _rows(matrix), _triple(offset), {**get.used}, reference, _triple(per_degc))


def parameters_of(sensor: Sensor, device_id: int | None, values: Mapping[str, float]) -> dict[str, float]:
    """Of the autopilot's parameters those that concern a sensor: its slot's, which devices the other slots are for,
    what mounts it, and what may change its calibration by itself."""
    calibration, thermal = CALIBRATION[sensor], THERMAL[sensor]
    beside = [f"{prefix}{slot}_ID" for prefix in (calibration, thermal) for slot in range(SLOTS)]
    beside += [f"{thermal}_ENABLE", *BY_ITSELF[sensor]]
    used = correction(sensor, device_id, values).parameters
    return {**used, **{name: values[name] for name in beside if np.isfinite(values.get(name, np.nan))}}


def corrected(piece: Correction, raw: Vector, temperature_degc: float | None = None) -> Vector:
    """Readings as the autopilot logs them, (n, 3), from raw ones."""
    return raw @ np.array(piece.matrix).T + _offset(piece, temperature_degc)


def uncorrected(piece: Correction, logged: Vector, temperature_degc: float | None = None) -> Vector:
    """Raw readings, (n, 3), from logged ones."""
    return np.linalg.solve(np.array(piece.matrix), (logged - _offset(piece, temperature_degc)).T).T


def _offset(piece: Correction, temperature_degc: float | None) -> Vector:
    offset = np.array(piece.offset)
    if temperature_degc is None or piece.temperature_degc is None:
        return offset
    return offset + (temperature_degc - piece.temperature_degc) * np.array(piece.offset_per_degc)


def _thermal(
    sensor: Sensor, device_id: int | None, get: _Found, temperature_degc: float | None
) -> tuple[Vector, Vector, float | None]:
    """Thermal compensation, its slope, and the temperature that they are told at; None where there is none."""
    prefix = THERMAL[sensor]
    slot = None if device_id is None else slot_of(prefix, device_id, get.values)
    if slot is None or get.values.get(f"{prefix}_ENABLE") != 1:
        return np.zeros(3), np.zeros(3), None
    own = f"{prefix}{slot}_"
    for name in (f"{prefix}_ENABLE", f"{own}ID"):
        get(name)
    reference, lowest, highest = (get(f"{own}{name}", default) for name, default in THERMAL_DEGC.items())
    told = reference if temperature_degc is None else temperature_degc
    d = min(max(told, lowest), highest) - reference
    coefficients = np.array([[get(f"{own}X{k}_{axis}") for axis in range(3)] for k in range(_DEGREES)])
    powers = d ** np.arange(_DEGREES)
    slope = np.arange(1, _DEGREES) * powers[:-1] @ coefficients[1:] if lowest <= told <= highest else np.zeros(3)
    return powers @ coefficients, slope, told


def _same(one: Correction, other: Correction) -> bool:
    return (one.matrix, one.offset, one.offset_per_degc) == (other.matrix, other.offset, other.offset_per_degc)


def _triple(values: Vector) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _rows(
    matrix: Vector,
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    return _triple(matrix[0]), _triple(matrix[1]), _triple(matrix[2])
