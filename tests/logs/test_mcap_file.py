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


@pytest.mark.parametrize("garbage", [b"\x77", b"\x77\x77"])
def test_a_chunk_right_behind_a_byte_too_many_is_found(tmp_path: Path, garbage: bytes) -> None:
    content = Flight(400).write(tmp_path / "a.mcap", chunk_size=30_000).read_bytes()
    begins: list[int] = []
    position = len(MAGIC)
    while len(begins) < 3:
        begins += [position] if content[position] == 6 else []
        position += 9 + int.from_bytes(content[position + 1 : position + 9], "little")
    (tmp_path / "b.mcap").write_bytes(content[: begins[2]] + garbage + content[begins[2] :])
    file = McapFile(tmp_path / "b.mcap")
    assert sum(len(block.starts) for block in file.blocks()) == 1600
    assert [place for place, _ in file.tally.damaged_records] == [begins[2]]


def chunk_declaring(size: int) -> bytes:
    """A chunk of a hundred bytes that unpack to nothing, of whatever size it says."""
    head = struct.pack("<QQQI", size, size, size, 0) + struct.pack("<I", 4) + b"zstd"
    return record(6, head + struct.pack("<Q", 100) + bytes(100))


def test_half_a_gibibyte_is_what_chunks_that_grow_too_much_may_cost_together(tmp_path: Path) -> None:
    sizes = [256 << 20, 256 << 20, 1 << 20]
    (tmp_path / "a.mcap").write_bytes(MAGIC + b"".join(map(chunk_declaring, sizes)) + record(15, bytes(4)))
    file = McapFile(tmp_path / "a.mcap")
    assert list(file.blocks()) == []
    refused = [why.startswith("unpacking over 536870912 bytes") for _, why in file.tally.damaged_chunks]
    assert refused == [False, False, True]


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
    monkeypatch.setattr("fieldcal.logs.mcap.chunks.TOTAL_CAP_BYTES", 1000)
    (tmp_path / "a.mcap").write_bytes(MAGIC + chunk_that_grows(times) + record(15, bytes(4)))
    file = McapFile(tmp_path / "a.mcap")
    assert sum(len(block.starts) for block in file.blocks()) == read
    assert len(file.tally.damaged_chunks) == 1 - read
    assert file.tally.ended
