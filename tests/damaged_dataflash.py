"""Damage to DataFlash files, seeded, and whether its result can be told from a whole file at all.

A DataFlash message has no checksum: a changed value, or a cut that joins two messages of one length, leaves a file that
is as whole as before. Such inputs are for crashes only; all others must be told, and never deliver a row that was not
recorded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MARK = b"\xa3\x95"
KINDS = ("truncation", "deletion", "insertion", "zeros", "head", "anything")


@dataclass(frozen=True)
class Damaged:
    """`told`: the damage can be found in the file; `places`: a few words for a failing test."""

    content: bytes
    kind: str
    told: bool
    places: str


def sizes_of(content: bytes) -> dict[int, int]:
    """Type → size, by the FMT messages."""
    sizes = {128: 89}
    place = content.find(MARK + b"\x80")
    while place >= 0:
        if place + 5 <= len(content) and content[place + 4] >= 3:
            sizes.setdefault(content[place + 3], content[place + 4])
        place = content.find(MARK + b"\x80", place + 1)
    return sizes


def starts_of(content: bytes, sizes: dict[int, int]) -> list[int] | None:
    """Where the messages of a whole file begin; None where it is not whole."""
    starts, place = [], 0
    while place < len(content):
        size = sizes.get(content[place + 2], 0) if place + 3 <= len(content) else 0
        if content[place : place + 2] != MARK or not size or place + size > len(content):
            return None
        starts.append(place)
        place += size
    return starts


def damage(content: bytes, seed: int) -> Damaged:
    """One damaged input, by its seed."""
    generator = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    sizes = sizes_of(content)
    place, span = int(generator.integers(1, len(content) - 1)), int(generator.integers(1, 400))
    if kind == "truncation":
        damaged = content[:place]
    elif kind == "deletion":
        damaged = content[:place] + content[place + span :]
    elif kind == "insertion":
        damaged = content[:place] + generator.bytes(span) + content[place:]
    elif kind == "zeros":
        damaged = content[:place] + bytes(len(content[place : place + span])) + content[place + span :]
    elif kind == "head":
        starts = starts_of(content, sizes)
        assert starts is not None
        start = starts[int(generator.integers(len(starts)))] + int(generator.integers(3))
        damaged = content[:start] + bytes([content[start] ^ 1 << int(generator.integers(8))]) + content[start + 1 :]
        place = start
    else:
        changed = bytearray(content)
        for at in generator.integers(0, len(content), int(generator.integers(1, 60))).tolist():
            changed[at] = int(generator.integers(256))
        damaged = bytes(changed)
    told = kind != "anything" and starts_of(damaged, sizes) is None
    if kind == "zeros":  # within one message it changes values only
        told = told and any(place < start < place + span for start in starts_of(content, sizes) or [])
    return Damaged(damaged, kind, told, f"seed {seed}: {kind} at {place}, {span} bytes")
