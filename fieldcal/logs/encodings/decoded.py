"""Fields wanted from messages, and the arrays that a decoder makes of them: the interface of every message encoding."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

COMPONENTS = {1: (), 3: ("x", "y", "z"), 4: ("x", "y", "z", "w")}
STAMP_FIELDS = ("header.stamp", "stamp", "timestamp", "time")
SECOND_NAMES = ("sec", "seconds")
NANOSECOND_NAMES = ("nanosec", "nsec", "nanos")
NANOSECONDS = 1_000_000_000


class MissingField(Exception):
    """A wanted field is not in the message definition."""

    def __init__(self, path: str, available: Sequence[str]) -> None:
        super().__init__(path)
        self.path = path
        self.available = tuple(available)


class UnsupportedSchema(Exception):
    """Messages of this encoding or with this schema cannot be decoded."""


@dataclass(frozen=True)
class Want:
    """A field to read: one path to an array or {x, y, z[, w]} of `width` numbers, or `width` paths to numbers."""

    paths: tuple[str, ...]
    width: int

    @staticmethod
    def of(path: str | Sequence[str], width: int) -> Want:
        """From a configured value: one path, or a path per component."""
        return Want((path,) if isinstance(path, str) else tuple(path), width)


@dataclass(frozen=True)
class Decoded:
    """Decoded messages.

    `values`: name -> float64, shape (n,) or (n, width). `stamp_ns`: int64 (n,), or None when messages carry no stamp.
    `kept`: the positions, among the messages handed in, of the n that could be decoded. `malformed`: how many could
    not, where that is not the rest.
    """

    values: dict[str, NDArray[np.float64]]
    stamp_ns: NDArray[np.int64] | None
    kept: NDArray[np.intp]
    malformed: int | None = None


class Decoder(Protocol):
    """Decodes many messages of one channel."""

    def decode(self, data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Decoded:
        """Payloads begin at byte `starts` of `data` and are `sizes` bytes long; the caller has checked the bounds."""
        ...


def decode_each(
    read: Callable[[bytes], tuple[int | None, list[list[float]]]],
    wants: Mapping[str, Want],
    data: NDArray[np.uint8],
    starts: NDArray[np.int64],
    sizes: NDArray[np.int64],
) -> Decoded:
    """Decode message by message with `read(bytes) -> (stamp_ns or None, list of number lists)`.

    Messages for which it raises are left out.
    """
    stamps: list[int | None] = []
    rows: list[list[list[float]]] = []
    kept: list[int] = []
    for number, (start, size) in enumerate(zip(starts.tolist(), sizes.tolist(), strict=True)):
        try:
            stamp, row = read(data[start : start + size].tobytes())
            row = [[float(value) for value in values] for values in row]
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError):
            continue
        if stamp is not None and not -(2**63) <= stamp < 2**63:
            continue
        kept.append(number)
        stamps.append(stamp)
        rows.append(row)
    values = {}
    for position, (name, want) in enumerate(wants.items()):
        column = np.array([row[position] for row in rows], np.float64).reshape(len(rows), want.width)
        values[name] = column if want.width > 1 else column[:, 0]
    unstamped = any(stamp is None for stamp in stamps)
    stamp_ns = None if unstamped else np.array(stamps, np.int64)
    return Decoded(values, stamp_ns, np.array(kept, np.intp))
