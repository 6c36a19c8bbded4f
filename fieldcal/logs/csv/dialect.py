"""How a CSV file is written: separator, decimal sign, header, units row."""

from __future__ import annotations

import csv
import re
from contextlib import suppress
from dataclasses import dataclass

from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv.units import is_units_row
from fieldcal.reason_codes import ReasonCode

SEPARATORS = ("\t", ";", ",")
WHITESPACE = " "
QUOTE = '"'
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?$|[+-]?(nan|inf|infinity)$", re.IGNORECASE)
COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?$")
_SEPARATOR_LINE = re.compile(r'"?sep=([,;\t|])"?$', re.IGNORECASE)
_LINES_LOOKED_AT = 50
_PREAMBLE_LINES_CAP = 1000
_NO_ROWS_ABOVE = re.compile(rb"(?:[ \t]*(?:(?:#|//)[^\n]*)?\n)*+")
_COMMENTS_KEPT = 200
"""Of those above the header the last so many: one may name the columns."""
NAME_CAP = 200
"""Longer names of columns are cut: what is looked for in one takes the square of its length."""
COMMENTS = ("#", "//")
COLUMNS_CAP = 10_000
HEADERS_BELOW = (("Format Version,", "Frame,Time"),)
"""Beginnings of a first line that may by chance have as many cells as the rows (Motive's), and of the header below."""
LEAST_FIELDS = 4
"""A time and the axes of one sensor: rows of fewer cells show no header below the first line."""


@dataclass(frozen=True)
class Dialect:
    """What a look at the first lines found.

    `first_row`: number of lines before the first row of data. `header`: the header line as it stands.
    `unit_row`: cells of the units row, or None. `preamble`: number of lines above the header that are neither rows nor
    comments. `header_line`: the header's line, counted from 1.
    """

    separator: str
    decimal: str
    names: tuple[str, ...]
    header: bytes
    unit_row: tuple[str, ...] | None
    first_row: int
    preamble: int = 0
    header_line: int = 1

    @property
    def fields(self) -> int:
        """Number of columns."""
        return len(self.names)


def is_number(cell: str) -> bool:
    """Whether a cell is a number with a decimal point."""
    return bool(_NUMBER.match(cell.strip()))


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of one line, quotes taken off."""
    if separator == WHITESPACE:
        return line.split()
    if QUOTE in line:
        with suppress(csv.Error):
            return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    return [cell.strip() for cell in line.split(separator)]


def find_dialect(block: bytes, log_name: str, separator: str | None, decimal: str | None) -> Dialect:
    """The dialect of a file from its first lines (`separator` and `decimal` where configured).

    Raises
    ------
    UnreadableLog
        `missing_header`, `not_text`, `no_rows`, `too_many_columns`.
    """
    passed = max(0, comment_lines(block) - _COMMENTS_KEPT)
    lines = block.split(b"\n", passed + _PREAMBLE_LINES_CAP)[passed : passed + _PREAMBLE_LINES_CAP]
    texts = [line_text(line) for line in lines]
    body = [number for number, text in enumerate(texts) if text.strip() and not text.lstrip().startswith(COMMENTS)]
    if not body:
        raise UnreadableLog(ReasonCode.NO_ROWS, f"{log_name} holds no rows. Nothing was recorded.")
    declared = _SEPARATOR_LINE.match(texts[body[0]].strip())
    if declared and len(body) > 1:
        separator, body = separator or declared[1], body[1:]
    preamble = header_place([texts[number] for number in body], separator, decimal)
    body = body[preamble:]
    place = body[0]
    if b"\0" in lines[place] or (not texts[place].replace("\t", " ").isprintable()):
        raise UnreadableLog(
            ReasonCode.NOT_TEXT, f"{log_name} does not begin with a readable header line. Check what it is."
        )
    data = [texts[number] for number in body[1:_LINES_LOOKED_AT]]
    found = separator or _separator(texts[place], data)
    names, header, first_row = cells_of(texts[place], found), lines[place], place + 1
    if found == WHITESPACE or QUOTE in texts[place]:
        header = found.join(names).encode()
    point = decimal or _decimal(data, found)
    if all(is_number(cell.replace(point, ".")) or not cell for cell in names):
        commented = [text for text in texts[:place] if text.lstrip().startswith(COMMENTS)]
        names = cells_of(commented[-1].lstrip("#/ "), found) if commented else []
        if len(names) != len(cells_of(texts[place], found)):
            raise UnreadableLog(
                ReasonCode.MISSING_HEADER,
                f"{log_name} has no header: its first line holds only numbers. Put a line with the column names first.",
            )
        header, first_row = b"", place
    if len(names) > COLUMNS_CAP:
        raise UnreadableLog(
            ReasonCode.TOO_MANY_COLUMNS,
            f"{log_name} has {len(names)} columns, {COLUMNS_CAP} at most are read. Check what it is.",
        )
    unit_row = None
    if header and data:
        cells = cells_of(data[0], found)
        if len(cells) == len(names) and is_units_row(cells):
            unit_row, first_row = tuple(cells), body[1] + 1
    names = [name[:NAME_CAP] for name in names]
    return Dialect(found, point, tuple(names), header, unit_row, passed + first_row, preamble, passed + place + 1)


def comment_lines(block: bytes) -> int:
    """How many lines, empty or comments, stand above all others."""
    above = _NO_ROWS_ABOVE.match(block)
    return above[0].count(b"\n") if above else 0


def header_place(texts: list[str], separator: str | None, decimal: str | None) -> int:
    """Which of the lines (neither empty nor comments) is the header: the first, or one that rows of numbers follow.

    Exporters put a preamble above the header ("key,value" lines, a title). It is looked for only where the first line
    does not fit what follows it, and only taken where a line of names with as many cells as the rows is found.
    """
    for title, header in HEADERS_BELOW:
        below = [place for place, line in enumerate(texts) if line.startswith(header)]
        if texts[0].startswith(title) and below:
            return below[0]
    data = texts[1:_LINES_LOOKED_AT]
    first = separator or _separator(texts[0], data)
    fields = len(cells_of(texts[0], first))
    if sum(_is_row(line, first, fields, decimal) for line in data) > len(data) // 2:
        return 0
    for place in range(1, len(texts) - 1):
        for candidate in (separator,) if separator else (*SEPARATORS, WHITESPACE):
            fields = len(cells_of(texts[place], candidate))
            rows = texts[place : place + _LINES_LOOKED_AT]
            if fields < LEAST_FIELDS or not _is_row(rows[0], candidate, fields, decimal):
                continue
            if sum(_is_row(line, candidate, fields, decimal) for line in rows) <= len(rows) // 2:
                continue
            above = place - 1
            if above and is_units_row(cells_of(texts[above], candidate)):
                above -= 1
            names = cells_of(texts[above], candidate)
            trailing = fields - len(names) in (0, 1)
            return above if trailing and any(name and not is_number(name) for name in names) else 0
    return 0


def _is_row(line: str, separator: str, fields: int, decimal: str | None) -> bool:
    """Whether a line is a row of so many cells, more of them numbers than words."""
    cells = cells_of(line, separator)
    filled = [cell for cell in cells if cell]
    numbers = sum(is_number(cell) or (decimal != "." and bool(COMMA_NUMBER.match(cell))) for cell in filled)
    return len(cells) - fields in (0, 1) and 2 * numbers > len(filled)


def line_text(line: bytes) -> str:
    """A line as text: UTF-8, else Latin-1, without a byte-order mark."""
    try:
        return line.decode("utf-8").strip("﻿")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _separator(header: str, data: list[str]) -> str:
    present = [separator for separator in SEPARATORS if separator in header]
    for separator in present:
        fields = len(cells_of(header, separator))
        if data and sum(len(cells_of(line, separator)) == fields for line in data) > len(data) // 2:
            return separator
    return present[0] if present else WHITESPACE


def _decimal(data: list[str], separator: str) -> str:
    # Where commas separate too, a cell holds one only in quotes.
    cells = [cell for line in data for cell in cells_of(line, separator)]
    commas = sum(bool(COMMA_NUMBER.match(cell)) for cell in cells)
    points = sum("." in cell and is_number(cell) for cell in cells)
    return "," if commas > points else "."
