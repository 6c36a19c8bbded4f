"""Text as it may be shown: what would steer a terminal, turn a line around or be invisible is written out."""

from __future__ import annotations

import re

_STEERING = re.compile("[\x00-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]")
"""Control characters, line ends among them, marks of direction, what has no width, and halves of characters."""
_FORMULA = ("=", "+", "-", "@")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|-")


def printable(text: str, keep: str = "") -> str:
    """The text with every such character as Python writes it (`\\x1b`), but for those of `keep`.

    Examples
    --------
    >>> print(printable("flight\\x1b[2J\\u202e.csv"))
    flight\\x1b[2J\\u202e.csv
    """
    return _STEERING.sub(lambda found: found[0] if found[0] in keep else ascii(found[0])[1:-1], text)


def json_printable(text: str) -> str:
    """JSON whose strings hold no such character, but escapes that read back as them."""
    return _STEERING.sub(lambda found: found[0] if found[0] == "\n" else f"\\u{ord(found[0]):04x}", text)


def csv_cell(text: str) -> str:
    """Text as a cell of CSV: what a spreadsheet would take for a formula gets an apostrophe."""
    shown = printable(text)
    return f"'{shown}" if shown.startswith(_FORMULA) and not _NUMBER.fullmatch(shown) else shown
