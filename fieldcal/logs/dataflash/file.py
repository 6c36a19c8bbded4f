"""A DataFlash file: which messages it holds and where, and what of it is no message.

    file = DataflashFile(path)
    file.locate({"IMU", "MAG"})        # one pass through the file
    rows = file.rows("IMU")            # None where the log has none

Messages have no checksum. One counts where the next begins at its end, or the file ends there; behind damage, reading
goes on at the next that is followed so. What is left out is counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldcal.errors import UnreadableLog
from fieldcal.logs.dataflash.records import (
    FMT_BYTES,
    FMT_LAYOUT,
    FMT_TYPE,
    HEAD_BYTES,
    LONGEST,
    MARK,
    Layout,
    Rows,
    multipliers,
    parse_fmt,
)
from fieldcal.logs.mcap.mapped import map_file
from fieldcal.reason_codes import ReasonCode

CHUNK_BYTES = 1 << 24
SELF_DESCRIPTION = ("FMTU", "MULT")


@dataclass
class Tally:
    """What a pass through the file met.

    `messages`: by type. `undefined`: bytes in messages of types that the log does not define. `stretches`: of other
    bytes that are no message, `damaged_bytes` in all, the first at byte `damaged_at`. `cut`: bytes of a last message
    that the file ends within. `redefined`: messages behind a second, different definition of their type.
    """

    messages: Counter[int] = field(default_factory=Counter)
    undefined: Counter[int] = field(default_factory=Counter)
    stretches: int = 0
    damaged_bytes: int = 0
    damaged_at: int | None = None
    cut: int = 0
    redefined: Counter[str] = field(default_factory=Counter)


class DataflashFile:
    """A memory-mapped log. Raises UnreadableLog: `empty_file`, `not_readable`, `not_an_autopilot_log`.

    `layouts`: type → layout, the first definition of each. `tally` is complete after `locate`.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self._map = map_file(path)
        self.content = np.frombuffer(self._map, np.uint8)
        self.size = len(self.content)
        self.tally = Tally()
        self.layouts: dict[int, Layout] = {FMT_TYPE: FMT_LAYOUT}
        self._redefined_at: dict[int, int] = {}
        self._starts: dict[int, NDArray[np.int64]] = {}
        self._multipliers: dict[int, dict[str, float]] = {}
        self._define()

    def locate(self, names: Collection[str]) -> None:
        """Walk through the file once and keep where the messages of these names begin."""
        wanted = {i for i, layout in self.layouts.items() if layout.name in names or layout.name in SELF_DESCRIPTION}
        parts: dict[int, list[NDArray[np.int64]]] = {type_id: [] for type_id in wanted}
        for starts, types in self._walk():
            counts = np.bincount(types)
            for type_id in np.flatnonzero(counts).tolist():
                limit = self._redefined_at.get(type_id)
                if type_id not in wanted and limit is None:
                    self.tally.messages[type_id] += int(counts[type_id])
                    continue
                found = starts[types == type_id]
                kept = found if limit is None else found[found < limit]
                self.tally.messages[type_id] += len(kept)
                if len(kept) < len(found):
                    self.tally.redefined[self.layouts[type_id].name] += len(found) - len(kept)
                if type_id in wanted:
                    parts[type_id].append(kept)
        self._starts = {i: np.concatenate(found) for i, found in parts.items() if found}
        self._multipliers = multipliers(self.rows("FMTU"), self.rows("MULT"), self.layouts)

    def rows(self, name: str) -> Rows | None:
        """The located messages of a name that can be read; None where there is none."""
        for type_id, starts in self._starts.items():
            layout = self.layouts[type_id]
            if layout.name == name and layout.columns and len(starts):
                return Rows(layout, self.content, starts, self._multipliers.get(type_id, {}))
        return None

    def unreadable(self) -> dict[str, int]:
        """Located messages whose definition contradicts itself, by name."""
        found: Counter[str] = Counter()
        for type_id, starts in self._starts.items():
            if not self.layouts[type_id].columns and len(starts):
                found[self.layouts[type_id].name] += len(starts)
        return dict(found)

    def counts(self) -> dict[str, int]:
        """Messages by name."""
        named: Counter[str] = Counter()
        for type_id, count in self.tally.messages.items():
            named[self.layouts[type_id].name] += count
        return dict(named)

    def _define(self) -> None:
        """Find every FMT message, wherever it stands: definitions are needed before the walk and may come late."""
        head = MARK + bytes([FMT_TYPE])
        place = self._map.find(head)
        while place >= 0:
            layout = parse_fmt(self._map[place : place + FMT_BYTES])
            if layout is not None and layout != self.layouts.setdefault(layout.type_id, layout):
                self._redefined_at.setdefault(layout.type_id, place)
            place = self._map.find(head, place + (HEAD_BYTES if layout is None else FMT_BYTES))
        if len(self.layouts) == 1:
            raise UnreadableLog(
                ReasonCode.NOT_AN_AUTOPILOT_LOG,
                f"{self.name} is no ArduPilot log: it does not hold one definition of a message (FMT). Check what it "
                "is, or rename it.",
            )

    def _walk(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
        """Where messages begin, and their types, chunk by chunk."""
        sizes = np.zeros(256, np.int64)
        for type_id, layout in self.layouts.items():
            sizes[type_id] = layout.size
        expected = at = 0  # where the next message has to begin, where the chunk does
        while at < self.size:
            stop = min(at + CHUNK_BYTES, self.size)
            window = self.content[at : stop + LONGEST + HEAD_BYTES]
            heads = np.flatnonzero(window[:-2] == MARK[0])
            heads = heads[window[heads + 1] == MARK[1]]
            types = window[heads + 2]
            heads += at
            ends = heads + sizes[types]
            inside = int(np.searchsorted(heads, stop))
            follows, fits = self._successors(heads, ends, inside)
            fits &= sizes[types[:inside]].astype(bool)
            good = np.flatnonzero(fits)
            places = heads[good]
            # A run of messages ends at one that the next head does not follow: it is damaged, or looks like a head
            # within its data.
            ends_run = np.flatnonzero(~(fits & follows))
            begin_or_end = np.zeros(inside + 1, np.int8)
            while (rank := int(np.searchsorted(places, expected))) < len(good):
                first = int(good[rank])
                if heads[first] > expected:
                    self._lost(expected, int(heads[first]), sizes)
                reach = int(np.searchsorted(ends_run, first))
                last = int(ends_run[reach]) if reach < len(ends_run) else inside - 1
                last -= not fits[last]
                begin_or_end[first] += 1
                begin_or_end[last + 1] -= 1
                expected = int(ends[last])
            taken = np.flatnonzero(np.cumsum(begin_or_end[:inside], dtype=np.int8))
            yield heads[taken], types[taken]
            at = max(stop, expected)
        if expected < self.size:
            self._last(expected, sizes)

    def _successors(
        self, heads: NDArray[np.int64], ends: NDArray[np.int64], inside: int
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Of the first `inside` heads: whether the very next one stands at their end, and whether any does."""
        after = np.append(heads[1:], -1)[:inside]
        follows = after == ends[:inside]
        fits = follows.copy()
        rest = np.flatnonzero(~follows)
        places = np.minimum(np.searchsorted(heads, ends[rest]), len(heads) - 1)
        fits[rest] = (heads[places] == ends[rest]) | (ends[rest] == self.size)
        for missing in (1, 2):  # a head that the file ends within
            begun = self.content[self.size - missing :].tobytes() == MARK[:missing]
            if begun:
                fits[rest] |= ends[rest] == self.size - missing
        return follows, fits

    def _lost(self, first: int, end: int, sizes: NDArray[np.int64]) -> None:
        """Account for bytes that are no message."""
        head = self.content[first : first + HEAD_BYTES].tobytes()
        if head[:2] == MARK and not sizes[head[2]]:
            self.tally.undefined[head[2]] += end - first
        else:
            self.tally.damaged_at = first if not self.tally.stretches else self.tally.damaged_at
            self.tally.stretches += 1
            self.tally.damaged_bytes += end - first

    def _last(self, first: int, sizes: NDArray[np.int64]) -> None:
        """Account for the file's end behind its last whole message."""
        head = self.content[first : first + HEAD_BYTES].tobytes()
        begun = MARK.startswith(head[:2])
        if begun and (len(head) < HEAD_BYTES or first + sizes[head[2]] > self.size):
            self.tally.cut = self.size - first
        else:
            self._lost(first, self.size, sizes)
