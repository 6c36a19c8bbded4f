"""Which topic plays which role: types in order of preference, hints, and what a refusal lists."""

from __future__ import annotations

import pytest

from fieldcal.config.configuration import McapMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.definitions import Channel, Definitions, Schema
from fieldcal.logs.messages.roles import choose_sources
from fieldcal.logs.messages.source import Source


def definitions(topics: dict[str, str], text: str = "float64 x") -> Definitions:
    """JSON channels of these topics and types; those whose type begins with "cdr" have the definition `text`."""
    found = Definitions()
    for i, (topic, name) in enumerate(topics.items(), 1):
        found.add(Schema(i, name, "ros2msg", text.encode()))
        found.add(Channel(i, i, topic, "cdr" if name.startswith("cdr") else "json", ()))
    return found


def chosen(topics: dict[str, str], **mapping: object) -> tuple[dict[str, Source], LogSummary]:
    summary = LogSummary("mcap")
    sources = choose_sources(definitions(topics), McapMap(**mapping), summary, "a.mcap")
    return {source.role: source for source in sources}, summary


IMU = {"/imu": "sensor_msgs/msg/Imu"}


@pytest.mark.parametrize(
    "type_name",
    [
        "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/TransformStamped", "foxglove.PoseInFrame", "foxglove.FrameTransform",
    ],
)  # fmt: skip
def test_every_pose_has_four_numbers_and_three(type_name: str) -> None:
    found, _ = chosen(IMU | {"/p": type_name})
    wants = found["vps"].decoders[2]._wants  # type: ignore[attr-defined]
    assert {name: want.width for name, want in wants.items()} == {"orientation": 4, "position": 3}


def test_every_sensor_has_three_numbers_and_every_other_value_one() -> None:
    topics = {
        "/raw": "fieldcal_msgs/msg/RawImu", "/mag": "sensor_msgs/msg/MagneticField",
        "/temperature": "sensor_msgs/msg/Temperature", "/bat": "sensor_msgs/msg/BatteryState",
        "/fix": "sensor_msgs/msg/NavSatFix",
    }  # fmt: skip
    three = {"gyroscope", "accelerometer", "magnetometer"}
    for topics_of_imu in (topics, topics | IMU):
        found, _ = chosen({t: n for t, n in topics_of_imu.items() if t != "/raw" or topics_of_imu is topics})
        for source in found.values():
            for decoder in source.decoders.values():
                wants = decoder._wants  # type: ignore[attr-defined]
                assert {name: want.width for name, want in wants.items()} == {n: 3 if n in three else 1 for n in wants}
        assert {"imu", "magnetometer", "temperature", "power", "position"} <= found.keys()


def test_configured_fields_have_three_numbers_and_the_temperature_one() -> None:
    found, _ = chosen({"/my": "my/Thing"}, imu="/my", imu_fields={"gyroscope": "w", "temperature": "t"})
    wants = found["imu"].decoders[1]._wants  # type: ignore[attr-defined]
    assert {name: want.width for name, want in wants.items()} == {"gyroscope": 3, "temperature": 1}


def test_types_go_before_hints_and_hints_before_the_alphabet() -> None:
    found, summary = chosen(IMU | {"/a/vicon": "nav_msgs/msg/Odometry", "/z": "geometry_msgs/msg/PoseStamped"})
    assert found["vps"].topic == "/z"
    assert [(f.code, f.count) for f in summary.findings] == [("ambiguous_topic", 2)]
    found, _ = chosen(IMU | {"/a": "nav_msgs/msg/Odometry", "/z/Vicon": "nav_msgs/msg/Odometry"})
    assert found["vps"].topic == "/z/Vicon"
    pose = "geometry_msgs/msg/PoseStamped"
    found, _ = chosen(IMU | {"/mavros/local_position/pose": pose, "/z": pose})
    assert found["vps"].topic == "/z"  # the other is the vehicle's own estimate
    found, summary = chosen(IMU | {"/a": "nav_msgs/msg/Odometry"})
    assert (found["vps"].topic, summary.findings) == ("/a", [])


def test_refusals_list_twenty_topics_and_thirty_fields() -> None:
    topics = {f"/t{i:02}": "my/Thing" for i in range(21)}
    with pytest.raises(UnreadableLog) as refused:
        chosen(topics, imu="/none")
    assert refused.value.reason_code == "missing_topic"
    assert "/t19 (my/Thing)." in refused.value.sentence
    assert "/t20" not in refused.value.sentence
    fields = "\n".join(f"float64 f{i:02}" for i in range(31))
    known = definitions({"/a": "cdr/Many"}, fields)
    mapping = McapMap(imu="/a", imu_fields={"gyroscope": "w"})
    with pytest.raises(UnreadableLog) as refused:
        choose_sources(known, mapping, LogSummary("mcap"), "a.mcap")
    assert refused.value.reason_code == "missing_field"
    assert "f29. " in refused.value.sentence
    assert "f30" not in refused.value.sentence


@pytest.mark.parametrize(
    ("topic", "type_name"),
    [
        ("/ublox/fix_velocity", "geometry_msgs/msg/TwistWithCovarianceStamped"),
        ("/mavros/global_position/raw/gps_vel", "geometry_msgs/msg/TwistStamped"),
    ],
)
def test_a_twist_is_a_receivers_velocity_by_its_name_alone(topic: str, type_name: str) -> None:
    assert chosen(IMU | {topic: type_name})[0]["gnss_velocity"].topic == topic
    assert "gnss_velocity" not in chosen(IMU | {"/cmd_vel": type_name})[0]
    assert chosen(IMU | {"/vel": type_name}, gnss_velocity="/vel")[0]["gnss_velocity"].topic == "/vel"
