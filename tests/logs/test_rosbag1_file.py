"""ROS 1 bags of a few records, each laid out by struct: what of them is read, where reading goes on, what is told."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path

import lz4.frame
import pytest
from rosbag1_records import chunk, field, length, message, record

from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.definitions import Channel, Definitions
from fieldcal.logs.rosbag1 import file
from fieldcal.logs.rosbag1.file import BagContainer
from fieldcal.logs.rosbag1.report import Tally, report

MAGIC = b"#ROSBAG V2.0\n"
PAUSED = record(field("op", b"\4") + field("ver", length(1)), b"")


def head(index: int, encryptor: bytes | None = None) -> bytes:
    """The bag header; its index begins at byte `index`."""
    given = b"" if encryptor is None else field("encryptor", encryptor)
    return record(field("op", b"\3") + field("index_pos", struct.pack("<Q", index)) + given, b"    ")


def connection(number: int, topic: bytes = b"/a") -> bytes:
    text = field("type", b"a/B") + field("message_definition", b"int8 x")
    return record(field("op", b"\7") + field("conn", length(number)) + field("topic", topic), text)


def chunk_info(*counts: int) -> bytes:
    header = field("op", b"\6") + field("ver", length(1)) + field("chunk_pos", bytes(8))
    return record(header, b"".join(map(length, counts)))


def stored(content: bytes, missing: int = 0) -> bytes:
    """A chunk that is not packed, of whose end some bytes are missing."""
    return chunk(content[: len(content) - missing], len(content), declared=len(content))


FIRST = stored(connection(1) + message(1, 1, 0, b"a") + message(1, 2, 0, b"b"))
SECOND = stored(message(1, 3, 0, b"c") + message(1, 4, 0, b"d"))
INDEX = connection(1), chunk_info(1, 2), chunk_info(1, 2)


def closed(*parts: bytes, index: tuple[bytes, ...] = INDEX) -> bytes:
    """A bag that its recorder closed."""
    body = b"".join(parts)
    return MAGIC + head(len(MAGIC) + len(head(0)) + len(body)) + body + b"".join(index)


class Read:
    """What a pass through the bag gave: payloads by block, counts by its index, findings (code, number, sentence)."""

    def __init__(self, folder: Path, content: bytes) -> None:
        (folder / "a.bag").write_bytes(content)
        container = BagContainer(folder / "a.bag")
        self.blocks = [
            b"".join(bytes(block.data[a : a + n]) for a, n in zip(block.starts, block.sizes, strict=True))
            for block in container.blocks([1])
        ]
        self.counts = container.counts
        summary = LogSummary("rosbag1")
        container.report(summary)
        self.told = {finding.code: finding.sentence for finding in summary.findings}


def test_a_whole_bag(tmp_path: Path) -> None:
    read = Read(tmp_path, closed(FIRST, SECOND))
    assert (read.blocks, read.counts, read.told) == ([b"ab", b"cd"], {1: 4}, {})


def test_a_recorder_that_did_not_close_the_bag(tmp_path: Path) -> None:
    for begin in (MAGIC + head(0), MAGIC, MAGIC + record(field("op", b"\3"), b""), MAGIC + PAUSED):
        read = Read(tmp_path, begin + FIRST + SECOND)
        assert (read.blocks, read.counts, list(read.told)) == ([b"ab", b"cd"], None, ["truncated"])
        assert "the recorder did not close it" in read.told["truncated"]


@pytest.mark.parametrize(
    "index",
    [
        (*INDEX, PAUSED),
        (*INDEX, b"\0"),
        (*INDEX, chunk_info(1, 2)[:-1]),
        (*INDEX, chunk_info(1, 2, 3)),
        (*INDEX, record(field("op", b"\6"), bytes(9))),
        (*INDEX, record(field("op", b"\7") + field("conn", length(1)) + field("topic", b"/a"), b"")),
        (),
        (chunk_info(1, 4),),
    ],
)
def test_an_index_that_is_damaged_is_not_used(tmp_path: Path, index: tuple[bytes, ...]) -> None:
    read = Read(tmp_path, closed(FIRST, SECOND, index=index))
    assert (b"".join(read.blocks), read.counts) == (b"abcd", None)
    assert "its index is damaged or cut off" in read.told["truncated"]


def test_messages_that_the_index_counts_and_the_bag_lacks(tmp_path: Path) -> None:
    read = Read(tmp_path, closed(FIRST))
    assert read.told == {"count_mismatch": "a.bag holds fewer messages than its index says. Lost: /a 2."}


def test_bags_that_are_encrypted_are_refused(tmp_path: Path) -> None:
    assert Read(tmp_path, MAGIC + head(0, b"") + FIRST).blocks == [b"ab"]
    with pytest.raises(UnreadableLog, match="is encrypted"):
        Read(tmp_path, MAGIC + head(0, b"x") + FIRST)


@pytest.mark.parametrize("begin", [b"", b"x", b"#ROSBAG V2.0", MAGIC[1:] + head(0), b"!" + MAGIC[1:] + head(0)])
def test_a_bag_without_its_begin_is_read_from_its_first_chunk(tmp_path: Path, begin: bytes) -> None:
    if begin.startswith(b"#"):
        with pytest.raises(UnreadableLog, match="a bag of another format"):
            Read(tmp_path, begin + FIRST + SECOND)
        return
    assert Read(tmp_path, begin + FIRST + SECOND).blocks == [b"ab", b"cd"]


# damage --------------------------------------------------------------------------------------------------------------


def damage(why: str, byte: int, lost: str = " are not counted in the file", places: int = 1) -> str:
    return (
        f"a.bag is damaged in {places} place(s), the first at byte {byte} ({why}). All whole chunks were read. "
        f"Messages lost{lost}."
    )


BEGIN = MAGIC + head(0)


@pytest.mark.parametrize("missing", range(1, 12))
def test_of_a_chunk_that_was_cut_whole_messages_are_read(tmp_path: Path, missing: int) -> None:
    content = message(1, 3, 0, b"c" * 10) + message(1, 4, 0, b"d" * 10)
    read = Read(tmp_path, BEGIN + FIRST + stored(content, missing))
    assert read.blocks == [b"ab", b"c" * 10]
    second = len(content) // 2
    why = f"the record at byte {second} ends {missing} bytes behind the data"
    if missing > 10:
        why = f"the record at byte {second} announces a header of {second - 18} bytes"
    assert read.told["damaged_chunk"] == damage(why, len(BEGIN + FIRST), places=2)


def test_a_chunk_that_was_cut_between_two_messages(tmp_path: Path) -> None:
    last = message(1, 4, 0, b"d")
    read = Read(tmp_path, BEGIN + FIRST + stored(message(1, 3, 0, b"c") + last, len(last)))
    assert read.blocks == [b"ab", b"c"]
    assert read.told["damaged_chunk"] == damage(f"the chunk ends {len(last)} bytes too early", len(BEGIN + FIRST))


def test_records_of_a_chunk_that_are_none(tmp_path: Path) -> None:
    short = record(field("op", b"\2") + field("conn", length(1)), b"x")
    nameless = record(field("op", b"\7") + field("conn", length(2)) + field("topic", b"/b"), b"")
    read = Read(tmp_path, closed(FIRST, stored(short + message(1, 3, 0, b"c") + short)))
    assert read.blocks == [b"ab", b"c"]
    at = len(MAGIC + head(0) + FIRST)
    assert read.told == {"damaged_chunk": damage("2 records of the chunk are none", at, ": /a 1")}
    read = Read(tmp_path, closed(FIRST, stored(nameless + message(1, 3, 0, b"cd"))))
    assert read.blocks == [b"ab", b"cd"]
    assert read.told == {"damaged_chunk": damage("the connection of /b names no type", 0, ": /a 1")}


@pytest.mark.parametrize("junk", [b"\0", b"\xff", b"\0" * 8, b"\xff" * 13, FIRST[:20]])
def test_reading_goes_on_at_the_next_chunk(tmp_path: Path, junk: bytes) -> None:
    read = Read(tmp_path, closed(FIRST, junk, SECOND))
    assert read.blocks == [b"ab", b"cd"]
    assert list(read.told) == ["damaged_chunk"]
    assert f"the first at byte {len(MAGIC + head(0) + FIRST)} (" in read.told["damaged_chunk"]
    assert read.told["damaged_chunk"].endswith("Messages lost: none.")


def test_a_chunk_that_lacks_bytes_costs_itself_alone(tmp_path: Path) -> None:
    """In whichever place they are missing: no byte of another message is taken for one of theirs, and the chunk behind,
    inside which the declared end lies, is read whole. (Nothing tells where messages as long as what is missing are
    spliced: a bag has no checksums.)"""
    letters = b"cdefgh"
    messages = [message(1, 3 + i, 0, bytes([letter]) * 9) for i, letter in enumerate(letters)]
    middle, last = stored(b"".join(messages)), stored(message(1, 9, 0, b"yz"))
    begin = len(middle) - sum(map(len, messages))
    for cut in (1, 2, 7, 40, len(messages[0]), len(messages[0]) + 5):
        for at in range(begin, len(middle) - cut + 1, cut if cut == len(messages[0]) else 1):
            read = Read(tmp_path, BEGIN + FIRST + middle[:at] + middle[at + cut :] + last)
            assert (read.blocks[0], read.blocks[-1]) == (b"ab", b"yz"), (at, cut)
            inside = b"".join(read.blocks[1:-1])
            kept = [letter for letter in letters if bytes([letter]) * 9 in inside]
            assert inside == b"".join(bytes([letter]) * 9 for letter in kept), (at, cut)
            assert len(kept) >= (at - begin) // len(messages[0]) - 1, (at, cut)
            assert f"the chunk lacks {cut} of its bytes" in read.told["damaged_chunk"]


def test_a_packed_chunk_that_could_be_unpacked_lacks_nothing(tmp_path: Path) -> None:
    """Although a message of it holds the bytes of a chunk, and what follows it is damaged."""
    content = message(1, 3, 0, SECOND)
    head = lz4.frame.compress(b"", store_size=False)[:-4]
    stored_block = struct.pack("<I", len(content) | 1 << 31) + content
    packed = chunk(head + stored_block + bytes(4), len(content), b"lz4")
    read = Read(tmp_path, BEGIN + FIRST + packed + b"\xff" * 9 + SECOND)
    assert read.blocks == [b"ab", SECOND, b"cd"]
    assert f"the first at byte {len(BEGIN + FIRST + packed)} (" in read.told["damaged_chunk"]


def test_reading_goes_on_where_a_damaged_record_ends_if_a_record_begins_there(tmp_path: Path) -> None:
    """A chunk of no known compression, then messages outside chunks: no next chunk is needed to find them."""
    odd = chunk(b"abc", 3, b"zip")
    loose = message(1, 5, 0, b"e")
    read = Read(tmp_path, BEGIN + FIRST + odd + loose)
    assert read.blocks == [b"ab", b"e"]
    why = "compression 'zip' is none of none, lz4, bz2"
    assert read.told["damaged_chunk"] == damage(why, len(BEGIN + FIRST))
    read = Read(tmp_path, BEGIN + FIRST + odd + b"\0" + loose + SECOND)
    assert read.blocks == [b"ab", b"cd"]


def test_a_record_behind_which_the_file_ends_too_early(tmp_path: Path) -> None:
    for last in (connection(2, b"/b"), message(1, 5, 0, b"e"), PAUSED):
        assert "damaged_chunk" not in Read(tmp_path, BEGIN + FIRST + last).told
        read = Read(tmp_path, BEGIN + FIRST + last[:-1])
        assert read.blocks == [b"ab"]
        assert f"the first at byte {len(BEGIN + FIRST)} (" in read.told["damaged_chunk"]


def test_messages_outside_chunks_are_read_some_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to the message that reaches so many bytes; a connection between them ends nothing."""
    parts = [message(1, i, 0, bytes([97 + i])) for i in range(5)]
    size = len(parts[0])
    content = BEGIN + connection(1) + b"".join(parts)
    for at_once, blocks in [
        (2 * size, [b"ab", b"cd", b"e"]),
        (2 * size - 1, [b"ab", b"cd", b"e"]),
        (2 * size + 1, [b"abc", b"de"]),
        (1, [b"a", b"b", b"c", b"d", b"e"]),
        (5 * size, [b"abcde"]),
    ]:
        monkeypatch.setattr(file, "_LOOSE_BYTES", at_once)
        read = Read(tmp_path, content)
        assert (read.blocks, list(read.told)) == (blocks, ["truncated"])
        assert Read(tmp_path, content + SECOND).blocks == [*blocks, b"cd"]
    mixed = BEGIN + connection(1) + parts[0] + connection(2, b"/b") + parts[1] + PAUSED + parts[2]
    assert Read(tmp_path, mixed).blocks == [b"ab", b"c"]


# what is told ---------------------------------------------------------------------------------------------------------


def told(tally: Tally, said: dict[int, int] | None, channels: int = 1) -> list[tuple[str, int, bool, bool]]:
    """Findings as (code, number, loses data, fatal), of a bag with so many topics."""
    definitions, summary = Definitions(), LogSummary("rosbag1")
    for number in range(1, channels + 1):
        definitions.add(Channel(number, 0, f"/{number}", "ros1", ()))
    report("a.bag", 100, True, tally, definitions, said, summary)
    return [(finding.code, finding.count, finding.loses_data, finding.fatal) for finding in summary.findings]


def test_what_a_bag_lost_is_told_with_its_number() -> None:
    some = Counter({1: 3})
    torn = [(7, "torn"), (9, "torn")]
    assert told(Tally(some), {1: 3}) == []
    assert told(Tally(some), {1: 2}) == []
    assert told(Tally(some), {1: 5, 2: 1}) == [("count_mismatch", 3, True, False)]
    assert told(Tally(some, torn), {1: 3}) == [("damaged_chunk", 2, False, False)]
    assert told(Tally(some, torn), {1: 4}) == [("damaged_chunk", 2, True, False)]
    assert told(Tally(some), None) == [("truncated", 1, True, False)]
    assert told(Tally(some, torn), None) == [("damaged_chunk", 2, True, False), ("truncated", 1, True, False)]
    assert told(Tally(Counter({1: 3, 2: 4, 5: 6})), {1: 3}) == [("unknown_channel", 10, True, False)]


@pytest.mark.parametrize(("topics", "listed"), [(4, 4), (5, 5), (6, 5)])
def test_a_topic_defined_twice_and_differently_makes_a_bag_useless(topics: int, listed: int) -> None:
    definitions, summary = Definitions(), LogSummary("rosbag1")
    for encoding in ("ros1", "cdr"):
        for number in range(topics):
            definitions.add(Channel(number, 0, f"/{number}", encoding, ()))
    report("a.bag", 100, True, Tally(), definitions, {}, summary)
    (finding,) = summary.findings
    assert (finding.code, finding.count, finding.fatal) == ("channel_redefined", topics, True)
    assert finding.sentence.count("/") == listed


@pytest.mark.parametrize(("topics", "listed"), [(7, 7), (8, 8), (9, 8)])
def test_as_many_topics_with_losses_are_named(topics: int, listed: int) -> None:
    definitions, summary = Definitions(), LogSummary("rosbag1")
    report("a.bag", 100, True, Tally(), definitions, dict.fromkeys(range(topics), 1), summary)
    (finding,) = summary.findings
    assert (finding.count, finding.sentence.count("connection ")) == (topics, listed)
