"""Writing MCAP logs from arrays, as a vehicle would have recorded them.

    write_mcap(path, [raw_imu_channel(t_ns, log_time_ns, gyro, accel, mag, temperature),
                      pose_channel(t_ns, log_time_ns, quaternion_xyzw, position_m)],
               metadata={"unit_gyroscope": "counts", "world": "ned", ...})

Stamps and log times are int64 nanoseconds of shape (n,); vectors (n, 3), quaternions (n, 4) scalar last. Log time is
when the recorder got the message; None means that it equals the stamp. Messages of all channels are written in the
order of their log times. `metadata` becomes the file's metadata record "fieldcal"; the keys that the reader
understands are `unit_gyroscope`, `unit_accelerometer`, `unit_magnetometer`, `world`, `body` and `gravity_sign`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike, NDArray

from fieldcal.logs.encodings.decoded import COMPONENTS, NANOSECONDS
from fieldcal.logs.encodings.ros2_definitions import Numbers, Text, flatten, full_text
from fieldcal.logs.messages.roles import METADATA_NAME, RAW_IMU

COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
ENCODINGS = ("cdr", "json")
NumberArray = NDArray[np.uint16 | np.int64 | np.float64]
Message: TypeAlias = "dict[str, Message | str | float | list[float]]"


@dataclass(frozen=True)
class MessageChannel:
    """Messages of one topic.

    `type_name`: short ROS name (`sensor_msgs/Imu`). `values`: path in the message -> array of n values or (n, k)
    numbers; what is not given is zero. `texts`: path -> string, the same in all messages. `definition`: text of a type
    that ROS does not define.
    """

    topic: str
    type_name: str
    t_ns: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]
    values: Mapping[str, NumberArray]
    texts: Mapping[str, str] = field(default_factory=dict)
    definition: str | None = None

    @property
    def schema_name(self) -> str:
        """Full ROS name, `sensor_msgs/msg/Imu`."""
        package, _, name = self.type_name.partition("/")
        return f"{package}/msg/{name}"

    @property
    def schema_text(self) -> str:
        """Definition with everything nested in it."""
        return full_text(self.type_name, {self.type_name: self.definition} if self.definition else None)


def imu_channel(
    t_ns: ArrayLike,
    log_time_ns: ArrayLike | None,
    gyroscope_radps: ArrayLike,
    accelerometer_mps2: ArrayLike,
    *,
    topic: str = "/imu/data_raw",
    frame_id: str = "imu",
) -> MessageChannel:
    """`sensor_msgs/Imu` without orientation: rates in rad/s, specific force in m/s^2, both (n, 3).

    A vector that is NaN in all messages is one that the log does not have: like the orientation it is marked by −1 in
    its covariance, which otherwise is 0, "unknown", as the message's definition has it.
    """
    vectors = {
        "angular_velocity": _vectors(gyroscope_radps, 3),
        "linear_acceleration": _vectors(accelerometer_mps2, 3),
    }
    absent = np.zeros((len(vectors["angular_velocity"]), 9))
    absent[:, 0] = -1.0
    values = {"orientation_covariance": absent, **vectors}
    values |= {f"{name}_covariance": absent for name, v in vectors.items() if len(v) and np.isnan(v).all()}
    return _stamped(topic, "sensor_msgs/Imu", t_ns, log_time_ns, values, frame_id)


def magnetic_field_channel(
    t_ns: ArrayLike,
    log_time_ns: ArrayLike | None,
    magnetometer_t: ArrayLike,
    *,
    topic: str = "/imu/mag",
    frame_id: str = "imu",
) -> MessageChannel:
    """`sensor_msgs/MagneticField`: tesla, (n, 3)."""
    values = {"magnetic_field": _vectors(magnetometer_t, 3)}
    return _stamped(topic, "sensor_msgs/MagneticField", t_ns, log_time_ns, values, frame_id)


def temperature_channel(
    t_ns: ArrayLike,
    log_time_ns: ArrayLike | None,
    temperature_degc: ArrayLike,
    *,
    topic: str = "/imu/temperature",
    frame_id: str = "imu",
) -> MessageChannel:
    """`sensor_msgs/Temperature`: degrees Celsius, (n,)."""
    values = {"temperature": np.asarray(temperature_degc, np.float64)}
    return _stamped(topic, "sensor_msgs/Temperature", t_ns, log_time_ns, values, frame_id)


def pose_channel(
    t_ns: ArrayLike,
    log_time_ns: ArrayLike | None,
    quaternion_xyzw: ArrayLike,
    position_m: ArrayLike,
    *,
    topic: str = "/vps/pose",
    frame_id: str = "world",
) -> MessageChannel:
    """`geometry_msgs/PoseStamped`: body to world, (n, 4) scalar last, and metres, (n, 3)."""
    values = {"pose.orientation": _vectors(quaternion_xyzw, 4), "pose.position": _vectors(position_m, 3)}
    return _stamped(topic, "geometry_msgs/PoseStamped", t_ns, log_time_ns, values, frame_id)


def velocity_channel(
    t_ns: ArrayLike,
    log_time_ns: ArrayLike | None,
    velocity_ned_mps: ArrayLike,
    sd_mps: ArrayLike,
    *,
    topic: str = "/gnss/fix_velocity",
    frame_id: str = "gnss",
) -> MessageChannel:
    """`geometry_msgs/TwistWithCovarianceStamped` of a satellite receiver: m/s, (n, 3) north-east-down, written east,
    north, up as ROS drivers do, and its standard deviation, (n,)."""
    ned = _vectors(velocity_ned_mps, 3)
    covariance = np.zeros((len(ned), 36))
    covariance[:, [0, 7, 14]] = np.asarray(sd_mps, np.float64)[:, None] ** 2
    values = {"twist.twist.linear": ned[:, [1, 0, 2]] * [1.0, 1.0, -1.0], "twist.covariance": covariance}
    return _stamped(topic, "geometry_msgs/TwistWithCovarianceStamped", t_ns, log_time_ns, values, frame_id)


def raw_imu_channel(
    t_ns: ArrayLike,
    log_time_ns: ArrayLike | None,
    gyroscope: ArrayLike,
    accelerometer: ArrayLike,
    magnetometer: ArrayLike,
    temperature_degc: ArrayLike | None = None,
    *,
    topic: str = "/imu/raw",
    frame_id: str = "imu",
) -> MessageChannel:
    """`fieldcal_msgs/RawImu`: what the converters gave, (n, 3) each, as uint16 or float64 like the arrays.

    Rows that are NaN (float64 only) say that a slower sensor gave nothing at that stamp.
    """
    sensors = {"gyro": gyroscope, "accel": accelerometer, "mag": magnetometer}
    arrays = {name: _vectors(values, 3, keep_type=True) for name, values in sensors.items()}
    ros_types = {name: "uint16" if values.dtype == np.uint16 else "float64" for name, values in arrays.items()}
    lines = ["std_msgs/Header header", *(f"{ros_types[name]}[3] {name}" for name in arrays), "float64 temperature"]
    rows = len(arrays["gyro"])
    absent = np.full(rows, np.nan)
    arrays["temperature"] = absent if temperature_degc is None else np.asarray(temperature_degc, np.float64)
    return _stamped(topic, RAW_IMU, t_ns, log_time_ns, arrays, frame_id, "\n".join(lines))


def write_mcap(
    path: Path,
    channels: Sequence[MessageChannel],
    *,
    metadata: Mapping[str, str] | None = None,
    compression: str = "zstd",
    chunk_size: int = 1 << 20,
    encoding: str = "cdr",
) -> None:
    """Write a log.

    Parameters
    ----------
    path : Path
        Replaced when it exists.
    channels : sequence of MessageChannel
        What to write, see the `*_channel` functions.
    metadata : mapping, optional
        Pairs for the metadata record "fieldcal".
    compression : str
        "zstd", "lz4" or "none".
    chunk_size : int
        Uncompressed bytes after which a chunk is closed.
    encoding : str
        "cdr" or "json" (the same field names).

    Raises
    ------
    ValueError
        Unknown compression or encoding; arrays of unequal length; fields that the type does not have.
    """
    if compression not in COMPRESSIONS or encoding not in ENCODINGS:
        raise ValueError(f"compression is one of {list(COMPRESSIONS)}, encoding one of {list(ENCODINGS)}")
    payloads = [_payloads(channel, encoding) for channel in channels]
    log_times = [channel.log_time_ns for channel in channels]
    owners = np.concatenate([np.full(len(times), number) for number, times in enumerate(log_times)])
    order = np.argsort(np.concatenate(log_times), kind="stable")
    places = np.concatenate([np.arange(len(times)) for times in log_times])
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_size, compression=COMPRESSIONS[compression])
        writer.start(profile="ros2" if encoding == "cdr" else "", library="fieldcal")
        if metadata:
            writer.add_metadata(METADATA_NAME, dict(metadata))
        ids = [_register(writer, channel, encoding) for channel in channels]
        stamps = [channel.t_ns.tolist() for channel in channels]
        times = [channel.log_time_ns.tolist() for channel in channels]
        for owner, place in zip(owners[order].tolist(), places[order].tolist(), strict=True):
            writer.add_message(ids[owner], times[owner][place], payloads[owner][place], stamps[owner][place], place)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap's own lacks it


def encode_cdr(channel: MessageChannel, byte_order: str = "<") -> NDArray[np.void]:
    """The channel's messages in CDR, encapsulation included: one element of n a message, all of one size."""
    leaves = flatten(channel.type_name, channel.schema_text)
    names, formats, offsets = ["encapsulation"], ["V4"], [0]
    cursor = 0
    for number, leaf in enumerate(leaves):
        if isinstance(leaf, Numbers):
            dtype = np.dtype(byte_order + leaf.code)
            cursor = -(-cursor // dtype.itemsize) * dtype.itemsize
            shape = f"({leaf.count},)" if leaf.array else ""
            size = leaf.count * dtype.itemsize
        elif isinstance(leaf, Text):
            text = channel.texts.get(leaf.path, "").encode() + b"\0"
            cursor = -(-cursor // 4) * 4
            dtype, shape, size = np.dtype(f"V{4 + len(text)}"), "", 4 + len(text)
        else:
            raise ValueError(f"{channel.type_name}: {leaf.path} is of variable length and cannot be written")
        names.append(f"{number}:{leaf.path}")
        formats.append(shape + dtype.str)
        offsets.append(4 + cursor)
        cursor += size
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 4 + cursor})
    rows = np.zeros(len(channel.t_ns), layout)
    rows["encapsulation"] = np.void(b"\0\1\0\0" if byte_order == "<" else b"\0\0\0\0")
    values = dict(_components(channel))
    for number, leaf in enumerate(leaves):
        if isinstance(leaf, Text):
            text = channel.texts.get(leaf.path, "").encode() + b"\0"
            rows[f"{number}:{leaf.path}"] = np.void(np.array(len(text), byte_order + "u4").tobytes() + text)
        elif leaf.path in values:
            rows[f"{number}:{leaf.path}"] = values.pop(leaf.path)
    if values:
        raise ValueError(f"{channel.type_name} has no field {', '.join(values)}")
    return rows


def _payloads(channel: MessageChannel, encoding: str) -> list[bytes]:
    if encoding == "json":
        return list(_json_messages(channel))
    rows = encode_cdr(channel)
    content, size = rows.tobytes(), rows.dtype.itemsize
    return [content[start : start + size] for start in range(0, len(content), size)]


def _json_messages(channel: MessageChannel) -> Iterator[bytes]:
    lists = {path: values.tolist() for path, values in _components(channel)}
    for row in range(len(channel.t_ns)):
        message: Message = {}
        flat = {**channel.texts, **{path: values[row] for path, values in lists.items()}}
        for path, value in flat.items():
            *parents, last = path.split(".")
            target = message
            for parent in parents:
                inner = target.setdefault(parent, {})
                assert isinstance(inner, dict)  # no field of a message is a number and a message
                target = inner
            target[last] = value
        yield json.dumps(message).encode()


def _components(channel: MessageChannel) -> Iterator[tuple[str, NumberArray]]:
    """Every given value by the path of its number or array of numbers."""
    arrays = {leaf.path for leaf in flatten(channel.type_name, channel.schema_text) if isinstance(leaf, Numbers)}
    yield "header.stamp.sec", channel.t_ns // NANOSECONDS
    yield "header.stamp.nanosec", channel.t_ns % NANOSECONDS
    for path, values in channel.values.items():
        if values.ndim == 1 or path in arrays:
            yield path, values
        else:
            for number, component in enumerate(COMPONENTS[values.shape[1]]):
                yield f"{path}.{component}", values[:, number]


def _register(writer: Writer, channel: MessageChannel, encoding: str) -> int:
    if encoding == "cdr":
        schema = writer.register_schema(channel.schema_name, "ros2msg", channel.schema_text.encode())
    else:
        schema = writer.register_schema(channel.schema_name, "jsonschema", b'{"type": "object"}')
    return int(writer.register_channel(channel.topic, encoding, schema))


def _stamped(
    topic: str,
    type_name: str,
    t_ns: ArrayLike,
    log_time_ns: ArrayLike | None,
    values: Mapping[str, NumberArray],
    frame_id: str,
    definition: str | None = None,
) -> MessageChannel:
    stamps = np.asarray(t_ns, np.int64)
    times = stamps if log_time_ns is None else np.asarray(log_time_ns, np.int64)
    lengths = {len(stamps), len(times), *(len(array) for array in values.values())}
    if len(lengths) > 1:
        raise ValueError(f"{topic}: stamps, log times and values have different lengths {sorted(lengths)}")
    return MessageChannel(topic, type_name, stamps, times, values, {"header.frame_id": frame_id}, definition)


def _vectors(values: ArrayLike, width: int, *, keep_type: bool = False) -> NumberArray:
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"expected an array of shape (n, {width}), got {array.shape}")
    return array if keep_type and array.dtype == np.uint16 else array.astype(np.float64)
