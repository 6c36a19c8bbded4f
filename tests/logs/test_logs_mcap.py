"""MCAP logs: what is written is read, the same as by independent readers, for every type, encoding and layout."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from logs_support import EPOCH_NS, Flight, messages_by_mcap_ros2, stamp_ns, vehicle
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.writer import Writer as Ros2Writer

from fieldcal.config.configuration import McapMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs import open_log, read_log
from fieldcal.logs.encodings.decoded import MissingField, UnsupportedSchema, Want
from fieldcal.logs.encodings.ros2_cdr import CdrDecoder
from fieldcal.logs.encodings.ros2_definitions import full_text
from fieldcal.logs.mcap.write import (
    MessageChannel,
    encode_cdr,
    imu_channel,
    magnetic_field_channel,
    pose_channel,
    raw_imu_channel,
    write_mcap,
)

GYRO = ["gyroscope_x", "gyroscope_y", "gyroscope_z"]
ACCEL = ["accelerometer_x", "accelerometer_y", "accelerometer_z"]
MAG = ["magnetometer_x", "magnetometer_y", "magnetometer_z"]
QUATERNION = ["qx", "qy", "qz", "qw"]
POSITION = ["px_m", "py_m", "pz_m"]

CUSTOM = "\n".join(
    [
        "# raw readings",
        "string LABEL=none # a constant",
        "uint8 version 3",
        "std_msgs/Header header",
        "string<=20 unit",
        "bool armed",
        "int16[2] spare",
        "Triple[2] pair",
        "float32 ax",
        "float32 ay",
        "float32 az",
        "float64[] mag",
        "int8 after",
        "=" * 80,
        "MSG: my_msgs/Triple",
        "int16 x",
        "int16 y",
        "int16 z",
        "=" * 80,
        "MSG: std_msgs/Header",
        "builtin_interfaces/Time stamp",
        "string frame_id",
    ]
)


@pytest.mark.parametrize("encoding", ["cdr", "json"])
@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_written_arrays_are_read_back_exactly(tmp_path: Path, encoding: str, compression: str) -> None:
    flight = Flight()
    path = flight.write(tmp_path / "log.mcap", encoding=encoding, compression=compression, chunk_size=40_000)
    frames, summary = read_log(path, vehicle())
    np.testing.assert_array_equal(frames["imu"]["t_ns"], flight.t_ns)
    np.testing.assert_array_equal(frames["imu"].select(GYRO), flight.gyroscope)
    np.testing.assert_array_equal(frames["imu"].select(ACCEL), flight.accelerometer)
    np.testing.assert_array_equal(frames["magnetometer"].select(MAG), flight.magnetometer)
    np.testing.assert_array_equal(frames["temperature"]["temperature_degc"], flight.temperature)
    np.testing.assert_array_equal(frames["vps"]["t_ns"], flight.t_ns + 7)
    np.testing.assert_array_equal(frames["vps"].select(QUATERNION), flight.quaternion)
    np.testing.assert_array_equal(frames["vps"].select(POSITION), flight.position)
    assert summary.findings == []
    assert summary.verifiable
    assert summary.epoch_known
    assert (summary.world, summary.body, summary.gravity_sign) == ("enu", "flu", "specific_force")
    assert summary.units == {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "T"}
    assert summary.counts == {"imu": 500, "magnetometer": 500, "temperature": 500, "vps": 500}


def test_mcap_ros2_reads_the_same_from_what_is_written(tmp_path: Path) -> None:
    flight = Flight(50)
    path = flight.write(tmp_path / "log.mcap")
    for row, (log_time, message) in enumerate(messages_by_mcap_ros2(path, "/imu/data_raw")):
        assert (stamp_ns(message), log_time) == (flight.t_ns[row], flight.t_ns[row] + 450_000)
        rate, force = message.angular_velocity, message.linear_acceleration
        assert [rate.x, rate.y, rate.z, force.x, force.y, force.z] == [
            *flight.gyroscope[row],
            *flight.accelerometer[row],
        ]
        assert message.header.frame_id == "imu"
        assert list(message.orientation_covariance) == [-1.0] + [0.0] * 8
    for row, (_, message) in enumerate(messages_by_mcap_ros2(path, "/vps/pose")):
        turn, place = message.pose.orientation, message.pose.position
        assert [turn.x, turn.y, turn.z, turn.w, place.x, place.y, place.z] == [
            *flight.quaternion[row],
            *flight.position[row],
        ]


def test_messages_written_by_mcap_ros2_with_changing_frame_ids_and_a_custom_definition(tmp_path: Path) -> None:
    generator = np.random.default_rng(3)
    frames, mags = generator.integers(-999, 999, (40, 2, 3)), generator.normal(size=(40, 3))
    accels = generator.normal(size=(40, 3)).astype(np.float32)
    path = tmp_path / "custom.mcap"
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        schema = writer.register_msgdef("my_msgs/msg/Raw", CUSTOM)
        for row in range(40):
            message = {
                "header": {"stamp": {"sec": 5 + row, "nanosec": row}, "frame_id": "f" * (row % 7)},
                "unit": "u" * (row % 5),
                "armed": True,
                "spare": [1, 2],
                "pair": [dict(zip("xyz", triple.tolist(), strict=True)) for triple in frames[row]],
                **dict(zip(("ax", "ay", "az"), accels[row].tolist(), strict=True)),
                "mag": mags[row].tolist(),
                "after": 1,
            }
            writer.write_message("/raw", schema, message, log_time=row)
        writer.finish()
    fields = {"gyroscope": "pair[1]", "accelerometer": ("ax", "ay", "az"), "magnetometer": "mag"}
    read, summary = read_log(path, vehicle(mcap=McapMap(imu="/raw", imu_fields=fields)))
    np.testing.assert_array_equal(read["imu"]["t_ns"], 5_000_000_000 + np.arange(40) * 1_000_000_001)
    np.testing.assert_array_equal(read["imu"].select(GYRO), frames[:, 1])
    np.testing.assert_array_equal(read["imu"].select(ACCEL), accels)
    np.testing.assert_array_equal(read["magnetometer"].select(MAG), mags)
    assert not summary.epoch_known
    assert summary.world is None
    assert set(summary.units.values()) == {"unknown"}


@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_both_byte_orders(byte_order: str) -> None:
    flight = Flight(20)
    channel = imu_channel(flight.t_ns, None, flight.gyroscope, flight.accelerometer, frame_id="a b")
    rows = encode_cdr(channel, byte_order)
    data = np.frombuffer(rows.tobytes(), np.uint8)
    size = rows.dtype.itemsize
    wants = {"rate": Want.of("angular_velocity", 3), "force": Want.of("linear_acceleration", 3)}
    decoder = CdrDecoder("sensor_msgs/msg/Imu", "", wants)
    decoded = decoder.decode(data, np.arange(20) * size, np.full(20, size))
    np.testing.assert_array_equal(decoded.values["rate"], flight.gyroscope)
    np.testing.assert_array_equal(decoded.values["force"], flight.accelerometer)
    np.testing.assert_array_equal(decoded.stamp_ns, flight.t_ns)


def test_messages_shorter_than_their_layout_are_left_out() -> None:
    flight = Flight(20)
    rows = encode_cdr(imu_channel(flight.t_ns, None, flight.gyroscope, flight.accelerometer))
    data = np.frombuffer(rows.tobytes(), np.uint8).copy()
    size = rows.dtype.itemsize
    sizes = np.full(20, size)
    sizes[[3, 7]] = [100, 2]
    data[5 * size + 12 : 5 * size + 16] = 255
    data[6 * size] = 9
    wants = {"rate": Want.of("angular_velocity", 3)}
    decoded = CdrDecoder("sensor_msgs/msg/Imu", "", wants).decode(data, np.arange(20) * size, sizes)
    kept = [row for row in range(20) if row not in (3, 5, 6, 7)]
    assert decoded.kept.tolist() == kept
    np.testing.assert_array_equal(decoded.values["rate"], flight.gyroscope[kept])


@pytest.mark.parametrize(
    ("type_name", "orientation", "position"),
    [
        ("geometry_msgs/TransformStamped", "transform.rotation", "transform.translation"),
        ("nav_msgs/Odometry", "pose.pose.orientation", "pose.pose.position"),
        ("geometry_msgs/PoseWithCovarianceStamped", "pose.pose.orientation", "pose.pose.position"),
    ],
)
def test_every_kind_of_pose(tmp_path: Path, type_name: str, orientation: str, position: str) -> None:
    flight = Flight(30)
    texts = {"header.frame_id": "map", "child_frame_id": "drone_1"}
    values = {orientation: flight.quaternion, position: flight.position}
    pose = MessageChannel("/pose", type_name, flight.t_ns, flight.t_ns, values, texts)
    write_mcap(tmp_path / "log.mcap", [flight.channels()[0], pose])
    frames, _ = read_log(tmp_path / "log.mcap", vehicle())
    np.testing.assert_array_equal(frames["vps"].select(QUATERNION), flight.quaternion)
    np.testing.assert_array_equal(frames["vps"].select(POSITION), flight.position)
    first = next(message for _, message in messages_by_mcap_ros2(tmp_path / "log.mcap", "/pose"))
    for name in orientation.split("."):
        first = getattr(first, name)
    assert [first.x, first.y, first.z, first.w] == flight.quaternion[0].tolist()


def test_position_from_satellites(tmp_path: Path) -> None:
    flight = Flight(10)
    place = {"latitude": flight.position[:, 0], "longitude": flight.position[:, 1], "altitude": flight.position[:, 2]}
    fixes = MessageChannel("/fix", "sensor_msgs/NavSatFix", flight.t_ns, flight.t_ns, place)
    write_mcap(tmp_path / "log.mcap", [flight.channels()[0], fixes])
    frames, _ = read_log(tmp_path / "log.mcap", vehicle())
    np.testing.assert_array_equal(
        frames["position"].select("latitude_deg", "longitude_deg", "altitude_m"), flight.position
    )


def test_raw_counts_with_what_the_file_declares_of_them(tmp_path: Path) -> None:
    flight = Flight(100)
    metadata = {"unit_gyroscope": "counts", "unit_magnetometer": "furlong", "world": "ned", "body": "frd"}
    metadata["gravity_sign"] = "gravity"
    channel = raw_imu_channel(flight.t_ns, flight.t_ns + 9, *flight.counts, flight.temperature)
    write_mcap(tmp_path / "raw.mcap", [channel], metadata=metadata)
    frames, summary = read_log(tmp_path / "raw.mcap", vehicle())
    np.testing.assert_array_equal(frames["imu"].select(GYRO), flight.counts[0])
    np.testing.assert_array_equal(frames["imu"].select(ACCEL), flight.counts[1])
    np.testing.assert_array_equal(frames["magnetometer"].select(MAG), flight.counts[2])
    np.testing.assert_array_equal(frames["temperature"]["temperature_degc"], flight.temperature)
    assert summary.units == {"gyroscope": "counts", "accelerometer": "unknown", "magnetometer": "unknown"}
    assert [finding.code for finding in summary.findings] == ["unit_not_supported"]
    assert (summary.world, summary.body, summary.gravity_sign) == ("ned", "frd", "gravity")
    assert summary.metadata["unit_gyroscope"] == "counts"


def test_slower_sensors_in_shared_messages_give_no_rows_where_they_are_absent(tmp_path: Path) -> None:
    flight = Flight(60)
    sparse = np.where(np.arange(60)[:, None] % 3 == 0, flight.magnetometer, np.nan)
    channel = raw_imu_channel(flight.t_ns, None, flight.gyroscope, flight.accelerometer, sparse)
    write_mcap(tmp_path / "raw.mcap", [channel])
    frames, _ = read_log(tmp_path / "raw.mcap", vehicle())
    np.testing.assert_array_equal(frames["magnetometer"].select(MAG), flight.magnetometer[::3])
    assert frames["imu"].height == 60
    assert "temperature" not in frames


def test_time_of_recording_when_asked_for(tmp_path: Path) -> None:
    flight = Flight(20)
    frames, _ = read_log(flight.write(tmp_path / "log.mcap"), vehicle(mcap=McapMap(time="log")))
    np.testing.assert_array_equal(frames["imu"]["t_ns"], flight.t_ns + 450_000)


def test_messages_without_header_get_the_time_of_recording(tmp_path: Path) -> None:
    flight = Flight(20)
    write_json(tmp_path / "log.mcap", "my.Thing", [{"w": [1.0, 2.0, row]} for row in range(20)], flight.t_ns)
    mapping = McapMap(imu="/topic", imu_fields={"gyroscope": "w"})
    frames, summary = read_log(tmp_path / "log.mcap", vehicle(mcap=mapping))
    np.testing.assert_array_equal(frames["imu"]["t_ns"], flight.t_ns)
    assert frames["imu"]["accelerometer_x"].null_count() == 20
    assert [(finding.code, finding.loses_data) for finding in summary.findings] == [("no_header_stamp", False)]


def test_foxglove_json(tmp_path: Path) -> None:
    messages = [
        {
            "timestamp": {"sec": 7, "nsec": row},
            "frame_id": "map",
            "pose": {"position": {"x": row, "y": 0, "z": 1}, "orientation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8}},
        }
        for row in range(5)
    ]
    content = BytesIO()
    writer = Writer(content)
    writer.start()
    flight = Flight(5)
    imu = flight.channels()[0]
    schema = writer.register_schema(imu.schema_name, "ros2msg", imu.schema_text.encode())
    channel = writer.register_channel("/imu", "cdr", schema)
    for row, payload in enumerate(encode_cdr(imu)):
        writer.add_message(channel, row, payload.tobytes(), row)
    schema = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"{}")
    channel = writer.register_channel("/pose", "json", schema)
    for row, message in enumerate(messages):
        writer.add_message(channel, row, json.dumps(message).encode(), row)
    writer.add_message(channel, 9, b'{"timestamp": {"sec": 1, "nsec": 2}, "pose": 3}', 9)
    writer.finish()
    (tmp_path / "log.mcap").write_bytes(content.getvalue())
    frames, summary = read_log(tmp_path / "log.mcap", vehicle())
    assert frames["vps"]["t_ns"].to_list() == [7_000_000_000 + row for row in range(5)]
    assert frames["vps"].row(3)[1:] == (0.0, 0.0, 0.6, 0.8, 3.0, 0.0, 1.0)
    assert [(finding.code, finding.count) for finding in summary.findings] == [("malformed_message", 1)]


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.NONE},
        {"use_chunking": False, "enable_data_crcs": True},
        {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False, "use_summary_offsets": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
    ],
)
@pytest.mark.parametrize("compression", list(CompressionType))
def test_files_without_index_chunks_or_summary(
    tmp_path: Path, options: dict[str, bool], compression: CompressionType
) -> None:
    flight = Flight(200)
    path = write_plain(tmp_path / "log.mcap", flight, compression=compression, chunk_size=10_000, **options)
    frames, summary = read_log(path, vehicle())
    np.testing.assert_array_equal(frames["imu"].select(GYRO), flight.gyroscope)
    assert summary.findings == []
    assert summary.verifiable


@pytest.mark.parametrize("options", [{"enable_crcs": False}, {"use_chunking": False}])
def test_files_without_checksums_are_marked(tmp_path: Path, options: dict[str, bool]) -> None:
    frames, summary = read_log(write_plain(tmp_path / "log.mcap", Flight(50), **options), vehicle())
    assert frames["imu"].height == 50
    assert not summary.verifiable
    assert [finding.code for finding in summary.findings] == ["unverifiable"]
    assert not summary.findings[0].loses_data


def test_several_candidates_are_decided_and_told(tmp_path: Path) -> None:
    flight = Flight(10)
    other = imu_channel(flight.t_ns, None, -flight.gyroscope, flight.accelerometer, topic="/imu/data")
    write_mcap(tmp_path / "log.mcap", [other, *flight.channels()])
    frames, summary = read_log(tmp_path / "log.mcap", vehicle())
    np.testing.assert_array_equal(frames["imu"].select(GYRO), flight.gyroscope)
    finding = next(finding for finding in summary.findings if finding.code == "ambiguous_topic")
    assert "/imu/data, /imu/data_raw" in finding.sentence
    frames, summary = read_log(tmp_path / "log.mcap", vehicle(mcap=McapMap(imu="/imu/data")))
    np.testing.assert_array_equal(frames["imu"].select(GYRO), -flight.gyroscope)
    assert summary.findings == []


def test_a_configured_topic_that_is_not_there_is_named_with_those_that_are(tmp_path: Path) -> None:
    path = Flight(10).write(tmp_path / "log.mcap")
    with pytest.raises(UnreadableLog, match=r"no topic /imu, .* /imu/data_raw \(sensor_msgs/Imu\)") as caught:
        open_log(path, vehicle(mcap=McapMap(imu="/imu")))
    assert caught.value.reason_code == "missing_topic"


def test_a_field_that_is_not_there_is_named_with_those_that_are(tmp_path: Path) -> None:
    flight = Flight(10)
    write_mcap(tmp_path / "raw.mcap", [raw_imu_channel(flight.t_ns, None, *flight.counts)])
    mapping = McapMap(imu="/imu/raw", imu_fields={"gyroscope": "gyros"})
    with pytest.raises(UnreadableLog, match=r"no field gyros .* gyro, accel, mag") as caught:
        open_log(tmp_path / "raw.mcap", vehicle(mcap=mapping))
    assert caught.value.reason_code == "missing_field"


def test_a_log_with_poses_only_has_no_sensor(tmp_path: Path) -> None:
    flight = Flight(10)
    write_mcap(tmp_path / "log.mcap", [pose_channel(flight.t_ns, None, flight.quaternion, flight.position)])
    with pytest.raises(UnreadableLog) as caught:
        open_log(tmp_path / "log.mcap", vehicle())
    assert caught.value.reason_code == "missing_sensor"


def test_a_log_with_a_magnetometer_only_is_readable(tmp_path: Path) -> None:
    flight = Flight(10)
    write_mcap(tmp_path / "log.mcap", [magnetic_field_channel(flight.t_ns, None, flight.magnetometer)])
    frames, summary = read_log(tmp_path / "log.mcap", vehicle())
    assert set(frames) == {"magnetometer"}
    assert summary.units["gyroscope"] == "unknown"


def test_the_configured_unit_is_followed_and_the_contradiction_told(tmp_path: Path) -> None:
    _, summary = read_log(Flight(10).write(tmp_path / "log.mcap"), vehicle(units={"gyroscope": "deg/s"}))
    assert summary.units["gyroscope"] == "deg/s"
    assert [finding.code for finding in summary.findings] == ["unit_conflict"]


def test_definitions_that_lead_nowhere_are_refused() -> None:
    loop = "Loop again\n" + "=" * 80 + "\nMSG: my_msgs/Loop\nLoop again"
    for text in (loop, "nonsense!", "Unknown thing", "Wide[30000] many\n===\nMSG: my_msgs/Wide\nint8 a\nint16 b"):
        with pytest.raises(UnsupportedSchema):
            CdrDecoder("my_msgs/msg/Loop", text, {"x": Want.of("x", 1)})
    with pytest.raises(UnsupportedSchema, match="variable layout"):
        CdrDecoder("my_msgs/msg/Names", "string[] names\nfloat64 x", {"x": Want.of("x", 1)})
    with pytest.raises(MissingField):
        CdrDecoder("my_msgs/msg/Two", "float64[2] x", {"x": Want.of("x", 3)})


def test_the_written_schema_text_names_every_nested_definition() -> None:
    text = full_text("nav_msgs/msg/Odometry")
    for nested in ("std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Quaternion", "geometry_msgs/Vector3"):
        assert text.count(f"MSG: {nested}\n") == 1


def test_the_writer_refuses_what_does_not_fit(tmp_path: Path) -> None:
    flight = Flight(10)
    with pytest.raises(ValueError, match="different lengths"):
        imu_channel(flight.t_ns, None, flight.gyroscope[:5], flight.accelerometer)
    with pytest.raises(ValueError, match=r"shape \(n, 3\)"):
        imu_channel(flight.t_ns, None, flight.gyroscope[:, :2], flight.accelerometer)
    wrong = MessageChannel("/t", "sensor_msgs/Imu", flight.t_ns, flight.t_ns, {"speed": flight.temperature})
    with pytest.raises(ValueError, match="no field speed"):
        write_mcap(tmp_path / "log.mcap", [wrong])
    with pytest.raises(ValueError, match="compression"):
        flight.write(tmp_path / "log.mcap", compression="brotli")


def write_plain(path: Path, flight: Flight, **options: object) -> Path:
    """An Imu-only log with the given options of the mcap package's writer."""
    imu = flight.channels()[0]
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", "test")
        schema = writer.register_schema(imu.schema_name, "ros2msg", imu.schema_text.encode())
        channel = writer.register_channel("/imu", "cdr", schema)
        for row, payload in enumerate(encode_cdr(imu)):
            writer.add_message(channel, EPOCH_NS + row, payload.tobytes(), EPOCH_NS + row)
        writer.finish()
    return path


def write_json(path: Path, name: str, messages: list[dict[str, object]], log_time_ns: np.ndarray) -> None:
    """Messages of one JSON topic."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/topic", "json", writer.register_schema(name, "jsonschema", b"{}"))
        for message, log_time in zip(messages, log_time_ns.tolist(), strict=True):
            writer.add_message(channel, log_time, json.dumps(message).encode(), log_time)
        writer.finish()
