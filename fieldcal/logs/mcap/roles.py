"""Which topic of an MCAP file is what: the inertial unit, the magnetometer, the VPS, temperature, current, position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldcal.config.configuration import McapMap
from fieldcal.config.values import Paths
from fieldcal.errors import UnreadableLog
from fieldcal.logs.encodings.decoded import Decoder, MissingField, UnsupportedSchema, Want
from fieldcal.logs.encodings.json_messages import JsonDecoder
from fieldcal.logs.encodings.protobuf_messages import ProtobufDecoder
from fieldcal.logs.encodings.ros2_cdr import CdrDecoder
from fieldcal.logs.encodings.ros2_definitions import short_name
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap.records import Channel, Schema
from fieldcal.logs.mcap.report import Definitions
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
_HINTS = {"imu": ("raw",), "magnetometer": ("raw",), "vps": ("vps", "mocap", "vrpn", "optitrack", "vicon")}


@dataclass(frozen=True)
class Source:
    """The topic that plays a role: its channels by id, message type, and which values it gives."""

    role: str
    topic: str
    type_name: str
    decoders: Mapping[int, Decoder]
    values: tuple[str, ...]


def choose_sources(definitions: Definitions, mapping: McapMap, summary: LogSummary, log_name: str) -> list[Source]:
    """The sources of every role that the file can fill.

    Parameters
    ----------
    definitions : Definitions
        Schemas and channels of the file.
    mapping : McapMap
        Configured topics (`imu`, `magnetometer`, `vps`, `temperature`, `power`, `position`) and `imu_fields`.
    summary : LogSummary
        Receives findings.
    log_name : str
        For sentences.

    Raises
    ------
    UnreadableLog
        `missing_topic`, `missing_field`, `unsupported_schema` for what is configured; `missing_sensor` when the file
        has no inertial or magnetic sensor.
    """
    sources = []
    fields = mapping.imu_fields or {}
    for role in KNOWN_TYPES:
        configured = getattr(mapping, role)
        if configured:
            sources.append(_configured(role, configured, fields, definitions, log_name))
        else:
            source = _by_type(role, fields, definitions, summary, log_name)
            sources += [source] if source else []
    given = {value for source in sources for value in source.values}
    if not given & {"gyroscope", "accelerometer", "magnetometer"}:
        raise UnreadableLog(
            ReasonCode.MISSING_SENSOR,
            f"{log_name} holds no gyroscope, accelerometer or magnetometer messages that are known; its topics "
            f"are {_topics(definitions)}. Name them under mcap.imu and mcap.imu_fields in the configuration.",
        )
    return sources


def _configured(role: str, topic: str, fields: Mapping[str, Paths], definitions: Definitions, log_name: str) -> Source:
    channels = definitions.by_topic().get(topic)
    if not channels:
        raise UnreadableLog(
            ReasonCode.MISSING_TOPIC,
            f"{log_name} has no topic {topic}, which the configuration gives as mcap.{role}; its topics are "
            f"{_topics(definitions)}. Correct mcap.{role}.",
        )
    type_name = _type_name(channels[0], definitions)
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
    role: str, fields: Mapping[str, Paths], definitions: Definitions, summary: LogSummary, log_name: str
) -> Source | None:
    """The source of a role that nothing configures: by message type, then hints in the topic's name, then the name."""
    candidates: dict[str, Source] = {}
    ranks: dict[str, tuple[int, bool, str]] = {}
    order = [*KNOWN_TYPES[role]]
    for topic, channels in sorted(definitions.by_topic().items()):
        type_name = _type_name(channels[0], definitions)
        wants = _wants(role, type_name, fields)
        if wants is None:
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
        ranks[topic] = (order.index(type_name) if type_name in order else -1, not hinted, topic)
        candidates[topic] = Source(role, topic, type_name, decoders, tuple(wants))
    if not candidates:
        return None
    chosen = min(candidates, key=lambda topic: ranks[topic])
    if len(candidates) > 1:
        summary.add(
            ReasonCode.AMBIGUOUS_TOPIC,
            len(candidates),
            f"{log_name}: {', '.join(candidates)} could all be the {role}; {chosen} is used. Name one as mcap.{role}.",
        )
    return candidates[chosen]


def _wants(role: str, type_name: str, fields: Mapping[str, Paths]) -> Mapping[str, Want] | None:
    known = KNOWN_TYPES[role].get(type_name)
    custom_allowed = not any(type_name in types for types in KNOWN_TYPES.values()) or type_name == RAW_IMU
    if role == "imu" and fields and custom_allowed:
        return {name: Want.of(path, 1 if name == "temperature" else 3) for name, path in fields.items()}
    return known


def _type_name(channel: Channel, definitions: Definitions) -> str:
    schema = definitions.schemas.get(channel.schema_id)
    return short_name(schema.name) if schema else ""


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
    if channel.message_encoding == "json":
        return JsonDecoder(wants)
    if channel.message_encoding == "protobuf" and schema.encoding == "protobuf":
        return ProtobufDecoder(schema.name, schema.data, wants)
    raise UnsupportedSchema(f"message encoding {channel.message_encoding!r} with schema encoding {schema.encoding!r}")


def _topics(definitions: Definitions) -> str:
    listed = sorted(
        f"{channel.topic} ({_type_name(channel, definitions)})" for channel in definitions.channels.values()
    )
    return ", ".join(listed[:20]) if listed else "none"
