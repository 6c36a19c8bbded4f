"""ROS 2 message definitions: their text form flattened into the sequence of values that CDR writes.

A definition names fields of numbers, strings, other messages and arrays of them; nested definitions follow, separated
by lines of `=`. Flattening follows the nesting, so that a dotted path such as `pose.orientation.x` names one value.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

NUMBER_TYPES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
DEPTH_CAP = 32
LEAVES_CAP = 20_000

_SEPARATOR = re.compile(r"^={3,}\s*$", re.MULTILINE)
_FIELD = re.compile(r"^([\w/]+)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=?)")


class DefinitionError(ValueError):
    """A message definition that cannot be followed."""


@dataclass(frozen=True)
class Numbers:
    """`count` numbers of one type at `path`. `array`: the path names an array, not a single number."""

    path: str
    code: str
    count: int = 1
    array: bool = False


@dataclass(frozen=True)
class Text:
    """A string at `path`: 4-byte length and that many bytes."""

    path: str


@dataclass(frozen=True)
class NumberSequence:
    """A sequence of numbers at `path`: 4-byte length and that many numbers."""

    path: str
    code: str


@dataclass(frozen=True)
class Opaque:
    """Something at `path` whose length is not followed; nothing behind it can be reached."""

    path: str


Leaf = Numbers | Text | NumberSequence | Opaque


@dataclass(frozen=True)
class _Field:
    type_name: str
    array: str | None
    name: str


def short_name(name: str) -> str:
    """`sensor_msgs/msg/Imu`, `sensor_msgs.msg.Imu` and `sensor_msgs/Imu` are all `sensor_msgs/Imu`."""
    parts = [part for part in re.split(r"[./]", name) if part not in ("msg", "")]
    return "/".join(parts)


@lru_cache(maxsize=64)
def flatten(name: str, text: str) -> tuple[Leaf, ...]:
    """The values of message `name` in the order of serialisation. Raises DefinitionError."""
    definitions = _parse(short_name(name), text)
    leaves: list[Leaf] = []
    _expand(short_name(name), "", definitions, leaves, 0)
    return tuple(leaves)


def _parse(name: str, text: str) -> dict[str, list[_Field]]:
    definitions = {"builtin_interfaces/Time": _fields(BUILTIN["builtin_interfaces/Time"])}
    definitions["builtin_interfaces/Duration"] = definitions["builtin_interfaces/Time"]
    # ROS 1 has them as types of their own.
    definitions["time"] = definitions["duration"] = _fields("uint32 sec\nuint32 nanosec")
    for number, part in enumerate(_SEPARATOR.split(text)):
        lines = part.strip().splitlines()
        if number and lines and lines[0].startswith("MSG:"):
            definitions[short_name(lines[0].removeprefix("MSG:").strip())] = _fields("\n".join(lines[1:]))
        elif number == 0:
            definitions[name] = _fields(part)
    return definitions


def _fields(text: str) -> list[_Field]:
    fields = []
    for line in text.splitlines():
        content = line.partition("#")[0].strip()
        if not content:
            continue
        match = _FIELD.match(content)
        if match is None:
            raise DefinitionError(f"the definition line {content[:80]!r} is not understood")
        if not match[4]:
            fields.append(_Field(match[1], match[2], match[3]))
    return fields


def _expand(name: str, prefix: str, definitions: dict[str, list[_Field]], leaves: list[Leaf], depth: int) -> None:
    if depth > DEPTH_CAP or len(leaves) > LEAVES_CAP:
        raise DefinitionError(f"the definition of {name} is nested or repeated without end")
    fields = definitions[name]
    if not fields:
        leaves.append(Numbers(prefix + "structure_needs_at_least_one_member", "u1"))
    for field in fields:
        path = prefix + field.name
        repeat = _repeat(field.array)
        if field.type_name in NUMBER_TYPES:
            code = NUMBER_TYPES[field.type_name]
            if repeat is None:
                leaves.append(NumberSequence(path, code))
            else:
                leaves.append(Numbers(path, code, repeat, field.array is not None))
        elif field.type_name == "string" and repeat is not None and repeat < LEAVES_CAP:
            leaves.extend(Text(path) for _ in range(repeat))
        elif field.type_name in ("string", "wstring") or repeat is None:
            leaves.append(Opaque(path))
        else:
            nested = _resolve(field.type_name, name, definitions)
            for number in range(repeat):
                inner = path if field.array is None else f"{path}[{number}]"
                _expand(nested, inner + ".", definitions, leaves, depth + 1)


def _repeat(array: str | None) -> int | None:
    """How often a field is repeated; None when the message itself says."""
    if array is None:
        return 1
    inside = array[1:-1]
    return int(inside) if inside.isdigit() else None


def _resolve(type_name: str, owner: str, definitions: dict[str, list[_Field]]) -> str:
    wanted = short_name(type_name)
    candidates = [wanted, f"{owner.rpartition('/')[0]}/{wanted}"]
    candidates += [known for known in definitions if known.rpartition("/")[2] == wanted]
    for candidate in candidates:
        if candidate in definitions:
            return candidate
    raise DefinitionError(f"{owner} contains a {type_name}, whose definition is missing")


_TIME = "int32 sec\nuint32 nanosec"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id"
_XYZ = "float64 x\nfloat64 y\nfloat64 z"
_XYZW = _XYZ + "\nfloat64 w"
_POSE = "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation"
_TWIST = "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular"

BUILTIN = {
    "builtin_interfaces/Time": _TIME,
    "std_msgs/Header": _HEADER,
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Quaternion": _XYZW,
    "geometry_msgs/Pose": _POSE,
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/Twist": _TWIST,
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "geometry_msgs/TwistWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance"
    ),
    "sensor_msgs/MagneticField": (
        "std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\nfloat64[9] magnetic_field_covariance"
    ),
    "sensor_msgs/Temperature": "std_msgs/Header header\nfloat64 temperature\nfloat64 variance",
    "sensor_msgs/BatteryState": (
        "std_msgs/Header header\nfloat32 voltage\nfloat32 temperature\nfloat32 current\nfloat32 charge\n"
        "float32 capacity\nfloat32 design_capacity\nfloat32 percentage\nuint8 power_supply_status\n"
        "uint8 power_supply_health\nuint8 power_supply_technology\nbool present\nfloat32[] cell_voltage\n"
        "float32[] cell_temperature\nstring location\nstring serial_number"
    ),
    "sensor_msgs/NavSatStatus": "int8 status\nuint16 service",
    "sensor_msgs/NavSatFix": (
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
        "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type"
    ),
}


def full_text(name: str, definitions: dict[str, str] | None = None) -> str:
    """The definition of `name` with those of everything nested in it, as a schema record holds it."""
    known = {**BUILTIN, **(definitions or {})}
    wanted, done = [short_name(name)], []
    while wanted:
        current = wanted.pop(0)
        if current in done:
            continue
        done.append(current)
        wanted += [field.type_name for field in _fields(known[current]) if field.type_name in known]
    parts = [known[done[0]], *(f"MSG: {nested}\n{known[nested]}" for nested in done[1:])]
    return ("\n" + "=" * 80 + "\n").join(parts) + "\n"
