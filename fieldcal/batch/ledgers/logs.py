"""sha256 of every log as it was last hashed, so that a night need not read a whole archive to find it unchanged.

A log counts as unchanged when size, times of change and inode of all its files are what they were; one that changed
just before it was hashed is not remembered, since another change might not show. The ledger may be deleted at any time.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

from fieldcal.batch.jobs import Ledger
from fieldcal.flight.job import Job
from fieldcal.names import Json
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import prepare
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

SETTLED_NS = 2_000_000_000


def read_ledger(root: Path) -> Ledger:
    """What is remembered; nothing where there is no whole ledger."""
    try:
        found = unseal(_place(root).read_bytes())["logs"]
        return {path: _entry(entry) for path, entry in found.items()} if isinstance(found, dict) else {}
    except (OSError, BrokenSeal, KeyError, ValueError):
        return {}


def write_ledger(root: Path, jobs: Iterable[Job]) -> None:
    """Remember these logs beside those of other archives; nothing is written when nothing is new."""
    before = read_ledger(root)
    settled = time.time_ns() - SETTLED_NS
    now = {
        job.path: (tuple(job.stamp), job.sha256)
        for job in jobs
        if job.sha256 is not None and max((*job.stamp[1::4], *job.stamp[2::4]), default=0) < settled
    }
    if all(before.get(path) == entry for path, entry in now.items()):
        return
    kept = {path: entry for path, entry in before.items() if Path(path).exists()}
    prepare(root)
    entries = {path: [list(stamp), sha256] for path, (stamp, sha256) in {**kept, **now}.items()}
    write_bytes(_place(root), seal({"logs": entries}), durable=False)


def _entry(entry: Json) -> tuple[tuple[int, ...], str]:
    match entry:
        case [[*stamp], str(sha256)]:
            return tuple(number for number in stamp if isinstance(number, int)), sha256
    raise ValueError(f"{entry!r} is no stamp with a sha256")


def _place(root: Path) -> Path:
    return root / "night" / "logs.json"
