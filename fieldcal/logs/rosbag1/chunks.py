"""A chunk of a ROS 1 bag: its content within what unpacking may cost, and where the next one is behind damage."""

from __future__ import annotations

import bz2
from mmap import mmap

from fieldcal.logs.mcap.chunks import CHUNK_CAP_BYTES, TOTAL_CAP_BYTES, TOTAL_CAP_RATIO, unpack_lz4
from fieldcal.logs.rosbag1.records import CHUNK, OPCODES, Buffer, Damage, Record, read_record

_OPCODE_FIELD = b"\x04\0\0\0op="
_FARTHEST_FIELD = 64
"""Bytes of a chunk's header before the field that says what it is."""


class ChunkOpener:
    """Opens chunks; those that grow beyond their ratio draw on what all together may cost."""

    def __init__(self, buffer: Buffer) -> None:
        self._buffer = buffer
        self._budget = TOTAL_CAP_BYTES

    def open(self, record: Record, limit: int) -> bytes | memoryview:
        """The content of a chunk that ends by `limit`; of an uncompressed one that does not, what is there.

        Raises Damage.
        """
        size = record.number(b"size")
        compression = record.value(b"compression").decode("utf-8", "replace")
        packed = memoryview(self._buffer)[record.data : min(record.end, limit)]
        if compression == "none":
            if size != record.end - record.data and record.data + size <= limit:
                raise Damage(f"the chunk has {record.end - record.data} bytes where {size} are declared")
            if len(packed) > CHUNK_CAP_BYTES:
                raise Damage(f"the chunk has {len(packed)} bytes, the cap is {CHUNK_CAP_BYTES}")
            return packed
        if record.end > limit:
            raise Damage(f"the chunk announces {record.end - record.data} bytes, {len(packed)} are left")
        if size > CHUNK_CAP_BYTES:
            raise Damage(f"the chunk declares {size} bytes, the cap is {CHUNK_CAP_BYTES}")
        if size > TOTAL_CAP_RATIO * len(packed):
            if size > self._budget:
                raise Damage(f"unpacking over {TOTAL_CAP_BYTES} bytes from chunks that grow so much is refused")
            self._budget -= size
        content = _unpacked(packed, compression, size)
        if len(content) != size:
            raise Damage(f"{len(content)} uncompressed bytes where {size} are declared")
        return content


def next_chunk(buffer: bytes | mmap, position: int, limit: int) -> int | None:
    """Where the next record of a chunk begins at or behind `position`."""
    field = _OPCODE_FIELD + bytes([CHUNK])
    found = buffer.find(field, position, limit)
    while found >= 0:
        for start in range(found - 4, max(position, found - _FARTHEST_FIELD) - 1, -1):
            if is_chunk(buffer, start, limit):
                return start
        found = buffer.find(field, found + 1, limit)
    return None


def is_chunk(buffer: Buffer, position: int, limit: int) -> bool:
    """Whether the whole record of a chunk begins there."""
    try:
        record = read_record(buffer, position, limit)
        return record.opcode == CHUNK and len(record.value(b"size")) == 4 and bool(record.value(b"compression"))
    except Damage:
        return False


def is_record(buffer: Buffer, position: int, limit: int) -> bool:
    """Whether a whole record begins there, or the file ends."""
    if position == limit:
        return True
    try:
        return read_record(buffer, position, limit).opcode in OPCODES
    except Damage:
        return False


def _unpacked(packed: memoryview, compression: str, size: int) -> bytes | memoryview:
    try:
        if compression == "lz4":
            return unpack_lz4(packed, size)
        if compression == "bz2":
            return bz2.BZ2Decompressor().decompress(packed, max_length=size + 1)
    except (OSError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise Damage(f"{compression} content does not decompress: {error}") from error
    raise Damage(f"compression {compression!r} is none of none, lz4, bz2")
