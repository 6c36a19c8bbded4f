"""One pass over an MCAP file: the fast way is taken where there is one, and limits are met from both sides."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard
from logs_support import Flight
from numpy.typing import NDArray

from fieldcal.logs.mcap import file as mcap_file
from fieldcal.logs.mcap.chunks import Located
from fieldcal.logs.mcap.file import McapFile
from fieldcal.logs.mcap.records import MAGIC


def test_messages_are_found_by_the_indexes_behind_their_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fast path: without the indexes a chunk is walked, which finds the same."""
    hints: list[int] = []
    real = mcap_file.locate_messages

    def locate(data: NDArray[np.uint8], given: list[NDArray[np.uint64]]) -> Located:
        hints.append(len(given))
        return real(data, given)

    monkeypatch.setattr(mcap_file, "locate_messages", locate)
    file = McapFile(Flight(400).write(tmp_path / "a.mcap", chunk_size=30_000))
    assert sum(len(block.starts) for block in file.blocks()) == 1600
    assert hints == [4] * file.tally.chunks
    assert file.tally.chunks > 5


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk_that_grows(times: float) -> bytes:
    """A chunk with one message of 100 kB that unpacks to so many times its size, or a little less."""
    rng = np.random.default_rng(0)
    for noise in range(4000):
        content = record(5, struct.pack("<HIQQ", 1, 0, 7, 7) + rng.bytes(noise) + bytes(100_000 - noise))
        packed = zstandard.compress(content)
        if len(content) <= times * len(packed):
            break
    head = struct.pack("<QQQI", 7, 7, len(content), 0) + struct.pack("<I", 4) + b"zstd"
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


@pytest.mark.parametrize(("times", "read"), [(64.0, 1), (66.0, 0)])
def test_a_chunk_may_grow_to_sixty_four_times_its_size_for_nothing(
    tmp_path: Path, times: float, read: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "TOTAL_CAP_BYTES", 1000)
    (tmp_path / "a.mcap").write_bytes(MAGIC + chunk_that_grows(times) + record(15, bytes(4)))
    file = McapFile(tmp_path / "a.mcap")
    assert sum(len(block.starts) for block in file.blocks()) == read
    assert len(file.tally.damaged_chunks) == 1 - read
    assert file.tally.ended
