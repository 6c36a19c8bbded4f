"""What the MCAP reader makes of topics, clocks, metadata and broken messages; each number in what it tells."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from logs_support import EPOCH_NS, Flight, vehicle
from mcap.reader import make_reader
from mcap.writer import Writer

from fieldcal.config.configuration import McapMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs import read_log
from fieldcal.logs.mcap.file import McapFile
from fieldcal.logs.mcap.write import (
    MessageChannel,
    encode_cdr,
    imu_channel,
    pose_channel,
    raw_imu_channel,
    write_mcap,
)

N = 8


@pytest.fixture
def flight() -> Flight:
    return Flight(N)


def told(
    path: Path, **mapping: object
) -> tuple[dict[str, list[tuple[object, ...]]], list[tuple[str, int, bool]], object]:
    frames, summary = read_log(path, vehicle(mcap=McapMap(**mapping)))
    found = [(str(f.code), f.count, f.loses_data) for f in summary.findings]
    return {table: frame.rows() for table, frame in frames.items()}, found, summary


def json_log(path: Path, topics: dict[str, list[object]], *, schema: str = "my.Thing") -> Path:
    """JSON messages by topic, recorded at 100, 101, …"""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, messages in topics.items():
            channel = writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
            for row, message in enumerate(messages):
                writer.add_message(channel, 100 + row, json.dumps(message).encode(), 100 + row)
        writer.finish()
    return path


def test_messages_that_are_none_are_counted_over_all_chunks(tmp_path: Path) -> None:
    messages: list[object] = [{"w": [1, 2, row]} for row in range(40)]
    for row in (3, 20, 39):
        messages[row] = {"w": [1, 2]}
    path = json_log(tmp_path / "a.mcap", {"/t": messages})
    tables, found, _ = told(path, imu="/t", imu_fields={"gyroscope": "w"})
    kept = [row for row in range(40) if row not in (3, 20, 39)]
    assert [row[0] for row in tables["imu"]] == [100 + row for row in kept]
    assert [row[3] for row in tables["imu"]] == kept
    assert found == [("malformed_message", 3, True), ("no_header_stamp", 37, False)]


def test_the_time_of_recording_when_asked_for_is_no_finding(tmp_path: Path) -> None:
    path = json_log(tmp_path / "a.mcap", {"/t": [{"w": [1, 2, 3], "stamp": {"sec": 5}}, {"w": [1, 2, 3]}]})
    tables, found, summary = told(path, imu="/t", imu_fields={"gyroscope": "w"}, time="log")
    assert [row[0] for row in tables["imu"]] == [100, 101]
    assert found == []
    assert not summary.epoch_known


def test_values_of_a_shared_message_that_have_a_topic_of_their_own(tmp_path: Path, flight: Flight) -> None:
    raw = raw_imu_channel(
        flight.t_ns, None, flight.gyroscope, flight.accelerometer, flight.magnetometer, flight.temperature
    )
    write_mcap(tmp_path / "shared.mcap", [raw])
    tables, found, _ = told(tmp_path / "shared.mcap")
    assert {name: len(rows) for name, rows in tables.items()} == {"imu": N, "magnetometer": N, "temperature": N}
    assert tables["temperature"] == [(int(t), x) for t, x in zip(flight.t_ns, flight.temperature, strict=True)]
    assert found == []
    write_mcap(tmp_path / "own.mcap", [raw, *flight.channels()[1:3]])
    tables, _, summary = told(tmp_path / "own.mcap")
    assert {name: len(rows) for name, rows in tables.items()} == {"imu": N, "magnetometer": N, "temperature": N}
    assert summary.units["magnetometer"] == "T"


def test_current_is_a_magnitude_and_absent_where_it_is_not_measured(tmp_path: Path, flight: Flight) -> None:
    current = np.array([-3.0, 4.0, np.nan, np.inf, 0.0, -1.5, 2.5, 1.0], np.float32)
    battery = MessageChannel("/bat", "sensor_msgs/BatteryState", flight.t_ns, flight.t_ns, {"current": current})
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for channel, head in ((flight.channels()[0], None), (battery, 12 + 4 * 7)):
            schema = writer.register_schema(channel.schema_name, "ros2msg", channel.schema_text.encode())
            own = writer.register_channel(channel.topic, "cdr", schema)
            for row in range(N):
                if head is None:
                    writer.add_message(own, row, encode_cdr(channel)[row].tobytes(), row)
                else:
                    body = bytearray(16 + 4 * 7)
                    body[0:4] = int(flight.t_ns[row] // 10**9).to_bytes(4, "little")
                    body[4:8] = int(flight.t_ns[row] % 10**9).to_bytes(4, "little")
                    body[8] = 1
                    body[16 + 8 : 16 + 12] = current[row].tobytes()
                    writer.add_message(own, row, b"\0\1\0\0" + bytes(body), row)
        writer.finish()
    tables, _, _ = told(path)
    rows = [row for row in range(N) if np.isfinite(current[row])]
    assert [row[:2] for row in tables["power"]] == [(int(flight.t_ns[r]), abs(float(current[r]))) for r in rows]


def test_metadata_of_others_keeps_its_name_and_our_own_overrules_ros(tmp_path: Path, flight: Flight) -> None:
    metadata = {"world": "ned", "unit_gyroscope": "deg/s", "note": "x"}
    write_mcap(tmp_path / "a.mcap", flight.channels(), metadata=metadata)
    _, _, summary = told(tmp_path / "a.mcap")
    assert (summary.world, summary.body, summary.gravity_sign) == ("ned", "flu", "specific_force")
    assert summary.units == {"gyroscope": "deg/s", "accelerometer": "m/s^2", "magnetometer": "T"}
    assert summary.metadata == {**metadata, "mcap.profile": "ros2", "mcap.library": "fieldcal"}
    assert summary.epoch_known


@pytest.mark.parametrize(("channels", "code"), [(4096, None), (4097, "too_many_channels")])
def test_so_many_channels_are_read(tmp_path: Path, flight: Flight, channels: int, code: str | None) -> None:
    imu = flight.channels()[0]
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(imu.schema_name, "ros2msg", imu.schema_text.encode())
        own = writer.register_channel("/imu", "cdr", schema)
        for number in range(channels - 1):
            writer.register_channel(f"/{number}", "x", 0)
        writer.add_message(own, 5, encode_cdr(imu)[0].tobytes(), 5)
        writer.finish()
    if code is None:
        assert len(told(tmp_path / "a.mcap")[0]["imu"]) == 1
        return
    with pytest.raises(UnreadableLog, match="4097 channels, 4096 at most") as refused:
        read_log(tmp_path / "a.mcap", vehicle())
    assert refused.value.reason_code == code


def test_a_log_of_which_no_message_can_be_read_says_why(tmp_path: Path) -> None:
    path = json_log(tmp_path / "a.mcap", {"/t": [{"w": 1}, {"w": 2}]})
    with pytest.raises(UnreadableLog, match=r"not one message of /t could be read \(.*2 messages on /t") as refused:
        told(path, imu="/t", imu_fields={"gyroscope": "w"})
    assert refused.value.reason_code == "no_messages"
    path = json_log(tmp_path / "b.mcap", {"/t": []})
    with pytest.raises(UnreadableLog, match=r"not one message of /t could be read\.$"):
        told(path, imu="/t", imu_fields={"gyroscope": "w"})


# topics --------------------------------------------------------------------------------------------------------------


def test_hints_in_the_name_decide_then_the_alphabet_and_all_candidates_are_counted(
    tmp_path: Path, flight: Flight
) -> None:
    def imu(topic: str) -> MessageChannel:
        return imu_channel(flight.t_ns, None, flight.gyroscope, flight.accelerometer, topic=topic)

    def pose(topic: str) -> MessageChannel:
        return pose_channel(flight.t_ns, None, flight.quaternion, flight.position, topic=topic)

    for topics, chosen in (
        (["/b", "/a", "/z/RAW"], "/z/RAW"), (["/b", "/a"], "/a"), (["/b_raw", "/a_raw", "/a"], "/a_raw")
    ):  # fmt: skip
        write_mcap(tmp_path / "a.mcap", [imu(topic) for topic in topics])
        _, found, summary = told(tmp_path / "a.mcap")
        assert found == [("ambiguous_topic", len(topics), False)]
        assert f"could all be the imu; {chosen} is used" in summary.findings[0].sentence
    write_mcap(tmp_path / "a.mcap", [imu("/raw"), pose("/a"), pose("/z/Vicon"), pose("/optitrack/x")])
    _, found, summary = told(tmp_path / "a.mcap")
    assert "; /optitrack/x is used" in summary.findings[0].sentence
    assert found == [("ambiguous_topic", 3, False)]


def test_a_better_type_comes_before_a_hint(tmp_path: Path, flight: Flight) -> None:
    raw = raw_imu_channel(flight.t_ns, None, *flight.counts, topic="/raw")
    imu = imu_channel(flight.t_ns, None, flight.gyroscope, flight.accelerometer, topic="/z")
    write_mcap(tmp_path / "a.mcap", [raw, imu])
    tables, _, _ = told(tmp_path / "a.mcap")
    assert tables["imu"][0][1] == flight.gyroscope[0, 0]


def test_a_known_type_that_cannot_be_read_is_one_finding(tmp_path: Path, flight: Flight) -> None:
    imu = flight.channels()[0]
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        good = writer.register_schema(imu.schema_name, "ros2msg", imu.schema_text.encode())
        odd = writer.register_schema("sensor_msgs/msg/MagneticField", "ros2msg", b"float64 other")
        own = writer.register_channel("/imu", "cdr", good)
        writer.register_channel("/odd", "cdr", odd)
        writer.register_channel("/bson", "bson", odd)
        writer.register_channel("/proto", "protobuf", odd)
        writer.add_message(own, 5, encode_cdr(imu)[0].tobytes(), 5)
        writer.finish()
    _, found, summary = told(tmp_path / "a.mcap")
    assert found == [("unsupported_schema", 1, False)] * 3
    assert "message encoding 'protobuf' with schema encoding 'ros2msg'" in summary.findings[2].sentence
    assert "message encoding 'bson' with schema encoding 'ros2msg'" in summary.findings[0].sentence


def test_twenty_topics_and_thirty_fields_are_listed(tmp_path: Path, flight: Flight) -> None:
    names = [f"/t{number:02d}" for number in range(25)]
    path = json_log(tmp_path / "a.mcap", {name: [] for name in names})
    with pytest.raises(UnreadableLog) as refused:
        read_log(path, vehicle())
    assert refused.value.sentence.count("(my/Thing)") == 20
    definition = "\n".join(f"float64 f{number:02d}" for number in range(35))
    with (tmp_path / "b.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.register_channel("/t", "cdr", writer.register_schema("my_msgs/msg/Wide", "ros2msg", definition.encode()))
        writer.finish()
    with pytest.raises(UnreadableLog, match=r"it has f00, .*, f29\. Correct"):
        told(tmp_path / "b.mcap", imu="/t", imu_fields={"gyroscope": "none"})


def test_a_custom_type_gives_single_temperatures_and_vectors_of_three(tmp_path: Path) -> None:
    message = {"w": [1, 2, 3], "deg": 21.5, "m": {"x": 4, "y": 5, "z": 6}}
    path = json_log(tmp_path / "a.mcap", {"/t": [message]})
    fields = {"gyroscope": "w", "temperature": "deg", "magnetometer": "m"}
    for mapping in ({"imu": "/t"}, {}):  # named, or the only topic whose type is unknown
        tables, _, _ = told(path, imu_fields=fields, **mapping)
        assert tables["temperature"] == [(100, 21.5)]
        assert tables["magnetometer"] == [(100, 4.0, 5.0, 6.0)]


# writing -------------------------------------------------------------------------------------------------------------


def test_messages_are_written_in_the_order_of_recording_with_their_place(tmp_path: Path, flight: Flight) -> None:
    late = imu_channel(flight.t_ns, EPOCH_NS + 10 * np.arange(N)[::-1], flight.gyroscope, flight.accelerometer)
    other = pose_channel(flight.t_ns, EPOCH_NS + 10 * np.arange(N), flight.quaternion, flight.position)
    write_mcap(tmp_path / "a.mcap", [late, other])
    with (tmp_path / "a.mcap").open("rb") as stream:
        met = [
            (channel.topic, message.log_time - EPOCH_NS, message.sequence, message.publish_time)
            for _, channel, message in make_reader(stream).iter_messages(log_time_order=False)
        ]
    expected = []
    for k in range(N):
        expected += [("/imu/data_raw", 10 * k, N - 1 - k, int(flight.t_ns[N - 1 - k]))]
        expected += [("/vps/pose", 10 * k, k, int(flight.t_ns[k]))]
    assert met == expected


@pytest.mark.parametrize(("size", "chunks"), [(1 << 20, 2), (1 << 18, 5)])
def test_a_chunk_is_closed_at_its_size(tmp_path: Path, size: int, chunks: int) -> None:
    big = Flight(3300)  # about 360 bytes a message
    channel = big.channels()[0]
    options = {} if size == 1 << 20 else {"chunk_size": size}
    write_mcap(tmp_path / "a.mcap", [channel], **options)
    file = McapFile(tmp_path / "a.mcap")
    assert sum(len(block.starts) for block in file.blocks()) == 3300
    total = 3300 * (encode_cdr(channel).dtype.itemsize + 31)
    assert file.tally.chunks == -(-total // size) == chunks


def test_an_absent_vector_is_marked_and_a_gap_is_not(flight: Flight) -> None:
    nothing, gap = np.full((N, 3), np.nan), flight.accelerometer.copy()
    gap[3] = np.nan
    channel = imu_channel(flight.t_ns, None, nothing, gap)
    marked = {name: values[:, 0].tolist() for name, values in channel.values.items() if name.endswith("covariance")}
    assert marked == {"orientation_covariance": [-1.0] * N, "angular_velocity_covariance": [-1.0] * N}
    for name in marked:
        assert channel.values[name].shape == (N, 9)
        assert (channel.values[name][:, 1:] == 0.0).all()
    none = imu_channel(flight.t_ns[:0], None, nothing[:0], gap[:0])
    assert set(none.values) == {"orientation_covariance", "angular_velocity", "linear_acceleration"}
    np.testing.assert_array_equal(imu_channel(flight.t_ns, flight.t_ns + 3, nothing, gap).log_time_ns, flight.t_ns + 3)


def test_what_cannot_be_written(tmp_path: Path, flight: Flight) -> None:
    with pytest.raises(ValueError, match=r"\(n, 4\), got"):
        pose_channel(flight.t_ns, None, flight.quaternion[:, :3], flight.position)
    with pytest.raises(ValueError, match=r"\(n, 3\), got"):
        pose_channel(flight.t_ns, None, flight.quaternion, flight.position[0])
    with pytest.raises(ValueError, match="encoding one of"):
        flight.write(tmp_path / "a.mcap", encoding="xml")
    with pytest.raises(ValueError, match="variable length"):
        encode_cdr(MessageChannel("/t", "my_msgs/A", flight.t_ns, flight.t_ns, {}, definition="float64[] x"))


def test_json_messages_nest_by_their_paths(tmp_path: Path, flight: Flight) -> None:
    flight.write(tmp_path / "a.mcap", encoding="json")
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == ""
        pose = json.loads(next(message.data for _, channel, message in reader.iter_messages(["/vps/pose"])))
    q, p, t = flight.quaternion[0], flight.position[0], int(flight.t_ns[0]) + 7
    assert pose == {
        "header": {"frame_id": "world", "stamp": {"sec": t // 10**9, "nanosec": t % 10**9}},
        "pose": {
            "orientation": dict(zip("xyzw", q.tolist(), strict=True)),
            "position": dict(zip("xyz", p.tolist(), strict=True)),
        },
    }
