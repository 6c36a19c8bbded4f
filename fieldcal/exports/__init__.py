"""The constants to fly with in the formats of others. Each module states its target's conventions and says what the
target cannot hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from fieldcal.exports.autopilots.ardupilot import ardupilot
from fieldcal.exports.autopilots.loading import Request
from fieldcal.exports.autopilots.px4 import px4
from fieldcal.exports.c_header import c_header
from fieldcal.exports.calibration import Constants, Export, nominal_scales, written
from fieldcal.exports.json_document import json_document
from fieldcal.exports.kalibr import kalibr
from fieldcal.exports.ros import imu_calib, imu_pipeline, ros
from fieldcal.names import SENSORS, Sensor

AUTOPILOTS: dict[str, Callable[[Constants, Request | None], Export]] = {"px4": px4, "ardupilot": ardupilot}
"""Those that something is asked of."""
PROGRAMS: dict[str, Callable[[Constants], Export]] = {
    "ros": ros,
    "imu_calib": imu_calib,
    "imu_pipeline": imu_pipeline,
    "kalibr": kalibr,
    "json": json_document,
    "c": c_header,
}
FORMATS = (*AUTOPILOTS, *PROGRAMS)
_ALL: dict[Sensor, tuple[str, ...]] = dict.fromkeys(SENSORS, ("zero", "scale"))
HELD: dict[str, dict[Sensor, tuple[str, ...]]] = {
    "ros": _ALL,
    "imu_calib": {Sensor.ACCELEROMETER: ("zero", "scale")},
    "imu_pipeline": {},
    "kalibr": {Sensor.GYROSCOPE: ("scale",), Sensor.ACCELEROMETER: ("scale",)},
    "json": _ALL,
    "c": _ALL,
}
"""Whose constants, and which, each of the programs is given."""


def export_to(to: str, constants: Constants, request: Request | None = None) -> Export:
    """Constants in one of `FORMATS`. `request`: for autopilots only.

    Raises
    ------
    FieldcalError
        `not_loadable`: an autopilot cannot take them, or must not without knowing more.
    """
    if to in AUTOPILOTS:
        export = AUTOPILOTS[to](constants, request)
    else:
        export = replace(PROGRAMS[to](constants), written=written(constants, HELD[to]))
    return replace(export, warnings=(*export.warnings, *nominal_scales(constants)))
