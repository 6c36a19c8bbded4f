"""Digests of the source of every step and of the trends, remembered for as long as no file of the package changes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from fieldcal.logs import ingest
from fieldcal.provenance.run_key import code_digest, source_digest
from fieldcal.stages.pipeline import INGEST, PIPELINE
from fieldcal.stages.stage import Stage, refused_beforehand
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

TRENDS = "trends"
NAMES = (INGEST, *(stage.name for stage in PIPELINE), TRENDS)

_known: dict[str, str] = {}


def sources() -> Mapping[str, str]:
    """Digest by step, and of the `TRENDS`, taken once in a process: what runs is what was imported."""
    if not _known:
        from fieldcal.trends.drift_table import update_drift
        from fieldcal.trends.pooled.table import update_pooled

        _known.update({stage.name: stage_source(stage) for stage in PIPELINE})
        _known[INGEST] = source_digest(ingest.tidy_log, ingest.logged_units, ingest.rejected)
        _known[TRENDS] = source_digest(update_drift, update_pooled)
    return _known


def stage_source(stage: Stage) -> str:
    """Digest of what a stage runs, and of what is declared of it that decides whether it runs at all."""
    declared = json.dumps([sorted(stage.reads.items()), stage.needs, stage.trusts])
    code = source_digest(stage.function, refused_beforehand)
    return hashlib.blake2b(f"{code}{declared}".encode(), digest_size=16).hexdigest()


def know_sources(root: Path, *, keep: bool) -> None:
    """Take the digests that the root remembers of this very code; else work them out and, with `keep`, remember."""
    found = _remembered(root)
    if found is not None:
        _known.update(found)
    elif keep:
        write_bytes(_place(root), seal({"code": code_digest(), "sources": dict(sources())}), durable=False)
    else:
        sources()


def is_new_to(root: Path) -> bool:
    """Whether this code has run no night of the root yet: the next plans for seconds, and most likely has work."""
    return _remembered(root) is None


def _remembered(root: Path) -> dict[str, str] | None:
    try:
        found = unseal(_place(root).read_bytes())
        digests = found["sources"]
        if found["code"] == code_digest() and isinstance(digests, dict) and set(digests) == set(NAMES):
            return {name: str(digest) for name, digest in digests.items()}
    except (OSError, BrokenSeal, KeyError):
        pass
    return None


def _place(root: Path) -> Path:
    return root / "night" / "sources.json"
