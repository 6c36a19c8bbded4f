"""A file as memory that the system reads when it is looked at."""

from __future__ import annotations

import mmap
from pathlib import Path

from fieldcal.errors import UnreadableLog
from fieldcal.reason_codes import ReasonCode


def map_file(path: Path) -> mmap.mmap:
    """The bytes of a file. Raises UnreadableLog: `empty_file`, `not_readable`."""
    try:
        with path.open("rb") as stream:
            if not path.stat().st_size:
                raise UnreadableLog(
                    ReasonCode.EMPTY_FILE, f"{path.name} is empty. Nothing was recorded, or the copy failed."
                )
            return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise UnreadableLog(
            ReasonCode.NOT_READABLE, f"{path.name} cannot be read: {error}. Check disk and permissions."
        ) from error
