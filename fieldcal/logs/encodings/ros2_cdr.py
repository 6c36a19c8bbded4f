"""Bulk decoding of ROS 2 messages in CDR: wanted fields of all messages of a chunk at once.

The definition is compiled into runs of equal numbers and the variable parts between them. Decoding walks these with one
cursor for all messages: a plain number as long as their layouts agree, an array where a string makes them differ. Only
the wanted values are gathered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.encodings.decoded import (
    COMPONENTS,
    NANOSECOND_NAMES,
    NANOSECONDS,
    SECOND_NAMES,
    STAMP_FIELDS,
    Decoded,
    MissingField,
    UnsupportedSchema,
    Want,
)
from fieldcal.logs.encodings.gather import gather
from fieldcal.logs.encodings.ros2_definitions import (
    BUILTIN,
    DefinitionError,
    Leaf,
    Numbers,
    NumberSequence,
    Opaque,
    Text,
    flatten,
    full_text,
    short_name,
)

ENCAPSULATION_BYTES = 4
ENCAPSULATIONS = {0x0000: (">", 8), 0x0100: ("<", 8), 0x0600: (">", 4), 0x0700: ("<", 4)}
"""First two bytes (as a little-endian number) -> byte order and largest alignment: CDR, and plain XCDR2."""

Cursor = int | NDArray[np.int64]


@dataclass(frozen=True)
class Run:
    """`count` consecutive numbers of one type: what CDR packs without padding between."""

    code: str
    count: int


@dataclass(frozen=True)
class Pick:
    """`count` numbers from number `first` of step `step` go to components `to`, ... of the value `name`."""

    step: int
    first: int
    count: int
    name: str
    to: int


class Malformed(Exception):
    """Some messages end before a wanted field; `sound` tells which do not."""

    def __init__(self, sound: NDArray[np.bool_]) -> None:
        super().__init__()
        self.sound = sound


class CdrDecoder:
    """Reads `wants` from messages of type `name`.

    Parameters
    ----------
    name, text : str
        Type and definition. A well-known type needs no text.
    wants : mapping
        Value name -> field.

    Raises
    ------
    MissingField
        A wanted field is not in the definition.
    UnsupportedSchema
        The definition cannot be followed as far as the wanted fields.
    """

    _head_bytes = ENCAPSULATION_BYTES

    def __init__(self, name: str, text: str, wants: Mapping[str, Want]) -> None:
        leaves = self._leaves(name, text)
        self._steps, places = _runs(leaves)
        self._widths = {value: want.width for value, want in wants.items()}
        stamp = _stamp_paths(places)
        self._stamped = stamp is not None
        if stamp is not None:
            self._widths |= {"sec": 1, "nanosec": 1}
            wants = {**wants, "sec": Want((stamp[0],), 1), "nanosec": Want((stamp[1],), 1)}
        self._picks = _picks(wants, places, leaves)
        last = max(pick.step for pick in self._picks)
        self._steps = self._steps[: last + 1]
        blocked = [step for step in self._steps if isinstance(step, Opaque)]
        if blocked:
            raise UnsupportedSchema(f"{name}: {blocked[0].path} has a variable layout and stands before a wanted field")

    def _leaves(self, name: str, text: str) -> tuple[Leaf, ...]:
        return _leaves(name, text)

    def decode(self, data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Decoded:
        """See `Decoder.decode`."""
        kept = np.flatnonzero(sizes >= ENCAPSULATION_BYTES)
        kinds = gather(data, starts[kept], np.dtype("<u2"))
        parts = [
            self._decode_kind(data, starts, sizes, kept[kinds == kind], *ENCAPSULATIONS[kind])
            for kind in np.unique(kinds).tolist()
            if kind in ENCAPSULATIONS
        ]
        if len(parts) == 1:
            return parts[0]
        return _in_order(parts, self._widths, self._stamped)

    def _decode_kind(
        self,
        data: NDArray[np.uint8],
        starts: NDArray[np.int64],
        sizes: NDArray[np.int64],
        kept: NDArray[np.intp],
        order: str,
        largest_alignment: int,
    ) -> Decoded:
        while True:
            bodies, limits = starts[kept] + self._head_bytes, sizes[kept] - self._head_bytes
            try:
                values = self._values(data, bodies, limits, order, largest_alignment)
                break
            except Malformed as malformed:
                kept = kept[malformed.sound]
        stamp_ns = None
        if self._stamped:
            seconds, nanoseconds = values.pop("sec"), values.pop("nanosec")
            stamp_ns = seconds.astype(np.int64) * NANOSECONDS + nanoseconds.astype(np.int64)
        return Decoded({name: value.astype(np.float64) for name, value in values.items()}, stamp_ns, kept)

    def _values(
        self,
        data: NDArray[np.uint8],
        bodies: NDArray[np.int64],
        limits: NDArray[np.int64],
        order: str,
        largest_alignment: int,
    ) -> dict[str, NDArray[np.generic]]:
        values: dict[str, NDArray[np.generic]] = {}
        cursor: Cursor = 0
        for number, step in enumerate(self._steps):
            if isinstance(step, Run):
                dtype = np.dtype(order + step.code)
                cursor = _aligned(cursor, min(dtype.itemsize, largest_alignment))
                _require(cursor + step.count * dtype.itemsize, limits)
                self._take(number, values, data, bodies + cursor, dtype)
                cursor = cursor + step.count * dtype.itemsize
            else:
                cursor = self._variable(number, step, values, data, bodies, limits, order, largest_alignment, cursor)
        return values

    def _variable(
        self,
        number: int,
        step: Text | NumberSequence | Opaque,
        values: dict[str, NDArray[np.generic]],
        data: NDArray[np.uint8],
        bodies: NDArray[np.int64],
        limits: NDArray[np.int64],
        order: str,
        largest_alignment: int,
        cursor: Cursor,
    ) -> Cursor:
        cursor = _aligned(cursor, min(4, largest_alignment))
        _require(cursor + 4, limits)
        counts = _collapsed(gather(data, bodies + cursor, np.dtype(order + "u4")).astype(np.int64))
        cursor = cursor + 4
        dtype = np.dtype(order + step.code) if isinstance(step, NumberSequence) else np.dtype("u1")
        some = counts > 0
        aligned = _aligned(cursor, min(dtype.itemsize, largest_alignment))
        cursor = np.where(some, aligned, cursor) if isinstance(counts, np.ndarray) else (aligned if some else cursor)
        _require(cursor + counts * dtype.itemsize, limits)
        needed = [pick.first + pick.count for pick in self._picks if pick.step == number]
        if needed:
            sound = np.broadcast_to(np.asarray(counts) == max(needed), limits.shape)
            if not sound.all():
                raise Malformed(sound)
            self._take(number, values, data, bodies + cursor, dtype)
        return _collapsed(cursor + counts * dtype.itemsize)

    def _take(
        self,
        number: int,
        values: dict[str, NDArray[np.generic]],
        data: NDArray[np.uint8],
        places: NDArray[np.int64],
        dtype: np.dtype[np.generic],
    ) -> None:
        for pick in self._picks:
            if pick.step != number:
                continue
            got = gather(data, places + pick.first * dtype.itemsize, dtype, pick.count)
            width = self._widths[pick.name]
            if pick.count == width:
                values[pick.name] = got
            else:
                value = values.setdefault(pick.name, np.empty((len(places), width)))
                value[:, pick.to : pick.to + pick.count] = got.reshape(len(places), pick.count)


class Ros1Decoder(CdrDecoder):
    """Reads `wants` from messages in ROS 1 serialisation: little-endian, without padding and without a head.

    Parameters and errors are those of `CdrDecoder`; the definition is needed.
    """

    _head_bytes = 0

    def _leaves(self, name: str, text: str) -> tuple[Leaf, ...]:
        try:
            return flatten(name, text)
        except (DefinitionError, KeyError) as error:
            raise UnsupportedSchema(f"{name}: {error}") from error

    def decode(self, data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Decoded:
        """See `Decoder.decode`."""
        return self._decode_kind(data, starts, sizes, np.arange(len(starts), dtype=np.intp), "<", 1)


def _leaves(name: str, text: str) -> tuple[Leaf, ...]:
    try:
        if text.strip():
            return flatten(name, text)
        if short_name(name) in BUILTIN:
            return flatten(name, full_text(name))
    except (DefinitionError, KeyError) as error:
        if short_name(name) in BUILTIN:
            return flatten(name, full_text(name))
        raise UnsupportedSchema(f"{name}: {error}") from error
    raise UnsupportedSchema(f"{name}: the file holds no definition of it")


def _runs(
    leaves: Sequence[Leaf],
) -> tuple[list[Run | Text | NumberSequence | Opaque], dict[str, tuple[int, int, int | None]]]:
    """Steps of the walk, and path -> (step, first number in it, how many; None: as many as a sequence has)."""
    steps: list[Run | Text | NumberSequence | Opaque] = []
    places: dict[str, tuple[int, int, int | None]] = {}
    for leaf in leaves:
        if not isinstance(leaf, Numbers):
            steps.append(leaf)
            if isinstance(leaf, NumberSequence):
                places[leaf.path] = (len(steps) - 1, 0, None)
            continue
        last = steps[-1] if steps else None
        if isinstance(last, Run) and last.code == leaf.code:
            first = last.count
            steps[-1] = Run(leaf.code, last.count + leaf.count)
        else:
            first = 0
            steps.append(Run(leaf.code, leaf.count))
        places[leaf.path] = (len(steps) - 1, first, leaf.count)
    return steps, places


def _stamp_paths(places: Mapping[str, object]) -> tuple[str, str] | None:
    for stamp in STAMP_FIELDS:
        for second, nanosecond in zip(SECOND_NAMES, NANOSECOND_NAMES, strict=False):
            if f"{stamp}.{second}" in places and f"{stamp}.{nanosecond}" in places:
                return f"{stamp}.{second}", f"{stamp}.{nanosecond}"
    return None


def _picks(
    wants: Mapping[str, Want], places: Mapping[str, tuple[int, int, int | None]], leaves: Sequence[Leaf]
) -> list[Pick]:
    picks: list[Pick] = []
    for name, want in wants.items():
        singles: list[tuple[int, int]] = []
        for path in want.paths:
            singles += _numbers(path, want.width if len(want.paths) == 1 else 1, places, leaves)
        if len(singles) != want.width:
            raise MissingField(" and ".join(want.paths), [leaf.path for leaf in leaves])
        for to, (step, number) in enumerate(singles):
            last = picks[-1] if picks else None
            if last and last.name == name and last.step == step and last.first + last.count == number:
                picks[-1] = Pick(step, last.first, last.count + 1, name, last.to)
            else:
                picks.append(Pick(step, number, 1, name, to))
    return picks


def _numbers(
    path: str, width: int, places: Mapping[str, tuple[int, int, int | None]], leaves: Sequence[Leaf]
) -> list[tuple[int, int]]:
    place = places.get(path)
    if place is not None and place[2] in (width, None):
        return [(place[0], place[1] + number) for number in range(width)]
    parts = [places.get(f"{path}.{component}") for component in COMPONENTS[width]]
    found = [(part[0], part[1]) for part in parts if part is not None and part[2] == 1]
    if place is not None or not found or len(found) != len(parts):
        raise MissingField(path, [leaf.path for leaf in leaves])
    return found


def _aligned(cursor: Cursor, alignment: int) -> Cursor:
    return (cursor + alignment - 1) // alignment * alignment


def _collapsed(values: Cursor) -> Cursor:
    """A plain number instead of an array of equal ones."""
    if isinstance(values, np.ndarray) and values.size and values.min() == values.max():
        return int(values[0])
    return values


def _require(ends: Cursor, limits: NDArray[np.int64]) -> None:
    sound = limits >= ends
    if not sound.all():
        raise Malformed(sound)


def _in_order(parts: Sequence[Decoded], widths: Mapping[str, int], stamped: bool) -> Decoded:
    """Parts with different encapsulations, put back into file order."""
    if not parts:
        empty = {name: np.empty((0, w) if w > 1 else 0) for name, w in widths.items() if name not in ("sec", "nanosec")}
        return Decoded(empty, np.empty(0, np.int64) if stamped else None, np.empty(0, np.intp))
    kept = np.concatenate([part.kept for part in parts])
    order = np.argsort(kept, kind="stable")
    values = {name: np.concatenate([part.values[name] for part in parts])[order] for name in parts[0].values}
    stamps = [part.stamp_ns for part in parts if part.stamp_ns is not None]
    return Decoded(values, np.concatenate(stamps)[order] if stamps else None, kept[order])
