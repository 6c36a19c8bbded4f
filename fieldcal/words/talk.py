"""Talk, which goes to stderr: stdout is for data."""

from __future__ import annotations

import sys


def say(sentence: str) -> None:
    """Talk: to stderr."""
    print(sentence, file=sys.stderr, flush=True)
