"""The topic that plays a role in a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fieldcal.logs.encodings.decoded import Decoder
from fieldcal.logs.encodings.protobuf_messages import ProtobufDecoder


@dataclass(frozen=True)
class Source:
    """The topic that plays a role: its channels by id, message type, and which values it gives.

    The role "frames" gives none: of the topic's transforms only the frames are of interest. `further`: it is of a unit
    beside the primary one that plays the role.
    """

    role: str
    topic: str
    type_name: str
    decoders: Mapping[int, Decoder]
    values: tuple[str, ...]
    further: bool = False

    @property
    def may_be_packed(self) -> bool:
        """Whether a payload that begins as a zstd frame does must be one: only a protobuf message can begin so too."""
        return not any(isinstance(decoder, ProtobufDecoder) for decoder in self.decoders.values())
