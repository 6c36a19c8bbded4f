"""Behind damage in an MCAP file: what is believed to be a record, what is not, and how often the file is searched."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from damaged_mcap import MAGIC, channel, chunk, ended, message, schema

from fieldcal.logs.mcap.file import McapFile
from fieldcal.logs.mcap.search import Search

DEFINED = schema(1, "a/A", "float64 x") + channel(1, 1, "/a")
GARBAGE = b"\x77" * 40


def messages(n: int, at: int, channel_id: int = 1) -> bytes:
    return b"".join(message(channel_id, at + i, bytes(8)) for i in range(n))


def found(path: Path, content: bytes) -> list[int]:
    """Messages in each block of the file."""
    path.write_bytes(content)
    return [len(block.starts) for block in McapFile(path).blocks()]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.mcap"


@pytest.mark.parametrize("garbage", [b"\x77", GARBAGE])
def test_four_sound_records_in_a_row_are_believed_and_three_are_not(path: Path, garbage: bytes) -> None:
    before = DEFINED + messages(3, 0) + garbage
    assert found(path, ended(before + messages(4, 10) + GARBAGE)) == [3, 4]
    assert found(path, ended(before + messages(3, 10) + GARBAGE)) == [3]
    assert found(path, ended(before + messages(3, 10) + GARBAGE + messages(4, 20))) == [3, 4]


@pytest.mark.parametrize("n", [1, 2])
def test_fewer_are_believed_where_the_data_end_behind_them(path: Path, n: int) -> None:
    before = MAGIC + DEFINED + messages(3, 0) + GARBAGE
    assert found(path, before + messages(n, 10)) == [3, n]
    assert found(path, before + messages(n, 10) + b"\x77") == [3]


def test_messages_of_channels_that_nobody_defined_are_not_believed(path: Path) -> None:
    before = DEFINED + messages(3, 0) + GARBAGE
    assert found(path, ended(before + messages(4, 10, channel_id=2))) == [3]
    assert found(path, ended(before + messages(4, 10, channel_id=257))) == [3]


def test_loose_messages_before_the_next_chunk_are_found_where_there_were_none_but_loose_ones(path: Path) -> None:
    loose = GARBAGE + messages(4, 10) + GARBAGE + chunk(messages(1, 20))
    assert found(path, ended(DEFINED + messages(3, 0) + loose)) == [3, 4, 1]
    assert found(path, ended(chunk(DEFINED + messages(3, 0)) + loose)) == [3, 1]
    damaged = chunk(messages(2, 5), crc=1)
    assert found(path, ended(DEFINED + damaged + messages(3, 0) + loose)) == [3, 1]


@pytest.mark.parametrize(("crc", "blocks"), [(-1, [2, 1]), (0, [1])])
def test_a_chunk_of_wrong_length_needs_its_crc(path: Path, crc: int, blocks: list[int]) -> None:
    """It announces more than the file has."""
    wrong = bytearray(chunk(DEFINED + messages(2, 0), crc=crc))
    struct.pack_into("<Q", wrong, 1, 1 << 40)
    assert found(path, ended(bytes(wrong) + chunk(DEFINED + messages(1, 5)))) == blocks


def test_reading_may_go_on_where_the_data_end_and_neither_beyond_nor_within_a_record(path: Path) -> None:
    path.write_bytes(MAGIC + chunk(DEFINED + messages(1, 0)))
    size = path.stat().st_size
    search = McapFile(path)._search
    assert [search.plausible(size + off) for off in (-1, 0, 1)] == [False, True, False]
    assert [search.plausible(len(MAGIC) + off) for off in (0, 1)] == [True, False]


@pytest.mark.parametrize("chunks", [0, 1])
def test_the_file_is_searched_once_for_the_same_chunk(path: Path, monkeypatch: pytest.MonkeyPatch, chunks: int) -> None:
    searched: list[int] = []
    real = Search._search_chunk

    def search(self: Search, position: int) -> int | None:
        searched.append(position)
        return real(self, position)

    monkeypatch.setattr(Search, "_search_chunk", search)
    end = (b"\x77" + chunk(messages(2, 90))) * chunks
    spoiled = b"".join(GARBAGE + messages(4, 10 * i) for i in range(1, 6))
    assert found(path, ended(DEFINED + messages(3, 0) + spoiled + end)) == [3, 4, 4, 4, 4, 4] + [2] * chunks
    assert len(searched) == 1
