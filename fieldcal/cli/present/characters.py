"""Characters that a terminal may not have, by those that every one has."""

from __future__ import annotations

import codecs
import sys
from io import TextIOWrapper
from typing import TextIO

PLAIN = {
    "±": "+-",
    "°": "deg",
    "µ": "u",
    "²": "^2",
    "√": "sqrt ",
    "–": "-",
    "−": "-",
    "…": "...",
    "→": "->",
    "·": "*",
    "σ": "sd",
    "ω": "w",
    "×": "x",
    "─": "-",
    **dict(zip("▁▂▃▄▅▆▇█", "_.,-~+*#", strict=True)),
}
ERRORS = "fieldcal_plain"


def settle(*streams: TextIO) -> None:
    """Let streams of another encoding than UTF-8 write what they have no character for in plain ones; they would end
    the command."""
    codecs.register_error(ERRORS, _plain)
    for stream in streams:
        if isinstance(stream, TextIOWrapper) and stream.encoding.lower().replace("-", "") != "utf8":
            stream.reconfigure(errors=ERRORS)


def for_stream(text: str) -> str:
    """The text in characters that stdout has, so that its width is what is counted."""
    if text.isascii():
        return text
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except (UnicodeEncodeError, LookupError):
        return "".join(PLAIN.get(one, one) for one in text)
    return text


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    wrong = error.object[error.start : error.end]
    return "".join(PLAIN.get(one, "?") for one in wrong), error.end
