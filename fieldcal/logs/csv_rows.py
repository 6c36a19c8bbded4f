"""Rows of a block of CSV lines: which lines are rows, and their cells as numbers. What is not read is counted."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fieldcal.logs.csv_dialect import QUOTE, WHITESPACE, Dialect

MISSING_CELLS = ("", "nan", "null", "na", "n/a", "none", "-")
_LINE_FEED, _COMMENT = 10, ord("#")


@dataclass
class Losses:
    """Rows left out: reason -> how many, and the number of the first line concerned (counted from 1)."""

    counts: dict[str, int] = field(default_factory=dict)
    first_lines: dict[str, int] = field(default_factory=dict)

    def add(self, reason: str, lines: NDArray[np.int64]) -> None:
        """Count `lines` (line numbers) under `reason`."""
        if lines.size:
            self.counts[reason] = self.counts.get(reason, 0) + int(lines.size)
            self.first_lines.setdefault(reason, int(lines.min()))


def read_rows(
    block: bytes, dialect: Dialect, first_line: int, columns: Sequence[int], losses: Losses
) -> tuple[pl.DataFrame, NDArray[np.int64]]:
    """Cells of `columns` (positions) as text, and the line number of each row.

    `block` consists of whole lines, the first of which is line `first_line` of the file. The frame's columns are named
    by their position.
    """
    if dialect.separator == WHITESPACE:
        block = re.sub(rb"(?m)^ | $", b"", re.sub(rb"[ \t]+", b" ", block))
    data = np.frombuffer(block, np.uint8)
    ends = np.flatnonzero(data == _LINE_FEED)
    starts = np.concatenate(([0], ends[:-1] + 1))
    numbers = first_line + np.arange(len(ends), dtype=np.int64)
    fields = _fields(block, data, starts, ends, dialect.separator)
    silent = _silent(block, data, starts, ends, dialect, numbers, losses)
    damaged = np.zeros(len(ends), bool)
    damaged[np.searchsorted(ends, np.flatnonzero(data == 0))] = True
    trailing = (fields == dialect.fields + 1) & (data[np.maximum(ends - 1, 0)] == ord(dialect.separator))
    ragged = (fields != dialect.fields) & ~trailing & ~silent & ~damaged
    losses.add("nul_bytes", numbers[damaged & ~silent])
    losses.add("ragged_row", numbers[ragged])
    kept = ~(silent | damaged | ragged)
    if not kept.all():
        block = data[np.repeat(kept, ends - starts + 1)].tobytes()
    if dialect.decimal != ".":
        block = block.replace(dialect.decimal.encode(), b".")
    return _cells(block, dialect, columns, int(kept.sum())), numbers[kept]


def numbers_of(cells: pl.Series) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Cells as float64, NaN where a cell is empty or says that nothing is there; and which cells are no number."""
    stripped = cells.str.strip_chars()
    values = stripped.str.strip_prefix("+").cast(pl.Float64, strict=False)
    numbers = values.fill_null(np.nan).to_numpy()
    if np.isfinite(numbers).all():
        return numbers, np.zeros(len(numbers), bool)
    missing = stripped.fill_null("").str.to_lowercase().is_in(MISSING_CELLS).to_numpy()
    bad = ~np.isfinite(numbers) & ~missing
    return np.where(np.isfinite(numbers), numbers, np.nan), bad


def _fields(
    block: bytes, data: NDArray[np.uint8], starts: NDArray[np.intp], ends: NDArray[np.intp], separator: str
) -> NDArray[np.int64]:
    """Number of fields of each line; 0 for one whose quotes do not close."""
    separators = np.flatnonzero(data == ord(separator))
    fields = np.bincount(np.searchsorted(ends, separators), minlength=len(ends)) + 1
    quotes = np.flatnonzero(data == ord(QUOTE))
    if quotes.size:
        per_line = np.bincount(np.searchsorted(ends, quotes), minlength=len(ends))
        for line in np.flatnonzero(per_line).tolist():
            text = block[starts[line] : ends[line]].decode("utf-8", "replace")
            odd = per_line[line] % 2 == 1
            fields[line] = 0 if odd else len(next(csv.reader([text], delimiter=separator), []))
    return fields.astype(np.int64)


def _silent(
    block: bytes,
    data: NDArray[np.uint8],
    starts: NDArray[np.intp],
    ends: NDArray[np.intp],
    dialect: Dialect,
    numbers: NDArray[np.int64],
    losses: Losses,
) -> NDArray[np.bool_]:
    """Lines that are no rows and lose nothing: empty, comments, the header once more."""
    silent: NDArray[np.bool_] = (ends == starts) | (data[starts] == _COMMENT)
    for line in np.flatnonzero((ends - starts < 64) & (data[starts] == ord(" ")) & ~silent).tolist():
        silent[line] = not block[starts[line] : ends[line]].strip()
    if dialect.header:
        alike = np.flatnonzero((data[starts] == dialect.header[0]) & (ends - starts == len(dialect.header)))
        repeated = [line for line in alike.tolist() if block[starts[line] : ends[line]] == dialect.header]
        silent[repeated] = True
        losses.add("repeated_header", numbers[repeated])
    return silent


def _cells(block: bytes, dialect: Dialect, columns: Sequence[int], rows: int) -> pl.DataFrame:
    order = sorted(set(columns))
    if not rows:
        return pl.DataFrame(schema={str(column): pl.String for column in order})
    quoted = QUOTE.encode() in block
    frame = _parsed(block, dialect, order, QUOTE if quoted else None)
    if quoted and frame.height != rows:
        frame = _parsed(block, dialect, order, None).select(pl.all().str.strip_chars(QUOTE))
    return frame


def _parsed(block: bytes, dialect: Dialect, columns: list[int], quote: str | None) -> pl.DataFrame:
    frame = pl.read_csv(
        block,
        has_header=False,
        separator=dialect.separator,
        columns=columns,
        infer_schema=False,
        quote_char=quote,
        encoding="utf8-lossy",
        truncate_ragged_lines=True,
    )
    frame.columns = [str(column) for column in columns]
    return frame
