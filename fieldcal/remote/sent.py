"""A log of an archive by URL, named for another machine: which objects it is, each in which version."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TypedDict

from fieldcal.remote.archive import arranged, stand_for
from fieldcal.remote.cache import ARCHIVES, note_copy, origin
from fieldcal.remote.url import checked


class SentLog(TypedDict):
    """`archive`: its URL; `log`: key of the log below it, a file or a folder; `files`: key → size and version
    (`content.version_ns`)."""

    archive: str
    log: str
    files: dict[str, list[int]]


def sent(log: Path) -> SentLog | None:
    """What another machine needs to find a log that lies in the copy of an archive; None of any other log."""
    copy = origin(ARCHIVES, log)
    if copy is None:
        return None
    folder, url = copy
    files = [file for file in (log.iterdir() if log.is_dir() else [log]) if not file.name.startswith(".")]
    stats = {file.relative_to(folder).as_posix(): file.stat() for file in sorted(files) if file.is_file()}
    versions = {key: [stat.st_size, stat.st_mtime_ns] for key, stat in stats.items()}
    return {"archive": url, "log": log.relative_to(folder).as_posix(), "files": versions}


def received(given: SentLog) -> Path:
    """The log's place in this machine's copy of the archive, of which it need know nothing else; its content is fetched
    when it is used (`content.here`), in the version that was named or not at all.

    Raises
    ------
    RemoteError
        `wrong_option`: no archive may lie at such a URL.
    """
    folder = note_copy(ARCHIVES, checked(given["archive"]))
    folder.mkdir(mode=0o700, exist_ok=True)
    log, named = folder / given["log"], {folder / key for key in given["files"]}
    if not all(path == log or path.parent == log for path in named):
        raise ValueError(f"{given['log']} is sent with files of another log")
    with arranged(folder):
        for parent in log.relative_to(folder).parents:
            if (folder / parent).is_file():
                (folder / parent).unlink()
        if log.is_dir() and log in named:
            shutil.rmtree(log)
        elif log.is_file() and log not in named:
            log.unlink()
        for other in [file for file in log.iterdir() if file not in named] if log.is_dir() else []:
            if other.is_file() and not other.name.startswith("."):
                other.unlink()
        for key, (size, version) in given["files"].items():
            stand_for(folder / key, size, version)
    return log
