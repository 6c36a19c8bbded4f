"""Payloads that rosbag2 compressed one by one (its compression mode "message", zstd)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import zstandard
from numpy.typing import NDArray

from fieldcal.logs.encodings.gather import gather
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.container import Block
from fieldcal.reason_codes import ReasonCode

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""No CDR message begins so."""
MESSAGE_CAP_BYTES = 1 << 20
BLOCK_CAP_BYTES = 256 << 20


class PackedPayloads:
    """Unpacks them, and counts those that do not unpack."""

    def __init__(self) -> None:
        self._lost = 0
        self._why = ""
        self._decompressor = zstandard.ZstdDecompressor()

    def unpacked(self, block: Block) -> Block:
        """The block with every payload as it was before; messages that do not unpack are left out."""
        packed = _packed(block.data, block.starts, block.sizes)
        if not packed.any():
            return block
        parts: list[bytes] = []
        sound = np.ones(len(packed), bool)
        room = BLOCK_CAP_BYTES
        for number, (start, size) in enumerate(zip(block.starts.tolist(), block.sizes.tolist(), strict=True)):
            part = block.data[start : start + size].tobytes()
            if packed[number]:
                try:
                    part = self._unpack(part, min(room, MESSAGE_CAP_BYTES))
                except (zstandard.ZstdError, ValueError, MemoryError) as error:
                    self._lost += 1
                    self._why = self._why or str(error)
                    sound[number] = False
                    continue
                room -= len(part)
            parts.append(part)
        sizes = np.array([len(part) for part in parts], np.int64)
        data = np.frombuffer(b"".join(parts), np.uint8)
        return replace(block.of(sound), data=data, starts=np.cumsum(sizes) - sizes, sizes=sizes)

    def report(self, summary: LogSummary, log_name: str) -> None:
        """A finding on those that did not unpack."""
        if self._lost:
            summary.add(
                ReasonCode.PACKED_MESSAGES,
                self._lost,
                f"{log_name}: {self._lost} messages whose payloads are zstd-compressed one by one do not unpack "
                f"({self._why}) and were left out. Copy the log again from the recorder.",
                loses_data=True,
            )

    def _unpack(self, payload: bytes, cap: int) -> bytes:
        """The first frame of a payload. Raises ZstdError or ValueError."""
        size = zstandard.frame_content_size(payload)
        if size > cap:
            raise ValueError(f"a message declares {size} bytes, {cap} are allowed")
        return self._decompressor.decompress(payload, max_output_size=cap)


def _packed(data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which payloads begin as a zstd frame does."""
    packed = sizes >= len(ZSTD_MAGIC)
    packed[packed] = gather(data, starts[packed], np.dtype("<u4")) == int.from_bytes(ZSTD_MAGIC, "little")
    return packed
