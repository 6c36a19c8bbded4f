"""Check every file that is kept against its recorded sha256, and the sources against theirs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypedDict, cast

from fieldcal.errors import FieldcalError
from fieldcal.warehouse import checksums
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.errors import WarehouseError, disk, no_warehouse
from fieldcal.warehouse.files import TEMPORARY, file_sha256
from fieldcal.warehouse.layout import FORMER_PARTITION, PARTITION, SITE, history_files, under
from fieldcal.warehouse.remote.whole import remote_files
from fieldcal.warehouse.sealed import BrokenSeal, unseal
from fieldcal.warehouse.stage_store import RECORD, broken_outputs, outputs_of
from fieldcal.warehouse.store import read_table

SHA256_BYTES = hashlib.sha256().digest_size
"""Arrays that a night remembers begin with the digest of what follows."""
Problem = tuple[str, str | None]
"""A path as shown, and what is wrong with it (None: nothing)."""


class Damage(TypedDict):
    """A file and what is wrong with it."""

    path: str
    reason: str


class Verification(TypedDict):
    """What `verify` found."""

    ok: bool
    files: int
    damaged: list[Damage]
    content_sha256: str | None


def verify(root: Path, archive: Path | None = None, log_sha256: Callable[[Path], str] | None = None) -> Verification:
    """Check `tables/`, `signals/`, `reports/`, complete stage outputs, what nights remember, the site and, with
    `archive`, the logs. Reports that an older release wrote have no recorded sha256 and are passed over.

    Nothing is changed.

    Parameters
    ----------
    archive : Path, optional
        Archive whose logs are compared with the `flight` table.
    log_sha256 : callable, optional
        sha256 of a log (a file or a folder) as ingest computes it; needed with `archive`.

    Returns
    -------
    dict
        `ok`, `files` (how many were checked), `damaged` (a list of `{"path", "reason"}`, paths relative to `root` or
        `archive`), `content_sha256` (of what `tables/` say; None when a file of theirs is damaged).

    Raises
    ------
    WarehouseError
        `no_warehouse`: there is nothing at `root`.
    """
    if not root.is_dir():
        raise no_warehouse(root)
    found = [*_recorded_files(root), *_stage_files(root), *night_files(root), *_site_files(root)]
    found += remote_files(root)
    if archive is not None:
        if log_sha256 is None:
            raise ValueError("log_sha256 is needed to check an archive")
        found += _logs(root, archive, log_sha256)
    damaged: list[Damage] = [{"path": path, "reason": reason} for path, reason in found if reason is not None]
    readable = not any(path.startswith("tables/") for path, reason in found if reason is not None)
    content = content_sha256(root) if readable else None
    return {"ok": not damaged, "files": len(found), "damaged": damaged, "content_sha256": content}


def _recorded_files(root: Path) -> Iterator[Problem]:
    """Files of the history and the signals: those there, and all that should be."""
    paths = {path for part in ("tables", "signals") for path in (root / part).rglob("*") if _kept(path)}
    records = root / "checksums"
    paths |= {
        root / path.relative_to(records).with_name(path.name.removesuffix(".json")) for path in records.rglob("*.json")
    }
    for path in sorted(paths):
        if path.is_relative_to(root / "tables") and not path.exists() and _moved(path):
            continue
        try:
            sha256 = file_sha256(path) if path.exists() else None
            yield str(path.relative_to(root)), checksums.problem(root, path, sha256)
        except WarehouseError as error:
            yield str(path.relative_to(root)), error.sentence


def _moved(path: Path) -> bool:
    """Whether a file of the history lies under its folder's other name: an upgrade records it under both for a
    moment."""
    return under(PARTITION, path).exists() or under(FORMER_PARTITION, path).exists()


def _kept(path: Path) -> bool:
    return path.is_file() and not (path.name.startswith(".") and path.name.endswith(TEMPORARY))


def _stage_files(root: Path) -> Iterator[Problem]:
    """Records of complete executions and the outputs they list. A folder without a record is merely unfinished."""
    for path in sorted((root / "stages").glob(f"*/*/*/{RECORD}")):
        shown = str(path.relative_to(root))
        try:
            with disk(path, "read"):
                record = unseal(path.read_bytes())
        except (BrokenSeal, WarehouseError) as error:
            yield shown, f"the record of the execution is damaged: {error}"
            continue
        yield shown, None
        broken = dict(broken_outputs(path.parent, record))
        for output in outputs_of(record).values():
            if "file" in output:
                file = path.parent / output["file"]
                yield str(file.relative_to(root)), broken.get(file)


def night_files(root: Path) -> Iterator[Problem]:
    """What the last night remembers for the next, each file with its own digest."""
    for path in sorted((root / "night").rglob("*.json")):
        try:
            with disk(path, "read"):
                unseal(path.read_bytes())
            yield str(path.relative_to(root)), None
        except (BrokenSeal, WarehouseError) as error:
            yield str(path.relative_to(root)), f"what the night remembers is damaged: {error}; it may be deleted"
    for path in sorted([*(root / "night").rglob("*.npz"), *(root / "night").rglob("*.bin")]):
        with disk(path, "read"):
            data = path.read_bytes()
        whole = hashlib.sha256(data[SHA256_BYTES:]).digest() == data[:SHA256_BYTES]
        yield str(path.relative_to(root)), None if whole else "what the night remembers is damaged; it may be deleted"


def _site_files(root: Path) -> Iterator[Problem]:
    """Pages of vehicles and flights, by what the night remembers of them. One that is not there is made anew."""
    for path in sorted((root / "night" / SITE).glob("*.json")):
        try:
            ledger = unseal(path.read_bytes())
        except (OSError, BrokenSeal):
            continue  # told by `night_files`
        parts = [ledger["files"], *(files for _, files in cast(Mapping[str, list[Any]], ledger["flights"]).values())]
        for name, (sha256, _) in sorted(
            pair for files in cast(list[Mapping[str, list[Any]]], parts) for pair in files.items()
        ):
            page = root / SITE / name
            whole = not page.exists() or file_sha256(page) == sha256
            wrong = (
                "its content is not what was written: the sha256 differs; it may be deleted, `fieldcal site` follows"
            )
            yield str(page.relative_to(root)), None if whole else wrong


def _logs(root: Path, archive: Path, log_sha256: Callable[[Path], str]) -> Iterator[Problem]:
    for file in history_files(root, "flight"):
        try:
            rows = read_table(file, "flight")
        except WarehouseError:
            continue
        for uri, sha256 in rows.select("log_uri", "log_sha256").iter_rows():
            yield str(uri), _log_problem(archive / str(uri), sha256, log_sha256)


def _log_problem(path: Path, sha256: str | None, log_sha256: Callable[[Path], str]) -> str | None:
    if not path.exists():
        return "the log is no longer in the archive"
    try:
        found = log_sha256(path)
    except (OSError, FieldcalError) as error:
        return f"the log cannot be read: {error}"
    return None if found == sha256 else "the log is not the one that was calibrated: its sha256 differs"
