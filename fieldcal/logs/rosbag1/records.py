"""The records of a ROS 1 bag (format 2.0), parsed with every length checked against the bytes that are there.

Layout of a record: header length (4 bytes, little endian), header, data length (4 bytes), data. A header is a run of
fields: length (4 bytes), name, "=", value; the order is the writer's own.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from mmap import mmap

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.encodings.decoded import NANOSECONDS
from fieldcal.logs.encodings.gather import gather

Buffer = bytes | memoryview | mmap

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
OPCODES = (MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION)
HEADER_CAP_BYTES = 1 << 16
"""Longest header that is believed; they hold a topic's name at most."""
LAYOUTS_CAP = 64
_U4 = np.dtype("<u4")
_LENGTH = struct.Struct("<I")


class Damage(Exception):
    """Bytes that do not form the record they should."""


@dataclass(frozen=True)
class Record:
    """Place of one record, and the fields of its header: name → (place in the buffer, value)."""

    opcode: int
    start: int
    data: int
    end: int
    fields: dict[bytes, tuple[int, bytes]]

    def number(self, name: bytes) -> int:
        """An unsigned integer of the header. Raises Damage."""
        return int.from_bytes(self.value(name), "little")

    def value(self, name: bytes) -> bytes:
        """A field of the header. Raises Damage."""
        if name not in self.fields:
            raise Damage(f"the record at byte {self.start} has no field {name.decode()}")
        return self.fields[name][1]


@dataclass(frozen=True)
class Messages:
    """Messages in a stretch: where their payloads begin, how long they are, connection and time; int64 (n,)."""

    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    connections: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]


def read_record(buffer: Buffer, position: int, limit: int, *, whole: bool = True) -> Record:
    """The record at `position`. Raises Damage where it is none, or (`whole`) does not end by `limit`."""
    header = _length(buffer, position, limit)
    if header > HEADER_CAP_BYTES:
        raise Damage(f"the record at byte {position} announces a header of {header} bytes")
    data = _length(buffer, position + 4 + header, limit)
    body = position + 8 + header
    fields = dict(read_fields(buffer, position + 4, position + 4 + header))
    opcode = fields.get(b"op", (0, b""))[1]
    if len(opcode) != 1 or opcode[0] not in OPCODES:
        raise Damage(f"the record at byte {position} is of no known kind")
    if whole and body + data > limit:
        raise Damage(f"the record at byte {position} announces {data} bytes, {limit - body} are left")
    return Record(opcode[0], position, body, body + data, fields)


def read_fields(buffer: Buffer, position: int, limit: int) -> Iterator[tuple[bytes, tuple[int, bytes]]]:
    """Name → (place, value) of the fields between two bytes. Raises Damage."""
    while position < limit:
        size = _length(buffer, position, limit)
        end = position + 4 + size
        if end > limit:
            raise Damage(f"a field of {size} bytes at byte {position}, {limit - position - 4} are left")
        name, equals, value = bytes(buffer[position + 4 : end]).partition(b"=")
        if not equals:
            raise Damage(f"a field without a name at byte {position}")
        yield name, (end - len(value), value)
        position = end


def walk(buffer: Buffer, position: int, limit: int) -> tuple[NDArray[np.int64], NDArray[np.int64], str | None]:
    """Starts and header lengths of the records that follow each other from `position`; damage that ended the walk."""
    starts, headers = array("q"), array("q")
    damage = None
    unpack = _LENGTH.unpack_from
    while position < limit:
        if position + 8 > limit:
            damage = f"a record begins at byte {position} and the data ends at {limit}"
            break
        (header,) = unpack(buffer, position)
        at_data = position + 4 + header
        if at_data + 4 > limit:
            damage = f"the record at byte {position} announces a header of {header} bytes"
            break
        end = at_data + 4 + unpack(buffer, at_data)[0]
        if end > limit:
            damage = f"the record at byte {position} ends {end - limit} bytes behind the data"
            break
        starts.append(position)
        headers.append(header)
        position = end
    return np.frombuffer(starts, np.int64), np.frombuffer(headers, np.int64), damage


def messages_of(
    data: NDArray[np.uint8], starts: NDArray[np.int64], headers: NDArray[np.int64]
) -> tuple[Messages, list[int], int]:
    """The messages among records of `data`, in order; the starts of other records; how many are none.

    Headers of one writer are alike but for their values: one is taken apart, the others are compared with it.
    """
    found: list[tuple[NDArray[np.int64], ...]] = []
    others: list[int] = []
    malformed = 0
    for header in np.unique(headers).tolist():
        left = starts[headers == header]
        for _ in range(LAYOUTS_CAP):
            if not left.size:
                break
            try:
                record = read_record(data.data, int(left[0]), data.size)
                places = _message_places(record)
            except Damage:
                malformed += 1
                left = left[1:]
                continue
            if record.opcode != MESSAGE:
                others.append(record.start)
                left = left[1:]
                continue
            alike = _alike(data, left, 4 + header, places)
            same = left[alike]
            connections = gather(data, same + places["conn"], _U4).astype(np.int64)
            seconds, nanoseconds = (gather(data, same + places["time"] + at, _U4).astype(np.int64) for at in (0, 4))
            sizes = gather(data, same + 4 + header, _U4).astype(np.int64)
            found.append((same, same + 8 + header, sizes, connections, seconds * NANOSECONDS + nanoseconds))
            left = left[~alike]
        malformed += left.size
    if not found:
        nothing = np.empty(0, np.int64)
        return Messages(nothing, nothing, nothing, nothing), sorted(others), malformed
    order = np.argsort(np.concatenate([part[0] for part in found]), kind="stable")
    columns = [np.concatenate([part[column] for part in found])[order] for column in range(1, 5)]
    return Messages(*columns), sorted(others), malformed


def _message_places(record: Record) -> dict[str, int]:
    """Where in a message's record connection and time stand, from its start. Raises Damage."""
    if record.opcode != MESSAGE:
        return {}
    for name, size in ((b"conn", 4), (b"time", 8)):
        if len(record.value(name)) != size:
            raise Damage(f"the message at byte {record.start} has a field {name.decode()} of another size")
    return {name.decode(): record.fields[name][0] - record.start for name in (b"conn", b"time")}


def _alike(data: NDArray[np.uint8], starts: NDArray[np.int64], size: int, places: dict[str, int]) -> NDArray[np.bool_]:
    """Which headers of `size` bytes differ from the first in nothing but the values at `places`."""
    headers = gather(data, starts, np.dtype("u1"), size).reshape(len(starts), size)
    fixed = np.ones(size, bool)
    fixed[places["conn"] : places["conn"] + 4] = False
    fixed[places["time"] : places["time"] + 8] = False
    return np.asarray((headers[:, fixed] == headers[0, fixed]).all(axis=1))


def _length(buffer: Buffer, position: int, limit: int) -> int:
    if position + 4 > limit:
        raise Damage(f"a length at byte {position}, the data ends at {limit}")
    return int.from_bytes(buffer[position : position + 4], "little")
