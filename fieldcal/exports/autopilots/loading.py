"""From a vehicle's constants to what goes into each slot of its autopilot: whose, in which axes, before what.

The history has the constants of raw sensors where an autopilot wrote the log, in the axes of the logged readings: they
are turned back by the mounting, and the slot is the one whose device id is the sensor's. Any other log does not tell
whether an autopilot had corrected its readings. Then the parameters that did it are given, and are composed with the
constants; or it is stated that none did. Without either nothing is exported: constants of corrected readings, loaded as
they are, make a sensor worse.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np

from fieldcal.config.loaded import Loaded
from fieldcal.errors import FieldcalError
from fieldcal.exports.autopilots.affine import angle_deg
from fieldcal.exports.autopilots.units import SHOWN_UNIT, in_autopilot_units
from fieldcal.exports.calibration import Constants, Origin, Triad
from fieldcal.geometry.frames import FRD_FROM_FLU
from fieldcal.geometry.rotation import Array
from fieldcal.names import INERTIAL_FIRST, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.reference import REFERENCE_DEGC

LEAST_TURN_DEG = 0.01
FIRST_SLOT = 0


@dataclass(frozen=True)
class Request:
    """What is asked of an export to an autopilot.

    `parameters`: of the autopilot, by name, active while the log was recorded; None: those in the log. `logged_raw`: it
    is stated that no autopilot had corrected the readings. `system_id`: MAVLink's, of the vehicle that loads them.
    """

    parameters: Mapping[str, float] | None = None
    logged_raw: bool = False
    system_id: int = 1


@dataclass(frozen=True)
class Loadable:
    """Constants of a raw sensor in the axes and units in which its autopilot calibrates.

    `slot` from 0. `device_id`: None where it is not known. `parameters`: what is loaded; empty where that is not known.
    `unit_id`, `horizontal_field_g`: whose they are, and where they come from (`Origin`).
    """

    sensor: Sensor
    triad: Triad
    slot: int
    device_id: int | None
    parameters: Mapping[str, float] = field(default_factory=dict)
    unit_id: str = ""
    horizontal_field_g: float | None = None


class Slots(Protocol):
    """What differs between autopilots."""

    @property
    def name(self) -> str:
        """As `Loaded` has it."""

    @property
    def title(self) -> str:
        """For people."""

    @property
    def magnetic_unit(self) -> float:
        """Of its magnetometers' parameters, in gauss."""

    @property
    def mounted_by(self) -> str:
        """The parameters that turn a sensor."""

    def calibrates_in_body(self, sensor: Sensor) -> bool:
        """Whether it turns a sensor before it corrects it."""

    def slot(self, sensor: Sensor, device_id: int, parameters: Mapping[str, float]) -> int | None:
        """Number of a device's slot, from 0."""

    def devices(self, sensor: Sensor, parameters: Mapping[str, float]) -> dict[int, int]:
        """Slot → device id, of slots that have one."""

    def named(self, sensor: Sensor, parameters: Mapping[str, float]) -> list[int]:
        """Slots that parameters tell of, with a device id or without, as of firmware that has none."""

    def names_device(self, sensor: Sensor) -> str:
        """How the parameter with a slot's device id is called."""

    def parameter(self, sensor: Sensor, slot: int, what: Literal["zero", "scale"], axis: int) -> str | None:
        """The parameter that holds a sensor's constant; None where there is none."""

    def raw(self, triad: Triad, sensor: Sensor, slot: int, parameters: Mapping[str, float]) -> Triad:
        """Constants of the raw sensor in its own axes, from those of readings in body axes that had been corrected."""


class _LeftOut(Exception):
    """Why a sensor has no place on the target."""


def loadable(constants: Constants, target: Slots, request: Request) -> tuple[list[Loadable], list[str]]:
    """What goes into the slots of an autopilot, further units too; and what is to be said of it.

    Raises
    ------
    FieldcalError
        `not_loadable`: whether the readings had been corrected is not known, or nothing has a place on the target.
    """
    found: list[Loadable] = []
    told: list[str] = []
    for own in (constants, *constants.further):
        for sensor in INERTIAL_FIRST:
            if (triad := own.triads.get(sensor)) is None:
                continue
            try:
                one, more = _place(sensor, triad, own.origins.get(sensor), target, request)
            except _LeftOut as why:
                told.append(f"{sensor}{_of_unit(own, sensor, constants)}: left out. {why}")
                continue
            if any((other.sensor, other.slot) == (sensor, one.slot) for other in found):
                told.append(
                    f"{sensor}{_of_unit(own, sensor, constants)}: left out. Its slot has another unit's already."
                )
                continue
            origin = own.origins.get(sensor) or Origin()
            unit_id = own.unit_ids.get(sensor, "")
            found.append(replace(one, unit_id=unit_id, horizontal_field_g=origin.horizontal_field_g))
            told += more
    if not found:
        raise FieldcalError(ReasonCode.NOT_LOADABLE, f"Nothing to load into {target.title}. {' '.join(told)}")
    return found, told


def without_constants(
    constants: Constants, target: Slots, request: Request, found: Sequence[Loadable]
) -> Iterator[Loadable]:
    """Slots of sensors that are not among those `found`, as their logs tell: with what is loaded, and a triad that
    leaves readings as the autopilot makes them."""
    for sensor in INERTIAL_FIRST:
        origin = constants.origins.get(sensor)
        if origin is None or (loaded := origin.loaded) is None or loaded.autopilot != target.name:
            continue
        if any(one.sensor == sensor for one in found):
            continue
        parameters = loaded.parameters if request.parameters is None else request.parameters
        try:
            slot, device_id = _slot(sensor, loaded.device_id, target, parameters)
        except _LeftOut:
            continue
        at_degc = REFERENCE_DEGC if origin.temperature_degc is None else origin.temperature_degc
        yield Loadable(
            sensor,
            unchanged(SHOWN_UNIT[sensor], at_degc),
            slot,
            device_id,
            parameters,
            constants.unit_ids.get(sensor, ""),
            origin.horizontal_field_g,
        )


def unchanged(unit: str, temperature_degc: float) -> Triad:
    """Constants that leave readings as they are."""
    nothing: Array = np.zeros(3)
    return Triad(
        scale=np.eye(3),
        zero=nothing,
        scale_per_degc=np.zeros((3, 3)),
        zero_per_degc=nothing,
        scale_sd=nothing,
        zero_sd=nothing,
        unit=unit,
        logged_unit=unit,
        temperature_degc=temperature_degc,
        flown_degc=None,
        why=(),
    )


def _place(
    sensor: Sensor, triad: Triad, origin: Origin | None, target: Slots, request: Request
) -> tuple[Loadable, list[str]]:
    own = in_autopilot_units(sensor, triad, target.magnetic_unit)
    if isinstance(own, str):
        raise _LeftOut(own)
    known = origin or Origin()
    loaded = known.loaded
    axes = FRD_FROM_FLU if known.body == "flu" else np.eye(3)
    sign = -1.0 if sensor == Sensor.ACCELEROMETER and known.gravity_sign == "gravity" else 1.0
    mounting = axes @ np.array(known.rotation_body_from_sensor) @ axes.T
    own, told = own.turned(sign * axes), _assumed(sensor, origin)
    if loaded is not None and loaded.autopilot == target.name:
        one = _by_log(sensor, own, known, loaded, target, request)
    elif request.logged_raw:
        one = _stated_raw(sensor, own, mounting, loaded, target, request, told)
    elif request.parameters is not None and loaded is None:
        one = _composed(sensor, own, mounting, target, request.parameters)
    else:
        raise FieldcalError(ReasonCode.NOT_LOADABLE, _why_not(sensor, loaded, target))
    if np.any(np.diagonal(one.triad.scale) <= 0.0):
        raise _LeftOut(
            "An axis has a negative scale: the autopilot expects that its driver or its rotation parameter puts axes"
            " right, not its calibration."
        )
    return one, told


def _by_log(sensor: Sensor, triad: Triad, origin: Origin, loaded: Loaded, target: Slots, request: Request) -> Loadable:
    """The log tells what was loaded, and the constants are the raw sensor's."""
    parameters = loaded.parameters if request.parameters is None else request.parameters
    if not target.calibrates_in_body(sensor):
        triad = triad.turned(np.array(loaded.rotation).T)
    if triad.flown_degc is None and origin.temperature_degc is not None:  # the zero is that of its flight
        triad = replace(triad, temperature_degc=origin.temperature_degc)
    slot, device_id = _slot(sensor, loaded.device_id, target, parameters)
    return Loadable(sensor, triad, slot, device_id, parameters)


def _stated_raw(
    sensor: Sensor,
    triad: Triad,
    mounting: Array,
    loaded: Loaded | None,
    target: Slots,
    request: Request,
    told: list[str],
) -> Loadable:
    """It is stated that nothing was done to the readings."""
    if loaded is not None:
        mounting = np.array(loaded.rotation)
        triad = triad.turned(mounting.T)
    if (angle := angle_deg(mounting)) > LEAST_TURN_DEG:
        if target.calibrates_in_body(sensor):
            triad = triad.turned(mounting)
        told.append(
            f"{sensor}: it is mounted turned by {angle:.4g}° against the body; {target.mounted_by} has to turn it so."
        )
    if request.parameters is not None:
        slot, device_id = _slot(sensor, None, target, request.parameters)
        return Loadable(sensor, triad, slot, device_id, request.parameters)
    told.append(
        f"{sensor}: goes into the first slot, whose {target.names_device(sensor)} has to be its device id, and no"
        " compensation of temperature may be enabled for it."
    )
    return Loadable(sensor, triad, FIRST_SLOT, None)


def _composed(
    sensor: Sensor, triad: Triad, mounting: Array, target: Slots, parameters: Mapping[str, float]
) -> Loadable:
    """The readings had been corrected by these parameters."""
    if angle_deg(mounting) > LEAST_TURN_DEG:
        raise FieldcalError(
            ReasonCode.NOT_LOADABLE,
            f"{sensor}: readings that {target.title} had corrected are in body axes, but fieldcal.toml turns them"
            f" (rotation_body_from_sensor, {angle_deg(mounting):.4g}°): one of both is wrong.",
        )
    slot, device_id = _slot(sensor, None, target, parameters)
    return Loadable(sensor, target.raw(triad, sensor, slot, parameters), slot, device_id, parameters)


def _slot(
    sensor: Sensor, device_id: int | None, target: Slots, parameters: Mapping[str, float]
) -> tuple[int, int | None]:
    """A sensor's slot and its device id: by that, else the only one that has an id."""
    known = target.devices(sensor, parameters)
    named = target.names_device(sensor)
    if device_id is not None:
        slot = target.slot(sensor, device_id, parameters)
        if slot is None:
            there = ", ".join(map(str, known.values())) or "none"
            raise _LeftOut(
                f"No {named} is its device id, {device_id} (there is: {there}): let {target.title} calibrate it once."
            )
        return slot, device_id
    named_slots = target.named(sensor, parameters)
    if not known and len(named_slots) == 1:
        return named_slots[0], None
    if len(known) != 1:
        there = ", ".join(map(str, known.values())) or "none"
        raise _LeftOut(
            f"The log does not tell its device id, and by {named} there is not one device ({there}): give --params a"
            " file with the parameters of this one only."
        )
    return next(iter(known.items()))


def _assumed(sensor: Sensor, origin: Origin | None) -> list[str]:
    if origin is not None:
        return []
    return [
        f"{sensor}: its axes are taken for forward, right, down and its readings for specific force; where they come"
        " from is not known."
    ]


def _why_not(sensor: Sensor, loaded: Loaded | None, target: Slots) -> str:
    if loaded is not None:
        return (
            f"{sensor}: its log is one of another autopilot than {target.title}; --logged-raw states that"
            f" {target.title} gets the same raw readings of its driver."
        )
    return (
        f"{sensor}: its log does not tell whether {target.title} had corrected the readings. Give the parameters that"
        " were active (--params FILE, as QGroundControl or Mission Planner saves them), or state that they were raw"
        " (--logged-raw)."
    )


def _of_unit(own: Constants, sensor: Sensor, primary: Constants) -> str:
    return "" if own is primary else f" of unit {own.unit_ids.get(sensor, '?')}"
