"""A chunk's messages found by its index (the fast path) and by walking (the slow one): each on its own, both against
the `mcap` package; and content held to the size it declares."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from fieldcal.logs.mcap import chunks
from fieldcal.logs.mcap.chunks import decompress, locate_messages
from fieldcal.logs.mcap.file import McapFile
from fieldcal.logs.mcap.records import ChunkHead, Damage, Record

MIB = 1 << 20
MESSAGE, CHANNEL = 5, 4
HEAD, MESSAGE_HEAD = 1 + 8, 2 + 4 + 8 + 8
"""The specification's opcode and length; channel, sequence, log time and publish time."""

Walked = list[tuple[int, int]]


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def message(payload: bytes = b"", channel: int = 1) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", channel, 0, 7, 7) + payload)


def joined(*records: bytes) -> tuple[np.ndarray, list[int]]:
    """The records in a row, and where each begins."""
    begins = np.cumsum([0, *map(len, records)])
    return np.frombuffer(b"".join(records), np.uint8), begins[:-1].tolist()


def hints(*offsets: int) -> list[np.ndarray]:
    return [np.array(offsets, np.uint64)]


@pytest.fixture
def walked(monkeypatch: pytest.MonkeyPatch) -> Walked:
    """Stretches that the slow path was sent over."""
    stretches: Walked = []
    real = chunks._walk

    def walk(view: memoryview, position: int, limit: int, found: array[int], others: list[Record]) -> str | None:
        stretches.append((position, limit))
        return real(view, position, limit, found, others)

    monkeypatch.setattr(chunks, "_walk", walk)
    return stretches


def mcap_chunks(content: bytes) -> Iterator[tuple[Chunk, list[np.ndarray]]]:
    """Chunks and their message indexes, as the `mcap` package reads them."""
    chunk: Chunk | None = None
    offsets: list[np.ndarray] = []
    for r in StreamReader(BytesIO(content), emit_chunks=True).records:
        if isinstance(r, Chunk):
            if chunk is not None:
                yield chunk, offsets
            chunk, offsets = r, []
        elif type(r).__name__ == "MessageIndex":
            offsets.append(np.array([offset for _, offset in r.records], np.uint64))
    assert chunk is not None
    yield chunk, offsets


def written(compression: CompressionType, interleaved: int = 3) -> bytes:
    """Messages of several channels and every length from nothing, channels defined between them."""
    stream = BytesIO()
    writer = Writer(stream, chunk_size=4_000, compression=compression)
    writer.start()
    rng = np.random.default_rng(4)
    ids: list[int] = []
    for row in range(400):
        if row % 100 == 0 and len(ids) < interleaved:
            schema = writer.register_schema(f"S{row}", "ros2msg", b"float64 x")
            ids.append(writer.register_channel(f"/{row}", "cdr", schema))
        writer.add_message(ids[row % len(ids)], row, rng.bytes(int(rng.integers(0, 90))), row, row)
    writer.finish()
    return stream.getvalue()


def parsed(data: np.ndarray, starts: np.ndarray) -> list[Message]:
    """Messages at `starts`, taken apart by the specification's layout."""
    found = []
    for start in starts.tolist():
        size = struct.unpack_from("<Q", data, start + 1)[0]
        body = data[start + HEAD : start + HEAD + size].tobytes()
        channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", body)
        found.append(Message(channel, log_time, body[MESSAGE_HEAD:], publish_time, sequence))
    return found


@pytest.mark.parametrize("compression", list(CompressionType))
def test_both_paths_find_what_the_mcap_package_finds(compression: CompressionType, walked: Walked) -> None:
    n_messages = n_chunks = 0
    for chunk, offsets in mcap_chunks(written(compression)):
        head = ChunkHead(0, 0, chunk.uncompressed_size, chunk.uncompressed_crc, chunk.compression, 0, len(chunk.data))
        data = np.frombuffer(decompress(chunk.data, head), np.uint8)
        wanted = [r for r in breakup_chunk(chunk, validate_crc=True) if isinstance(r, Message)]
        walked.clear()
        fast = locate_messages(data, offsets)
        assert sum(end - start for start, end in walked) == data.size - sum(
            HEAD + MESSAGE_HEAD + len(m.data) for m in wanted
        )  # only what is no message was walked
        walked.clear()
        slow = locate_messages(data, [])
        assert walked == [(0, data.size)]
        for located in (fast, slow):
            assert located.damage is None
            assert parsed(data, located.starts) == wanted
        assert fast.others == slow.others
        n_messages += len(wanted)
        n_chunks += 1
    assert (n_messages, n_chunks > 3) == (400, True)


def test_a_whole_index_spares_every_walk(walked: Walked) -> None:
    """The last message is as short as one can be, and so is the only one of a chunk."""
    for records in ([message()], [message(b"x" * 30), message(b"y"), message(), message()]):
        data, begins = joined(*records)
        for index in (hints(*begins), hints(*begins[::-1]), hints(*begins[1::2]) + hints(*begins[::2])):
            assert locate_messages(data, index).starts.tolist() == begins
        assert walked == []


def test_what_the_index_leaves_out_is_walked(walked: Walked) -> None:
    data, begins = joined(message(b"a"), record(CHANNEL, bytes(40)), message(b"b"), message(b"c"), message())
    located = locate_messages(data, hints(begins[0], begins[3]))
    assert located.starts.tolist() == [begins[0], begins[2], begins[3], begins[4]]
    assert [r.start for r in located.others] == [begins[1]]
    assert walked == [(begins[1], begins[3]), (begins[4], data.size)]


FOUR = (message(b"x" * 40), message(b"y" * 50), message(b"z" * 60), message(b"w" * 70))
BEGINS = joined(*FOUR)[1]
LAST = BEGINS[3] + len(FOUR[3])


@pytest.mark.parametrize(
    "offset", [1 << 63, (1 << 64) - 1, LAST + 1, LAST, *(LAST - 1 - back for back in range(40)), BEGINS[1] + 1]
)
def test_an_index_that_leads_outside_or_to_no_message_is_not_believed(offset: int, walked: Walked) -> None:
    data, begins = joined(*FOUR)
    located = locate_messages(data, hints(begins[0], begins[1], offset))
    assert (located.starts.tolist(), located.damage) == (begins, None)
    assert walked == [(0, data.size)]


def test_an_index_that_names_another_record_is_not_believed(walked: Walked) -> None:
    data, begins = joined(message(b"a"), record(CHANNEL, bytes(40)), message(b"b"))
    located = locate_messages(data, hints(*begins))
    assert located.starts.tolist() == [begins[0], begins[2]]
    assert walked == [(0, data.size)]


@pytest.mark.parametrize("host", range(4))
def test_a_message_inside_a_message_is_not_believed(host: int, walked: Walked) -> None:
    """A payload that looks like a message, and an index that says that it is one."""
    records = [*FOUR]
    records[host] = message(b"x" * 11 + message(b"inside") + b"x" * 9)
    data, begins = joined(*records)
    inside = begins[host] + HEAD + MESSAGE_HEAD + 11
    assert data[inside] == MESSAGE
    located = locate_messages(data, hints(*begins, inside))
    assert located.starts.tolist() == begins
    assert walked == [(0, data.size)]


@pytest.mark.parametrize("n_messages", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("announced", [10, 21, 71 + 22, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 9, (1 << 64) - 1])
def test_a_message_of_impossible_length_is_damage(n_messages: int, announced: int, walked: Walked) -> None:
    """Too short for its head; or longer than what is left, up to lengths that are negative as signed numbers."""
    records = [*FOUR[: n_messages - 1], FOUR[3][:1] + struct.pack("<Q", announced) + FOUR[3][9:]]
    data, begins = joined(*records)
    located = locate_messages(data, hints(*begins))
    assert located.starts.tolist() == begins[:-1]
    assert walked == [(0, data.size)]
    assert located.damage is not None
    if announced < MESSAGE_HEAD:
        assert located.damage == f"a message of {announced} bytes at byte {begins[-1]} of the chunk"
    else:
        assert f"announces {announced} bytes, {70 + MESSAGE_HEAD} are left" in located.damage


def test_a_short_message_first_is_damage_before_all_others(walked: Walked) -> None:
    data, begins = joined(record(MESSAGE, bytes(21)), *FOUR)
    located = locate_messages(data, hints(*begins))
    assert (located.starts.tolist(), located.damage) == ([], "a message of 21 bytes at byte 0 of the chunk")
    assert walked == [(0, data.size)]


def test_damage_between_announced_messages_ends_the_chunk_there() -> None:
    data, begins = joined(FOUR[0], FOUR[1], b"\0" * 30, FOUR[2])
    located = locate_messages(data, hints(begins[0], begins[1], begins[3]))
    assert located.starts.tolist() == begins[:2]
    assert located.damage == f"record 0x00 at byte {begins[2]} announces 0 bytes, 21 are left"


@pytest.mark.parametrize(("count", "sound"), [(100_000, True), (100_001, False)])
def test_a_hundred_thousand_other_records_are_enough(count: int, sound: bool) -> None:
    """Documented in `OTHER_RECORDS_CAP`: each costs an object, a chunk of nothing else would fill the memory."""
    located = locate_messages(np.frombuffer(record(0x80, b"") * count + message(), np.uint8), [])
    assert (located.damage is None) == sound
    assert len(located.others) == 100_000
    assert len(located.starts) == (1 if sound else 0)


def head_of(packed: bytes, compression: str, declared: int, crc: int = 0) -> ChunkHead:
    return ChunkHead(0, 0, declared, crc, compression, 0, len(packed))


def stream_zstd(content: bytes) -> bytes:
    """A frame that does not say how long its content is."""
    return zstandard.ZstdCompressor(write_content_size=False).compress(content)


PACKERS: dict[str, tuple[str, Callable[[bytes], bytes]]] = {
    "none": ("", bytes),
    "zstd": ("zstd", zstandard.compress),
    "zstd without size": ("zstd", stream_zstd),
    "lz4": ("lz4", lz4.frame.compress),
}


@pytest.mark.parametrize("pack", PACKERS)
@pytest.mark.parametrize("size", [0, 1, 5_000, MIB - 1, MIB, MIB + 1, 2 * MIB + 70_000])
def test_content_is_exactly_what_is_declared(pack: str, size: int) -> None:
    """Held against what was packed. One byte more or less than declared is damage, the CRC decides the rest."""
    compression, packer = PACKERS[pack]
    content = np.random.default_rng(size).bytes(size)
    packed = packer(content)
    crc = zlib.crc32(content)
    assert bytes(decompress(packed, head_of(packed, compression, size, crc))) == content
    for declared in {size + 1, max(size - 1, 0)} - {size}:
        with pytest.raises(Damage, match=f"bytes where {declared} are declared"):
            decompress(packed, head_of(packed, compression, declared))
    with pytest.raises(Damage, match="CRC does not match"):
        decompress(packed, head_of(packed, compression, size, crc ^ 1 or 2))


@pytest.mark.parametrize("pack", ["zstd", "zstd without size", "lz4"])
@pytest.mark.parametrize("declared", [0, 100, MIB - 1, MIB, MIB + 1])
def test_unpacking_stops_one_byte_behind_what_is_declared(pack: str, declared: int) -> None:
    """However much more there is: 8 MiB."""
    compression, packer = PACKERS[pack]
    packed = packer(bytes(8 * MIB))
    with pytest.raises(Damage, match=f"^{declared + 1} uncompressed bytes where {declared} are declared"):
        decompress(packed, head_of(packed, compression, declared))


@pytest.mark.parametrize("pack", ["zstd", "zstd without size", "lz4"])
def test_several_frames_are_one_content(pack: str) -> None:
    compression, packer = PACKERS[pack]
    parts = [np.random.default_rng(i).bytes(size) for i, size in enumerate((100_000, 1, 0, 70_000))]
    packed = b"".join(map(packer, parts))
    assert bytes(decompress(packed, head_of(packed, compression, 170_001))) == b"".join(parts)


def test_bytes_behind_the_only_frame_are_damage() -> None:
    packed = zstandard.compress(b"content") + b"behind"
    with pytest.raises(Damage, match="zstd content does not decompress"):
        decompress(packed, head_of(packed, "zstd", 7))


@pytest.mark.parametrize(("log2_window", "taken"), [(10, True), (27, True), (28, False), (29, False)])
def test_a_window_of_128_mib_is_the_largest(log2_window: int, taken: bool) -> None:
    """A frame by hand (RFC 8878): no content size, the window's size, one last raw block."""
    content = b"content"
    block = (1 | len(content) << 3).to_bytes(3, "little") + content
    packed = b"\x28\xb5\x2f\xfd\x00" + bytes([(log2_window - 10) << 3]) + block
    if taken:
        assert bytes(decompress(packed, head_of(packed, "zstd", len(content)))) == content
    else:
        with pytest.raises(Damage, match="zstd content does not decompress"):
            decompress(packed, head_of(packed, "zstd", len(content)))


@pytest.mark.parametrize(
    ("declared", "why"),
    [
        (256 * MIB, "uncompressed bytes where 268435456 are declared"),
        (256 * MIB + 1, "the chunk declares 268435457 bytes, the cap is 268435456"),
    ],
)
def test_a_chunk_of_256_mib_is_the_largest(declared: int, why: str, tmp_path: Path) -> None:
    inner = struct.pack("<QQQII", 0, 0, declared, 1, 0) + struct.pack("<Q", 5) + b"short"
    path = tmp_path / "log.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + record(1, bytes(8)) + record(6, inner))
    log = McapFile(path)
    assert list(log.blocks()) == []
    assert why in log.tally.damaged_chunks[0][1]
