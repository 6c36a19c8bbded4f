"""Where the summary of an MCAP file begins: where the footer says, or behind a data end if its CRC says so."""

from __future__ import annotations

import struct
import zlib

import pytest
from damaged_mcap import MAGIC, channel, record, schema

from fieldcal.logs.mcap.records import Damage
from fieldcal.logs.mcap.summary import Summary, ends_whole, read_summary

DATA_END = record(15, bytes(4))
COUNTS = struct.pack("<QHIIIIQQ", 7, 1, 1, 0, 0, 3, 0, 0) + struct.pack("<IHQ", 10, 1, 7)
TOLD = schema(1, "a/A", "float64 x") + channel(1, 1, "/a") + record(11, COUNTS)


def file_of(before: bytes, summary: bytes, *, start: int | None = None, crc: int | None = None) -> bytes:
    """A file with this summary; its footer may lie."""
    body = MAGIC + before + DATA_END
    foot = struct.pack("<BQQQ", 2, 20, len(body) if start is None else start, 0)
    crc = zlib.crc32(summary + foot) if crc is None else crc
    return body + summary + foot + struct.pack("<I", crc) + MAGIC


def read(content: bytes) -> Summary:
    found = read_summary(content)
    assert found is not None
    return found


@pytest.mark.parametrize("crc", [None, 0])
@pytest.mark.parametrize("before", [b"", bytes(100)])
def test_a_summary_is_read_from_where_the_footer_says(before: bytes, crc: int | None) -> None:
    found = read(file_of(before, TOLD, crc=crc))
    assert found.start == 8 + len(before) + 13
    assert [c.topic for c in found.definitions.channels.values()] == ["/a"]
    assert [s.name for s in found.definitions.schemas.values()] == ["a/A"]
    assert found.statistics is not None
    assert (found.statistics.message_count, found.statistics.chunk_count) == (7, 3)
    assert found.statistics.channel_message_counts == {1: 7}


def test_a_summary_may_be_empty_or_not_there() -> None:
    content = file_of(b"", b"")
    found = read(content)
    assert (found.start, found.definitions.channels, found.statistics) == (21, {}, None)
    assert read_summary(file_of(b"", b"", start=0, crc=0)) is None


@pytest.mark.parametrize(("start", "why"), [(20, "places it at byte 20"), (22, None), (1 << 40, "places it at byte")])
def test_a_place_outside_the_data_is_no_summarys(start: int, why: str | None) -> None:
    """Behind the magic and a data end at least, before the footer at most. Without a CRC nothing says where it is."""
    content = file_of(bytes(1) if why is None else b"", TOLD, start=start, crc=0)
    if why is None:
        assert read(content).start == start
        return
    with pytest.raises(Damage, match=why):
        read_summary(content)


def test_between_the_summary_and_the_footer_there_is_nothing() -> None:
    content = file_of(b"", b"")
    footer = len(content) - 8 - 29
    for start, placed in ((footer, True), (footer + 1, False)):
        changed = content[: footer + 9] + struct.pack("<QQI", start, 0, 0) + MAGIC
        if placed:
            assert read(changed).start == start
        else:
            with pytest.raises(Damage, match=f"places it at byte {start}"):
                read_summary(changed)


@pytest.mark.parametrize("lost", [10, -10])
@pytest.mark.parametrize(("false", "found"), [(0, True), (7, True), (8, False)])
def test_a_summary_that_moved_is_behind_one_of_the_last_eight_data_ends(lost: int, false: int, found: bool) -> None:
    """Bytes were lost or gained before it; within it stands what looks like data ends."""
    content = file_of(bytes(100), TOLD + record(0x80, DATA_END * false))
    moved = content[:30] + bytes(max(-lost, 0)) + content[30 + max(lost, 0) :]
    if found:
        assert read(moved).start == 8 + 100 - lost + 13
        assert read(moved).definitions.channels.keys() == {1}
        return
    with pytest.raises(Damage):
        read_summary(moved)


def test_a_crc_that_does_not_match_is_damage() -> None:
    with pytest.raises(Damage, match="CRC does not match"):
        read_summary(file_of(b"", TOLD, crc=1))
    with pytest.raises(Damage, match="does not end with a footer"):
        read_summary(file_of(b"", TOLD)[:-37] + record(0x80, bytes(20)) + MAGIC)


def test_a_whole_end_is_the_magic_with_room_for_a_footer() -> None:
    """Eight bytes, 29 and eight."""
    assert ends_whole(MAGIC + bytes(29) + MAGIC)
    assert not ends_whole(MAGIC + bytes(28) + MAGIC)
    assert not ends_whole(MAGIC + bytes(29) + MAGIC[:-1] + b"x")
    assert not ends_whole(MAGIC + bytes(29) + MAGIC + b"x")
