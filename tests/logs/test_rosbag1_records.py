"""ROS 1 bags record by record, each laid out by struct here: what is whole, and what is one byte short of it."""

from __future__ import annotations

import bz2
from fractions import Fraction

import numpy as np
import pytest
from rosbag1_records import chunk, field, length, message, record

from fieldcal.logs.rosbag1 import chunks
from fieldcal.logs.rosbag1.chunks import ChunkOpener, is_chunk, is_record, next_chunk
from fieldcal.logs.rosbag1.records import Damage, messages_of, read_fields, read_record, walk

OTHER = record(field("op", b"\7") + field("conn", length(1)), b"xyz")


def refusal(content: bytes, position: int = 0, limit: int | None = None, *, whole: bool = True) -> str:
    """Why the record is none; empty where it is one."""
    try:
        read_record(content, position, len(content) if limit is None else limit, whole=whole)
    except Damage as damage:
        return str(damage)
    return ""


def test_a_record_is_what_its_lengths_say() -> None:
    content = b"##" + OTHER + b"rest"
    found = read_record(content, 2, len(content))
    assert (found.opcode, found.start, content[found.data : found.end]) == (7, 2, b"xyz")
    assert found.number(b"conn") == 1
    assert content[found.fields[b"conn"][0] :][:4] == length(1)
    with pytest.raises(Damage, match="record at byte 2 has no field time"):
        found.value(b"time")


def test_a_record_that_is_not_whole_is_none() -> None:
    body = len(OTHER) - 3
    assert refusal(OTHER) == ""
    assert refusal(OTHER, limit=len(OTHER) - 1) == "the record at byte 0 announces 3 bytes, 2 are left"
    assert refusal(OTHER, limit=len(OTHER) - 1, whole=False) == ""
    assert refusal(OTHER, limit=body, whole=False) == ""
    assert refusal(OTHER, limit=body - 1, whole=False).startswith(f"a length at byte {body - 4}, the data ends at")
    assert refusal(length(3)) == "a length at byte 7, the data ends at 4"
    assert refusal(length(0)[:3]) == "a length at byte 0, the data ends at 3"
    for opcode in (0, 1, 8, 255):
        assert refusal(record(field("op", bytes([opcode])), b"")).endswith("is of no known kind")
    assert refusal(record(field("op", b"\7\7"), b"")).endswith("is of no known kind")
    assert refusal(record(field("other", b"\7"), b"")).endswith("is of no known kind")
    for size, named in ((1 << 16, ""), ((1 << 16) + 1, "the record at byte 0 announces a header of 65537 bytes")):
        wide = field("op", b"\7")
        assert refusal(record(wide + field("x", bytes(size - len(wide) - 6)), b"")) == named


def test_fields_are_what_their_lengths_say() -> None:
    content = field("a", b"1") + field("b", b"x=y") + field("c", b"")
    assert dict(read_fields(content, 0, len(content))) == {b"a": (6, b"1"), b"b": (13, b"x=y"), b"c": (22, b"")}
    with pytest.raises(Damage, match="a field of 3 bytes at byte 0, 2 are left"):
        list(read_fields(field("a", b"1"), 0, 6))
    with pytest.raises(Damage, match="a field of 3 bytes at byte 7, 1 are left"):
        list(read_fields(field("a", b"1") * 2, 7, 12))
    with pytest.raises(Damage, match="a field without a name at byte 0"):
        list(read_fields(length(2) + b"ab", 0, 6))


@pytest.mark.parametrize(
    ("tail", "damage"),
    [
        (b"", None),
        (length(0), "a record begins at byte 72 and the data ends at 76"),
        (length(0) + length(0)[:3], "a record begins at byte 72 and the data ends at 79"),
        (length(4) + bytes(7), "the record at byte 72 announces a header of 4 bytes"),
        (length(0) + length(2) + b"x", "the record at byte 72 ends 1 bytes behind the data"),
    ],
)
def test_records_follow_each_other(tail: bytes, damage: str | None) -> None:
    content = OTHER * 2 + record(b"", b"")
    starts, headers, told = walk(content + tail, 0, len(content) + len(tail))
    size = len(OTHER)
    assert (starts.tolist(), headers.tolist()) == ([0, size, 2 * size], [size - 11, size - 11, 0])
    assert told == damage


def found_of(*parts: bytes) -> tuple[list[tuple[bytes, int, int]], list[int], int]:
    content = b"".join(parts)
    starts, headers, damage = walk(content, 0, len(content))
    assert damage is None
    messages, others, malformed = messages_of(np.frombuffer(content, np.uint8), starts, headers)
    ends = messages.starts + messages.sizes
    payloads = [content[a:b] for a, b in zip(messages.starts.tolist(), ends.tolist(), strict=True)]
    return (
        list(zip(payloads, messages.connections.tolist(), messages.log_time_ns.tolist(), strict=True)),
        others,
        malformed,
    )


def test_messages_among_other_records() -> None:
    parts = [message(7, 1, 5, b"ab"), OTHER, message(2**32 - 1, 2**32 - 1, 999_999_999, b""), message(8, 0, 0, b"c")]
    found, others, malformed = found_of(*parts)
    assert found == [(b"ab", 7, 1_000_000_005), (b"", 2**32 - 1, (2**32 - 1) * 10**9 + 999_999_999), (b"c", 8, 0)]
    assert (others, malformed) == ([len(parts[0])], 0)
    assert found_of(OTHER, OTHER) == ([], [0, len(OTHER)], 0)


def test_records_that_are_none_are_counted() -> None:
    short = record(field("op", b"\2") + field("conn", b"\1\0") + field("time", bytes(8)), b"x")
    brief = record(field("op", b"\2") + field("conn", length(1)) + field("time", bytes(4)), b"x")
    nameless = record(field("op", b"\2") + field("conn", length(1)), b"x")
    unknown = record(field("op", b"\1"), b"")
    for bad in (short, brief, nameless, unknown):
        found, others, malformed = found_of(bad, message(1, 2, 3, b"y"), bad)
        assert found == [(b"y", 1, 2_000_000_003)]
        assert (others, malformed) == ([], 2)


def test_so_many_different_headers_of_one_length_are_taken_apart() -> None:
    def odd(number: int) -> bytes:
        header = field("op", b"\2") + field("conn", length(1)) + field("time", bytes(8)) + field("x", bytes([number]))
        return record(header, b"")

    for count, malformed in ((64, 0), (65, 1), (70, 6)):
        found, _, lost = found_of(*(odd(number) for number in range(count)))
        assert (len(found), lost) == (min(count, 64), malformed)


def test_headers_that_differ_in_connection_and_time_alone_are_alike() -> None:
    """Hundreds of them are one layout, whatever bytes their values have and however long the messages are."""
    generator = np.random.default_rng(0)
    values = generator.integers(0, 2**32, (300, 3)).tolist()
    told = [(bytes(i % 7), connection, s * 10**9 + ns) for i, (connection, s, ns) in enumerate(values)]
    found, _, malformed = found_of(*(message(c, s, ns, bytes(i % 7)) for i, (c, s, ns) in enumerate(values)))
    assert (found, malformed) == (told, 0)


# chunks --------------------------------------------------------------------------------------------------------------


def opened(content: bytes, limit: int | None = None, opener: ChunkOpener | None = None) -> bytes | str:
    found = read_record(content, 0, len(content), whole=False)
    try:
        return bytes((opener or ChunkOpener(content)).open(found, len(content) if limit is None else limit))
    except Damage as damage:
        return str(damage)


def test_the_content_of_a_chunk() -> None:
    assert opened(chunk(b"abc", 3)) == b"abc"
    assert opened(chunk(bz2.compress(b"abc"), 3, b"bz2")) == b"abc"
    assert opened(chunk(b"abc", 2)) == "the chunk has 3 bytes where 2 are declared"
    assert opened(chunk(bz2.compress(b"abc"), 2, b"bz2")) == "3 uncompressed bytes where 2 are declared"
    assert opened(chunk(bz2.compress(b"abc"), 4, b"bz2")) == "3 uncompressed bytes where 4 are declared"
    assert opened(chunk(bz2.compress(b"abc"), 1, b"bz2")) == "2 uncompressed bytes where 1 are declared"
    assert str(opened(chunk(b"abc", 3, b"bz2"))).startswith("bz2 content does not decompress")
    assert opened(chunk(b"abc", 3, b"zip")) == "compression 'zip' is none of none, lz4, bz2"


def test_of_a_chunk_that_was_cut_there_is_what_is_there_unless_it_is_packed() -> None:
    whole, packed = chunk(b"abcdef", 6), chunk(bz2.compress(b"abc"), 3, b"bz2")
    assert opened(whole, len(whole) - 2) == b"abcd"
    assert opened(chunk(b"abcd", 5, declared=6)) == b"abcd"
    assert opened(chunk(b"abcd", 4, declared=6)) == "the chunk has 6 bytes where 4 are declared"
    assert opened(packed, len(packed)) == b"abc"
    size = len(bz2.compress(b"abc"))
    assert opened(packed, len(packed) - 1) == f"the chunk announces {size} bytes, {size - 1} are left"


def test_a_chunk_may_grow_up_to_a_cap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "CHUNK_CAP_BYTES", 1000)
    packed = bz2.compress(bytes(1000))
    assert opened(chunk(bytes(1000), 1000)) == bytes(1000)
    assert opened(chunk(bytes(1001), 1001)) == "the chunk has 1001 bytes, the cap is 1000"
    assert opened(chunk(packed, 1000, b"bz2")) == bytes(1000)
    assert opened(chunk(packed, 1001, b"bz2")) == "the chunk declares 1001 bytes, the cap is 1000"
    monkeypatch.setattr(chunks, "TOTAL_CAP_BYTES", 2000)
    content = chunk(packed, 1000, b"bz2")
    monkeypatch.setattr(chunks, "TOTAL_CAP_RATIO", Fraction(1000, len(packed)))
    opener = ChunkOpener(content)
    assert [len(opened(content, opener=opener)) for _ in range(3)] == [1000] * 3
    monkeypatch.setattr(chunks, "TOTAL_CAP_RATIO", Fraction(999, len(packed)))
    opener = ChunkOpener(content)
    assert [len(opened(content, opener=opener)) for _ in range(2)] == [1000, 1000]
    assert opened(content, opener=opener) == "unpacking over 2000 bytes from chunks that grow so much is refused"


def test_where_records_begin() -> None:
    content = chunk(b"abc", 3)
    assert is_chunk(content, 0, len(content))
    assert not is_chunk(content, 0, len(content) - 1)
    assert not is_chunk(OTHER, 0, len(OTHER))
    assert not is_chunk(record(field("op", b"\5") + field("size", length(3)), b""), 0, 30)
    two = record(field("op", b"\5") + field("size", b"\3\0") + field("compression", b"none"), b"")
    assert not is_chunk(two, 0, len(two))
    assert [is_record(OTHER, at, len(OTHER)) for at in (0, 1, len(OTHER))] == [True, False, True]
    assert not is_record(OTHER, 0, len(OTHER) - 1)


@pytest.mark.parametrize(
    "junk", [b"", b"x", field("op", b"\5"), field("op", b"\5") * 2, field("op", b"\5")[:-1], bytes(70)]
)
def test_the_next_chunk_is_found_wherever_its_kind_stands_in_its_header(junk: bytes) -> None:
    early = chunk(b"abc", 3)
    late = record(field("compression", b"none") + field("size", length(3)) + field("op", b"\5"), b"abc")
    for content in (early, late):
        begin, end = len(junk), len(junk) + len(content)
        whole = junk + content + OTHER + content
        assert [next_chunk(whole, at, len(whole)) for at in (0, begin, begin + 1)] == [begin, begin, end + len(OTHER)]
        assert next_chunk(junk + content, 0, end) == begin
        assert next_chunk(junk + content, 0, end - 1) is None
        assert next_chunk(junk + OTHER, 0, len(junk + OTHER)) is None
