"""What goes wrong with the warehouse, and how an operating system's refusal becomes a sentence."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import called


class WarehouseError(FieldcalError):
    """The warehouse cannot be read or written as asked; what it held before is still there.

    Examples
    --------
    >>> import fieldcal
    >>> try:
    ...     fieldcal.Warehouse("nowhere").history()
    ... except fieldcal.WarehouseError as error:
    ...     print(error.reason_code)
    no_warehouse
    """


def no_warehouse(root: Path) -> WarehouseError:
    """What is told where nothing was ever published."""
    told = f"There is no warehouse at {called(root)}; run `fieldcal nightly` or give --warehouse."
    return WarehouseError(ReasonCode.NO_WAREHOUSE, told)


_KNOWN = {
    errno.ENOSPC: (ReasonCode.DISK_FULL, "the disk is full; free some space"),
    errno.EDQUOT: (ReasonCode.DISK_FULL, "the disk quota is used up; free some space"),
    errno.EFBIG: (
        ReasonCode.DISK_FULL,
        "files of this size are not allowed here; raise `ulimit -f` or free some space",
    ),
    errno.EROFS: (ReasonCode.READ_ONLY, "the file system is read-only; remount it or name another --warehouse"),
    errno.EACCES: (
        ReasonCode.PERMISSION_DENIED,
        "permission is denied; give this user the right to it or name another --warehouse",
    ),
    errno.EPERM: (
        ReasonCode.PERMISSION_DENIED,
        "permission is denied; give this user the right to it or name another --warehouse",
    ),
    errno.ENOENT: (ReasonCode.MISSING_FILE, "it is not there"),
    errno.ENOTDIR: (
        ReasonCode.NOT_A_FOLDER,
        "a file stands where a folder is needed; move it or name another --warehouse",
    ),
    errno.EEXIST: (
        ReasonCode.NOT_A_FOLDER,
        "a file stands where a folder is needed; move it or name another --warehouse",
    ),
    errno.EISDIR: (ReasonCode.NOT_A_FILE, "a folder stands where a file is needed; move it"),
    errno.ELOOP: (ReasonCode.LINK_LOOP, "its links lead in a circle; remove them"),
    errno.ENAMETOOLONG: (
        ReasonCode.NAME_TOO_LONG,
        "its name is too long for this file system; name another --warehouse",
    ),
    errno.EMFILE: (ReasonCode.TOO_MANY_FILES, "too many files are open; raise `ulimit -n`"),
}


@contextmanager
def disk(path: Path, action: str) -> Iterator[None]:
    """Turn an `OSError` of the block into a `WarehouseError` that names the path and what is needed."""
    try:
        yield
    except OSError as error:
        reason_code, need = _KNOWN.get(error.errno or 0, (ReasonCode.DISK_ERROR, f"{error.strerror or error}"))
        raise WarehouseError(reason_code, f"{path} cannot be {action}: {need}.") from error
