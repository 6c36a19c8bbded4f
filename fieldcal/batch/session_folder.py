"""In which archive a session folder really lies, past links and `..`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode


def archive_of(folder: Path, archives: Iterable[Path]) -> tuple[Path, Path]:
    """The archive that a session folder lies in, the innermost where they are nested, and the folder's place there.

    Raises
    ------
    FieldcalError
        `outside_archives`: in none of them. Whether there is such a folder elsewhere is not told.
    """
    archives = list(archives)
    real = folder.resolve()
    found = [
        (archive, archive / real.relative_to(archive.resolve()))
        for archive in archives
        if archive.resolve() in real.parents and real.is_dir()
    ]
    if not found:
        named = ", ".join(str(archive) for archive in archives)
        raise FieldcalError(
            ReasonCode.OUTSIDE_ARCHIVES,
            f"{folder} is no session folder inside the archives that are served ({named}): put it there, serve its "
            "archive too, or run it with `fieldcal session`.",
        )
    return max(found, key=lambda pair: len(pair[0].resolve().parts))
