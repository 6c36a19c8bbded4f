"""One pass over an MCAP file: the fast way is taken where there is one, and limits are met from both sides."""

from __future__ import annotations

import mmap
import struct
from bisect import bisect_left
from pathlib import Path

import numpy as np
import pytest
import zstandard
from damaged_mcap import channel, chunk, ended, message, schema, text
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
    noise = np.random.default_rng(0).bytes(4000)

    def content(n: int) -> bytes:
        return record(5, struct.pack("<HIQQ", 1, 0, 7, 7) + noise[:n] + bytes(100_000 - n))

    def grows_less(n: int) -> bool:
        return len(content(n)) <= times * len(zstandard.compress(content(n)))

    whole = content(bisect_left(range(len(noise)), True, key=grows_less))
    packed = zstandard.compress(whole)
    head = struct.pack("<QQQI", 7, 7, len(whole), 0) + struct.pack("<I", 4) + b"zstd"
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


# record by record ----------------------------------------------------------------------------------------------------

HEADER = record(1, text("ros2") + text("test"))
DEFINED = schema(1, "a/A", "float64 x") + channel(1, 1, "/a")
DATA_END = record(15, bytes(4))
ATTACHMENT = record(9, bytes(16) + text("a") + text("b") + struct.pack("<Q", 0) + bytes(4))


def messages(n: int, at: int = 0) -> bytes:
    return b"".join(message(1, at + i, bytes(8)) for i in range(n))


def index(n: int) -> bytes:
    """A message index of channel 1 with n offsets, none of which leads anywhere."""
    return record(7, struct.pack("<HI", 1, 16 * n) + b"".join(struct.pack("<QQ", 0, 1 << 40) for _ in range(n)))


def passed(path: Path, content: bytes) -> tuple[McapFile, list[int], list[bool]]:
    """The file after a pass through it; messages in each block, and whether a CRC vouches for them."""
    path.write_bytes(content)
    file = McapFile(path)
    blocks = list(file.blocks())
    return file, [len(block.starts) for block in blocks], [block.verified for block in blocks]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.mcap"


def spoiled(record_bytes: bytes) -> bytes:
    """The last byte of a record changed."""
    return record_bytes[:-1] + bytes([record_bytes[-1] ^ 255])


def test_the_index_of_a_damaged_chunk_says_how_many_are_lost(path: Path) -> None:
    """A chunk whose CRC does not hold, and one whose head is none; those of intact chunks and loose messages count
    nothing lost, nor does one before everything."""
    bad = chunk(messages(2), "")
    headless = bytearray(bad)
    headless[9 + 28] = 200  # length of the name of the compression
    for damaged in (spoiled(bad), bytes(headless)):
        file, found, _ = passed(path, ended(chunk(DEFINED + messages(3)) + index(3) + damaged + index(2) + index(3)))
        assert (found, file.tally.lost) == ([3], {1: 5})
        assert len(file.tally.damaged_chunks) == 1
    sound = DEFINED + messages(3)
    for content in (MAGIC + index(3) + sound, ended(sound + index(3)), ended(chunk(sound) + index(3) + index(2))):
        assert passed(path, content)[0].tally.lost == {}


@pytest.mark.parametrize("crc", [-1, 0])
def test_only_a_crc_vouches_for_messages(path: Path, crc: int) -> None:
    file, found, verified = passed(path, ended(chunk(DEFINED + messages(1), crc=crc) + chunk(messages(2, 5), crc=crc)))
    assert (found, verified) == ([1, 2], [crc != 0] * 2)
    assert file.tally.unverifiable == (0 if crc else 2)
    assert (file.tally.chunks, file.tally.ended, file.has_summary) == (2, True, False)


def test_messages_outside_chunks_have_no_crc(path: Path) -> None:
    file, found, verified = passed(path, ended(DEFINED + messages(2) + ATTACHMENT + messages(3)))
    assert (found, verified, file.tally.unverifiable) == ([2, 3], [False, False], 2)


def test_chunks_that_stand_again_are_counted(path: Path) -> None:
    first = chunk(DEFINED + messages(2))
    file, found, _ = passed(path, ended(first * 3 + chunk(messages(1, 7))))
    assert (found, file.tally.duplicate_chunks, file.tally.chunks) == ([2, 1], 2, 2)


def test_behind_damage_nothing_is_read_again(path: Path) -> None:
    sound = chunk(DEFINED + messages(2)) + ATTACHMENT
    file, found, _ = passed(path, ended(sound + b"\x77" * 40 + chunk(messages(1, 7))))
    assert (found, file.tally.duplicate_chunks) == ([2, 1], 0)
    assert [place for place, _ in file.tally.damaged_records] == [len(MAGIC + HEADER + sound)]


def test_what_a_private_record_with_a_wrong_length_covers_is_found(path: Path) -> None:
    """0x80 is the first of them. It leads to garbage, so what lies within it is searched."""
    covered = chunk(messages(2, 5))
    private = struct.pack("<BQ", 0x80, 10 + len(covered)) + bytes(10) + covered
    _, found, _ = passed(path, ended(chunk(DEFINED + messages(1)) + private + b"\x77" * 40 + chunk(messages(3, 9))))
    assert found == [1, 2, 3]


def test_a_file_without_magic_begins_with_its_first_chunk(path: Path) -> None:
    file, found, _ = passed(path, chunk(DEFINED + messages(2)) + DATA_END)
    assert found == [2]
    assert [place for place, _ in file.tally.damaged_records] == [0]


def test_a_chunks_wrong_length_into_the_footer_is_damage(path: Path) -> None:
    """It announces 25 bytes too many: those behind it are a data end of 13, a footer of 29 and the magic."""
    content = bytearray(ended(chunk(DEFINED + messages(2))))
    place = len(MAGIC + HEADER) + 1
    struct.pack_into("<Q", content, place, struct.unpack_from("<Q", content, place)[0] + 25)
    file, found, _ = passed(path, bytes(content))
    assert found == [2]
    assert ["length is wrong" in why for _, why in file.tally.damaged_records] == [True]


def test_a_footer_ends_a_file_that_lost_its_magic_and_an_attachment_does_not(path: Path) -> None:
    body = MAGIC + HEADER + chunk(DEFINED + messages(1)) + ATTACHMENT + chunk(messages(2, 5))
    for end, is_end in ((record(2, bytes(20)) + b"rest", True), (DATA_END, True), (ATTACHMENT, False)):
        file, found, _ = passed(path, body + end)
        assert (found, file.tally.ended) == ([1, 2], is_end)


def test_data_that_reach_up_to_the_summary_have_ended(tmp_path: Path) -> None:
    """Whatever became of the data end before it."""
    content = Flight(50).write(tmp_path / "a.mcap").read_bytes()
    place = content.rindex(DATA_END[:9])
    for data_end in (content[place : place + 13], b"\x80" + content[place + 1 : place + 13]):
        file, found, _ = passed(tmp_path / "b.mcap", content[:place] + data_end + content[place + 13 :])
        assert (sum(found), file.tally.ended, file.has_summary) == (200, True, True)


def test_pages_are_let_go_of_up_to_the_last_whole_one(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Never what is still to be read: dropped pages are read from the disk once more."""
    page = mmap.ALLOCATIONGRANULARITY
    file, _, _ = passed(path, ended(chunk(DEFINED + messages(1))))
    let_go: list[tuple[int, int, int]] = []

    class Mapped:
        def madvise(self, *what: int) -> None:
            let_go.append((what[0], what[1], what[2]))

    monkeypatch.setattr(file, "buffer", Mapped())
    monkeypatch.setattr(mcap_file, "RELEASE_BYTES", 3 * page + 10)
    steps = (3 * page + 9, 3 * page + 10, 6 * page + 19, 6 * page + 20)
    for position in steps:
        file._release(position)
    assert let_go == [(mmap.MADV_DONTNEED, 0, 3 * page), (mmap.MADV_DONTNEED, 0, 6 * page)]
