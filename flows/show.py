"""Rows and numbers for people: tables on stdout, talk on stderr; JSON and CSV for programs."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import polars as pl
    from rich.console import Console
    from rich.table import Table

PLAIN_WIDTH = 160
FRAME_WIDTH = 1000
NESTED = ("measured", "versions", "findings")


def say(sentence: str) -> None:
    """Talk: to stderr."""
    print(sentence, file=sys.stderr, flush=True)


def print_json(document: Any) -> None:
    """One JSON document on stdout."""
    print(json.dumps(document, ensure_ascii=False, indent=1, allow_nan=False, default=_as_json))


def print_csv(frame: pl.DataFrame) -> None:
    """A frame as CSV on stdout; lists and structures as JSON."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(frame.columns)
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


def rows_of(frame: pl.DataFrame) -> list[dict[str, Any]]:
    """Rows as objects; what is not a finite number is null."""
    return [{name: _finite(value) for name, value in row.items()} for row in frame.iter_rows(named=True)]


def unfolded(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row whose JSON texts (`measured`, `versions`, `findings`) are objects."""
    return {k: json.loads(v) if k in NESTED and isinstance(v, str) else v for k, v in row.items()}


def console(*, plain_width: int = PLAIN_WIDTH) -> Console:
    """The console of stdout; `plain_width` wide when it is no terminal."""
    from rich.console import Console

    return Console(file=sys.stdout, width=None if sys.stdout.isatty() else plain_width, highlight=False)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None) -> Table:
    """A plain table; numbers keep to the right."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    listed = [list(row) for row in rows]
    result = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", title_style="bold", pad_edge=False)
    for i, name in enumerate(columns):
        numeric = bool(listed) and all(_numeric(row[i]) for row in listed)
        result.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for row in listed:
        result.add_row(*(Text(text) for text in row))
    return result


def cell(value: Any) -> str:
    """A value in a table."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, datetime):
        return value.strftime("%Y-%m-%d %H:%M:%S")
    return str(value)


def number(value: float | None, digits: int = 5) -> str:
    """A number with so many significant digits."""
    return "–" if value is None else f"{value:.{digits}g}"


def with_sd(value: float | None, sd: float | None) -> str:
    """A value and its standard deviation, to the digits that the latter leaves."""
    if value is None:
        return "–"
    if sd is None or not sd > 0:
        return number(value)
    from math import floor, log10

    places = 1 - floor(log10(sd))
    places = 0 if -3 <= places < 0 else places
    if 0 <= places <= 9:
        return f"{value:.{places}f} ± {sd:.{places}f}"
    return f"{number(value)} ± {number(sd, 2)}"


def _numeric(text: str) -> bool:
    return text == "–" or text[:1].isdigit() or (text[:1] == "-" and text[1:2].isdigit())


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))) else value


def _as_json(value: Any) -> Any:
    return value.isoformat() if hasattr(value, "isoformat") else str(value)


def _as_csv(value: Any) -> Any:
    if isinstance(value, list | dict):
        return json.dumps(value, ensure_ascii=False, default=_as_json)
    return value.isoformat() if hasattr(value, "isoformat") else value
