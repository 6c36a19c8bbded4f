"""Site and reports by URL: what this copy has written is uploaded, each file with its kind, so that a browser shows it.

A copy writes pages of the flights that it calibrated; those of others were uploaded by whoever did.
"""

from __future__ import annotations

import mimetypes
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

from fieldcal.remote.objects import Objects
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import SITE, encode_id
from fieldcal.warehouse.remote.known import in_threads, objects_of
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

PARTS = (SITE, "reports")


def at_hand(root: Path, flight_id: str) -> bool:
    """Whether a flight's page can be made of what is here; by URL what another machine has calibrated is not."""
    return objects_of(root) is None or (root / "stages" / "ingest" / encode_id(flight_id)).is_dir()


def upload_pages(root: Path, objects: Objects) -> None:
    """Upload what is another than at the last time; remove what was uploaded from here and is here no longer."""
    before = _remembered(root)
    now = {
        path.relative_to(root).as_posix(): [told.st_size, told.st_mtime_ns]
        for part in PARTS
        for path in sorted((root / part).rglob("*"))
        if path.is_file() and not path.name.startswith(".")
        for told in [path.stat()]
    }
    if now == before:
        return
    in_threads(partial(_upload, root, objects), [name for name, told in now.items() if before.get(name) != told])
    objects.delete([name for name in before if name not in now])
    write_bytes(_place(root), seal({"pages": now}), durable=False)


def _upload(root: Path, objects: Objects, name: str) -> None:
    objects.put(name, root / name, kind=mimetypes.guess_type(name)[0])


def _remembered(root: Path) -> Mapping[str, list[int]]:
    try:
        return cast(Mapping[str, Any], unseal(_place(root).read_bytes())["pages"])
    except (OSError, BrokenSeal, KeyError):
        return {}


def _place(root: Path) -> Path:
    return root / "remote" / "pages.json"
