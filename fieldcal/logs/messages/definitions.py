"""Channels of messages and the schemas of what they carry, as a log defines them."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Schema:
    """How the messages of some channels are laid out."""

    schema_id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """One stream of messages. `schema_id` 0: no schema."""

    channel_id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: tuple[tuple[str, str], ...]


@dataclass
class Definitions:
    """Schemas and channels by id. A second, different definition of an id is kept in `redefined` and not adopted."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    redefined: dict[str, None] = field(default_factory=dict)

    def add(self, definition: Schema | Channel) -> None:
        """Take a definition, identical repetitions included."""
        if isinstance(definition, Schema):
            known: Schema | Channel = self.schemas.setdefault(definition.schema_id, definition)
            what = f"schema {definition.schema_id} ({definition.name})"
        else:
            known = self.channels.setdefault(definition.channel_id, definition)
            what = f"channel {definition.channel_id} ({definition.topic})"
        if known != definition:
            self.redefined[what] = None

    def by_topic(self) -> dict[str, list[Channel]]:
        """Topic → its channels."""
        topics: dict[str, list[Channel]] = {}
        for channel in self.channels.values():
            topics.setdefault(channel.topic, []).append(channel)
        return topics
