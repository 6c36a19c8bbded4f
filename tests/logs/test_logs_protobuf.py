"""Foxglove and other protobuf messages in MCAP, written by the mcap_protobuf package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.message import Message
from logs_support import EPOCH_NS, Flight, vehicle
from mcap_protobuf.writer import Writer

from fieldcal.config.configuration import McapMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs import read_log

FieldProto = descriptor_pb2.FieldDescriptorProto
TYPES = {"double": FieldProto.TYPE_DOUBLE, "string": FieldProto.TYPE_STRING, "uint32": FieldProto.TYPE_UINT32}


@pytest.fixture(scope="module")
def pool() -> descriptor_pool.DescriptorPool:
    """Foxglove's public message types, field for field, and one of a custom kind."""
    file = descriptor_pb2.FileDescriptorProto(
        name="types.proto", package="foxglove", syntax="proto3", dependency=["google/protobuf/timestamp.proto"]
    )
    stamp = ("timestamp", ".google.protobuf.Timestamp")
    axes = [(axis, "double") for axis in "xyz"]
    add(file, "Vector3", axes)
    add(file, "Quaternion", [*axes, ("w", "double")])
    add(file, "Pose", [("position", ".foxglove.Vector3"), ("orientation", ".foxglove.Quaternion")])
    add(file, "PoseInFrame", [stamp, ("frame_id", "string"), ("pose", ".foxglove.Pose")])
    transform = [("translation", ".foxglove.Vector3"), ("rotation", ".foxglove.Quaternion")]
    add(file, "FrameTransform", [stamp, ("parent_frame_id", "string"), ("child_frame_id", "string"), *transform])
    place = [(name, "double") for name in ("latitude", "longitude", "altitude")]
    add(file, "LocationFix", [stamp, ("frame_id", "string"), *place])
    add(file, "Raw", [stamp, ("gyro", "repeated uint32"), ("accel", ".foxglove.Vector3"), *axes])
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return pool


def test_poses_positions_and_a_custom_imu(tmp_path: Path, pool: descriptor_pool.DescriptorPool) -> None:
    flight = Flight(40)
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream, Writer(stream) as writer:
        for row in range(40):
            t_ns = int(flight.t_ns[row])
            raw = message(pool, "Raw", t_ns, gyro=flight.counts[0, row].tolist())
            fill(raw.accel, "xyz", flight.accelerometer[row])
            fill(raw, "xyz", flight.magnetometer[row])
            pose = message(pool, "PoseInFrame", t_ns + 1, frame_id="map")
            fill(pose.pose.position, "xyz", flight.position[row])
            fill(pose.pose.orientation, "xyzw", flight.quaternion[row])
            fix = message(pool, "LocationFix", t_ns + 2)
            fill(fix, ("latitude", "longitude", "altitude"), flight.position[row])
            for topic, item in (("/raw", raw), ("/pose", pose), ("/fix", fix)):
                writer.write_message(topic, item, t_ns, t_ns)
        writer.write_message("/pose", message(pool, "PoseInFrame", 5), EPOCH_NS, EPOCH_NS)
    fields = {"gyroscope": "gyro", "accelerometer": "accel", "magnetometer": ("x", "y", "z")}
    frames, summary = read_log(path, vehicle(mcap=McapMap(imu="/raw", imu_fields=fields)))
    expected = np.column_stack([flight.counts[0], flight.accelerometer])
    np.testing.assert_array_equal(frames["imu"].drop("t_ns"), expected)
    np.testing.assert_array_equal(frames["imu"]["t_ns"], flight.t_ns)
    np.testing.assert_array_equal(frames["magnetometer"].drop("t_ns"), flight.magnetometer)
    np.testing.assert_array_equal(frames["vps"].drop("t_ns"), np.column_stack([flight.quaternion, flight.position]))
    np.testing.assert_array_equal(frames["vps"]["t_ns"], flight.t_ns + 1)
    np.testing.assert_array_equal(frames["position"].drop("t_ns"), flight.position)
    assert [(finding.code, finding.count) for finding in summary.findings] == [("malformed_message", 1)]


def test_frame_transform(tmp_path: Path, pool: descriptor_pool.DescriptorPool) -> None:
    flight = Flight(5)
    with (tmp_path / "log.mcap").open("wb") as stream, Writer(stream) as writer:
        for row in range(5):
            transform = message(pool, "FrameTransform", int(flight.t_ns[row]), child_frame_id="drone")
            fill(transform.translation, "xyz", flight.position[row])
            fill(transform.rotation, "xyzw", flight.quaternion[row])
            raw = message(pool, "Raw", int(flight.t_ns[row]), gyro=[1, 2, 3])
            writer.write_message("/tf", transform, row, row)
            writer.write_message("/raw", raw, row, row)
    mapping = McapMap(imu="/raw", imu_fields={"gyroscope": "gyro"})
    frames, _ = read_log(tmp_path / "log.mcap", vehicle(mcap=mapping))
    np.testing.assert_array_equal(frames["vps"].drop("t_ns"), np.column_stack([flight.quaternion, flight.position]))


def test_a_field_that_the_type_lacks(tmp_path: Path, pool: descriptor_pool.DescriptorPool) -> None:
    with (tmp_path / "log.mcap").open("wb") as stream, Writer(stream) as writer:
        writer.write_message("/raw", message(pool, "Raw", 1, gyro=[1, 2, 3]), 1, 1)
    with pytest.raises(UnreadableLog, match=r"no field gyroscope .* gyro, accel") as caught:
        read_log(tmp_path / "log.mcap", vehicle(mcap=McapMap(imu="/raw", imu_fields={"gyroscope": "gyroscope"})))
    assert caught.value.reason_code == "missing_field"


def add(file: descriptor_pb2.FileDescriptorProto, name: str, fields: list[tuple[str, str]]) -> None:
    """A message type with fields of the named types, numbered from 1."""
    definition = file.message_type.add(name=name)
    for number, (field_name, kind) in enumerate(fields, 1):
        field = definition.field.add(name=field_name, number=number)
        field.label = FieldProto.LABEL_REPEATED if kind.startswith("repeated ") else FieldProto.LABEL_OPTIONAL
        kind = kind.removeprefix("repeated ")
        if kind in TYPES:
            field.type = TYPES[kind]
        else:
            field.type, field.type_name = FieldProto.TYPE_MESSAGE, kind


def message(pool: descriptor_pool.DescriptorPool, name: str, t_ns: int, **values: object) -> Message:
    """A message with its timestamp set."""
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))(**values)
    made.timestamp.seconds, made.timestamp.nanos = divmod(t_ns, 1_000_000_000)
    return made


def fill(target: Message, names: str | tuple[str, ...], values: np.ndarray) -> None:
    """Set numbers one by one."""
    for name, value in zip(names, values.tolist(), strict=True):
        setattr(target, name, value)
