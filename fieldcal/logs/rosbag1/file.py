"""A ROS 1 bag read in file order, whatever happened to its index; behind damage at the next chunk that is whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap.mapped import map_file
from fieldcal.logs.messages.container import Block
from fieldcal.logs.messages.definitions import Channel, Definitions, Schema
from fieldcal.logs.rosbag1.chunks import ChunkOpener, is_record, next_chunk
from fieldcal.logs.rosbag1.records import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    CONNECTION,
    MAGIC,
    MESSAGE,
    Buffer,
    Damage,
    Record,
    messages_of,
    read_fields,
    read_record,
    walk,
)
from fieldcal.logs.rosbag1.report import Tally, report
from fieldcal.reason_codes import ReasonCode

_LOOSE_BYTES = 4 << 20


class BagContainer:
    """The file as a `Container`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`, `not_bag`; `no_messages`: no topic is defined in what is left of it.
    """

    def __init__(self, path: Path) -> None:
        self._name = path.name
        self._buffer = map_file(path)
        self._limit = len(self._buffer)
        self.definitions = Definitions()
        self.metadata: dict[str, dict[str, str]] = {}
        self._tally = Tally()
        self._said: Counter[int] | None = None
        self._begin = self._first_record()
        index = self._index_place()
        self._closed = bool(index)
        if not (self._closed and self._read_index(index)):
            for _ in self.blocks(frozenset()):
                pass
            self._tally = Tally()
        if not self.definitions.channels:
            raise UnreadableLog(
                ReasonCode.NO_MESSAGES,
                f"{self._name} holds no whole chunk and no definition of any topic: it was cut or damaged before the "
                "first messages were safe. Nothing of it can be used.",
            )

    @property
    def counts(self) -> Mapping[int, int] | None:
        """See `Container`."""
        return self._said

    def blocks(self, channels: Collection[int]) -> Iterator[Block]:
        """See `Container`. Chunks are read whole: of every channel."""
        opener = ChunkOpener(self._buffer)
        position: int | None = self._begin
        while position is not None and position < self._limit:
            try:
                record = read_record(self._buffer, position, self._limit, whole=False)
                if record.opcode != CHUNK and record.end > self._limit:
                    raise Damage(f"the record at byte {position} ends behind the file")
                if record.opcode == CHUNK:
                    content = opener.open(record, self._limit)
                    if (following := self._inside(record)) is not None:
                        why = f"the chunk lacks {record.end - following} of its bytes"
                        self._tally.damaged.append((position, why))
                        left = np.frombuffer(content, np.uint8)[: following - record.data]
                        yield from self._stretch(left, position, lacking=True)
                        position = following
                        continue
                    yield from self._stretch(np.frombuffer(content, np.uint8), record.start)
                elif record.opcode == MESSAGE:
                    end = self._loose_end(position)
                    yield from self._stretch(np.frombuffer(self._buffer, np.uint8, end - position, position), position)
                    position = end
                    continue
                elif record.opcode == CONNECTION:
                    self._define(self._buffer, record)
            except Damage as damage:
                self._tally.damaged.append((position, str(damage)))
                position = self._behind(position)
                continue
            if record.end > self._limit:
                self._tally.damaged.append((position, f"the chunk ends {record.end - self._limit} bytes too early"))
            position = record.end

    def report(self, summary: LogSummary) -> None:
        """See `Container`. Nothing in a bag is under a checksum."""
        report(self._name, self._limit, self._closed, self._tally, self.definitions, self._said, summary)

    def _first_record(self) -> int:
        """Where records begin: behind the magic, else at the first chunk. Raises UnreadableLog where it is no bag."""
        begin = self._buffer[: len(MAGIC)]
        if begin.startswith(b"#ROSRECORD") or (begin.startswith(b"#ROSBAG V") and begin != MAGIC):
            version = begin.decode("ascii", "replace").strip()
            raise UnreadableLog(
                ReasonCode.NOT_BAG,
                f"{self._name} is a bag of another format ({version}); 2.0 is read. Convert it: rosbag fix.",
            )
        if begin == MAGIC:
            return len(MAGIC)
        first = next_chunk(self._buffer, 0, self._limit)
        if first is None:
            raise UnreadableLog(
                ReasonCode.NOT_BAG,
                f"{self._name} does not begin like a ROS bag and holds no whole chunk. Check what it is.",
            )
        return first

    def _index_place(self) -> int:
        """Where the index begins; 0 where the recorder did not close the bag. Raises UnreadableLog if encrypted."""
        try:
            record = read_record(self._buffer, len(MAGIC), self._limit)
            if record.opcode != BAG_HEADER:
                return 0
            if b"encryptor" in record.fields and record.value(b"encryptor"):
                raise UnreadableLog(ReasonCode.NOT_BAG, f"{self._name} is encrypted. Decrypt it: rosbag decrypt.")
            return record.number(b"index_pos")
        except Damage:
            return 0

    def _read_index(self, position: int) -> bool:
        """Take connections and counts from the index at the file's end; whether it is whole."""
        definitions, said = Definitions(), Counter[int]()
        try:
            while position < self._limit:
                record = read_record(self._buffer, position, self._limit)
                if record.opcode == CONNECTION:
                    _add_connection(definitions, self._buffer, record)
                elif record.opcode == CHUNK_INFO:
                    pairs = np.frombuffer(self._buffer[record.data : record.end], "<u4").reshape(-1, 2)
                    for connection, count in pairs.tolist():
                        said[connection] += count
                else:
                    return False
                position = record.end
        except (Damage, ValueError):
            return False
        if definitions.channels:
            self.definitions, self._said = definitions, said
        return bool(definitions.channels)

    def _stretch(self, data: NDArray[np.uint8], place: int, *, lacking: bool = False) -> Iterator[Block]:
        """The messages of a chunk's content, or of bytes of the file. Where bytes are missing (`lacking`), the record
        before the one that is none has taken bytes of what follows for its own: it is left out too."""
        starts, headers, damage = walk(data.data, 0, data.size)
        if lacking and damage:
            starts, headers = starts[:-1], headers[:-1]
        messages, others, malformed = messages_of(data, starts, headers)
        if damage or malformed:
            self._tally.damaged.append((place, damage or f"{malformed} records of the chunk are none"))
        for start in others:
            try:
                record = read_record(data.data, start, data.size)
                if record.opcode == CONNECTION:
                    self._define(data.data, record)
            except Damage as error:
                self._tally.damaged.append((place, str(error)))
        if messages.starts.size:
            ids, counts = np.unique(messages.connections, return_counts=True)
            self._tally.messages.update(dict(zip(ids.tolist(), counts.tolist(), strict=True)))
            yield Block(data, messages.starts, messages.sizes, messages.connections, messages.log_time_ns)

    def _loose_end(self, position: int) -> int:
        """The end of a run of messages outside chunks."""
        begin = position
        while position - begin < _LOOSE_BYTES:
            try:
                record = read_record(self._buffer, position, self._limit)
            except Damage:
                break
            if record.opcode not in (MESSAGE, CONNECTION):
                break
            position = record.end
        return position

    def _behind(self, position: int) -> int | None:
        """Where reading goes on behind damage: the end that the record declares, else the next chunk."""
        try:
            end = read_record(self._buffer, position, self._limit).end
            if is_record(self._buffer, end, self._limit):
                return end
        except Damage:
            pass
        return next_chunk(self._buffer, position + 1, self._limit)

    def _inside(self, chunk: Record) -> int | None:
        """Where the next chunk begins, if that is before the end that this one declares: bytes of it are missing. A
        packed one could not have been unpacked without them."""
        if chunk.end > self._limit or chunk.value(b"compression") != b"none":
            return None
        found = self._behind(chunk.start)
        return found if found is not None and found < chunk.end else None

    def _define(self, buffer: Buffer, record: Record) -> None:
        try:
            _add_connection(self.definitions, buffer, record)
        except Damage as damage:
            self._tally.damaged.append((record.start, str(damage)))


def _add_connection(definitions: Definitions, buffer: Buffer, record: Record) -> None:
    """A connection is a channel with a schema of its own. Raises Damage."""
    connection, topic = record.number(b"conn"), record.value(b"topic").decode("utf-8", "replace")
    fields = {name: value for name, (_, value) in read_fields(buffer, record.data, record.end)}
    if b"type" not in fields:
        raise Damage(f"the connection of {topic} names no type")
    text = fields.get(b"message_definition", b"")
    definitions.add(Schema(connection, fields[b"type"].decode("utf-8", "replace"), "ros1msg", text))
    definitions.add(Channel(connection, connection, topic, "ros1", ()))
