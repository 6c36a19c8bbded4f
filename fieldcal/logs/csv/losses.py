"""Rows of a CSV file that are left out: why, how many, and where the first of them stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.interface import Finding
from fieldcal.reason_codes import ReasonCode

_TIMES_READ = "times are numbers, ISO 8601 or HH:MM:SS with or without a fraction"
_SHOWN = 60
"""Characters of a cell that a sentence shows."""
_SENTENCES = {
    ReasonCode.RAGGED_ROW: ("have more or fewer fields than the header and were left out", True),
    ReasonCode.NUL_BYTES: ("contain NUL bytes and were left out", True),
    ReasonCode.BAD_TIME: ("have a time that is none and were left out", True),
    ReasonCode.BAD_NUMBER: ("have a cell that is no number and were left out", True),
    ReasonCode.INCOMPLETE_ROW: ("have only part of a sensor's cells and were left out", True),
    ReasonCode.HEADER_CHANGED: (
        "name the columns anew and differently; nothing behind them was read: split the file",
        True,
    ),
    ReasonCode.REPEATED_HEADER: ("repeat the header; several recordings may stand in one file", False),
}


@dataclass
class Losses:
    """Rows left out: reason -> how many, and the number of the first line concerned (counted from 1)."""

    counts: dict[ReasonCode, int] = field(default_factory=dict)
    first_lines: dict[ReasonCode, int] = field(default_factory=dict)
    _last_lines: dict[ReasonCode, NDArray[np.int64]] = field(default_factory=dict)

    def add(self, reason: ReasonCode, lines: NDArray[np.int64]) -> None:
        """Count `lines` (ascending numbers) under `reason`; a line that several tables lose counts once."""
        last = self._last_lines.get(reason)
        new = lines if last is None else np.setdiff1d(lines, last, assume_unique=True)
        if new.size:
            self.counts[reason] = self.counts.get(reason, 0) + int(new.size)
            self.first_lines[reason] = min(int(new[0]), self.first_lines.get(reason, int(new[0])))
            self._last_lines[reason] = new if last is None else np.concatenate([last, new])

    def next_block(self) -> None:
        """The lines to come are others than those met so far."""
        self._last_lines.clear()

    def findings(self, name: str, bad_time: str | None) -> Iterator[Finding]:
        """The losses of the file called `name`; `bad_time` is a cell that is no time, if one was met."""
        for reason, count in self.counts.items():
            words, loses_data = _SENTENCES[reason]
            told = f"{name}: {count} row(s) {words}; the first is line {self.first_lines[reason]}."
            if reason == ReasonCode.BAD_TIME and bad_time is not None:
                shown = bad_time if len(bad_time) <= _SHOWN else f"{bad_time[:_SHOWN]}…"
                told += f" {shown!r} is none: {_TIMES_READ}."
            yield Finding(reason, count, told, loses_data=loses_data)
