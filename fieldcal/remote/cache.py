"""Where local copies of what lies in object stores are kept, and whose copy a folder is."""

from __future__ import annotations

import hashlib
import json
import os
import re
from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

FOLDER, GIGABYTES = "FIELDCAL_CACHE_DIR", "FIELDCAL_CACHE_GB"
LARGEST_GB = 20.0
"""Of logs, unless the environment says otherwise."""
ARCHIVES, WAREHOUSES = "archives", "warehouses"


def cache_root() -> Path:
    """Folder of all copies: FIELDCAL_CACHE_DIR, else `fieldcal` where this user's caches are."""
    named = os.environ.get(FOLDER)
    if named:
        return Path(named).resolve()
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(caches).resolve() / "fieldcal"


def copy_of(kind: str, url: str) -> Path:
    """Folder for the copy of what lies at a URL; it need not be there."""
    readable = re.sub(r"[^A-Za-z0-9]+", "-", urlsplit(url).netloc + urlsplit(url).path)[:40].strip("-")
    return cache_root() / kind / f"{readable}-{hashlib.sha256(url.encode()).hexdigest()[:16]}"


def note_copy(kind: str, url: str) -> Path:
    """The same, after a note beside it whose copy it is. The folder of all is readable by its owner only."""
    folder = copy_of(kind, url)
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    note = _note(folder)
    if not note.exists():
        beside = note.with_name(f".{note.name}.{os.getpid()}")
        beside.write_text(json.dumps({"url": url}), encoding="utf-8")
        beside.replace(note)
    return folder


def origin(kind: str, path: Path) -> tuple[Path, str] | None:
    """The copy that a path lies in, and its URL; None of any path that is in no copy."""
    root = cache_root() / kind
    if not path.is_relative_to(root) or path == root:
        return None
    folder = root / path.relative_to(root).parts[0]
    try:
        return folder, _url_in(_note(folder))
    except (OSError, ValueError, KeyError):
        return None


def called(path: Path) -> str:
    """What people call a folder: by its URL, where it is a copy."""
    found = origin(ARCHIVES, path) or origin(WAREHOUSES, path)
    return str(path) if found is None else "/".join([found[1], *path.relative_to(found[0]).parts])


@cache
def _url_in(note: Path) -> str:
    return str(json.loads(note.read_bytes())["url"])


def _note(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.json")


def most_bytes() -> float:
    """How many bytes of logs may be kept."""
    try:
        return float(os.environ[GIGABYTES]) * 1e9
    except (KeyError, ValueError):
        return LARGEST_GB * 1e9
