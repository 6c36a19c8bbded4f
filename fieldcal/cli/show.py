"""Documents and frames on stdout: JSON and CSV for programs, a table for people."""

from __future__ import annotations

import csv
import json
import sys
from datetime import date, time
from typing import TYPE_CHECKING

from fieldcal.words.numbers import cell
from fieldcal.words.printable import csv_cell, json_printable
from fieldcal.words.rows import rows_of
from fieldcal.words.talk import say

if TYPE_CHECKING:
    import polars as pl


def print_json(document: object) -> None:
    """One JSON document on stdout."""
    text = json.dumps(document, ensure_ascii=False, indent=1, allow_nan=False, default=_as_json)
    print(json_printable(text))


def print_csv(frame: pl.DataFrame) -> None:
    """A frame as CSV on stdout; lists and structures as JSON, texts so that no spreadsheet takes one for a formula."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow([csv_cell(name) for name in frame.columns])
    writer.writerows([_as_csv(value) for value in row] for row in frame.iter_rows())


def print_frame(frame: pl.DataFrame, *, as_json: bool, as_csv: bool, wide: bool = False) -> None:
    """A frame as the caller wants it: JSON array of rows, CSV, or a table."""
    if as_json:
        print_json(rows_of(frame))
    elif as_csv:
        print_csv(frame)
    else:
        from fieldcal.cli.present.screen import console, table

        rows = ([cell(value) for value in row] for row in frame.iter_rows())
        console(wide=wide).print(table(frame.columns, rows))
        say(f"{frame.height} row{'' if frame.height == 1 else 's'}")


def _as_json(value: object) -> str:
    return value.isoformat() if isinstance(value, date | time) else str(value)


def _as_csv(value: object) -> object:
    if isinstance(value, list | dict):
        return csv_cell(json.dumps(value, ensure_ascii=False, default=_as_json))
    if isinstance(value, str):
        return csv_cell(value)
    return value.isoformat() if isinstance(value, date | time) else value
