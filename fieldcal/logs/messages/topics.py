"""What the topics of a log say beyond their types: halves of an IMU, estimates that are no reference."""

from __future__ import annotations

from fieldcal.logs.encodings.ros2_definitions import short_name
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.definitions import Channel, Definitions
from fieldcal.reason_codes import ReasonCode

IMU = "sensor_msgs/Imu"
ESTIMATES = ("local_position", "global_position", "ekf", "estimat", "filtered", "fused", "robot_pose", "localization")
"""What stands in the names of topics that carry an autopilot's own estimate: it has seen the IMU already."""


def tell_of_estimate(vps: str, summary: LogSummary, log_name: str) -> bool:
    """Whether the topic `vps`, which nothing configures, carries an estimate of the vehicle's own; it is told."""
    if is_estimate(vps):
        summary.add(
            ReasonCode.VPS_IS_ESTIMATE,
            1,
            f"{log_name}: {vps} is the only pose, but looks like the vehicle's own estimate, which has seen the IMU "
            "already: agreement with it proves nothing, and it is not used as VPS. If it is a reference, name it as "
            "mcap.vps.",
        )
        return True
    return False


def is_estimate(topic: str) -> bool:
    """Whether a topic's name is that of an autopilot's own estimate."""
    return any(word in topic.lower() for word in ESTIMATES)


def imu_halves(definitions: Definitions) -> tuple[str, str] | None:
    """Topics of gyroscope and accelerometer where these two, so named, are the only ones of type sensor_msgs/Imu.

    Drivers of cameras publish each sensor in a message of an IMU whose other half is zero.
    """
    topics = [t for t, channels in definitions.by_topic().items() if type_name_of(channels[0], definitions) == IMU]
    gyroscopes = [topic for topic in topics if "gyro" in topic.lower() and "acc" not in topic.lower()]
    accelerometers = [topic for topic in topics if "acc" in topic.lower() and "gyro" not in topic.lower()]
    if len(topics) == 2 and len(gyroscopes) == len(accelerometers) == 1:
        return gyroscopes[0], accelerometers[0]
    return None


def type_name_of(channel: Channel, definitions: Definitions) -> str:
    """Message type of a channel in its short form, empty where it has no schema."""
    schema = definitions.schemas.get(channel.schema_id)
    return short_name(schema.name) if schema else ""
