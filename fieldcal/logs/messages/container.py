"""What a file of messages hands over, whatever its format: definitions of topics, blocks of messages, what was lost."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.definitions import Definitions


@dataclass(frozen=True)
class Block:
    """n messages to be decoded together, in file order.

    `starts`, `sizes`: the places of their payloads in the bytes `data`, within its bounds; `channels`: their channel
    ids; `log_time_ns`: when the recorder got them. All int64 (n,). `verified`: `data` was under a checksum that held.
    """

    data: NDArray[np.uint8]
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    channels: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]
    verified: bool = False

    def of(self, which: NDArray[np.bool_]) -> Block:
        """Some of the messages."""
        places = self.starts[which], self.sizes[which], self.channels[which], self.log_time_ns[which]
        return Block(self.data, *places, self.verified)


class Container(Protocol):
    """A recording of messages, open for one pass.

    `definitions` is complete before the pass; `counts` are messages by channel id as the recording itself says, None
    where it does not; `metadata` are named maps of texts, complete after the pass.
    """

    @property
    def definitions(self) -> Definitions: ...
    @property
    def counts(self) -> Mapping[int, int] | None: ...
    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]: ...

    def blocks(self, channels: Collection[int]) -> Iterator[Block]:
        """The messages of `channels`, and perhaps of others."""
        ...

    def report(self, summary: LogSummary) -> None:
        """After the pass: findings on what was lost, and whether the log is verifiable."""
        ...
