"""Names that stand in tables and files, each once: a misspelt one fails in the type check, not in a night."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Literal, TypeAlias

Json: TypeAlias = "Mapping[str, Json] | Sequence[Json] | str | float | bool | None"
"""Plain JSON; whole numbers are floats to the type check."""

UseVps = bool | Literal["auto"]
"""Whether a VPS enters the estimate: "auto" where there is a usable one."""

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


class DatedBy(StrEnum):
    """What tells when a flight was."""

    LOG = "log"
    """Its clock."""
    SESSION = "session"
    """The date in the name of its session's folder."""
    NAME = "name"
    """Nothing: it is placed by the names of session and log."""


class Approach(StrEnum):
    """What `method` in `fieldcal.toml` chooses for a sensor."""

    AUTO = "auto"
    """Everything in one likelihood; one step after the other where that cannot run."""
    SERIAL = "serial"
    """One step after the other."""
    JOINT = "joint"
    """Everything in one likelihood."""


class Rung(StrEnum):
    """How much the joint estimate could ask of a recording."""

    BY_VPS = "by_vps"
    """Gyroscope by the VPS's attitude, vector triads by the trajectory."""
    BY_VELOCITY = "by_velocity"
    """All triads by a satellite receiver's velocity."""
    FREE = "free"
    """Everything by vectors."""
    TURNING_START = "turning_start"
    """The same, the gyroscope's start from how fast the field turns, or gravity."""
    FIELD_ALONE = "field_alone"
    """Gyroscope and magnetometer from that start, without the accelerometer."""
    HELD = "held"
    """The accelerometer's constants held at those known beforehand."""
    INERTIAL_START = "inertial_start"
    """From attitudes by accelerometer and gyroscope alone."""
    ZEROS = "zeros"
    """The gyroscope's scales held too: its zero alone."""


class Method(StrEnum):
    """The estimator that a row of the history comes from."""

    JOINT = "joint"
    VELOCITY = "velocity"
    """The joint one by a satellite receiver's velocity."""
    OUTPUT_ERROR = "output_error"
    EQUATION_ERROR = "equation_error"
    ELLIPSOID_ROBUST = "ellipsoid_robust"
    ELLIPSOID = "ellipsoid"
    ELLIPSOID_FULL = "ellipsoid_full"
    ELLIPSOID_TWO_STEP = "ellipsoid_two_step"
    ELLIPSOID_TLS = "ellipsoid_tls"
    WARM_UP = "warm_up"
    MOTOR_FIELD = "motor_field"
    MOMENTS = "moments"
    """Of flights together, by `fieldcal refit`."""


JOINT_METHODS = (Method.JOINT, Method.VELOCITY)
"""What stage `joint` gives, one of them a flight."""
PREFERRED_METHODS = (
    Method.JOINT,
    Method.VELOCITY,
    Method.OUTPUT_ERROR,
    Method.ELLIPSOID_ROBUST,
    Method.ELLIPSOID,
    Method.EQUATION_ERROR,
)
"""Of several estimates of one constant the most exact counts: this order, those not named last."""


def exactness(method: str) -> int:
    """Place of an estimator among all, 0 the most exact; those that nobody ordered come last."""
    order = [str(known) for known in PREFERRED_METHODS]
    return order.index(method) if method in order else len(order)


class Status(StrEnum):
    """How a stage, or a row that it wrote, ended."""

    OK = "ok"
    REFUSED = "refused"
    """The recording does not determine it."""
    ABSENT = "absent"
    """There is nothing to do."""
    FAILED = "failed"
    """An error of fieldcal's own."""
    WITHDRAWN = "withdrawn"
    """It was ok, and somebody decided that it does not count."""


class Decision(StrEnum):
    """What people decide about flights and rows."""

    WITHDRAW = "withdraw"
    """It counts nowhere, and stays."""
    ACCEPT = "accept"
    """It counts, again or as it did."""


class Verdict(StrEnum):
    """What a log is good for."""

    OK = "ok"
    PARTIAL = "partial"
    """Something is missing of it; the rest counts."""
    NO_RESULT = "no_result"
    """It was read, and no constant came out of it."""
    QUARANTINED = "quarantined"
    """It contradicts itself; nothing of it is published."""
    REJECTED = "rejected"
    """Nothing of it can be read."""

    @property
    def usable(self) -> bool:
        """Whether stages run on it."""
        return self in (Verdict.OK, Verdict.PARTIAL, Verdict.NO_RESULT)


class DriftStatus(StrEnum):
    """What the history says of a constant."""

    STABLE = "stable"
    DRIFTING = "drifting"
    STEP = "step"
    OUTLIER = "outlier"
    """Unlike the rest of the fleet."""
    INSUFFICIENT = "insufficient"
    """Too few sessions for a trend."""


class Standing(StrEnum):
    """What is said of a vehicle before it flies, the gravest first."""

    NOTHING = "nothing to fly with"
    LOOK = "look first"
    TOO_FEW = "too few to tell"
    """Its constants are there; whether they hold, too few sessions tell."""
    FINE = "fine to fly"


GRAVEST_FIRST = (
    DriftStatus.STEP,
    DriftStatus.DRIFTING,
    DriftStatus.OUTLIER,
    DriftStatus.STABLE,
    DriftStatus.INSUFFICIENT,
)


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
CsvPreset = Literal[
    "betaflight",
    "euroc",
    "mavlogdump",
    "motive",
    "motive_z_up",
    "phyphox",
    "plotjuggler",
    "qualisys",
    "rostopic",
    "ulog2csv",
    "vicon_nexus",
    "x_io",
    "xsens_mt",
]
"""CSV formats that are known by name (`fieldcal.logs.csv.presets`)."""


FIELD_ASSUMED = "assumed"
"""`field_source` where neither the configuration nor the log says where it was flown: length 1, north, dip unknown."""

RESIDUAL = "residual_"
"""Before the parameters that hold for readings which an autopilot had corrected before it logged them."""
