"""Versions that made a result, as the `run` table keeps them."""

from __future__ import annotations

import functools
import importlib.metadata
import platform

import fieldcal

NAMES = ("numpy", "scipy", "polars")


@functools.cache
def versions() -> dict[str, str]:
    """Name → version."""
    libraries = {name: importlib.metadata.version(name) for name in NAMES}
    return {"fieldcal": fieldcal.__version__, "python": platform.python_version(), **libraries}
