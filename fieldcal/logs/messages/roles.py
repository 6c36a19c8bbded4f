"""Which topic of a log is what: the inertial unit, the magnetometer, the VPS, temperature, current, position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from fieldcal.config.configuration import McapMap
from fieldcal.config.values import Paths
from fieldcal.errors import UnreadableLog
from fieldcal.logs.encodings.decoded import Decoder, MissingField, UnsupportedSchema, Want
from fieldcal.logs.encodings.json_messages import JsonDecoder
from fieldcal.logs.encodings.protobuf_messages import ProtobufDecoder
from fieldcal.logs.encodings.ros2_cdr import CdrDecoder, Ros1Decoder
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.joining import INERTIAL
from fieldcal.logs.messages.definitions import Channel, Definitions, Schema
from fieldcal.logs.messages.source import Source
from fieldcal.logs.messages.topics import imu_halves, is_estimate, tell_of_estimate, type_name_of
from fieldcal.logs.messages.transforms import frames_of_transforms, transform_source
from fieldcal.reason_codes import ReasonCode

RAW_IMU = "fieldcal_msgs/RawImu"
METADATA_NAME = "fieldcal"

_POSITION = {
    "latitude_deg": Want.of("latitude", 1),
    "longitude_deg": Want.of("longitude", 1),
    "altitude_m": Want.of("altitude", 1),
}
_POSE = {"orientation": Want.of("pose.orientation", 4), "position": Want.of("pose.position", 3)}
_NESTED_POSE = {"orientation": Want.of("pose.pose.orientation", 4), "position": Want.of("pose.pose.position", 3)}
_TRANSFORM = {"orientation": Want.of("transform.rotation", 4), "position": Want.of("transform.translation", 3)}
_FLAT_TRANSFORM = {"orientation": Want.of("rotation", 4), "position": Want.of("translation", 3)}

KNOWN_TYPES: Mapping[str, Mapping[str, Mapping[str, Want]]] = {
    "imu": {
        "sensor_msgs/Imu": {
            "gyroscope": Want.of("angular_velocity", 3),
            "accelerometer": Want.of("linear_acceleration", 3),
        },
        RAW_IMU: {
            "gyroscope": Want.of("gyro", 3),
            "accelerometer": Want.of("accel", 3),
            "magnetometer": Want.of("mag", 3),
            "temperature": Want.of("temperature", 1),
        },
    },
    "magnetometer": {"sensor_msgs/MagneticField": {"magnetometer": Want.of("magnetic_field", 3)}},
    "temperature": {"sensor_msgs/Temperature": {"temperature": Want.of("temperature", 1)}},
    "power": {"sensor_msgs/BatteryState": {"current": Want.of("current", 1)}},
    "position": {"sensor_msgs/NavSatFix": _POSITION, "foxglove/LocationFix": _POSITION},
    "gnss_velocity": {
        "geometry_msgs/TwistWithCovarianceStamped": {
            "velocity": Want.of("twist.twist.linear", 3),
            "covariance": Want.of("twist.covariance", 36),
        },
        "geometry_msgs/TwistStamped": {"velocity": Want.of("twist.linear", 3)},
    },
    "vps": {
        "geometry_msgs/PoseStamped": _POSE,
        "geometry_msgs/PoseWithCovarianceStamped": _NESTED_POSE,
        "nav_msgs/Odometry": _NESTED_POSE,
        "geometry_msgs/TransformStamped": _TRANSFORM,
        "foxglove/PoseInFrame": _POSE,
        "foxglove/FrameTransform": _FLAT_TRANSFORM,
    },
}
"""Role -> message type -> its fields; among types, the first is preferred."""

SI_TYPES = ("sensor_msgs/Imu", "sensor_msgs/MagneticField")
FEW_SHARE = 0.01
"""Topics with fewer than this share of the messages of the busiest one that could play a role are commands."""
OPTIONAL = ("magnetometer", "temperature", "power", "position", "gnss_velocity", "vps")
"""Roles that a flight may lack although they are configured."""
_HINTS = {"imu": ("raw",), "magnetometer": ("raw",), "vps": ("vps", "mocap", "vrpn", "optitrack", "vicon")}
_REQUIRED_HINTS = {"gnss_velocity": ("fix_vel", "gnss", "gps", "ublox", "navsat")}
"""Roles that no message type tells: a twist may be a command, or a wheel's."""


def choose_sources(
    definitions: Definitions,
    mapping: McapMap,
    summary: LogSummary,
    log_name: str,
    counts: Mapping[int, int] | None = None,
) -> list[Source]:
    """The sources of every role that the file can fill.

    Parameters
    ----------
    definitions : Definitions
        Schemas and channels of the file.
    mapping : McapMap
        Configured topics (`imu`, `magnetometer`, `vps`, `temperature`, `power`, `position`, `gnss_velocity`) and
        `imu_fields`.
    summary : LogSummary
        Receives findings.
    log_name : str
        For sentences.
    counts : mapping, optional
        Channel id → messages, where the file says.

    Raises
    ------
    UnreadableLog
        `missing_topic`, `missing_field`, `unsupported_schema` for a configured IMU; `missing_sensor` when the file
        has no inertial or magnetic sensor.
    """
    sources: list[Source] = []
    fields = mapping.imu_fields or {}
    for role in KNOWN_TYPES:
        configured = getattr(mapping, role)
        if not configured and role == "imu" and not fields and (halves := imu_halves(definitions)):
            sources += [_half(sensor, topic, definitions) for sensor, topic in zip(INERTIAL, halves, strict=True)]
            continue
        if role == "vps" and (transforms := transform_source(definitions, mapping, summary, log_name)):
            sources.append(transforms)
            continue
        if not configured:
            source = _by_type(role, fields, definitions, summary, log_name, counts or {})
            sources += [source] if source else []
            continue
        try:
            sources.append(_configured(role, configured, fields, definitions, log_name))
        except UnreadableLog as error:
            if role not in OPTIONAL:
                raise
            summary.add(error.reason_code, 1, f"{error.sentence} The log is read without its {role}.")
    sources += _further(mapping.further, fields, definitions, summary, log_name)
    vps = next((source.topic for source in sources if source.role == "vps"), None)
    if vps is not None and not mapping.vps and tell_of_estimate(vps, summary, log_name):
        sources = [source for source in sources if source.role != "vps"]
    if not any(source.role in ("vps", "frames") for source in sources):
        sources += frames_of_transforms(definitions)
    given = {value for source in sources for value in source.values}
    if not given & {"gyroscope", "accelerometer", "magnetometer"}:
        raise UnreadableLog(
            ReasonCode.MISSING_SENSOR,
            f"{log_name} holds no gyroscope, accelerometer or magnetometer messages that are known; its topics "
            f"are {_topics(definitions)}. Name them under mcap.imu and mcap.imu_fields in the configuration.",
        )
    return sources


def _further(
    topics: Sequence[str], fields: Mapping[str, Paths], definitions: Definitions, summary: LogSummary, log_name: str
) -> list[Source]:
    """The sources of further units: each topic an IMU or a magnetometer, as its message type says."""
    found = []
    for topic in topics:
        channels = definitions.by_topic().get(topic)
        type_name = type_name_of(channels[0], definitions) if channels else ""
        role = "magnetometer" if type_name in KNOWN_TYPES["magnetometer"] else "imu"
        try:
            source = _configured(role, topic, fields, definitions, log_name)
        except UnreadableLog as error:
            summary.add(
                error.reason_code,
                1,
                error.sentence.replace(f"mcap.{role}", "mcap.further") + " The log is read without this unit.",
            )
            continue
        found.append(replace(source, further=True))
    return found


def _configured(role: str, topic: str, fields: Mapping[str, Paths], definitions: Definitions, log_name: str) -> Source:
    channels = definitions.by_topic().get(topic)
    if not channels:
        raise UnreadableLog(
            ReasonCode.MISSING_TOPIC,
            f"{log_name} has no topic {topic}, which the configuration gives as mcap.{role}; its topics are "
            f"{_topics(definitions)}. Correct mcap.{role}.",
        )
    type_name = type_name_of(channels[0], definitions)
    wants = _wants(role, type_name, fields)
    if wants is None:
        raise UnreadableLog(
            ReasonCode.UNSUPPORTED_SCHEMA,
            f"{log_name}: topic {topic} carries {type_name}, which is not a known type for mcap.{role}"
            + (". Name its fields in mcap.imu_fields." if role == "imu" else "."),
        )
    try:
        decoders = _decoders(channels, definitions, wants)
    except MissingField as error:
        listed = ", ".join(error.available[:30])
        raise UnreadableLog(
            ReasonCode.MISSING_FIELD,
            f"{log_name}: {type_name} on {topic} has no field {error.path} of the needed size; it has {listed}. "
            "Correct mcap.imu_fields.",
        ) from error
    except UnsupportedSchema as error:
        raise UnreadableLog(
            ReasonCode.UNSUPPORTED_SCHEMA, f"{log_name}: topic {topic} cannot be decoded. {error}."
        ) from error
    return Source(role, topic, type_name, decoders, tuple(wants))


def _by_type(
    role: str,
    fields: Mapping[str, Paths],
    definitions: Definitions,
    summary: LogSummary,
    log_name: str,
    counts: Mapping[int, int],
) -> Source | None:
    """The source of a role that nothing configures: by message type, then hints in the topic's name, then the name.

    Topics with hardly any messages, and of poses the vehicle's own estimates, come last.
    """
    candidates: dict[str, Source] = {}
    ranks: dict[str, tuple[bool, int, bool, str]] = {}
    messages: dict[str, int] = {}
    order = [*KNOWN_TYPES[role]]
    for topic, channels in sorted(definitions.by_topic().items()):
        type_name = type_name_of(channels[0], definitions)
        wants = _wants(role, type_name, fields)
        needed = _REQUIRED_HINTS.get(role)
        if wants is None or (needed is not None and not any(hint in topic.lower() for hint in needed)):
            continue
        try:
            decoders = _decoders(channels, definitions, wants)
        except (MissingField, UnsupportedSchema) as error:
            if type_name in order:
                summary.add(
                    ReasonCode.UNSUPPORTED_SCHEMA, 1, f"{log_name}: topic {topic} ({type_name}) is not read: {error}."
                )
            continue
        hinted = any(hint in topic.lower() for hint in _HINTS.get(role, ()))
        rank = order.index(type_name) if type_name in order else -1
        messages[topic] = sum(counts.get(channel.channel_id, 0) for channel in channels)
        ranks[topic] = (role == "vps" and is_estimate(topic), rank, not hinted, topic)
        candidates[topic] = Source(role, topic, type_name, decoders, tuple(wants))
    if not candidates:
        return None
    busiest = max(messages.values())
    chosen = min(candidates, key=lambda topic: (messages[topic] < FEW_SHARE * busiest, *ranks[topic]))
    if len(candidates) > 1:
        summary.add(
            ReasonCode.AMBIGUOUS_TOPIC,
            len(candidates),
            f"{log_name}: {', '.join(candidates)} could all be the {role}; {chosen} is used. Name one as mcap.{role}.",
        )
    return candidates[chosen]


def _half(sensor: str, topic: str, definitions: Definitions) -> Source:
    """One sensor of an IMU that has a topic for each."""
    channels = definitions.by_topic()[topic]
    type_name = type_name_of(channels[0], definitions)
    wants = {sensor: KNOWN_TYPES["imu"][type_name][sensor]}
    return Source(sensor, topic, type_name, _decoders(channels, definitions, wants), (sensor,))


def _wants(role: str, type_name: str, fields: Mapping[str, Paths]) -> Mapping[str, Want] | None:
    known = KNOWN_TYPES[role].get(type_name)
    custom_allowed = not any(type_name in types for types in KNOWN_TYPES.values()) or type_name == RAW_IMU
    if role == "imu" and fields and custom_allowed:
        return {name: Want.of(path, 1 if name == "temperature" else 3) for name, path in fields.items()}
    return known


def _decoders(channels: Sequence[Channel], definitions: Definitions, wants: Mapping[str, Want]) -> dict[int, Decoder]:
    """Channel id → decoder; channels of one schema and encoding share theirs."""
    shared: dict[tuple[int, str], Decoder] = {}
    for channel in channels:
        kind = channel.schema_id, channel.message_encoding
        if kind not in shared:
            shared[kind] = _decoder(channel, definitions, wants)
    return {channel.channel_id: shared[channel.schema_id, channel.message_encoding] for channel in channels}


def _decoder(channel: Channel, definitions: Definitions, wants: Mapping[str, Want]) -> Decoder:
    schema = definitions.schemas.get(channel.schema_id, Schema(0, "", "", b""))
    if channel.message_encoding == "cdr":
        text = schema.data.decode("utf-8", "replace") if schema.encoding == "ros2msg" else ""
        return CdrDecoder(schema.name, text, wants)
    if channel.message_encoding == "ros1" and schema.encoding == "ros1msg":
        return Ros1Decoder(schema.name, schema.data.decode("utf-8", "replace"), wants)
    if channel.message_encoding == "json":
        return JsonDecoder(wants)
    if channel.message_encoding == "protobuf" and schema.encoding == "protobuf":
        return ProtobufDecoder(schema.name, schema.data, wants)
    raise UnsupportedSchema(f"message encoding {channel.message_encoding!r} with schema encoding {schema.encoding!r}")


def _topics(definitions: Definitions) -> str:
    listed = sorted(
        f"{channel.topic} ({type_name_of(channel, definitions)})" for channel in definitions.channels.values()
    )
    return ", ".join(listed[:20]) if listed else "none"
