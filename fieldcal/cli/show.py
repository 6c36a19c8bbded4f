"""Rows and numbers for people: tables on stdout, talk on stderr; JSON and CSV for programs."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterable, Sequence
from datetime import date, time
from typing import TYPE_CHECKING, Any

from fieldcal.words.numbers import cell
from fieldcal.words.printable import csv_cell, json_printable, printable
from fieldcal.words.rows import rows_of
from fieldcal.words.talk import say

if TYPE_CHECKING:
    import polars as pl
    from rich.console import Console
    from rich.table import Table

PLAIN_WIDTH = 160
FRAME_WIDTH = 1000


def print_json(document: object) -> None:
    """One JSON document on stdout."""
    text = json.dumps(document, ensure_ascii=False, indent=1, allow_nan=False, default=_as_json)
    print(json_printable(text))


def print_csv(frame: pl.DataFrame) -> None:
    """A frame as CSV on stdout; lists and structures as JSON, texts so that no spreadsheet takes one for a formula."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow([csv_cell(name) for name in frame.columns])
    writer.writerows([_as_csv(value) for value in row] for row in frame.iter_rows())


def print_frame(frame: pl.DataFrame, *, as_json: bool, as_csv: bool) -> None:
    """A frame as the caller wants it: JSON array of rows, CSV, or a table."""
    if as_json:
        print_json(rows_of(frame))
    elif as_csv:
        print_csv(frame)
    else:
        shown = table(frame.columns, ([cell(value) for value in row] for row in frame.iter_rows()))
        console(plain_width=FRAME_WIDTH).print(shown)
        say(f"{frame.height} row{'' if frame.height == 1 else 's'}")


def console(*, plain_width: int = PLAIN_WIDTH) -> Console:
    """The console of stdout; `plain_width` wide when it is no terminal. Lines of text are shown `printable`."""
    from rich.console import Console

    class PrintableConsole(Console):
        def print(self, *objects: object, **how: Any) -> None:
            super().print(*(printable(shown) if isinstance(shown, str) else shown for shown in objects), **how)

    return PrintableConsole(file=sys.stdout, width=None if sys.stdout.isatty() else plain_width, highlight=False)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None) -> Table:
    """A plain table; numbers keep to the right."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    listed = [list(row) for row in rows]
    result = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", title_style="bold", pad_edge=False)
    for i, name in enumerate(columns):
        numeric = bool(listed) and all(_numeric(row[i]) for row in listed)
        result.add_column(Text(printable(name)), justify="right" if numeric else "left", overflow="fold")
    for row in listed:
        result.add_row(*(Text(printable(text)) for text in row))
    return result


def _numeric(text: str) -> bool:
    return text == "–" or text[:1].isdigit() or (text[:1] == "-" and text[1:2].isdigit())


def _as_json(value: object) -> str:
    return value.isoformat() if isinstance(value, date | time) else str(value)


def _as_csv(value: object) -> object:
    if isinstance(value, list | dict):
        return csv_cell(json.dumps(value, ensure_ascii=False, default=_as_json))
    if isinstance(value, str):
        return csv_cell(value)
    return value.isoformat() if isinstance(value, date | time) else value
