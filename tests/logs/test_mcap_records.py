"""MCAP records as the `mcap` package writes them, taken apart; and what is one byte too long or too short."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from mcap import records as written
from mcap.data_stream import RecordBuilder

from fieldcal.logs.encodings.gather import gather
from fieldcal.logs.mcap import records
from fieldcal.logs.mcap.records import Damage, Fields
from fieldcal.logs.mcap.summary import ends_whole, read_summary
from fieldcal.logs.messages.definitions import Definitions

HEAD = 1 + 8
FOOTER = HEAD + 8 + 8 + 4
DATA_END = HEAD + 4

SCHEMA = written.Schema(id=3, data=b"float64 x", encoding="ros2msg", name="a/B")
CHANNEL = written.Channel(id=7, topic="/t", message_encoding="cdr", metadata={"z": "1", "a": "µ"}, schema_id=3)
CHUNK = written.Chunk(
    compression="",
    uncompressed_crc=77,
    data=b"\x05" + bytes(40),
    message_end_time=9,
    message_start_time=4,
    uncompressed_size=41,
)
INDEX = written.MessageIndex(channel_id=7, records=[(100, 5), (101, 2**40)])
STATISTICS = written.Statistics(
    attachment_count=11, channel_count=12, channel_message_counts={7: 5, 258: 2**33}, chunk_count=13,
    message_count=2**34, message_end_time=15, message_start_time=16, metadata_count=17, schema_count=18,
)  # fmt: skip
RECORDS = {
    "header": written.Header(library="l", profile="p"),
    "schema": SCHEMA,
    "channel": CHANNEL,
    "message": written.Message(channel_id=7, data=b"abc", log_time=1, publish_time=2, sequence=3),
    "chunk": CHUNK,
    "message index": INDEX,
    "attachment": written.Attachment(create_time=1, data=b"d", log_time=2, media_type="m", name="n"),
    "metadata": written.Metadata(metadata={"k": "v"}, name="n"),
    "data end": written.DataEnd(data_section_crc=5),
    "footer": written.Footer(summary_crc=1, summary_offset_start=2, summary_start=3),
}
OPEN_ENDED = {"schema", "channel", "message", "chunk"}
"""Records that may have more bytes than their fields: a later version of the format may add some."""


def encoded(record: written.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def fields(content: bytes, padding: int = 5) -> Fields:
    """The body of one record between other bytes."""
    return Fields(bytes(padding) + content + bytes(padding), padding + HEAD, padding + len(content))


def with_body(content: bytes, body: bytes) -> bytes:
    return content[:1] + struct.pack("<Q", len(body)) + body


def test_bodies_are_what_the_mcap_package_wrote() -> None:
    assert records.read_schema(fields(encoded(SCHEMA))) == records.Schema(3, "a/B", "ros2msg", b"float64 x")
    assert records.read_channel(fields(encoded(CHANNEL))) == records.Channel(
        7, 3, "/t", "cdr", (("a", "µ"), ("z", "1"))
    )
    head = records.read_chunk_head(fields(encoded(CHUNK)))
    assert head == records.ChunkHead(4, 9, 41, 77, "", 5 + len(encoded(CHUNK)) - 41, 5 + len(encoded(CHUNK)))
    channel_id, offsets = records.read_message_index(fields(encoded(INDEX)))
    assert (channel_id, offsets.tolist()) == (7, [5, 2**40])
    assert records.read_statistics(fields(encoded(STATISTICS))) == records.Statistics(2**34, 13, {7: 5, 258: 2**33})
    assert records.read_metadata(fields(encoded(RECORDS["metadata"]))) == ("n", {"k": "v"})


def test_places_of_a_record() -> None:
    content = encoded(SCHEMA)
    buffer = bytes(5) + content + bytes(3)
    assert records.read_record(buffer, 5, 5 + len(content)) == records.Record(3, 5, 14, 5 + len(content))
    for limit in range(5, 5 + len(content)):
        with pytest.raises(Damage, match="begins at byte 5" if limit < 14 else f"{limit - 14} are left"):
            records.read_record(buffer, 5, limit)
    with pytest.raises(Damage, match="record 0x00 at byte 0 announces"):
        records.read_record(buffer, 0, len(buffer))
    assert records.read_record(b"\x05" + bytes(8), 0, 9).end == 9


@pytest.mark.parametrize("kind", sorted(RECORDS))
def test_a_record_is_refused_unless_its_body_has_the_shape_of_its_opcode(kind: str) -> None:
    content = encoded(RECORDS[kind])
    body = content[HEAD:]

    def check(changed: bytes) -> None:
        buffer = bytes(5) + with_body(content, changed) + b"\xff" * 9
        records.check_record(buffer, records.read_record(buffer, 5, len(buffer)))

    check(body)
    least = {"message": 2 + 4 + 8 + 8}.get(kind, len(body))
    for size in range(len(body)):
        if size >= least:
            check(body[:size])
        elif not (kind == "message index" and size == 6 + 16):
            with pytest.raises(Damage):
                check(body[:size])
    if kind in OPEN_ENDED:
        check(body + b"\0")
    else:
        with pytest.raises(Damage, match=r"1 bytes more|no whole number"):
            check(body + b"\0")


def test_opcodes_that_may_stand_in_a_data_section() -> None:
    for opcode in range(1, 256):
        record = records.Record(opcode, 0, HEAD, HEAD)
        if opcode >= 0x80:
            records.check_record(bytes(HEAD), record)
        elif opcode in (8, 10, 11, 13, 14) or opcode > 15:  # chunk index … summary offset, and what is not defined
            with pytest.raises(Damage, match=f"record {opcode:#04x} at byte 0 does not belong there"):
                records.check_record(bytes(HEAD), record)


@pytest.mark.parametrize("opcode", [1, 2, 3, 4, 5, 6, 7, 12, 15, 0x7F, 0x80, 0xFF])
def test_opcodes_with_which_a_chunk_may_begin(opcode: int) -> None:
    content = bytes(4) + bytes([opcode]) + bytes(8)
    head = records.ChunkHead(0, 0, 9, 0, "", 4, 13)
    if opcode in (3, 4, 5) or opcode >= 0x80:
        records.check_first_record(content, head)
    else:
        with pytest.raises(Damage, match="does not belong into a chunk"):
            records.check_first_record(content, head)


def test_fields_never_reach_beyond_their_limit() -> None:
    content = struct.pack("<HIQ", 513, 2**31, 2**63) + b"abcd"
    reader = Fields(content, 0, len(content))
    assert [reader.number(2), reader.number(4), reader.number(8), reader.left()] == [513, 2**31, 2**63, 4]
    for act in (reader.take, reader.skip):
        with pytest.raises(Damage, match="5 bytes announced at byte 14, 4 are left"):
            act(5)
    assert reader.position == 14
    assert reader.take(4) == b"abcd"
    assert (reader.left(), reader.take(0)) == (0, b"")
    reader.skip(0)
    with pytest.raises(Damage):
        reader.number(1)


def text(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def test_texts_and_pairs() -> None:
    content = text("grün".encode()) + text(text(b"k") + text(b"v") + text(b"") + text(b"w")) + text(b"\xff\xfe")
    reader = Fields(content, 0, len(content))
    assert reader.text() == "grün"
    assert reader.text_map() == {"k": "v", "": "w"}
    with pytest.raises(Damage, match=f"not UTF-8 before byte {len(content)}"):
        reader.text()
    odd = text(text(b"k"))
    with pytest.raises(Damage):
        Fields(odd, 0, len(odd)).text_map()
    inner = Fields(text(b"abc") + b"xyz", 0, 10)
    within = inner.inner()
    assert (within.left(), within.position, inner.position) == (3, 4, 7)
    with pytest.raises(Damage):
        within.take(4)


@pytest.mark.parametrize("compression", ["", "lz4", "zstd", "brotli"])
def test_compressions(compression: str) -> None:
    chunk = written.Chunk(compression, b"abc", 0, 0, 0, 3)
    content = encoded(chunk)
    if compression == "brotli":
        with pytest.raises(Damage, match="'brotli' is none of"):
            records.read_chunk_head(fields(content))
    else:
        assert records.read_chunk_head(fields(content)).compression == compression


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("code", ["<u1", "<i2", ">f8"])
def test_gathered_values_are_those_at_the_offsets_up_to_the_last_byte(code: str, count: int) -> None:
    data = np.frombuffer(np.random.default_rng(0).bytes(64), np.uint8)
    dtype = np.dtype(code)
    size = dtype.itemsize * count
    offsets = np.array([64 - size, 0, 7, 7])
    found = gather(data, offsets, dtype, count)
    expected = np.array([np.frombuffer(data[o : o + size].tobytes(), dtype) for o in offsets])
    np.testing.assert_array_equal(found, expected if count > 1 else expected[:, 0])
    assert found.shape == ((4, count) if count > 1 else (4,))
    assert gather(data, offsets[:0], dtype, count).shape == ((0, count) if count > 1 else (0,))
    with pytest.raises(IndexError):
        gather(data, offsets + 1, dtype, count)


# summary -------------------------------------------------------------------------------------------------------------


def file_of(summary: bytes, *, data: bytes = b"", start: int | None = None, crc: int | None = None) -> bytes:
    """Magic, data section, summary, footer, magic; `start` and `crc` as the footer gives them."""
    before = records.MAGIC + data + encoded(written.DataEnd(0))
    own = len(before) if start is None else start
    body = struct.pack("<QQ", own, 0)
    footer = b"\x02" + struct.pack("<Q", 20) + body
    right = zlib.crc32(summary + footer)
    return before + summary + footer + struct.pack("<I", right if crc is None else crc) + records.MAGIC


SUMMARY = encoded(SCHEMA) + encoded(CHANNEL) + encoded(STATISTICS)


@pytest.mark.parametrize("data", [b"", encoded(written.Header("l", "p"))])
@pytest.mark.parametrize("crc", [None, 0])
def test_a_summary_gives_definitions_and_counts(data: bytes, crc: int | None) -> None:
    summary = read_summary(file_of(SUMMARY, data=data, crc=crc))
    assert summary is not None
    assert summary.start == len(records.MAGIC) + len(data) + DATA_END
    assert summary.definitions.schemas == {3: records.read_schema(fields(encoded(SCHEMA)))}
    assert summary.definitions.channels == {7: records.read_channel(fields(encoded(CHANNEL)))}
    assert summary.statistics == records.Statistics(2**34, 13, {7: 5, 258: 2**33})


def test_a_file_may_have_no_summary_or_an_empty_one() -> None:
    assert read_summary(file_of(b"", start=0)) is None
    empty = read_summary(file_of(b""))
    assert empty is not None
    assert (empty.start, empty.statistics, empty.definitions) == (len(records.MAGIC) + DATA_END, None, Definitions())


def test_a_summary_that_is_not_what_its_crc_says_is_refused() -> None:
    with pytest.raises(Damage, match="CRC does not match"):
        read_summary(file_of(SUMMARY, crc=5))
    for start in (len(records.MAGIC) + DATA_END - 1, 1 << 40):
        with pytest.raises(Damage, match=f"places it at byte {start}"):
            read_summary(file_of(SUMMARY, start=start, crc=5))
        with pytest.raises(Damage, match=f"places it at byte {start}"):
            read_summary(file_of(SUMMARY, start=start, crc=0))
    content = bytearray(file_of(SUMMARY))
    content[-8 - FOOTER] = 4
    with pytest.raises(Damage):
        read_summary(bytes(content))
    wrong = file_of(SUMMARY)[: -8 - FOOTER] + encoded(written.DataEnd(0)) + bytes(FOOTER - DATA_END) + records.MAGIC
    with pytest.raises(Damage, match="does not end with a footer"):
        read_summary(wrong)


@pytest.mark.parametrize("moved_by", [-30, -1, 1, 500])
def test_a_summary_that_moved_is_found_behind_its_data_end(moved_by: int) -> None:
    """Bytes before it were lost or gained since the footer was written."""
    data = encoded(written.Header("l" * 600, "p"))
    start = len(records.MAGIC) + len(data) + DATA_END - moved_by
    summary = read_summary(file_of(SUMMARY, data=data, start=start))
    assert summary is not None
    assert summary.start == start + moved_by
    assert summary.statistics is not None


@pytest.mark.parametrize("others", [0, 7, 8])
def test_eight_data_ends_are_tried(others: int) -> None:
    """What looks like a data end may stand in the summary itself, in a schema's text for instance."""
    text_of = written.Schema(id=3, data=encoded(written.DataEnd(0)) * others, encoding="e", name="n")
    content = file_of(encoded(text_of), start=0x777)
    if others < 8:
        found = read_summary(content)
        assert found is not None
        assert 3 in found.definitions.schemas
    else:
        with pytest.raises(Damage):
            read_summary(content)


def test_where_a_file_ends_whole() -> None:
    shortest = records.MAGIC + bytes(FOOTER) + records.MAGIC
    assert ends_whole(shortest)
    assert not ends_whole(shortest[1:])
    assert not ends_whole(shortest[:-1] + b"x")
    assert not ends_whole(records.MAGIC)
