"""A file that was compressed as a whole with zstd, unpacked to a temporary file within what that may cost."""

from __future__ import annotations

import mmap
import tempfile
from pathlib import Path

import zstandard

from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap.mapped import map_file
from fieldcal.reason_codes import ReasonCode

SUFFIXES = (".zstd", ".zst")
FREE_BYTES = 512 << 20
CAP_RATIO = 64
CAP_BYTES = 64 << 30
"""A file may unpack to 512 MiB, or to 64 times its own size (recordings: 1 to 15 times), and to 64 GiB at most."""

WINDOW_CAP_BYTES = 128 << 20
_PIECE_BYTES = 1 << 14
"""What is lost before damage at most: a piece comes whole or not at all."""


def is_packed(path: Path) -> bool:
    """Whether a file's name says that it was compressed as a whole."""
    return path.name.lower().endswith(SUFFIXES)


class Unpacked:
    """The content of `path` in a temporary file, which goes when this does.

    What stands before damage is kept, and the damage told by `report`; that a file was cut is for the content's reader
    to see, as it is of one that was never packed.

    Raises
    ------
    UnreadableLog
        `empty_file`; `not_readable`: nothing of it unpacks, or there is no room for it.
    """

    def __init__(self, path: Path) -> None:
        self._name = path.name
        self._damage: str | None = None
        try:
            packed_bytes = path.stat().st_size
            self._cap = min(max(FREE_BYTES, CAP_RATIO * packed_bytes), CAP_BYTES)
            self._file = tempfile.NamedTemporaryFile(prefix="fieldcal-", suffix=path.with_suffix("").suffix)  # noqa: SIM115  # lives as long as this object
            self._bytes = self._unpack(path)
            self._file.flush()
        except OSError as error:
            raise UnreadableLog(
                ReasonCode.NOT_READABLE,
                f"{path.name} cannot be unpacked: {error}. Check disk and permissions; it is unpacked into "
                f"{tempfile.gettempdir()}, which the environment variable TMPDIR changes.",
            ) from error
        if not packed_bytes:
            raise UnreadableLog(
                ReasonCode.EMPTY_FILE, f"{path.name} is empty. Nothing was recorded, or the copy failed."
            )
        if not self._bytes:
            raise UnreadableLog(
                ReasonCode.NOT_READABLE,
                f"{path.name} does not unpack: {self._damage or 'there is nothing in it'}. Copy it again from the "
                "recorder.",
            )

    @property
    def path(self) -> Path:
        """Where the content lies."""
        return Path(self._file.name)

    def map(self) -> mmap.mmap:
        """The content as memory."""
        return map_file(self.path)

    def report(self, summary: LogSummary) -> None:
        """A finding where not everything was unpacked."""
        if self._damage:
            summary.add(
                ReasonCode.TRUNCATED,
                1,
                f"{self._name}: unpacking it ended after {self._bytes} bytes ({self._damage}). What stands before was "
                "read. Copy the file again from the recorder.",
                loses_data=True,
            )

    def _unpack(self, path: Path) -> int:
        written = 0
        decompressor = zstandard.ZstdDecompressor(max_window_size=WINDOW_CAP_BYTES)
        with path.open("rb") as stream:
            try:
                reader = decompressor.stream_reader(stream, read_across_frames=True)
                while piece := reader.read(_PIECE_BYTES):
                    room = self._cap - written
                    written += self._file.write(piece[:room])
                    if len(piece) > room:
                        self._damage = f"more than {self._cap} bytes are not unpacked from a file of its size"
                        break
            except (zstandard.ZstdError, MemoryError) as error:
                self._damage = str(error)
        return written
