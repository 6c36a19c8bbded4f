"""Bags as the package rosbags writes them, of readings with a known truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
IMU = "sensor_msgs/msg/Imu"
FIELD = "sensor_msgs/msg/MagneticField"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

Row = tuple[str, str, int, Any]


class Messages:
    """Makes messages of either ROS."""

    def __init__(self, *, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if TRANSFORMS not in self.store.types:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
        self._types = self.store.types

    def header(self, t_ns: int, frame: str) -> Any:
        stamp = self._types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
        given = {"seq": 7} if self.ros1 else {}
        return self._types["std_msgs/msg/Header"](**given, stamp=stamp, frame_id=frame)

    def vector(self, values: Sequence[float]) -> Any:
        return self._types["geometry_msgs/msg/Vector3"](*map(float, values))

    def quaternion(self, values: Sequence[float]) -> Any:
        return self._types["geometry_msgs/msg/Quaternion"](*map(float, values))

    def imu(self, t_ns: int, rate: Sequence[float], force: Sequence[float], frame: str = "imu") -> Any:
        none = np.zeros(9)
        parts = self.quaternion([0, 0, 0, 1]), none, self.vector(rate), none, self.vector(force), none
        return self._types[IMU](self.header(t_ns, frame), *parts)

    def field(self, t_ns: int, values: Sequence[float]) -> Any:
        return self._types[FIELD](self.header(t_ns, "imu"), self.vector(values), np.zeros(9))

    def transforms(self, given: Sequence[tuple[int, str, str, Sequence[float], Sequence[float]]]) -> Any:
        """(stamp, parent, child, position, quaternion) of each."""
        stamped, transform = (self._types[f"geometry_msgs/msg/{name}"] for name in ("TransformStamped", "Transform"))
        made = [
            stamped(self.header(t, parent), child, transform(self.vector(p), self.quaternion(q)))
            for t, parent, child, p, q in given
        ]
        return self._types[TRANSFORMS](made)

    def payload(self, message: Any, name: str) -> bytes:
        return bytes((self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr)(message, name))


class Truth:
    """n readings at 100 Hz, and the rows (topic, type, log time, message) that tell of them."""

    def __init__(self, n: int = 300, *, ros1: bool = False, first: int = 0) -> None:
        generator = np.random.default_rng(5)
        self.t_ns = START_NS + STEP_NS * np.arange(first, first + n)
        values = generator.normal(size=(first + n, 9))[first:]
        self.rate, self.force, self.field = values[:, :3], values[:, 3:6], values[:, 6:]
        self.messages = Messages(ros1=ros1)
        self.rows: list[Row] = []
        for t, rate, force, field in zip(self.t_ns.tolist(), self.rate, self.force, self.field, strict=True):
            self.rows.append(("/imu", IMU, t + 1000, self.messages.imu(t, rate, force)))
            self.rows.append(("/mag", FIELD, t + 2000, self.messages.field(t, field)))

    def check(self, frames: dict[str, Any], kept: slice = slice(None)) -> None:
        """What was read is the truth, or that part of it."""
        imu, field = frames["imu"], frames["magnetometer"]
        assert imu["t_ns"].to_list() == self.t_ns[kept].tolist()
        columns = [f"{sensor}_{axis}" for sensor in ("gyroscope", "accelerometer") for axis in "xyz"]
        np.testing.assert_array_equal(imu.select(columns).to_numpy(), np.hstack([self.rate, self.force])[kept])
        np.testing.assert_array_equal(field.drop("t_ns").to_numpy(), self.field[kept])


def write_rosbag2(
    folder: Path,
    messages: Messages,
    rows: Sequence[Row],
    storage: str = "sqlite3",
    compression: str | None = None,
    version: int = 9,
) -> Path:
    plugin = {"sqlite3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}[storage]
    writer = rosbag2.Writer(folder, version=version, storage_plugin=plugin)
    if compression:
        modes = rosbag2.CompressionMode
        mode = {"file": modes.FILE, "message": modes.MESSAGE, "storage": modes.STORAGE}[compression]
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        _write(writer, messages, rows)
    return folder


def write_rosbag1(
    path: Path, messages: Messages, rows: Sequence[Row], compression: str = "none", chunk: int = 20_000
) -> Path:
    writer = rosbag1.Writer(path)
    if compression != "none":
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk
    with writer:
        _write(writer, messages, rows)
    return path


def _write(writer: Any, messages: Messages, rows: Sequence[Row]) -> None:
    connections: dict[str, Any] = {}
    for topic, name, t_ns, message in rows:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, name, typestore=messages.store)
        writer.write(connections[topic], t_ns, messages.payload(message, name))
