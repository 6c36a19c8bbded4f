"""What is logged on a worker while it works, for the night to say."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

MOST = 50
"""Lines of a batch."""


@contextmanager
def heard() -> Iterator[list[str]]:
    """Lines that any library logs during the block, warnings and worse, as they come."""
    lines: list[str] = []
    handler = _Lines(lines)
    logging.getLogger().addHandler(handler)
    try:
        yield lines
    finally:
        logging.getLogger().removeHandler(handler)


class _Lines(logging.Handler):
    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        if len(self._lines) < MOST:
            self._lines.append(f"{record.name}: {record.getMessage()}")
