"""The summary section at the end of an MCAP file: definitions and statistics, believed when its CRC holds."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

from fieldcal.logs.mcap.records import (
    CHANNEL,
    DATA_END,
    DATA_END_BYTES,
    FOOTER,
    FOOTER_BYTES,
    HEAD_BYTES,
    MAGIC,
    SCHEMA,
    STATISTICS,
    Buffer,
    Damage,
    Fields,
    Statistics,
    check_record,
    read_channel,
    read_record,
    read_schema,
    read_statistics,
)
from fieldcal.logs.messages.definitions import Definitions

_CRC_BYTES = 4
_DATA_END_HEAD = bytes([DATA_END]) + (DATA_END_BYTES - HEAD_BYTES).to_bytes(8, "little")
_DATA_ENDS_TRIED = 8


@dataclass
class Summary:
    """A summary section that begins at byte `start`."""

    start: int
    definitions: Definitions = field(default_factory=Definitions)
    statistics: Statistics | None = None


def _moved(buffer: Buffer, footer: int, crc: int) -> int | None:
    """Where the summary begins in a file that lost or gained bytes before it: behind a data end, its CRC says so."""
    position = footer
    for _ in range(_DATA_ENDS_TRIED):
        position = buffer.rfind(_DATA_END_HEAD, 0, position) if crc and not isinstance(buffer, memoryview) else -1
        if position < 0:
            return None
        start = position + DATA_END_BYTES
        if start <= footer and zlib.crc32(buffer[start : footer + FOOTER_BYTES - _CRC_BYTES]) == crc:
            return start
    return None


def ends_whole(buffer: Buffer) -> bool:
    """Whether a file ends with MCAP's magic bytes and has room for a footer before them."""
    size = len(buffer)
    return size >= 2 * len(MAGIC) + FOOTER_BYTES and bytes(buffer[size - len(MAGIC) : size]) == MAGIC


def read_summary(buffer: Buffer) -> Summary | None:
    """The summary of a file that ends whole; None when its footer says that there is none. Raises Damage."""
    footer = len(buffer) - len(MAGIC) - FOOTER_BYTES
    record = read_record(buffer, footer, footer + FOOTER_BYTES)
    check_record(buffer, record)
    if record.opcode != FOOTER:
        raise Damage("the file does not end with a footer")
    fields = Fields(buffer, record.body, record.end)
    start, _, crc = fields.number(8), fields.number(8), fields.number(4)
    if start == 0:
        return None
    placed = len(MAGIC) + DATA_END_BYTES <= start <= footer
    if not placed or (crc and zlib.crc32(buffer[start : footer + FOOTER_BYTES - _CRC_BYTES]) != crc):
        moved = _moved(buffer, footer, crc)
        if moved is None:
            raise Damage("the summary's CRC does not match" if placed else f"the footer places it at byte {start}")
        start = moved
    summary, position = Summary(start), start
    while position < footer:
        record = read_record(buffer, position, footer)
        fields = Fields(buffer, record.body, record.end)
        if record.opcode == SCHEMA:
            summary.definitions.add(read_schema(fields))
        elif record.opcode == CHANNEL:
            summary.definitions.add(read_channel(fields))
        elif record.opcode == STATISTICS:
            summary.statistics = read_statistics(fields)
        position = record.end
    return summary
