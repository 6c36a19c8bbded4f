"""Messages decoded one by one, JSON and protobuf: what a number, a stamp and a schema must be to be taken."""

from __future__ import annotations

import json

import numpy as np
import pytest
from google.protobuf import descriptor_pb2

from fieldcal.logs.encodings.decoded import Decoded, MissingField, UnsupportedSchema, Want
from fieldcal.logs.encodings.gather import gather
from fieldcal.logs.encodings.json_messages import JsonDecoder
from fieldcal.logs.encodings.protobuf_messages import ProtobufDecoder

FieldProto = descriptor_pb2.FieldDescriptorProto
X = {"x": Want.of("x", 1)}


def joined(messages: list[bytes]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    sizes = np.array([len(message) for message in messages], np.int64)
    return np.frombuffer(b"".join(messages), np.uint8), np.cumsum(sizes) - sizes, sizes


def decode(messages: list[object], wants: dict[str, Want]) -> Decoded:
    return JsonDecoder(wants).decode(*joined([json.dumps(message).encode() for message in messages]))


def stamped(nanoseconds: int) -> dict[str, object]:
    return {"header": {"stamp": {"sec": 0, "nanosec": nanoseconds}}, "x": 1.0}


@pytest.mark.parametrize(
    ("count", "empty", "values"),
    [(1, (0,), [1, 3]), (2, (0, 2), [[1, 2], [3, 4]]), (3, (0, 3), [[1, 2, 3], [3, 4, 5]])],
)
def test_values_lie_where_they_are_looked_for(count: int, empty: tuple[int, ...], values: list[object]) -> None:
    data = np.arange(6, dtype=np.uint8)
    assert gather(data, np.array([1, 3]), np.dtype(np.uint8), count).tolist() == values
    assert gather(data, np.array([], np.int64), np.dtype(np.uint8), count).shape == empty
    assert gather(data[:0], np.array([], np.int64), np.dtype(np.uint8), count).shape == empty


@pytest.mark.parametrize("number", [True, False, "1.5", None, [1.5], {}])
def test_what_is_no_number_costs_its_message(number: object) -> None:
    for message, wants in (({"x": number}, X), ({"x": [1.0, number, 2.0]}, {"x": Want.of("x", 3)})):
        decoded = decode([message, {"x": 4.5 if wants is X else [4.5] * 3}], wants)
        assert decoded.kept.tolist() == [1]
        assert (decoded.values["x"] == 4.5).all()


def test_vectors_are_arrays_objects_or_a_path_a_number_and_of_the_right_length() -> None:
    wants = {"v": Want.of("v", 3), "pair": Want.of(("a", "b.c"), 2)}
    sound = {"a": 1, "b": {"c": 2}}
    messages = [
        {"v": [1, 2, 3], **sound},
        {"v": {"z": 3, "x": 1, "y": 2}, **sound},
        {"v": [1, 2], **sound},
        {"v": [1, 2, 3, 4], **sound},
        {"v": {"x": 1, "y": 2}, **sound},
        {"v": 1, **sound},
        {"v": [1, 2, 3], "a": 1, "b": 2},
    ]
    decoded = decode(messages, wants)
    assert decoded.kept.tolist() == [0, 1]
    np.testing.assert_array_equal(decoded.values["v"], [[1.0, 2.0, 3.0]] * 2)
    np.testing.assert_array_equal(decoded.values["pair"], [[1.0, 2.0]] * 2)
    assert decode([], wants).values["v"].shape == (0, 3)
    assert decode([], X).values["x"].shape == (0,)


def test_stamps_are_taken_as_far_as_64_bits_reach() -> None:
    limits = [-(2**63) - 1, -(2**63), 2**63 - 1, 2**63]
    decoded = decode([stamped(limit) for limit in limits], X)
    assert decoded.kept.tolist() == [1, 2]
    assert decoded.stamp_ns is not None
    assert decoded.stamp_ns.tolist() == limits[1:3]


def test_seconds_alone_are_a_stamp_and_nanoseconds_alone_are_none() -> None:
    decoded = decode([{"x": 1, "stamp": {"sec": 5}}, {"x": 1, "time": {"seconds": 6, "nanos": 7}}], X)
    assert decoded.stamp_ns is not None
    assert decoded.stamp_ns.tolist() == [5_000_000_000, 6_000_000_007]
    assert decode([{"x": 1, "stamp": {"nsec": 5}}], X).stamp_ns is None
    assert decode([{"x": 1, "stamp": 5}], X).stamp_ns is None
    assert decode([{"x": 1, "stamp": {"sec": [5]}}, {"x": 2}], X).kept.tolist() == [1]


def test_one_message_without_a_stamp_leaves_all_to_the_time_of_recording() -> None:
    decoded = decode([stamped(5), {"x": 2.0}], X)
    assert decoded.stamp_ns is None
    assert decoded.values["x"].tolist() == [1.0, 2.0]


# protobuf ------------------------------------------------------------------------------------------------------------


def file_of(name: str, depends: list[str], fields: list[tuple[str, str]]) -> descriptor_pb2.FileDescriptorProto:
    """A file `name`.proto with one message type `Name` whose fields are doubles or messages."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{name}.proto", package="p", syntax="proto3")
    file.dependency.extend(f"{other}.proto" for other in depends)
    definition = file.message_type.add(name=name)
    for number, (field_name, kind) in enumerate(fields, 1):
        field = definition.field.add(name=field_name, number=number, label=FieldProto.LABEL_OPTIONAL)
        field.type = FieldProto.TYPE_DOUBLE if kind == "double" else FieldProto.TYPE_MESSAGE
        if kind != "double":
            field.type_name = f".p.{kind}"
    return file


DOUBLES = [(axis, "double") for axis in "xyz"]
POINT, FLAT = file_of("Point", [], DOUBLES), file_of("Flat", [], DOUBLES[:2])
POSE = file_of("Pose", ["Point", "Flat"], [("at", "Point"), ("seen", "Flat"), ("w", "double")])


def descriptors(*files: descriptor_pb2.FileDescriptorProto) -> bytes:
    return descriptor_pb2.FileDescriptorSet(file=files).SerializeToString()


@pytest.mark.parametrize("files", [(POSE, FLAT, POINT), (POINT, POSE, FLAT), (POINT, FLAT, POSE)])
def test_descriptors_may_stand_in_any_order(files: tuple[descriptor_pb2.FileDescriptorProto, ...]) -> None:
    wants = {"at": Want.of("at", 3), "pair": Want.of(("w", "at.y"), 2), "w": Want.of("w", 1)}
    decoder = ProtobufDecoder("p.Pose", descriptors(*files), wants)
    point = b"".join(bytes([8 * number + 1]) + np.float64(number).tobytes() for number in (1, 2, 3))
    message = bytes([10, len(point)]) + point + bytes([25]) + np.float64(9.0).tobytes()
    decoded = decoder.decode(*joined([message, b"\xff\xff", b""]))
    assert decoded.kept.tolist() == [0]
    assert decoded.stamp_ns is None
    assert decoded.values["at"].tolist() == [[1.0, 2.0, 3.0]]
    assert decoded.values["pair"].tolist() == [[9.0, 2.0]]
    assert decoded.values["w"].tolist() == [9.0]


def test_descriptors_in_a_circle_or_without_the_type_are_refused() -> None:
    circle = descriptors(file_of("A", ["B"], DOUBLES), file_of("B", ["A"], DOUBLES))
    with pytest.raises(UnsupportedSchema, match="circle"):
        ProtobufDecoder("p.A", circle, X)
    for content in (descriptors(POINT), b"\xff\xff\xff", descriptors(POSE)):
        with pytest.raises(UnsupportedSchema, match="cannot be used"):
            ProtobufDecoder("p.Pose", content, X)


def test_a_vector_that_lacks_a_component_is_a_missing_field() -> None:
    with pytest.raises(MissingField, match=r"seen\.z") as missing:
        ProtobufDecoder("p.Pose", descriptors(POINT, FLAT, POSE), {"v": Want.of("seen", 3)})
    assert missing.value.available == ("at", "seen", "w")
