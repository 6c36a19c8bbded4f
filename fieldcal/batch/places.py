"""Where a night reads and writes: folders on this machine, or URLs, of which it has local copies."""

from __future__ import annotations

from pathlib import Path

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.archive import local_archive
from fieldcal.remote.url import above, is_url
from fieldcal.warehouse import Warehouse


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
    archive, session = above(str(place), 2)
    folder = local_archive(archive)
    if not (folder / session).is_dir():
        raise FieldcalError(ReasonCode.NO_SESSION, f"There is no session folder at {place}.")
    return folder, folder / session


def warehouse_at(place: str | Path | None) -> Path:
    """Data root of a warehouse; of one by URL the copy, brought up to date."""
    return Warehouse(place).root


def _folder(place: str | Path, reason_code: ReasonCode, what: str) -> Path:
    if not Path(place).is_dir():
        raise FieldcalError(reason_code, f"There is no {what} at {place}.")
    return Path(place).absolute()
