"""The lines of a text file, whatever its encoding and line ends, in blocks of bounded size."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from pathlib import Path

from fieldcal.errors import UnreadableLog
from fieldcal.reason_codes import ReasonCode

BLOCK_BYTES = 4 << 20
LINE_CAP_BYTES = 1 << 20
_BOMS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
_PROBE_BYTES = 4096
_NULS = re.compile(rb"\0{2,}")


class LineBlocks:
    """Whole lines of a file as UTF-8 bytes, each ended by a single line feed.

    Byte-order marks, UTF-16 and the line ends CR LF and CR are taken away, runs of NUL bytes become one. Undecodable
    bytes of a UTF-8 file are left as they are. `unterminated` tells, once iterated, that the last line had no end and
    was not delivered.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`, `not_text` (no line end within 1 MiB).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.unterminated = False
        try:
            if not path.stat().st_size:
                raise UnreadableLog(
                    ReasonCode.EMPTY_FILE, f"{path.name} is empty. Nothing was recorded, or the copy failed."
                )
            with path.open("rb") as stream:
                self._encoding, self._skip = _encoding(stream.read(_PROBE_BYTES))
        except OSError as error:
            raise _not_readable(path, error) from error

    def __iter__(self) -> Iterator[bytes]:
        self.unterminated = False
        decoder = codecs.getincrementaldecoder(self._encoding)("replace") if self._encoding != "utf-8" else None
        rest = b""
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._skip)
                while piece := stream.read(BLOCK_BYTES):
                    rest += _NULS.sub(b"\0", decoder.decode(piece).encode() if decoder else piece)
                    held = rest.endswith(b"\r")
                    lines, rest = _split(rest[:-1] if held else rest)
                    rest += b"\r" if held else b""
                    if len(rest) > LINE_CAP_BYTES:
                        raise UnreadableLog(
                            ReasonCode.NOT_TEXT,
                            f"{self._path.name} has a line of over {LINE_CAP_BYTES} bytes: it is no table of text. "
                            "Check what it is.",
                        )
                    if lines:
                        yield lines
        except OSError as error:
            raise _not_readable(self._path, error) from error
        if rest.endswith(b"\r"):
            lines, rest = _split(rest)
            yield lines
        self.unterminated = bool(rest.strip(b" \t\x1a"))


def _split(text: bytes) -> tuple[bytes, bytes]:
    if b"\r" in text:
        text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    end = text.rfind(b"\n") + 1
    return text[:end], text[end:]


def _encoding(probe: bytes) -> tuple[str, int]:
    """Encoding, and how many bytes of byte-order mark to skip."""
    for mark, encoding in _BOMS:
        if probe.startswith(mark):
            return encoding, len(mark)
    pairs = len(probe) // 2
    if pairs >= 8:
        even, odd = probe[0::2].count(0), probe[1::2].count(0)
        if odd > 0.9 * pairs and not even:
            return "utf-16-le", 0
        if even > 0.9 * pairs and not odd:
            return "utf-16-be", 0
    return "utf-8", 0


def _not_readable(path: Path, error: OSError) -> UnreadableLog:
    return UnreadableLog(ReasonCode.NOT_READABLE, f"{path.name} cannot be read: {error}. Check disk and permissions.")
