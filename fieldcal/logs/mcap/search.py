"""Behind damage in an MCAP file: where reading can go on.

The next record is trusted where the damaged one's declared length leads to a plausible one; else the next chunk whose
CRC holds, or several sound records in a row where a file keeps its messages outside chunks.
"""

from __future__ import annotations

import mmap
import re

from fieldcal.logs.mcap.chunks import ChunkOpener
from fieldcal.logs.mcap.records import MESSAGE, Damage, Statistics, check_record, read_record
from fieldcal.logs.mcap.report import Tally
from fieldcal.logs.messages.definitions import Definitions

_LOOSE_CHAIN = 4
_CHUNK_PATTERN = re.compile(rb"\x06.{5}\x00{3}.{21}\x00{3}.{4}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)", re.DOTALL)
_LOOSE_PATTERN = re.compile(rb"[\x03-\x0f].{3}\x00{5}", re.DOTALL)


class Search:
    """Searches a file before byte `limit`. What chunks were met, and whether searching became too much, is in the
    tally; `definitions` tell which channels a message may belong to."""

    def __init__(
        self,
        buffer: mmap.mmap,
        limit: int,
        opener: ChunkOpener,
        tally: Tally,
        definitions: Definitions,
        statistics: Statistics | None,
    ) -> None:
        self._buffer = buffer
        self._limit = limit
        self._opener = opener
        self._tally = tally
        self._definitions = definitions
        self._statistics = statistics
        self._searched: tuple[int, int | None] | None = None

    def chunk_end(self, position: int) -> int | None:
        """End of a chunk whose record length is wrong, when its inner length leads to content that fits its CRC."""
        opened = self._opener.open(position, self._limit, searching=True)
        return None if isinstance(opened, str) or not opened[0].crc else opened[0].end

    def resynchronised(self, damaged: int, declared_end: int | None = None) -> int | None:
        """Where reading can go on behind damage at byte `damaged`, or None."""
        if declared_end is not None and self.plausible(declared_end):
            return declared_end
        places = [place for place in (self.next_chunk(damaged + 1), self._next_loose(damaged + 1)) if place is not None]
        return min(places, default=None)

    def plausible(self, position: int) -> bool:
        """Whether a sound record begins there, or what is searched ends."""
        if position >= self._limit:
            return position == self._limit
        try:
            check_record(self._buffer, read_record(self._buffer, position, self._limit))
        except Damage:
            return False
        return True

    def next_chunk(self, position: int) -> int | None:
        """The next chunk whose content matches its CRC."""
        if self._searched is not None:
            start, found = self._searched
            if start <= position and (found is None or position <= found):
                return found
        found = self._search_chunk(position)
        self._searched = position, found
        return found

    def _search_chunk(self, position: int) -> int | None:
        for match in _CHUNK_PATTERN.finditer(self._buffer, position, self._limit):
            if self.chunk_end(match.start()) is not None:
                return match.start()
            if self._tally.stopped:
                return None
        return None

    def _next_loose(self, position: int) -> int | None:
        """The next of several sound records in a row, in a file that keeps its messages outside chunks."""
        if (
            self._tally.chunks
            or self._tally.damaged_chunks
            or (self._statistics is not None and self._statistics.chunk_count)
        ):
            return None
        for match in _LOOSE_PATTERN.finditer(self._buffer, position, self._limit):
            place: int | None = match.start()
            for _ in range(_LOOSE_CHAIN):
                place = self._sound_end(place) if place is not None and place < self._limit else place
            if place is not None:
                return match.start()
        return None

    def _sound_end(self, position: int) -> int | None:
        try:
            record = read_record(self._buffer, position, self._limit)
            check_record(self._buffer, record)
        except Damage:
            return None
        if record.opcode == MESSAGE:
            channel_id = int.from_bytes(self._buffer[record.body : record.body + 2], "little")
            return record.end if channel_id in self._definitions.channels else None
        return record.end
