"""Where logs are read: folders on this machine, or URLs, of which there are local copies."""

from __future__ import annotations

from pathlib import Path

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.archive import local_archive
from fieldcal.remote.content import here
from fieldcal.remote.url import above, is_url

LEVELS_OF_A_SESSION, LEVELS_OF_A_LOG = 2, 3
"""ARCHIVE/<vehicle>/<session>/<log>."""


def archive_at(place: str | Path) -> Path:
    """Folder of an archive; of one by URL the copy, brought up to what is listed there.

    Raises
    ------
    FieldcalError
        `no_archive`, or the store's refusal.
    """
    return local_archive(str(place)) if is_url(place) else _folder(place, ReasonCode.NO_ARCHIVE, "archive")


def session_at(place: str | Path) -> tuple[Path, Path]:
    """Folders of an archive and of one session in it.

    Raises
    ------
    FieldcalError
        `no_session`, `no_archive`, or the store's refusal.
    """
    if not is_url(place):
        folder = _folder(place, ReasonCode.NO_SESSION, "session folder")
        return folder.parent.parent, folder
    archive, session = above(str(place), LEVELS_OF_A_SESSION)
    folder = local_archive(archive)
    if not (folder / session).is_dir():
        raise FieldcalError(ReasonCode.NO_SESSION, f"There is no session folder at {place}.")
    return folder, folder / session


def folder_at(place: str | Path, command: str) -> Path:
    """A place that must be a folder on this machine.

    Raises
    ------
    FieldcalError
        `wrong_option`: it is a URL.
    """
    if is_url(place):
        told = f"fieldcal {command} takes a folder on this machine, not {place}; nightly and session take URLs."
        raise FieldcalError(ReasonCode.WRONG_OPTION, told)
    return Path(place)


def log_at(place: str | Path) -> Path:
    """Path of a log; of one by URL its place in the copy of its archive, with its content.

    Raises
    ------
    FieldcalError
        `not_found`, or the store's refusal.
    """
    if not is_url(place):
        return Path(place)
    archive, name = above(str(place), LEVELS_OF_A_LOG)
    log = local_archive(archive) / name
    if not log.exists():
        raise FieldcalError(ReasonCode.NOT_FOUND, f"There is no log at {place}.")
    with here(log):
        return log


def _folder(place: str | Path, reason_code: ReasonCode, what: str) -> Path:
    if not Path(place).is_dir():
        raise FieldcalError(reason_code, f"There is no {what} at {place}.")
    return Path(place).absolute()
