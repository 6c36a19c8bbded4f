"""Locks of the operating system on files, which end with their process; where it has none, a sentence says so."""

from __future__ import annotations

import platform

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode

try:
    import fcntl
except ImportError as error:
    raise FieldcalError(
        ReasonCode.PLATFORM_NOT_SUPPORTED,
        f"fieldcal keeps results with POSIX file locks, which {platform.system() or 'this system'} does not have. "
        "It runs on Linux and macOS; on Windows, install it in WSL.",
    ) from error

__all__ = ["fcntl"]
