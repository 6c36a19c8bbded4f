"""A chunk's content: decompressed within what it declares, checked against its CRC, its messages located."""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from fieldcal.logs.encodings.gather import gather
from fieldcal.logs.mcap.records import (
    HEAD_BYTES,
    MESSAGE,
    MESSAGE_HEAD_BYTES,
    Buffer,
    ChunkHead,
    Damage,
    Fields,
    Record,
    check_first_record,
    read_chunk_head,
    read_record,
)
from fieldcal.logs.mcap.report import Tally

CHUNK_CAP_BYTES = 256 << 20
"""Largest uncompressed chunk that is read; writers use about 1 MiB."""

TOTAL_CAP_BYTES = 512 << 20
TOTAL_CAP_RATIO = 64
"""A chunk may unpack to 64 times its own size (real logs: 2 to 15 times); all that go beyond, to 512 MiB together."""

ZSTD_WINDOW_CAP_BYTES = 128 << 20
OTHER_RECORDS_CAP = 100_000
_PIECE_BYTES = 1 << 20
_FED_BYTES = 1 << 16


@dataclass(frozen=True)
class Located:
    """Where the messages of a stretch of records begin (ascending), the other records, and damage that ended it."""

    starts: NDArray[np.int64]
    others: list[Record]
    damage: str | None


class ChunkOpener:
    """Opens the chunks of a file within what unpacking them may cost; that this was too much is said in the tally."""

    def __init__(self, buffer: Buffer, tally: Tally) -> None:
        self._buffer = buffer
        self._tally = tally
        self._budget = TOTAL_CAP_BYTES

    def open(self, start: int, limit: int, *, searching: bool = False) -> tuple[ChunkHead, bytes | memoryview] | str:
        """Head and content of the chunk at `start`, or why it cannot be read.

        Chunks read one behind the other cannot unpack to more than their ratio allows. Where chunks are searched for,
        false ones may overlap: each that fails draws on what all together may cost.
        """
        try:
            head = read_chunk_head(Fields(self._buffer, start + HEAD_BYTES, limit))
            size = head.uncompressed_size
            if size > CHUNK_CAP_BYTES:
                raise Damage(f"the chunk declares {size} bytes, the cap is {CHUNK_CAP_BYTES}")
            if searching and not head.compression:
                check_first_record(self._buffer, head)
            if searching or size > TOTAL_CAP_RATIO * (head.end - head.start):
                if size > self._budget:
                    return self._refused(searching)
                self._budget -= size
            content = decompress(self._buffer, head)
            if searching:
                self._budget += size
            return head, content
        except Damage as damage:
            return str(damage)

    def _refused(self, searching: bool) -> str:
        if not searching:
            return f"unpacking over {TOTAL_CAP_BYTES} bytes from chunks that grow over {TOTAL_CAP_RATIO} times refused"
        self._tally.stopped = f"searching over {TOTAL_CAP_BYTES} bytes behind damage for a chunk is refused"
        return self._tally.stopped


def decompress(buffer: Buffer, head: ChunkHead) -> bytes | memoryview:
    """The chunk's uncompressed records. Raises Damage when they are not exactly what the head declares.

    Memory stays within the declared size, which the caller has held against `CHUNK_CAP_BYTES`.
    """
    size = head.uncompressed_size
    packed = memoryview(buffer)[head.start : head.end]
    try:
        content: bytes | memoryview
        if head.compression == "zstd":
            content = _zstd(packed, size)
        elif head.compression == "lz4":
            content = unpack_lz4(packed, size)
        else:
            content = packed
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
        raise Damage(f"{head.compression} content does not decompress: {error}") from error
    if len(content) != size:
        raise Damage(f"{len(content)} uncompressed bytes where {size} are declared")
    if head.crc and zlib.crc32(content) != head.crc:
        raise Damage("the content's CRC does not match")
    return content


def _zstd(packed: memoryview, size: int) -> bytes | memoryview:
    decompressor = zstandard.ZstdDecompressor(max_window_size=ZSTD_WINDOW_CAP_BYTES)
    if size and zstandard.frame_content_size(packed) == size:
        return decompressor.decompress(packed, allow_extra_data=False)
    reader = decompressor.stream_reader(packed, read_across_frames=True)
    content, filled = bytearray(size + 1), 0
    with memoryview(content) as room:
        while filled <= size and (count := reader.readinto(room[filled : filled + _PIECE_BYTES])):
            filled += count
    return memoryview(content)[:filled]


def unpack_lz4(packed: memoryview, size: int) -> memoryview:
    """At most `size` + 1 bytes of all frames, fed in pieces: the decompressor copies what it is fed and does not use.

    Raises RuntimeError, ValueError.
    """
    content, filled, position = bytearray(size + 1), 0, 0
    frame = lz4.frame.LZ4FrameDecompressor()
    rest = b""
    while filled <= size:
        if frame.eof:
            rest, frame = frame.unused_data or b"", lz4.frame.LZ4FrameDecompressor()
        if not rest and frame.needs_input:
            if position == len(packed):
                break
            rest = bytes(packed[position : position + _FED_BYTES])
            position += len(rest)
        piece = frame.decompress(rest, max_length=min(size + 1 - filled, _PIECE_BYTES))
        rest = b""
        content[filled : filled + len(piece)] = piece
        filled += len(piece)
    return memoryview(content)[:filled]


def locate_messages(data: NDArray[np.uint8], hints: Sequence[NDArray[np.uint64]]) -> Located:
    """Find the messages in a stretch of records.

    `hints` are the offsets of the message index. They save walking the records one by one and are believed only as far
    as the announced records tile the stretch; whatever lies between them is walked.
    """
    starts, ends = _hinted(data, hints)
    edges_from = np.concatenate(([0], ends))
    edges_to = np.concatenate((starts, [data.size]))
    gaps = np.flatnonzero(edges_from != edges_to)
    found = array("q")
    others: list[Record] = []
    view = data.data
    for gap in gaps:
        damage = _walk(view, int(edges_from[gap]), int(edges_to[gap]), found, others)
        if damage:
            return Located(_merged(starts[: int(gap)], found), others, damage)
    return Located(_merged(starts, found), others, None)


def _hinted(
    data: NDArray[np.uint8], hints: Sequence[NDArray[np.uint64]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    nothing = np.empty(0, np.int64)
    room = data.size - HEAD_BYTES - MESSAGE_HEAD_BYTES
    if not hints or room < 0:
        return nothing, nothing
    offsets = np.concatenate(hints)
    if not offsets.size or int(offsets.max()) > room:
        return nothing, nothing
    starts = np.unique(offsets.astype(np.int64))
    sizes = gather(data, starts + 1, np.dtype("<u8"))
    if np.any(data[starts] != MESSAGE) or int(sizes.max()) > data.size or int(sizes.min()) < MESSAGE_HEAD_BYTES:
        return nothing, nothing
    ends = starts + HEAD_BYTES + sizes.astype(np.int64)
    if int(ends[-1]) > data.size or np.any(ends[:-1] > starts[1:]):
        return nothing, nothing
    return starts, ends


def _walk(view: memoryview, position: int, limit: int, found: array[int], others: list[Record]) -> str | None:
    while position < limit:
        try:
            record = read_record(view, position, limit)
        except Damage as damage:
            return str(damage)
        if record.opcode != MESSAGE:
            if len(others) == OTHER_RECORDS_CAP:
                return f"more than {OTHER_RECORDS_CAP} records that are no messages"
            others.append(record)
        elif record.end - record.body < MESSAGE_HEAD_BYTES:
            return f"a message of {record.end - record.body} bytes at byte {position} of the chunk"
        else:
            found.append(position)
        position = record.end
    return None


def _merged(starts: NDArray[np.int64], found: array[int]) -> NDArray[np.int64]:
    if not found:
        return starts
    if not starts.size:
        return np.frombuffer(found, np.int64)
    return np.sort(np.concatenate((starts, np.frombuffer(found, np.int64))))
