"""DataFlash's description of itself: FMT messages, format letters, multipliers.

A message is 0xA3 0x95, one byte of type, and fields packed little-endian as the FMT message of its type says; it has
no length and no checksum. (ArduPilot, libraries/AP_Logger/LogStructure.h.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

MARK = b"\xa3\x95"
HEAD_BYTES = 3
LONGEST = 255
FMT_TYPE = 128
FMT_BYTES = 89
DIFFERENT_TYPES = 256
"""One byte names the type; logs that were joined define each again and again."""


@dataclass(frozen=True)
class Letter:
    """How a field of one format letter is stored. `divisor`: what the letter itself says of its unit, else None."""

    dtype: np.dtype[np.generic]
    divisor: float | None = None


LETTERS: Mapping[str, Letter] = {
    "a": Letter(np.dtype(("<i2", 32))),
    "b": Letter(np.dtype("i1")),
    "B": Letter(np.dtype("u1")),
    "h": Letter(np.dtype("<i2")),
    "H": Letter(np.dtype("<u2")),
    "i": Letter(np.dtype("<i4")),
    "I": Letter(np.dtype("<u4")),
    "q": Letter(np.dtype("<i8")),
    "Q": Letter(np.dtype("<u8")),
    "g": Letter(np.dtype("<f2")),
    "f": Letter(np.dtype("<f4")),
    "d": Letter(np.dtype("<f8")),
    "n": Letter(np.dtype("S4")),
    "N": Letter(np.dtype("S16")),
    "Z": Letter(np.dtype("S64")),
    "c": Letter(np.dtype("<i2"), 1e2),
    "C": Letter(np.dtype("<u2"), 1e2),
    "e": Letter(np.dtype("<i4"), 1e2),
    "E": Letter(np.dtype("<u4"), 1e2),
    "L": Letter(np.dtype("<i4"), 1e7),
    "M": Letter(np.dtype("u1")),
}
"""Every format letter: centi units, 1e-7 degrees and flight modes among numbers and texts."""


@dataclass(frozen=True)
class Layout:
    """The fields of one message type, as its FMT message says.

    `size`: of the whole message, bytes. `offsets`: of each column from the message's start.
    """

    type_id: int
    name: str
    size: int
    letters: str
    columns: tuple[str, ...]
    offsets: tuple[int, ...]

    def letter(self, column: str) -> Letter:
        """How a column is stored. Raises ValueError where there is none of this name."""
        return LETTERS[self.letters[self.columns.index(column)]]

    def offset(self, column: str) -> int:
        """Where a column begins in the message, bytes."""
        return self.offsets[self.columns.index(column)]

    def is_number(self, column: str) -> bool:
        """Whether there is a column of this name that holds one number."""
        return column in self.columns and self.letter(column).dtype.kind in "iuf"


@lru_cache(DIFFERENT_TYPES)
def parse_fmt(message: bytes) -> Layout | None:
    """The layout in one FMT message of `FMT_BYTES` bytes; None where this is none: names have to be words.

    Where the declared length is not that of the declared fields (ArduPilot had such types), the layout has no columns:
    its messages can be stepped over, not read.
    """
    if len(message) != FMT_BYTES or message[:HEAD_BYTES] != MARK + bytes([FMT_TYPE]):
        return None
    type_id, size = message[3], message[4]
    name, letters, columns = (_text(message[a:b]) for a, b in ((5, 9), (9, 25), (25, FMT_BYTES)))
    if not name or letters is None or columns is None or size < HEAD_BYTES:
        return None
    names = tuple(columns.split(",")) if columns else ()
    if not name.replace("_", "").isalnum() or not all(letter in LETTERS for letter in letters) or not all(names):
        return None
    ends = np.cumsum([HEAD_BYTES] + [LETTERS[letter].dtype.itemsize for letter in letters])
    if int(ends[-1]) != size or len(names) != len(letters) or len(set(names)) != len(names):
        return Layout(type_id, name, size, "", (), ())
    return Layout(type_id, name, size, letters, names, tuple(int(end) for end in ends[:-1]))


FMT_LAYOUT = Layout(
    FMT_TYPE, "FMT", FMT_BYTES, "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"), (3, 4, 5, 9, 25)
)
"""That of FMT messages themselves, which every log has in common."""


@dataclass(frozen=True)
class Rows:
    """Messages of one type: columns are read when they are asked for.

    `content`: the bytes of the file. `starts`: where each message begins, (n,). `multipliers`: column → factor to its
    unit, from FMTU and MULT messages.
    """

    layout: Layout
    content: NDArray[np.uint8]
    starts: NDArray[np.int64]
    multipliers: Mapping[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.starts)

    def __contains__(self, column: str) -> bool:
        """Whether there is a column of this name that holds one number."""
        return self.layout.is_number(column)

    def has_text(self, column: str) -> bool:
        """Whether there is a column of this name that holds texts."""
        return column in self.layout.columns and self.layout.letter(column).dtype.kind == "S"

    def where(self, kept: NDArray[np.bool_]) -> Rows:
        """The rows for which `kept` (n,) holds."""
        return Rows(self.layout, self.content, self.starts[kept], self.multipliers)

    def stored(self, column: str) -> NDArray[np.generic]:
        """A column as it stands in the file, (n,), or (n, 32) of letter a. Raises ValueError without this column."""
        dtype, offset = self.layout.letter(column).dtype, self.layout.offset(column)
        if not len(self.starts):
            return np.empty(0, dtype)
        # A view at every byte of the file: of those, the ones at which this column of a message begins are taken.
        places = len(self.content) - offset - dtype.itemsize + 1
        base = dtype.base
        shape, strides = (places, *dtype.shape), (1, *((base.itemsize,) * len(dtype.shape)))
        everywhere = np.ndarray(shape, base, self.content.data, offset, strides)
        return everywhere[self.starts]

    def integers(self, column: str) -> NDArray[np.int64]:
        """A column of whole numbers as they are stored, (n,); floats are cut, to 0 where they are not finite."""
        stored = self.stored(column)
        return (np.nan_to_num(stored, posinf=0, neginf=0) if stored.dtype.kind == "f" else stored).astype(np.int64)

    def numbers(self, column: str) -> NDArray[np.float64]:
        """A column as numbers, (n,), divided by what its letter says (centi units, 1e-7 degrees)."""
        divisor = self.layout.letter(column).divisor
        with np.errstate(invalid="ignore"):  # damaged bytes may be a NaN that signals
            values = self.stored(column).astype(np.float64)
        return values if divisor is None else values / divisor

    def in_unit(self, column: str, multiplier: float = 1.0) -> NDArray[np.float64]:
        """A column in its unit, (n,). A multiplier applies to stored integers whose letter says nothing: the log's
        own, else `multiplier`."""
        letter = self.layout.letter(column)
        if letter.dtype.kind == "f" or letter.divisor is not None:
            return self.numbers(column)
        return self.numbers(column) / (1.0 / self.multipliers.get(column, multiplier))  # 1 / 1e-3 is exact, 1e-3 not

    def texts(self, column: str) -> list[str]:
        """A column of texts; bytes that are no UTF-8 are replaced."""
        return [bytes(text).partition(b"\0")[0].decode("utf-8", "replace") for text in self.stored(column).tolist()]


def multipliers(fmtu: Rows | None, mult: Rows | None, layouts: Mapping[int, Layout]) -> dict[int, dict[str, float]]:
    """Type → column → multiplier, from the log's FMTU and MULT messages. A multiplier of 0 stands for none."""
    if fmtu is None or mult is None:
        return {}
    if not ("FmtType" in fmtu and fmtu.has_text("MultIds") and "Id" in mult and "Mult" in mult):
        return {}
    factors = dict(zip(mult.integers("Id").tolist(), mult.numbers("Mult").tolist(), strict=True))
    found: dict[int, dict[str, float]] = {}
    for type_id, ids in zip(fmtu.integers("FmtType").tolist(), fmtu.texts("MultIds"), strict=True):
        if type_id in layouts and len(ids) == len(layouts[type_id].columns):
            columns = zip(layouts[type_id].columns, ids, strict=True)
            found[type_id] = {column: factors[ord(i)] for column, i in columns if factors.get(ord(i), 0.0) > 0.0}
    return found


def _text(raw: bytes) -> str | None:
    """A text that is padded with NUL; None where anything follows the padding or is no printable ASCII."""
    text = raw.rstrip(b"\0")
    return text.decode("ascii") if all(32 < byte < 127 for byte in text) else None
