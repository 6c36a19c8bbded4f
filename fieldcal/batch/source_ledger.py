"""The digests of the steps' source, remembered for as long as the code is the same: reading imports takes a second."""

from __future__ import annotations

from pathlib import Path

from fieldcal.batch import steps
from fieldcal.stages import run_key
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal


def know_sources(root: Path, *, keep: bool) -> None:
    """Take the digests that the root remembers of this very code; else work them out and, with `keep`, remember."""
    place = root / "night" / "sources.json"
    try:
        found = unseal(place.read_bytes())
        if found["code"] == run_key.code_digest() and set(found["sources"]) == set(steps.STEPS):
            steps.take_sources(found["sources"])
            return
    except (OSError, BrokenSeal, KeyError, TypeError):
        pass
    sources = steps.step_sources()
    if keep:
        write_bytes(place, seal({"code": run_key.code_digest(), "sources": sources}), durable=False)
