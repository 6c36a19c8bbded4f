"""The records of an MCAP file, parsed with every length checked against the bytes that are there.

Layout of a record: opcode (1 byte), body length (8 bytes, little endian), body. Nothing here trusts a declared size.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from mmap import mmap

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.messages.definitions import Channel, Schema

Buffer = bytes | memoryview | mmap

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(8, 16)
FIRST_PRIVATE_OPCODE = 0x80

HEAD_BYTES = 9
MESSAGE_HEAD_BYTES = 22
FOOTER_BYTES = HEAD_BYTES + 20
DATA_END_BYTES = HEAD_BYTES + 4
COMPRESSIONS = ("", "lz4", "zstd")

_RECORD_HEAD = struct.Struct("<BQ")
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


class Damage(Exception):
    """Bytes that do not form the record they should."""


@dataclass(frozen=True)
class Record:
    """Place of one record: `start` of its opcode, `body` of its content, `end` just behind it (byte offsets)."""

    opcode: int
    start: int
    body: int
    end: int


@dataclass(frozen=True)
class ChunkHead:
    """What a chunk says of its content, which lies in the file from byte `start` to byte `end`."""

    message_start_time: int
    message_end_time: int
    uncompressed_size: int
    crc: int
    compression: str
    start: int
    end: int


@dataclass(frozen=True)
class Statistics:
    """The writer's own count of what it wrote."""

    message_count: int
    chunk_count: int
    channel_message_counts: dict[int, int]


class Fields:
    """Reads little-endian fields of `buffer` from `position`, never beyond `limit`. Raises Damage."""

    def __init__(self, buffer: Buffer, position: int, limit: int) -> None:
        self._buffer = buffer
        self.position = position
        self._limit = limit

    def take(self, size: int) -> bytes:
        """The next `size` bytes."""
        end = self.position + size
        if end > self._limit:
            raise Damage(f"{size} bytes announced at byte {self.position}, {self._limit - self.position} are left")
        piece = bytes(self._buffer[self.position : end])
        self.position = end
        return piece

    def number(self, size: int) -> int:
        """An unsigned integer of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """A string with a 4-byte length."""
        try:
            return self.take(self.number(4)).decode("utf-8")
        except UnicodeDecodeError as error:
            raise Damage(f"text that is not UTF-8 before byte {self.position}") from error

    def text_map(self) -> dict[str, str]:
        """Pairs of strings with a 4-byte total length."""
        inner = self.inner()
        pairs = {}
        while inner.left():
            key = inner.text()
            pairs[key] = inner.text()
        return pairs

    def inner(self) -> Fields:
        """A stretch with a 4-byte length."""
        size = self.number(4)
        start = self.position
        self.skip(size)
        return Fields(self._buffer, start, start + size)

    def skip(self, size: int) -> None:
        """Pass over `size` bytes without reading them."""
        if self.position + size > self._limit:
            raise Damage(f"{size} bytes announced at byte {self.position}, {self._limit - self.position} are left")
        self.position += size

    def left(self) -> int:
        """Bytes before the limit."""
        return self._limit - self.position


def read_record(buffer: Buffer, position: int, limit: int) -> Record:
    """The record at `position`. Raises Damage when its head or body does not end by `limit`."""
    if position + HEAD_BYTES > limit:
        raise Damage(f"a record begins at byte {position} and the data ends at {limit}")
    opcode, size = _RECORD_HEAD.unpack_from(buffer, position)
    body = position + HEAD_BYTES
    if opcode == 0 or size > limit - body:
        raise Damage(f"record {opcode:#04x} at byte {position} announces {size} bytes, {limit - body} are left")
    return Record(opcode, position, body, body + size)


def read_schema(fields: Fields) -> Schema:
    """A schema record's body."""
    schema_id, name, encoding = fields.number(2), fields.text(), fields.text()
    return Schema(schema_id, name, encoding, fields.take(fields.number(4)))


def read_channel(fields: Fields) -> Channel:
    """A channel record's body."""
    channel_id, schema_id = fields.number(2), fields.number(2)
    return Channel(channel_id, schema_id, fields.text(), fields.text(), tuple(sorted(fields.text_map().items())))


def read_chunk_head(fields: Fields) -> ChunkHead:
    """A chunk record's body up to its content, whose bytes are only located."""
    first, last, uncompressed_size, crc = fields.number(8), fields.number(8), fields.number(8), fields.number(4)
    compression = fields.text()
    if compression not in COMPRESSIONS:
        raise Damage(f"compression {compression!r} is none of lz4, zstd, none")
    size = fields.number(8)
    start = fields.position
    fields.skip(size)
    return ChunkHead(first, last, uncompressed_size, crc, compression, start, start + size)


def read_message_index(fields: Fields) -> tuple[int, NDArray[np.uint64]]:
    """A message index record's body: channel and the offsets of its messages in the chunk before it."""
    channel_id, size = fields.number(2), fields.number(4)
    if size % _INDEX_ENTRY.itemsize:
        raise Damage(f"a message index of {size} bytes holds no whole number of entries")
    offsets = np.frombuffer(fields.take(size), dtype=_INDEX_ENTRY)["offset"]
    _need_all_read(fields)
    return channel_id, offsets


def _need_all_read(fields: Fields) -> None:
    if fields.left():
        raise Damage(f"{fields.left()} bytes more than the record has fields")


def read_metadata(fields: Fields) -> tuple[str, dict[str, str]]:
    """A metadata record's body: name and pairs."""
    return fields.text(), fields.text_map()


def read_statistics(fields: Fields) -> Statistics:
    """A statistics record's body."""
    message_count = fields.number(8)
    fields.skip(2 + 4 + 4 + 4)
    chunk_count = fields.number(4)
    fields.skip(8 + 8)
    inner = fields.inner()
    counts = {}
    while inner.left():
        channel_id = inner.number(2)
        counts[channel_id] = inner.number(8)
    return Statistics(message_count, chunk_count, counts)


def _check_header(fields: Fields) -> None:
    fields.text()
    fields.text()
    _need_all_read(fields)


def _check_message(fields: Fields) -> None:
    fields.skip(MESSAGE_HEAD_BYTES)


def _check_attachment(fields: Fields) -> None:
    fields.skip(16)
    fields.text()
    fields.text()
    fields.skip(fields.number(8))
    fields.skip(4)
    _need_all_read(fields)


def _check_metadata(fields: Fields) -> None:
    read_metadata(fields)
    _need_all_read(fields)


def _check_exact(size: int) -> Callable[[Fields], None]:
    def check(fields: Fields) -> None:
        fields.skip(size)
        _need_all_read(fields)

    return check


_DATA_SECTION: dict[int, Callable[[Fields], object]] = {
    HEADER: _check_header,
    SCHEMA: read_schema,
    CHANNEL: read_channel,
    MESSAGE: _check_message,
    CHUNK: read_chunk_head,
    MESSAGE_INDEX: read_message_index,
    ATTACHMENT: _check_attachment,
    METADATA: _check_metadata,
    DATA_END: _check_exact(4),
    FOOTER: _check_exact(20),
}


def check_record(buffer: Buffer, record: Record) -> None:
    """Raise Damage unless the record may stand in a data section and its body has the shape of its opcode."""
    if record.opcode >= FIRST_PRIVATE_OPCODE:
        return
    check = _DATA_SECTION.get(record.opcode)
    if check is None:
        raise Damage(f"record {record.opcode:#04x} at byte {record.start} does not belong there")
    check(Fields(buffer, record.body, record.end))


def check_first_record(buffer: Buffer, head: ChunkHead) -> None:
    """Raise Damage unless an uncompressed chunk's content begins with a record that may stand in a chunk."""
    record = read_record(buffer, head.start, head.end)
    if record.opcode not in (SCHEMA, CHANNEL, MESSAGE) and record.opcode < FIRST_PRIVATE_OPCODE:
        raise Damage(f"record {record.opcode:#04x} does not belong into a chunk")
