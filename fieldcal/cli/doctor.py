"""`fieldcal doctor`: is everything there that a night needs, and what to do where it is not. Nothing is changed."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import stat
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement

import fieldcal
from fieldcal import compiled
from fieldcal.config.find import configuration_of, find_source
from fieldcal.errors import FieldcalError
from fieldcal.flows.alive import FOLDER as RUNNING
from fieldcal.flows.alive import dead, is_held
from fieldcal.flows.connection import answers, no_answer
from fieldcal.flows.server import has_served, serving_address
from fieldcal.logs import find_logs
from fieldcal.logs.unread import find_unread, told

OK, WARNING, FAILED = "ok", "warning", "failed"
LEAST_FREE_BYTES = 200 << 20
LITTLE_FREE_BYTES = 2 << 30
LEAST_FILES_OPEN = 256
LEAST_PYTHON = (3, 11)
WIDTH = 80


@dataclass(frozen=True)
class Check:
    """One thing looked at: `status` ok, warning or failed, what was found, and what to do unless it is ok."""

    check: str
    status: str
    found: str
    advice: str | None = None


@dataclass(frozen=True)
class Examination:
    """All that was looked at; `ok`: nothing failed."""

    ok: bool
    checks: list[Check]


def examine(root: Path, archive: Path | None = None, config: Path | None = None) -> Examination:
    """Look at everything."""
    checks = [
        *_versions(),
        *_root(root),
        *([] if archive is None else [_archive(archive, config)]),
        *_disk(root),
        _open_files(),
        *_locks(root),
        _server(root),
    ]
    return Examination(all(check.status != FAILED for check in checks), checks)


def lines(result: Examination) -> Iterator[str]:
    """What was looked at, a check a line or two; what is wrong says what to do."""
    for check in result.checks:
        head = f"{check.status:8} {check.check:14}"
        yield from _wrapped(head, check.found)
        if check.advice:
            yield from _wrapped(" " * len(head), check.advice)


def _wrapped(head: str, text: str) -> list[str]:
    rest = " " * len(head)
    wrapper = textwrap.TextWrapper(
        WIDTH, initial_indent=head, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
    )
    return wrapper.wrap(text) or [head.rstrip()]


def _versions() -> Iterator[Check]:
    machine = f"{platform.system()} {platform.machine()}"
    found = f"{platform.python_implementation()} {platform.python_version()} on {machine}"
    old = sys.version_info[:2] < LEAST_PYTHON
    yield Check("python", FAILED if old else OK, found, "Install Python 3.11 or later." if old else None)
    yield Check("fieldcal", OK, fieldcal.__version__)
    asked = compiled.LIBRARY is None and os.environ.get(compiled.SWITCH) is None
    advice = "Install a C compiler, then fieldcal once more: the joint estimate takes a third of the time."
    yield Check("kernel", WARNING if asked else OK, compiled.DESCRIPTION, advice if asked else None)
    try:
        required = importlib.metadata.requires("fieldcal") or []
    except importlib.metadata.PackageNotFoundError:
        yield Check("libraries", WARNING, "fieldcal is not installed", "Install it: pip install fieldcal.")
        return
    for text in required:
        wanted = Requirement(text)
        if wanted.marker is None or wanted.marker.evaluate({"extra": ""}):
            yield _library(wanted)


def _library(wanted: Requirement) -> Check:
    advice = f"pip install '{wanted.name}{wanted.specifier}'"
    try:
        version = importlib.metadata.version(wanted.name)
    except importlib.metadata.PackageNotFoundError:
        return Check(wanted.name, FAILED, "missing", advice)
    if wanted.specifier.contains(version, prereleases=True):
        return Check(wanted.name, OK, version)
    return Check(wanted.name, WARNING, f"{version}, tested with {wanted.specifier}", advice)


def _root(root: Path) -> Iterator[Check]:
    place = _nearest(root)
    if not root.exists():
        yield Check("warehouse", OK, f"{root} does not exist yet; the first night makes it")
    elif not root.is_dir():
        yield Check("warehouse", FAILED, f"{root} is no folder", "Move the file, or name another --warehouse.")
        return
    else:
        yield Check("warehouse", OK, str(root))
    yield _writable(place)
    stages = root / "stages"
    if stages.is_dir() and stat.S_IMODE(stages.stat().st_mode) & 0o077:
        yield Check("cache", WARNING, f"{stages} is open to others", f"chmod 700 '{stages}' (the next night does).")


def _writable(folder: Path) -> Check:
    """By writing, since root squash, quotas and read-only mounts do not show in the mode."""
    try:
        with tempfile.TemporaryFile(dir=folder) as stream:
            stream.write(bytes(4096))
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        why = f"{folder} cannot be written: {(error.strerror or str(error)).lower()}"
        return Check("permissions", FAILED, why, "Give this user the right to it, or name another --warehouse.")
    return Check("permissions", OK, f"{folder} can be written")


def _archive(archive: Path, config: Path | None) -> Check:
    if not archive.is_dir():
        return Check("archive", FAILED, f"there is no folder {archive}", "Mount it, or correct the path.")
    unreadable = [path for path in sorted(archive.rglob("*")) if not path.is_symlink() and not os.access(path, os.R_OK)]
    if unreadable:
        found = f"{len(unreadable)} of its files cannot be read, the first is {unreadable[0]}"
        return Check("archive", WARNING, found, "Give this user the right to read them.")
    try:
        mapped = configuration_of(find_source(config, archive)).logs
    except FieldcalError as error:
        return Check("archive", WARNING, f"{archive}: {error.sentence}", "Correct the configuration.")
    logs = find_logs(archive, mapped)
    if unread := find_unread(archive, {log.log_uri for log in logs}):
        advice = "Convert them, name them in archive.logs, or move them out."
        return Check("archive", WARNING, f"{archive}: {len(logs)} logs; {told(unread)}", advice)
    return Check("archive", OK, f"{archive}: {len(logs)} logs")


def _disk(root: Path) -> Iterator[Check]:
    place = _nearest(root)
    free = shutil.disk_usage(place).free
    status = FAILED if free < LEAST_FREE_BYTES else WARNING if free < LITTLE_FREE_BYTES else OK
    advice = None if status == OK else f"Free some space below {place}; a night needs about the size of its new logs."
    yield Check("disk", status, f"{free / 1e9:.1f} GB free at {place}", advice)
    nodes = os.statvfs(place)
    if nodes.f_files and nodes.f_favail < 10_000:
        yield Check("disk", WARNING, f"{nodes.f_favail} inodes free at {place}", "Remove files that are not needed.")


def _open_files() -> Check:
    import resource

    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    few = limit != resource.RLIM_INFINITY and limit < LEAST_FILES_OPEN
    return Check("open files", WARNING if few else OK, f"limit {limit}", "Raise it: ulimit -n 1024." if few else None)


def _locks(root: Path) -> Iterator[Check]:
    held = [path for path in sorted(root.glob(".lock-*")) if is_held(path)]
    names = ", ".join(path.name.removeprefix(".lock-") for path in held[:5])
    yield Check("locks", OK, f"being published now: {names}" if held else "free")
    if (root / RUNNING).is_dir() and (abandoned := dead(root)):
        yield Check("runs", WARNING, f"{len(abandoned)} were killed", "The next night marks them as crashed.")


def _server(root: Path) -> Check:
    own = os.environ.get("PREFECT_API_URL")
    if own:
        if answers(own):
            return Check("server", OK, f"PREFECT_API_URL={own} answers")
        return Check("server", FAILED, f"PREFECT_API_URL={own} does not answer", no_answer(own))
    serving = serving_address(root)
    if serving is not None and answers(serving):
        return Check("server", OK, f"fieldcal serve answers at {serving}")
    if has_served(root):
        return Check("server", WARNING, "fieldcal serve is not running", "Start it again: fieldcal serve.")
    return Check("server", OK, "none is configured; every night starts one of its own on 127.0.0.1")


def _nearest(path: Path) -> Path:
    """The path, or the folder above it that exists."""
    path = path.absolute()
    while not path.exists() and path != path.parent:
        path = path.parent
    return path
