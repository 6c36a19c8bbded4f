"""Rows of a block of CSV lines: which lines are rows, and their cells as numbers. What is not read is counted."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fieldcal.logs.csv.dialect import COMMA_NUMBER, QUOTE, WHITESPACE, Dialect, is_number
from fieldcal.logs.csv.losses import Losses
from fieldcal.reason_codes import ReasonCode

MISSING_CELLS = ("", "nan", "null", "na", "n/a", "none", "-")
_LINE_FEED, _COMMENT, _SLASH = 10, ord("#"), ord("/")


def read_rows(
    block: bytes, dialect: Dialect, first_line: int, columns: Sequence[int], losses: Losses
) -> tuple[pl.DataFrame, NDArray[np.int64]]:
    """Cells of `columns` (positions) as text, and the line number of each row.

    `block` consists of whole lines, the first of which is line `first_line` of the file. The frame's columns are named
    by their position.
    """
    if dialect.separator == WHITESPACE:
        block = re.sub(rb"(?m)^ | $", b"", re.sub(rb"[ \t]+", b" ", block))
    block, unclosed = _unquoted(block, dialect)
    data = np.frombuffer(block, np.uint8)
    ends = np.flatnonzero(data == _LINE_FEED)
    starts = np.concatenate(([0], ends[:-1] + 1))
    numbers = first_line + np.arange(len(ends), dtype=np.int64)
    fields = np.bincount(np.searchsorted(ends, np.flatnonzero(data == ord(dialect.separator))), minlength=len(ends)) + 1
    fields[unclosed] = 0
    silent = _silent(block, data, starts, ends, dialect, numbers, losses)
    damaged = np.zeros(len(ends), bool)
    damaged[np.searchsorted(ends, np.flatnonzero(data == 0))] = True
    trailing = (fields == dialect.fields + 1) & (data[ends - 1] == ord(dialect.separator))
    ragged = (fields != dialect.fields) & ~trailing & ~silent & ~damaged
    losses.add(ReasonCode.NUL_BYTES, numbers[damaged & ~silent])
    losses.add(ReasonCode.RAGGED_ROW, numbers[ragged])
    kept = ~(silent | damaged | ragged)
    if not kept.all():
        block = data[np.repeat(kept, ends - starts + 1)].tobytes()
    if dialect.decimal not in (".", dialect.separator):
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


def other_header(frame: pl.DataFrame, dialect: Dialect) -> int | None:
    """Position of the first row that names columns of this file in another order: what follows it means other things.

    `frame` holds cells as text, its columns named by their position.
    """
    own = {name: dialect.names[int(name)] for name in frame.columns}
    names = [name for name in dialect.names if name and not is_number(name)]
    if not own:
        return None
    named = frame.select(pl.sum_horizontal(pl.col(*own).str.strip_chars().is_in(names)).alias("n")).to_series()
    for place in (named * 2 > len(own)).arg_true().to_list():
        if any(cell is None or cell.strip() != own[name] for name, cell in frame.row(place, named=True).items()):
            return int(place)
    return None


def _unquoted(block: bytes, dialect: Dialect) -> tuple[bytes, list[int]]:
    """The block with quotes resolved, and the positions of lines whose quotes do not close.

    A decimal comma inside quotes becomes a point where commas separate the cells too. Any other separator inside
    quotes becomes a space: such cells are words, which are not read.
    """
    separator = dialect.separator
    comma = dialect.decimal == separator == ","
    if QUOTE.encode() not in block:
        return block, []
    lines = block.split(b"\n")
    unclosed = []
    for number, line in enumerate(lines):
        quotes = line.count(QUOTE.encode())
        if not quotes:
            continue
        if quotes % 2:
            unclosed.append(number)
            continue
        try:
            cells = next(csv.reader([line.decode("utf-8", "surrogateescape")], delimiter=separator, strict=True))
        except csv.Error:
            unclosed.append(number)
            continue
        if comma:
            cells = [cell.replace(",", ".") if COMMA_NUMBER.match(cell.strip()) else cell for cell in cells]
        text = separator.join(cell.replace(separator, " ").replace("\n", " ") for cell in cells)
        lines[number] = text.encode("utf-8", "surrogateescape")
    return b"\n".join(lines), unclosed


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
    silent |= (data[starts] == _SLASH) & (data[np.minimum(starts + 1, len(data) - 1)] == _SLASH)
    blank = (data[starts] == ord(" ")) | (data[starts] == ord("\t"))
    for line in np.flatnonzero((ends - starts < 64) & blank & ~silent).tolist():
        silent[line] = not block[starts[line] : ends[line]].strip()
    if dialect.header:
        alike = np.flatnonzero((data[starts] == dialect.header[0]) & (ends - starts == len(dialect.header)))
        repeated = [line for line in alike.tolist() if block[starts[line] : ends[line]] == dialect.header]
        silent[repeated] = True
        losses.add(ReasonCode.REPEATED_HEADER, numbers[repeated])
    return silent


def _cells(block: bytes, dialect: Dialect, columns: Sequence[int], rows: int) -> pl.DataFrame:
    order = sorted(set(columns))
    if not rows:
        return pl.DataFrame(schema={str(column): pl.String for column in order})
    frame = pl.read_csv(
        block,
        has_header=False,
        separator=dialect.separator,
        columns=order,
        infer_schema=False,
        quote_char=None,
        encoding="utf8-lossy",
        truncate_ragged_lines=True,
    )
    frame.columns = [str(column) for column in order]
    return frame
