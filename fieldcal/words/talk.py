"""Talk, which goes to stderr: stdout is for data."""

from __future__ import annotations

import sys

from fieldcal.words.printable import printable


def say(sentence: str) -> None:
    """Talk: to stderr, in one line."""
    print(printable(sentence), file=sys.stderr, flush=True)
