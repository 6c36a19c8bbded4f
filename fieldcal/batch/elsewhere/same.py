"""Whether a worker computes what the night would: the same fieldcal, Python, libraries and kernel."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping

import fieldcal
from fieldcal.provenance.run_key import code_digest, library_versions

SHOWN = 12
"""Digits of a digest."""


def made_by() -> dict[str, str]:
    """What results of this process follow from, by name."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"fieldcal": fieldcal.__version__, "its code": code_digest()[:SHOWN], "Python": python, **library_versions()}


def difference(worker: str, theirs: Mapping[str, str], ours: Mapping[str, str]) -> str | None:
    """One sentence where a worker has other versions than the night; None where it has the same."""
    differing = [name for name in ours if theirs.get(name) != ours[name]]
    if not differing:
        return None
    named = list(dict.fromkeys(["fieldcal", *differing]))
    has, wanted = (", ".join(f"{name} {of.get(name, 'unknown')}" for name in named) for of in (theirs, ours))
    return f"Worker {worker} has {has}, the night {wanted}: install the same on both, then run it again."


def this_worker() -> str:
    """What people call this process."""
    return f"{platform.node()}, process {os.getpid()}"
