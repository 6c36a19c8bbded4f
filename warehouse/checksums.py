"""The recorded sha256 of every file that is kept.

While a file gets its final name the record holds the sha256 of the new content and of what was there until then (None:
nothing), so that after a crash at that moment either is what it should be; afterwards it holds the new one alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import WAREHOUSES, origin
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.files import file_sha256, write_bytes
from fieldcal.warehouse.layout import checksum_path, history_files
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

_TRIES = 3
"""A file may be replaced between the look at its record and at itself."""


@contextmanager
def recording(root: Path, path: Path, sha256: str, *, dispensable: bool = False) -> Iterator[None]:
    """Record the sha256 that `path` gets within the block; one that is `dispensable` may be deleted later."""
    before = file_sha256(path) if path.exists() else None
    record(root, path, [sha256, before])
    yield
    record(root, path, [sha256, None] if dispensable else [sha256])


def record(root: Path, path: Path, allowed: list[str | None]) -> None:
    """Record what `path` may hold from now on."""
    write_bytes(checksum_path(root, path), seal({"sha256": allowed}))


def recorded(root: Path, path: Path) -> list[str | None] | None:
    """What `path` may hold (None in the list: it may be absent); None when nothing is recorded.

    Raises
    ------
    BrokenSeal
        The record itself is damaged.
    """
    beside = checksum_path(root, path)
    if not beside.exists():
        return None
    with disk(beside, "read"):
        data = beside.read_bytes()
    found = unseal(data).get("sha256")
    if not isinstance(found, list):
        raise BrokenSeal("it lists no sha256")
    return found


def problem(root: Path, path: Path, sha256: str | None) -> str | None:
    """What is wrong with `path`, whose content has this sha256 (None: it is absent); None when nothing is."""
    try:
        allowed = recorded(root, path)
    except BrokenSeal as error:
        return f"its recorded sha256 is damaged: {error}"
    if allowed is None:
        return "no sha256 is recorded for it"
    if sha256 in allowed:
        return None
    return "it is missing" if sha256 is None else "its content is not what was written: the sha256 differs"


def assure(root: Path, paths: Iterable[Path], *, strict: bool = False) -> None:
    """Make sure, before files are read, that each holds what was written: every byte, by its recorded sha256.

    Where none is recorded, or the record itself is damaged, the file has only the checksums of its pages: `strict`
    refuses that too. One that is absent holds nothing wrong: `verify` tells that it is missing.

    Raises
    ------
    WarehouseError
        `damaged_file`, or the disk's refusal.
    """
    for path in paths:
        for _ in range(_TRIES):
            wrong = _wrong(root, path, strict)
            if wrong is None:
                break
        else:
            told = f"{path} is damaged ({wrong}); `fieldcal verify` lists what else is. {remedy(root, path)}"
            raise WarehouseError(ReasonCode.DAMAGED_FILE, told)


def assured(root: Path, path: Path) -> str:
    """The sha256 of a file that holds what was written; raises as `assure`, strictly."""
    assure(root, [path], strict=True)
    return file_sha256(path)


def _wrong(root: Path, path: Path, strict: bool) -> str | None:
    if not path.exists():
        return None
    if not strict:
        try:
            if recorded(root, path) is None:
                return None
        except BrokenSeal:
            return None
    return problem(root, path, file_sha256(path))


def remedy(root: Path, path: Path) -> str:
    """What to do about a damaged file: what people decided and exported no night makes anew."""
    if (copy := origin(WAREHOUSES, root)) is not None:
        return f"Remove it: it is a copy of what lies at {copy[1]}, and is fetched anew."
    beside = checksum_path(root, path)
    if path.is_relative_to(root / "tables") and path.relative_to(root / "tables").parts[0] in ("decision", "export"):
        return f"Restore it: no night makes it anew. Without a copy of it, remove it and {beside}, and decide again."
    return f"Restore it, or remove it and {beside} and run the night again: the flights are calibrated anew."


def history_digest(root: Path, tables: Iterable[str]) -> str:
    """One digest of what these history tables hold by their records: the same as long as nothing was published."""
    digest = hashlib.sha256()
    for table in sorted(tables):
        for path in history_files(root, table):
            beside = checksum_path(root, path)
            recorded_now = beside.read_bytes() if beside.exists() else b"none"
            digest.update(f"{path.relative_to(root)}\0".encode("utf-8", "surrogateescape") + recorded_now)
    return digest.hexdigest()
