"""MCAP logs as drivers and converters write them, each kind made small, serialised by rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_support import vehicle
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from fieldcal.config.configuration import McapMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs import read_log
from fieldcal.logs.ingest import read_flight

IMU, FIELD, POSE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField", "geometry_msgs/msg/PoseStamped"
START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
ROWS = 40
Row = tuple[str, str, int, Any]


class Messages:
    """Messages of ROS 1 or 2, of the values that are asked for."""

    def __init__(self, *, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self._types = self.store.types
        self.rng = np.random.default_rng(1)

    def header(self, t_ns: int, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        number = {"seq": 7} if self.ros1 else {}
        return self._types["std_msgs/msg/Header"](**number, stamp=time, frame_id=frame)

    def vector(self, values: Sequence[float]) -> Any:
        return self._types["geometry_msgs/msg/Vector3"](*map(float, values))

    def imu(self, t_ns: int, rate: Sequence[float], force: Sequence[float], frame: str = "imu") -> Any:
        cov, turn = np.zeros(9), self._types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        head = self.header(t_ns, frame)
        return self._types[IMU](head, turn, cov, self.vector(rate), cov, self.vector(force), cov)

    def field(self, t_ns: int, values: Sequence[float]) -> Any:
        return self._types[FIELD](self.header(t_ns, "mag"), self.vector(values), np.zeros(9))

    def pose(self, t_ns: int) -> Any:
        pose = self._types["geometry_msgs/msg/Pose"](
            self._types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0),
            self._types["geometry_msgs/msg/Quaternion"](0.0, 0.6, 0.0, 0.8),
        )
        return self._types[POSE](self.header(t_ns, "world"), pose)

    def write(self, path: Path, rows: Sequence[Row], pack: bool = False, spoil: int = 0) -> Path:
        """(topic, type, log time, message) as one file; payloads packed, the first `spoil` of them cut."""
        import zstandard

        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros1" if self.ros1 else "ros2")
            channels: dict[str, int] = {}
            for number, (topic, name, t_ns, message) in enumerate(rows):
                if topic not in channels:
                    text = self.store.generate_msgdef(name, ros_version=1 if self.ros1 else 2)[0]
                    short = name.replace("/msg/", "/") if self.ros1 else name
                    schema = writer.register_schema(short, "ros1msg" if self.ros1 else "ros2msg", text.encode())
                    channels[topic] = writer.register_channel(topic, "ros1" if self.ros1 else "cdr", schema)
                data = bytes((self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr)(message, name))
                data = zstandard.compress(data) if pack else data
                data = data[:-5] if number < spoil else data
                writer.add_message(channels[topic], t_ns, data, t_ns)
            writer.finish()
        return path


def stamps() -> list[int]:
    return [START_NS + STEP_NS * i for i in range(ROWS)]


def values() -> np.ndarray:
    return np.random.default_rng(3).normal(size=(ROWS, 9))


def whole_flight(messages: Messages) -> list[Row]:
    rows: list[Row] = []
    for t, v in zip(stamps(), values().tolist(), strict=True):
        rows += [("/imu", IMU, t, messages.imu(t, v[:3], v[3:6])), ("/mag", FIELD, t, messages.field(t, v[6:]))]
        rows += [("/vicon/pose", POSE, t, messages.pose(t))]
    return rows


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("frame", ["", "imu", "imu_link"])
def test_both_serialisations_give_the_same(tmp_path: Path, ros1: bool, frame: str) -> None:
    messages = Messages(ros1=ros1)
    rows = whole_flight(messages)
    for _, name, _, message in rows:
        message.header.frame_id = frame if name == IMU else message.header.frame_id
    frames, summary = read_log(messages.write(tmp_path / "a.mcap", rows), vehicle())
    np.testing.assert_array_equal(frames["imu"].drop("t_ns").to_numpy(), values()[:, :6])
    np.testing.assert_array_equal(frames["magnetometer"].drop("t_ns").to_numpy(), values()[:, 6:])
    assert frames["imu"]["t_ns"].to_list() == stamps()
    assert frames["vps"].row(0)[1:] == (0.0, 0.6, 0.0, 0.8, 1.0, 2.0, 3.0)
    assert (summary.world, summary.units["gyroscope"], summary.findings) == ("enu", "rad/s", [])


@pytest.mark.parametrize("role", ["vps", "temperature", "power", "position", "magnetometer"])
def test_a_configured_role_that_is_absent_is_told(tmp_path: Path, role: str) -> None:
    messages = Messages()
    path = messages.write(tmp_path / "a.mcap", [row for row in whole_flight(messages) if row[0] == "/imu"])
    frames, summary = read_log(path, vehicle(mcap=McapMap.model_validate({role: "/nowhere"})))
    assert list(frames) == ["imu"]
    assert [finding.code for finding in summary.findings] == ["missing_topic"]
    assert f"mcap.{role}" in summary.findings[0].sentence
    with pytest.raises(UnreadableLog) as refused:
        read_log(path, vehicle(mcap=McapMap(imu="/nowhere")))
    assert refused.value.reason_code == "missing_topic"


def test_stamps_that_are_never_filled_in_give_way_to_the_recorders(tmp_path: Path) -> None:
    messages = Messages()
    rows = [("/imu", IMU, t, messages.imu(0, [1, 2, 3], [4, 5, 6])) for t in stamps()]
    frames, summary = read_log(messages.write(tmp_path / "a.mcap", rows), vehicle())
    assert frames["imu"]["t_ns"].to_list() == stamps()
    assert [(finding.code, finding.count) for finding in summary.findings] == [("no_header_stamp", ROWS)]


@pytest.mark.parametrize(
    ("away_ns", "told"), [(-START_NS, True), (ROWS * STEP_NS, True), ((ROWS - 1) * STEP_NS, False)]
)
def test_a_magnetometer_of_another_clock_is_told(tmp_path: Path, away_ns: int, told: bool) -> None:
    messages = Messages()
    rows = whole_flight(messages)
    moved = [
        (topic, name, t, messages.field(t + away_ns, v[6:]) if name == FIELD else message)
        for (topic, name, t, message), v in zip(rows, np.repeat(values(), 3, axis=0).tolist(), strict=True)
    ]
    _, facts = read_flight(messages.write(tmp_path / "a.mcap", moved), vehicle())
    assert ("clocks_apart" in [finding["code"] for finding in facts["findings"]]) == told
    if told:
        assert f"{ROWS} readings of the magnetometer" in str(facts["reason"])


def test_messages_that_were_compressed_one_by_one_are_read(tmp_path: Path) -> None:
    messages = Messages()
    rows = whole_flight(messages)
    plain, _ = read_log(messages.write(tmp_path / "a.mcap", rows), vehicle())
    packed, summary = read_log(messages.write(tmp_path / "b.mcap", rows, pack=True), vehicle())
    assert packed.keys() == plain.keys()
    for table, frame in plain.items():
        assert packed[table].equals(frame)
    assert summary.findings == []


def test_packed_messages_that_do_not_unpack_are_left_out_and_told(tmp_path: Path) -> None:
    messages = Messages()
    rows = whole_flight(messages)
    path = messages.write(tmp_path / "a.mcap", rows, pack=True, spoil=3)
    frames, summary = read_log(path, vehicle())
    assert sum(len(frame) for frame in frames.values()) == len(rows) - 3
    told = {finding.code: finding for finding in summary.findings}["packed_messages"]
    assert (told.count, told.loses_data) == (3, True)


def test_a_topic_of_few_messages_is_no_vps(tmp_path: Path) -> None:
    messages = Messages()
    rows = whole_flight(messages) * 5
    goal = [("/goal_vicon", POSE, START_NS, messages.pose(START_NS))]
    frames, summary = read_log(messages.write(tmp_path / "a.mcap", goal + rows), vehicle())
    assert len(frames["vps"]) == 5 * ROWS
    assert "/vicon/pose is used" in summary.findings[0].sentence


def test_an_estimate_of_the_vehicles_own_is_no_reference(tmp_path: Path) -> None:
    messages = Messages()
    own = [("/mavros/local_position/pose", POSE, t, messages.pose(t)) for t in stamps()]
    both = whole_flight(messages)
    _, summary = read_log(messages.write(tmp_path / "a.mcap", own + both), vehicle())
    assert "/vicon/pose is used" in summary.findings[0].sentence
    assert len(summary.findings) == 1
    alone = own + [row for row in both if row[1] != POSE]
    frames, summary = read_log(messages.write(tmp_path / "b.mcap", alone), vehicle())
    assert [finding.code for finding in summary.findings] == ["vps_is_estimate"]
    assert "vps" not in frames
    named = McapMap(vps="/mavros/local_position/pose")
    frames, summary = read_log(tmp_path / "b.mcap", vehicle(mcap=named))
    assert summary.findings == []
    assert "vps" in frames


def test_halves_of_an_imu_are_joined(tmp_path: Path) -> None:
    messages = Messages()
    rows: list[Row] = []
    for i, t in enumerate(stamps()):
        rows.append(("/camera/gyro/sample", IMU, t, messages.imu(t, [i, 2, 3], [0, 0, 0])))
        late = t + 3_000_000
        rows.append(("/camera/accel/sample", IMU, late, messages.imu(late, [0, 0, 0], [10 * i + 3, 0, 9.8])))
    frames, summary = read_log(messages.write(tmp_path / "a.mcap", rows), vehicle())
    assert frames["imu"]["gyroscope_x"].to_list() == list(range(1, ROWS))
    np.testing.assert_allclose(frames["imu"]["accelerometer_x"], 10 * np.arange(1, ROWS), rtol=1e-12)
    assert [(finding.code, finding.count) for finding in summary.findings] == [("sensors_joined", ROWS - 1)]


def test_two_imus_on_one_topic_are_refused_or_split(tmp_path: Path) -> None:
    messages = Messages()
    rows = [
        ("/imu", IMU, t + k, messages.imu(t + k, [k, i, 0], [1, 2, 3], f"imu_{side}"))
        for i, t in enumerate(stamps())
        for k, side in enumerate(("left", "right"))
    ]
    path = messages.write(tmp_path / "a.mcap", rows)
    with pytest.raises(UnreadableLog, match="'imu_left' or 'imu_right'") as refused:
        read_log(path, vehicle())
    assert refused.value.reason_code == "several_units"
    for k, side in enumerate(("left", "right")):
        frames, _ = read_log(path, vehicle(mcap=McapMap(frame_id=f"imu_{side}")))
        assert frames["imu"]["gyroscope_x"].to_list() == [k] * ROWS
        assert frames["imu"]["gyroscope_y"].to_list() == list(range(ROWS))


def test_a_frame_that_is_renamed_once_is_one_imu(tmp_path: Path) -> None:
    messages = Messages()
    rows = [
        ("/imu", IMU, t, messages.imu(t, [1, 2, 3], [4, 5, 6], "imu" if i < ROWS // 2 else "imu_link"))
        for i, t in enumerate(stamps())
    ]
    frames, _ = read_log(messages.write(tmp_path / "a.mcap", rows), vehicle())
    assert len(frames["imu"]) == ROWS
