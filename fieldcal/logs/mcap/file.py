"""An MCAP file read in file order: every intact chunk of it, whatever happened to the rest.

`McapFile.blocks()` yields verified stretches of messages. After damage it goes on at the next record that can be
trusted: behind the damaged record's declared length where that is plausible, else at the next chunk whose CRC holds.
What was lost is told in findings.
"""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Generator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldcal.errors import UnreadableLog
from fieldcal.logs.encodings.gather import gather
from fieldcal.logs.mcap.chunks import ChunkOpener, locate_messages
from fieldcal.logs.mcap.mapped import map_file
from fieldcal.logs.mcap.records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    DATA_END_BYTES,
    FIRST_PRIVATE_OPCODE,
    FOOTER,
    FOOTER_BYTES,
    HEAD_BYTES,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD_BYTES,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Damage,
    Fields,
    Record,
    Statistics,
    check_record,
    read_channel,
    read_message_index,
    read_metadata,
    read_record,
    read_schema,
)
from fieldcal.logs.mcap.report import Tally
from fieldcal.logs.mcap.search import Search
from fieldcal.logs.mcap.summary import ends_whole, read_summary
from fieldcal.logs.messages.container import Block
from fieldcal.logs.messages.definitions import Definitions
from fieldcal.reason_codes import ReasonCode

MESSAGES_AT_ONCE = 1 << 16
LOOSE_BYTES = 4 << 20
RELEASE_BYTES = 64 << 20
_CRC_PIECE_BYTES = 16 << 20
_LOG_TIME_PLACE = 6
_U2, _U8 = np.dtype("<u2"), np.dtype("<u8")


class McapFile:
    """One pass over an MCAP file.

    Parameters
    ----------
    path : Path
        The file.
    buffer : mmap, optional
        Its content, where it is mapped already.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_mcap`, `not_readable`.
    """

    def __init__(self, path: Path, buffer: mmap.mmap | None = None) -> None:
        self.name = path.name
        self.buffer = map_file(path) if buffer is None else buffer
        self.size = len(self.buffer)
        self.definitions = Definitions()
        self.metadata: dict[str, dict[str, str]] = {}
        self.statistics: Statistics | None = None
        self.tally = Tally()
        self._opener = ChunkOpener(self.buffer, self.tally)
        self._seen: dict[tuple[int, int, int, int], tuple[int, int]] = {}
        self._lost_chunk = False
        self._unsure = -1
        self._released = 0
        self._limit = self.size
        self._data_end: int | None = None
        self._has_end = ends_whole(self.buffer)
        self.has_summary = False
        if self._has_end:
            self._limit = self.size - len(MAGIC) - FOOTER_BYTES
            self._adopt_summary()
        self._search = Search(self.buffer, self._limit, self._opener, self.tally, self.definitions, self.statistics)
        if self.buffer[: len(MAGIC)] != MAGIC:
            self._begin = self._search.next_chunk(0)
            if self._begin is None:
                raise UnreadableLog(
                    ReasonCode.NOT_MCAP,
                    f"{self.name} does not begin like an MCAP file and holds no intact MCAP chunk. Check what it is.",
                )
            self.tally.damaged_records.append((0, "the file does not begin with MCAP's magic bytes"))
        else:
            self._begin = len(MAGIC)

    def _adopt_summary(self) -> None:
        try:
            summary = read_summary(self.buffer)
        except Damage as damage:
            self.tally.summary_damage = str(damage)
            return
        if summary is not None:
            self.definitions, self.statistics = summary.definitions, summary.statistics
            self._limit = summary.start
            self._data_end = summary.start - DATA_END_BYTES
            self.has_summary = True

    def blocks(self) -> Generator[Block]:
        """The messages of every intact stretch, in file order. Definitions and the tally grow on the way."""
        position: int | None = self._begin
        while position is not None and position < self._limit and not self.tally.ended and not self.tally.stopped:
            self._release(position)
            record = self._sound_record(position)
            if record is None:
                declared_end = self._declared_end(position)
                position = self._search.resynchronised(self._unsure if self._unsure >= 0 else position, declared_end)
                if position is None and declared_end is None and not self._has_end:
                    self.tally.forget_cut()
            elif record.opcode == CHUNK:
                position = yield from self._chunk(record)
            elif record.opcode in (SCHEMA, CHANNEL, MESSAGE):
                position = yield from self._loose(record)
            else:
                position = self._other(record)
        if self._data_end is not None and position == self._limit and not self.tally.ended:
            self.tally.ended = True

    def _release(self, position: int) -> None:
        """Let go of mapped pages that were read, so that a file larger than the memory can pass through it."""
        if position - self._released >= RELEASE_BYTES:
            passed = position // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
            self.buffer.madvise(mmap.MADV_DONTNEED, 0, passed)
            self._released = position

    def _sound_record(self, position: int) -> Record | None:
        """The record at `position`; None, and an entry in the tally, when it is damaged."""
        try:
            record = read_record(self.buffer, position, self._limit)
            check_record(self.buffer, record)
            if record.opcode == DATA_END and self._data_end not in (None, record.start):
                raise Damage(f"the data section ends at byte {record.start}, the summary begins elsewhere")
        except Damage as damage:
            if self.buffer[position] != CHUNK:
                self.tally.damaged_records.append((position, str(damage)))
            elif (end := self._search.chunk_end(position)) is not None:
                self.tally.damaged_records.append((position, f"a chunk's record length is wrong: {damage}"))
                return Record(CHUNK, position, position + HEAD_BYTES, end)
            else:
                self.tally.damaged_chunks.append((position, str(damage)))
            self._lost_chunk = True
            return None
        return record

    def _declared_end(self, position: int) -> int | None:
        try:
            return read_record(self.buffer, position, self._limit).end
        except Damage:
            return None

    def _other(self, record: Record) -> int:
        if record.opcode == MESSAGE_INDEX:
            if self._lost_chunk:
                channel_id, offsets = read_message_index(Fields(self.buffer, record.body, record.end))
                self.tally.lost[channel_id] += len(offsets)
            return record.end
        self._lost_chunk = record.opcode >= FIRST_PRIVATE_OPCODE
        self._unsure = record.start if self._lost_chunk else -1
        if record.opcode == METADATA:
            name, pairs = read_metadata(Fields(self.buffer, record.body, record.end))
            self.metadata[name] = pairs
        elif record.opcode == HEADER:
            fields = Fields(self.buffer, record.body, record.end)
            self.metadata["mcap"] = {"profile": fields.text(), "library": fields.text()}
        elif record.opcode == DATA_END:
            self.tally.ended = True
            self._check_data_crc(record)
        elif record.opcode == FOOTER:
            self.tally.ended = True
        return record.end

    def _check_data_crc(self, record: Record) -> None:
        expected = int.from_bytes(self.buffer[record.body : record.end], "little")
        if not expected or not self.tally.unverifiable:
            return
        found = 0
        for start in range(0, record.start, _CRC_PIECE_BYTES):
            found = zlib.crc32(self.buffer[start : min(start + _CRC_PIECE_BYTES, record.start)], found)
        if found == expected:
            self.tally.unverifiable = 0
        else:
            self.tally.damaged_records.append((record.start, "the CRC of the data section does not match"))

    def _chunk(self, record: Record) -> Generator[Block, None, int | None]:
        self._lost_chunk, self._unsure = False, -1
        opened = self._opener.open(record.start, record.end)
        if isinstance(opened, str):
            self.tally.damaged_chunks.append((record.start, opened))
            self._lost_chunk = True
            return self._search.resynchronised(record.start, record.end)
        head, content = opened
        end = record.end
        if head.end != end:
            self.tally.damaged_records.append((record.start, "a chunk ends before its record does"))
            end = head.end if self._search.plausible(head.end) else end
        hints, after = self._indexes(end)
        key = (head.message_start_time, head.message_end_time, head.uncompressed_size, head.crc)
        if key in self._seen:
            first, last = self._seen[key]
            if self.buffer[first:last] == self.buffer[head.start : head.end]:
                self.tally.duplicate_chunks += 1
                return after
        self._seen[key] = (head.start, head.end)
        self.tally.chunks += 1
        self.tally.unverifiable += head.crc == 0
        data = np.frombuffer(content, np.uint8)
        located = locate_messages(data, hints)
        self._define(content, located.others)
        if located.damage:
            self.tally.damaged_chunks.append((record.start, located.damage))
        yield from self._slices(data, located.starts, head.crc != 0)
        return after

    def _indexes(self, position: int) -> tuple[list[NDArray[np.uint64]], int]:
        """The message indexes that follow a chunk, and the position behind them."""
        hints = []
        while position < self._limit and self.buffer[position] == MESSAGE_INDEX:
            try:
                record = read_record(self.buffer, position, self._limit)
                hints.append(read_message_index(Fields(self.buffer, record.body, record.end))[1])
            except Damage:
                break
            position = record.end
        return hints, position

    def _define(self, content: bytes | memoryview | mmap.mmap, records: list[Record]) -> None:
        for record in records:
            if record.opcode not in (SCHEMA, CHANNEL):
                continue
            read = read_schema if record.opcode == SCHEMA else read_channel
            try:
                self.definitions.add(read(Fields(content, record.body, record.end)))
            except Damage as damage:
                self.tally.damaged_records.append((record.start, str(damage)))

    def _loose(self, record: Record) -> Generator[Block, None, int | None]:
        """Messages outside chunks: a run of them is one block."""
        self._lost_chunk, self._unsure = False, -1
        begin, starts, position = record.start, [], record.start
        current: Record | None = record
        while current is not None and current.opcode in (SCHEMA, CHANNEL, MESSAGE):
            if current.opcode == MESSAGE:
                starts.append(current.start - begin)
            else:
                self._define(self.buffer, [current])
            position = current.end
            if position - begin >= LOOSE_BYTES or position >= self._limit:
                break
            try:
                current = read_record(self.buffer, position, self._limit)
                check_record(self.buffer, current)
            except Damage:
                current = None
        if starts:
            self.tally.unverifiable += 1
            data = np.frombuffer(self.buffer, np.uint8, position - begin, begin)
            yield from self._slices(data, np.asarray(starts, np.int64), False)
        return position

    def _slices(self, data: NDArray[np.uint8], starts: NDArray[np.int64], verified: bool) -> Generator[Block]:
        for first in range(0, len(starts), MESSAGES_AT_ONCE):
            some = starts[first : first + MESSAGES_AT_ONCE]
            of_messages = gather(data, some + HEAD_BYTES, _U2).astype(np.int64)
            channels, counts = np.unique(of_messages, return_counts=True)
            for channel_id, count in zip(channels.tolist(), counts.tolist(), strict=True):
                known = channel_id in self.definitions.channels
                (self.tally.messages if known else self.tally.unknown_channels)[channel_id] += count
            log_time_ns = gather(data, some + HEAD_BYTES + _LOG_TIME_PLACE, _U8).view(np.int64)
            sizes = gather(data, some + 1, _U8).view(np.int64) - MESSAGE_HEAD_BYTES
            yield Block(data, some + HEAD_BYTES + MESSAGE_HEAD_BYTES, sizes, of_messages, log_time_ns, verified)
