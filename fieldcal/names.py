"""Names that stand in tables and files, each once: a misspelt one fails in the type check, not in a night."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

Triple = tuple[float, float, float]
"""x, y, z."""
Rotation = tuple[Triple, Triple, Triple]
"""A 3x3 matrix by rows."""
Signs = tuple[int, int, int]
"""1 or -1 for x, y, z."""


class Sensor(StrEnum):
    """The three triads of an IMU."""

    MAGNETOMETER = "magnetometer"
    ACCELEROMETER = "accelerometer"
    GYROSCOPE = "gyroscope"


SENSORS = tuple(Sensor)
"""The one order of the sensors."""
INERTIAL_FIRST = SENSORS[::-1]
"""The same backwards: gyroscope, accelerometer, magnetometer, as logs and constants for autopilots list them."""
VECTOR_SENSORS = (Sensor.MAGNETOMETER, Sensor.ACCELEROMETER)
"""Those that sense a known vector, the local field and gravity."""


class Approach(StrEnum):
    """What `method` in `fieldcal.toml` chooses for a sensor."""

    SERIAL = "serial"
    """One step after the other."""
    JOINT = "joint"
    """Everything in one likelihood."""


World = Literal["ned", "enu"]
Body = Literal["frd", "flu"]
GravitySign = Literal["gravity", "specific_force"]
FieldUnit = Literal["norm", "T", "uT", "G"]
EllipsoidFit = Literal["robust", "li", "li_full", "two_step", "tls"]
AttitudeFit = Literal["quest", "davenport", "svd", "triad", "euler"]
Equations = Literal["all", "scalar"]
InitialAttitude = Literal["estimated", "fixed"]
SegmentEnds = Literal["odd", "even"]
ProfileName = Literal["full", "onboard", "paper"]
