"""The VPS where a log has it among the transforms of many frames in one topic: `/tf`."""

from __future__ import annotations

from collections.abc import Sequence

from fieldcal.config.configuration import McapMap
from fieldcal.logs.encodings.transforms import TransformDecoder
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.definitions import Channel, Definitions
from fieldcal.logs.messages.source import Source
from fieldcal.logs.messages.topics import type_name_of
from fieldcal.reason_codes import ReasonCode

TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
STATIC = "static"
"""What stands in the name of topics of transforms that never change."""
ENCODINGS = ("cdr", "ros1")
FRAMES_TOLD = 10


def transform_source(definitions: Definitions, mapping: McapMap, summary: LogSummary, log_name: str) -> Source | None:
    """The transforms that are the VPS by the configuration: those of `mapping.vps_frame`, or of the topic
    `mapping.vps` where that carries transforms. None: the VPS is to be found elsewhere."""
    topics = _topics(definitions)
    if mapping.vps:
        topics = {topic: channels for topic, channels in topics.items() if topic == mapping.vps}
        if not topics:
            return None
    elif not mapping.vps_frame:
        return None
    if not topics:
        summary.add(
            ReasonCode.MISSING_TOPIC,
            1,
            f"{log_name} has no topic of transforms (tf2_msgs/TFMessage), among which mcap.vps_frame names the "
            f"vehicle's frame {mapping.vps_frame}. Correct or remove mcap.vps_frame.",
        )
        return None
    topic = min(topics, key=lambda topic: (topic.strip("/") != "tf", topic))
    if len(topics) > 1:
        summary.add(
            ReasonCode.AMBIGUOUS_TOPIC,
            len(topics),
            f"{log_name}: {', '.join(topics)} all carry transforms; {topic} is used. Name one as mcap.vps.",
        )
    role = "vps" if mapping.vps_frame else "frames"
    return _source(role, topic, topics[topic], definitions, mapping.vps_frame, mapping.vps_parent_frame)


def frames_of_transforms(definitions: Definitions) -> list[Source]:
    """Sources that find out which frames a log without a VPS has transforms of."""
    return [
        _source("frames", topic, channels, definitions, None, None) for topic, channels in _topics(definitions).items()
    ]


def tell_of_transforms(sources: Sequence[Source], summary: LogSummary, log_name: str) -> None:
    """After the pass: findings where transforms were not read, or not those that are configured."""
    for source in sources:
        decoder = next(iter(source.decoders.values()))
        if not isinstance(decoder, TransformDecoder):
            continue
        frames = [f"{parent} → {child}" for (parent, child), _ in decoder.seen.most_common()]
        listed = ", ".join(frames[:FRAMES_TOLD]) + (", …" if len(frames) > FRAMES_TOLD else "")
        if source.role == "frames":
            summary.add(
                ReasonCode.UNSUPPORTED_SCHEMA,
                1,
                f"{log_name}: there is no VPS; the transforms on {source.topic} ({source.type_name}: "
                f"{listed or 'none'}) are not read. If the vehicle's pose is among them, name its frame, the second of "
                "a pair, as mcap.vps_frame.",
            )
            continue
        used = decoder.seen[decoder.parent or "", decoder.frame or ""]
        others = {pair: count for pair, count in decoder.seen.items() if pair[1] == decoder.frame}
        if not used:
            summary.add(
                ReasonCode.MISSING_TOPIC,
                1,
                f"{log_name} has no transform of {decoder.parent or 'any frame'} → {decoder.frame} on {source.topic}, "
                f"which mcap.vps_frame asks for; it has {listed or 'none'}. Correct mcap.vps_frame. The log is read "
                "without its vps.",
            )
        elif len(others) > 1:
            summary.add(
                ReasonCode.AMBIGUOUS_TOPIC,
                sum(others.values()) - used,
                f"{log_name}: {decoder.frame} is given in several frames on {source.topic}: "
                f"{', '.join(parent for parent, _ in others)}; {decoder.parent} is used, "
                f"{sum(others.values()) - used} transforms in others are left out. Name one as mcap.vps_parent_frame.",
            )


def _topics(definitions: Definitions) -> dict[str, list[Channel]]:
    """Topics of transforms that change, with their channels."""
    return {
        topic: channels
        for topic, channels in sorted(definitions.by_topic().items())
        if type_name_of(channels[0], definitions) in TRANSFORM_TYPES
        and STATIC not in topic.lower()
        and all(channel.message_encoding in ENCODINGS for channel in channels)
    }


def _source(
    role: str, topic: str, channels: Sequence[Channel], definitions: Definitions, frame: str | None, parent: str | None
) -> Source:
    decoder = TransformDecoder(frame, parent, ros1=channels[0].message_encoding == "ros1")
    values = ("orientation", "position") if role == "vps" else ()
    decoders = {channel.channel_id: decoder for channel in channels}
    return Source(role, topic, type_name_of(channels[0], definitions), decoders, values)
