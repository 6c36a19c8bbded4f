"""What goes wrong with the warehouse, and how an operating system's refusal becomes a sentence."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldcal.errors import FieldcalError


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


_KNOWN = {
    errno.ENOSPC: ("disk_full", "the disk is full; free some space"),
    errno.EDQUOT: ("disk_full", "the disk quota is used up; free some space"),
    errno.EFBIG: ("disk_full", "files of this size are not allowed here; raise `ulimit -f` or free some space"),
    errno.EROFS: ("read_only", "the file system is read-only; remount it or name another --warehouse"),
    errno.EACCES: (
        "permission_denied",
        "permission is denied; give this user the right to it or name another --warehouse",
    ),
    errno.EPERM: (
        "permission_denied",
        "permission is denied; give this user the right to it or name another --warehouse",
    ),
    errno.ENOENT: ("missing_file", "it is not there"),
    errno.ENOTDIR: ("not_a_folder", "a file stands where a folder is needed; move it or name another --warehouse"),
    errno.EEXIST: ("not_a_folder", "a file stands where a folder is needed; move it or name another --warehouse"),
    errno.EISDIR: ("not_a_file", "a folder stands where a file is needed; move it"),
    errno.ELOOP: ("link_loop", "its links lead in a circle; remove them"),
    errno.ENAMETOOLONG: ("name_too_long", "its name is too long for this file system; name another --warehouse"),
    errno.EMFILE: ("too_many_files", "too many files are open; raise `ulimit -n`"),
}


@contextmanager
def disk(path: Path, action: str) -> Iterator[None]:
    """Turn an `OSError` of the block into a `WarehouseError` that names the path and what is needed."""
    try:
        yield
    except OSError as error:
        reason_code, need = _KNOWN.get(error.errno or 0, ("disk_error", f"{error.strerror or error}"))
        raise WarehouseError(reason_code, f"{path} cannot be {action}: {need}.") from error
