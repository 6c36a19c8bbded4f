"""Damaged and hostile MCAP files by the hundred, made from one sound file with `struct` alone.

`damaged_files(sound)` gives every kind with what must become of it. What the chunks of the sound file hold is told by
the `mcap` package, so that nothing here trusts the reader under test.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import lz4.frame
import numpy as np
import zstandard
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

MAGIC = b"\x89MCAP0\r\n"
HEAD = 9
CHUNK_FIELDS = {"start_time": 0, "end_time": 8, "size": 16, "crc": 24, "compression_length": 28, "compression": 32}
FOOTER = HEAD + 20
USABLE, LOSSY, CONTRADICTORY, NOTHING = ("ok", "partial"), ("partial",), ("quarantined",), ("rejected",)


@dataclass(frozen=True)
class Damaged:
    """One file. `verdicts`: those allowed. `whole`: no message may be missing. `checked`: CRCs cover every message."""

    name: str
    content: bytes
    verdicts: tuple[str, ...] = USABLE
    whole: bool = False
    checked: bool = True


@dataclass(frozen=True)
class Place:
    """A record of the sound file: bytes [start, end), `body` behind opcode and length."""

    opcode: int
    start: int
    body: int
    end: int


def places(content: bytes) -> list[Place]:
    """All records between the magic bytes."""
    found, position = [], len(MAGIC)
    while position < len(content) - len(MAGIC):
        opcode, size = struct.unpack_from("<BQ", content, position)
        found.append(Place(opcode, position, position + HEAD, position + HEAD + size))
        position = found[-1].end
    return found


def chunks(content: bytes) -> list[Place]:
    """Its chunks."""
    return [place for place in places(content) if place.opcode == 0x06]


def messages_of_chunks(content: bytes) -> list[list[tuple[str, int]]]:
    """(topic, log time) of the messages of every chunk, read by the mcap package."""
    topics: dict[int, str] = {}
    found: list[list[tuple[str, int]]] = []
    for record in StreamReader(io.BytesIO(content), emit_chunks=True, validate_crcs=True).records:
        if isinstance(record, Chunk):
            inner = breakup_chunk(record, validate_crc=True)
            topics |= {channel.id: channel.topic for channel in inner if isinstance(channel, McapChannel)}
            found.append([(topics[m.channel_id], m.log_time) for m in inner if isinstance(m, Message)])
    return found


def flip(content: bytes, position: int, bit: int = 4) -> bytes:
    """One bit flipped."""
    changed = bytearray(content)
    changed[position] ^= 1 << bit
    return bytes(changed)


def put(content: bytes, position: int, piece: bytes) -> bytes:
    """Bytes overwritten."""
    return content[:position] + piece + content[position + len(piece) :]


def record(opcode: int, body: bytes, declared: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if declared is None else declared) + body


def text(content: str | bytes, declared: int | None = None) -> bytes:
    raw = content.encode() if isinstance(content, str) else content
    return struct.pack("<I", len(raw) if declared is None else declared) + raw


def schema(schema_id: int, name: str, definition: str, declared: int | None = None) -> bytes:
    return record(0x03, struct.pack("<H", schema_id) + text(name) + text("ros2msg") + text(definition, declared))


def channel(channel_id: int, schema_id: int, topic: str, encoding: str = "cdr", metadata: bytes = b"") -> bytes:
    head = struct.pack("<HH", channel_id, schema_id)
    return record(0x04, head + text(topic) + text(encoding) + text(metadata))


def message(channel_id: int, log_time: int, payload: bytes) -> bytes:
    return record(0x05, struct.pack("<HIQQ", channel_id, 0, log_time, log_time) + payload)


PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.ZstdCompressor(level=1).compress,
    "lz4": lz4.frame.compress,
    "": bytes,
}


def chunk(
    records: bytes, compression: str = "zstd", *, packed: bytes | None = None, size: int | None = None, crc: int = -1
) -> bytes:
    """A chunk record; `packed`, `size` and `crc` may lie."""
    packed = PACK[compression](records) if packed is None else packed
    crc = zlib.crc32(records) if crc == -1 else crc
    head = struct.pack("<QQQI", 0, 0, len(records) if size is None else size, crc) + text(compression)
    return record(0x06, head + struct.pack("<Q", len(packed)) + packed)


def inner(content: bytes, place: Place) -> bytes:
    """The records of a zstd chunk."""
    (length,) = struct.unpack_from("<I", content, place.body + 28)
    return zstandard.ZstdDecompressor().decompress(content[place.body + 32 + length + 8 : place.end])


def ended(body: bytes) -> bytes:
    """A file of these records with the end that a writer without summary gives it."""
    header = record(0x01, text("ros2") + text("test"))
    return MAGIC + header + body + record(0x0F, bytes(4)) + record(0x02, bytes(20)) + MAGIC


def repacked(content: bytes, make: Callable[[bytes], bytes]) -> bytes:
    """The sound file's chunks rewritten by `make`, without index and summary."""
    return ended(b"".join(make(inner(content, place)) for place in chunks(content)))


def damaged_files(sound: bytes) -> Iterator[Damaged]:
    """Every kind, made from a sound file of zstd chunks with CRCs, index and summary."""
    yield from _cuts(sound)
    yield from _flips(sound)
    yield from _overwritten(sound)
    yield from _disorder(sound)
    yield from _contradictions(sound)
    yield from _oversize(sound)
    yield from _bombs(sound)
    yield from _other_writers(sound)
    yield from _floods(sound)
    yield from _no_logs()


def _cuts(sound: bytes) -> Iterator[Damaged]:
    all_chunks = chunks(sound)
    for number, place in enumerate(all_chunks):
        for name, at in (("before", place.end - 1), ("at", place.end), ("after", place.end + 1)):
            verdicts = NOTHING if number == 0 and name == "before" else LOSSY
            yield Damaged(f"cut {name} the end of chunk {number}", sound[:at], verdicts)
    by_opcode = {place.opcode: place for place in places(sound)}
    data_end, footer = by_opcode[0x0F], by_opcode[0x02]
    yield Damaged("cut before the header ends", sound[: places(sound)[0].end - 1], NOTHING)
    yield Damaged("cut behind the header", sound[: places(sound)[0].end], NOTHING)
    yield Damaged("cut before the data end", sound[: data_end.start], USABLE, whole=True)
    yield Damaged("cut inside the data end", sound[: data_end.end - 2], USABLE, whole=True)
    yield Damaged("cut behind the data end", sound[: data_end.end], ("ok",), whole=True)
    yield Damaged("cut inside the summary", sound[: (data_end.end + footer.start) // 2], ("ok",), whole=True)
    yield Damaged("cut before the footer", sound[: footer.start], ("ok",), whole=True)
    yield Damaged("cut inside the last magic", sound[:-3], ("ok",), whole=True)


def _flips(sound: bytes) -> Iterator[Damaged]:
    every = places(sound)
    header, data_end, footer = every[0], *(p for p in every if p.opcode in (0x0F, 0x02))
    for name, at in (("magic", 3), ("opcode", header.start), ("length", header.start + 1), ("text", header.body + 2)):
        yield Damaged(f"flip in the header's {name}", flip(sound, at), ("ok",), whole=True)
    for number in (0, 4, 9):
        place = chunks(sound)[number]
        for name, at in (("opcode", place.start), ("length", place.start + 1), ("length's top", place.start + 8)):
            yield Damaged(f"flip in chunk {number}'s {name}", flip(sound, at), USABLE)
        for name, offset in CHUNK_FIELDS.items():
            yield Damaged(f"flip in chunk {number}'s {name}", flip(sound, place.body + offset), USABLE)
        for name, at in (("first byte", place.body + 45), ("middle", (place.body + place.end) // 2)):
            yield Damaged(f"flip in chunk {number}'s content, {name}", flip(sound, at), LOSSY)
        yield Damaged(f"flip in chunk {number}'s content, last byte", flip(sound, place.end - 1), USABLE)
    index = next(place for place in every if place.opcode == 0x07)
    for name, at in (
        ("opcode", index.start),
        ("length", index.start + 1),
        ("channel", index.body),
        ("size", index.body + 2),
        ("time", index.body + 7),
        ("offset", index.body + 15),
    ):
        yield Damaged(f"flip in a message index's {name}", flip(sound, at), ("ok",), whole=True)
    for name, at in (("opcode", data_end.start), ("length", data_end.start + 1), ("crc", data_end.body)):
        yield Damaged(f"flip in the data end's {name}", flip(sound, at), ("ok",), whole=True)
    for opcode, name in ((3, "schema"), (4, "channel"), (8, "chunk index"), (11, "statistics"), (14, "offset")):
        place = next(p for p in every if p.opcode == opcode and p.start > data_end.start)
        for part, at in (("opcode", place.start), ("length", place.start + 2), ("body", place.body + 3)):
            yield Damaged(f"flip in the summary's {name} {part}", flip(sound, at), ("ok",), whole=True)
    for name, offset in (("opcode", 0), ("start", HEAD), ("offset start", HEAD + 8), ("crc", HEAD + 16)):
        yield Damaged(f"flip in the footer's {name}", flip(sound, footer.start + offset), ("ok",), whole=True)
    yield Damaged("flip in the last magic", flip(sound, len(sound) - 4), ("ok",), whole=True)


def _overwritten(sound: bytes) -> Iterator[Damaged]:
    third, fourth = chunks(sound)[3:5]
    index = next(place for place in places(sound) if place.opcode == 0x07 and place.start > third.start)
    where = {"inside a chunk": third.start + 900, "over a chunk's head": fourth.start - 200, "an index": index.start}
    for name, at in where.items():
        for filler in (b"\xff", b"\0", b"\x06", MAGIC):
            piece = (filler * 512)[:512]
            yield Damaged(f"512 bytes {filler[:1]!r} {name}", put(sound, at, piece), USABLE)
        yield Damaged(f"512 bytes missing {name}", sound[:at] + sound[at + 512 :], USABLE)
        yield Damaged(f"700 bytes inserted {name}", sound[:at] + bytes(range(7)) * 100 + sound[at:], USABLE)
    first = chunks(sound)[0]
    yield Damaged(
        "bytes missing in the chunk of definitions", sound[: first.body + 60] + sound[first.body + 90 :], LOSSY
    )
    yield Damaged("chunk of definitions gone", sound[: first.start] + sound[first.end :], LOSSY)
    yield Damaged("header gone", MAGIC + sound[first.start :], ("ok",), whole=True)
    yield Damaged("first 100 bytes gone", sound[100:], USABLE)
    yield Damaged("text before the file", b"-----\r\n" * 9 + sound, ("ok",), whole=True)
    yield Damaged("text behind the file", sound + b"-----\r\n" * 9, ("ok",), whole=True)
    yield Damaged("last quarter zeros", sound[: len(sound) * 3 // 4] + bytes(len(sound) // 4), LOSSY)


def _disorder(sound: bytes) -> Iterator[Damaged]:
    some = chunks(sound)
    body = [inner(sound, place) for place in some]
    as_they_are = [sound[place.start : place.end] for place in some]
    yield Damaged("a chunk twice", _inserted(sound, as_they_are[2]), ("ok",), whole=True)
    yield Damaged("a chunk twice, packed differently", _inserted(sound, chunk(body[2], "lz4")), ("ok",), whole=True)
    yield Damaged("the file twice", sound + sound, ("ok",), whole=True)
    yield Damaged("chunks in reverse", ended(b"".join(reversed(as_they_are))), ("ok",), whole=True)
    yield Damaged("two chunks swapped", ended(b"".join([as_they_are[0], *as_they_are[:0:-1]])), ("ok",), whole=True)
    lines = [body[1][p.start : p.end] for p in _inside(body[1])]
    repeated = b"".join(line for line in lines for _ in range(2))
    yield Damaged("every message of a chunk twice", _inserted(sound, chunk(repeated)), ("ok",), whole=True)
    rng = np.random.default_rng(3)
    mixed = [as_they_are[0], *(chunk(_shuffled(one, rng)) for one in body[1:])]
    yield Damaged("messages shuffled in every chunk", ended(b"".join(mixed)), ("ok",), whole=True)
    other = [flip(line, len(line) - 2) for line in lines[:3]]
    yield Damaged("three messages again with other values", _inserted(sound, chunk(b"".join(other))), USABLE)


def _contradictions(sound: bytes) -> Iterator[Damaged]:
    imu = "sensor_msgs/msg/Imu"
    redefinitions = {
        "schema": schema(1, imu, "float64 x"),
        "schema's name": schema(1, "sensor_msgs/msg/Temperature", "float64 x"),
        "channel's topic": channel(1, 1, "/other"),
        "channel's schema": channel(1, 2, "/imu/data_raw"),
        "channel's encoding": channel(1, 1, "/imu/data_raw", "json"),
    }
    for name, piece in redefinitions.items():
        yield Damaged(f"{name} redefined between chunks", _inserted(sound, piece), CONTRADICTORY)
        yield Damaged(f"{name} redefined inside a chunk", _inserted(sound, chunk(piece)), CONTRADICTORY)
    first = inner(sound, chunks(sound)[0])
    same = [first[p.start : p.end] for p in _inside(first) if p.opcode in (3, 4)]
    yield Damaged("all definitions repeated as they are", _inserted(sound, b"".join(same)), ("ok",), whole=True)
    unknown = message(77, 1, b"\0\1\0\0" + bytes(40))
    yield Damaged("messages of an undefined channel", _inserted(sound, chunk(unknown * 5)), LOSSY)
    short = message(1, 1, b"\0\1\0\0" + bytes(9))
    yield Damaged("messages shorter than their schema", _inserted(sound, chunk(short * 5)), LOSSY)
    yield Damaged("messages without content", _inserted(sound, chunk(message(1, 1, b"") * 5)), LOSSY)
    place = chunks(sound)[4]
    filler = record(0x90, bytes(place.end - place.start - HEAD))
    yield Damaged("a chunk replaced by a private record", put(sound, place.start, filler), LOSSY)


def _oversize(sound: bytes) -> Iterator[Damaged]:
    huge = (1 << 32) - 1
    imu = "sensor_msgs/msg/Imu"
    between = {
        "record of 2^63 bytes": record(0x05, bytes(30), 1 << 63),
        "private record of 2^64-1 bytes": record(0x90, bytes(30), (1 << 64) - 1),
        "schema text of 4 GB": schema(9, imu, "float64 x", huge),
        "channel metadata of 4 GB": record(0x04, struct.pack("<HH", 9, 1) + text("/x") + text("cdr") + text("", huge)),
        "message index of 4 GB": record(0x07, struct.pack("<HI", 1, huge) + bytes(16)),
        "attachment of 2^63 bytes": record(0x09, bytes(16) + text("a") + text("b") + struct.pack("<Q", 1 << 63)),
        "metadata of 4 GB": record(0x0C, text("a") + text("", huge)),
    }
    for name, piece in between.items():
        yield Damaged(f"declared: {name}", _inserted(sound, piece), ("ok",), whole=True)
    body = bytes(100)
    for size in (1, 1 << 20, 300 << 20, 100 << 30, (1 << 64) - 1):
        for compression in ("zstd", "lz4", ""):
            piece = chunk(body, compression, size=size, crc=0)
            yield Damaged(
                f"declared: {size} bytes in a {compression or 'plain'} chunk",
                _inserted(sound, piece),
                ("ok",),
                whole=True,
            )
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 100 << 30) + b"\x01\0\0" + bytes(8)
    piece = chunk(b"", packed=frame, size=1000)
    yield Damaged("declared: a zstd frame of 100 GB", _inserted(sound, piece), ("ok",), whole=True)
    piece = chunk(record(0x05, bytes(22), 1 << 62))
    yield Damaged(
        "declared: a message of 2^62 bytes in a chunk with a CRC", _inserted(sound, piece), ("ok",), whole=True
    )


def _bombs(sound: bytes) -> Iterator[Damaged]:
    zeros = zstandard.compress(bytes(600 << 20))
    yield Damaged(
        "bomb: zstd, 600 MB from 100 declared",
        _inserted(sound, chunk(b"", packed=zeros, size=100)),
        ("ok",),
        whole=True,
    )
    yield Damaged(
        "bomb: zstd, 600 MB declared", _inserted(sound, chunk(b"", packed=zeros, size=600 << 20)), ("ok",), whole=True
    )
    many = zstandard.compress(bytes(60 << 20)) * 10
    yield Damaged(
        "bomb: ten zstd frames", _inserted(sound, chunk(b"", packed=many, size=200 << 20)), ("ok",), whole=True
    )
    packed = lz4.frame.compress(bytes(120 << 20))
    yield Damaged(
        "bomb: lz4, 120 MB from 100 declared",
        _inserted(sound, chunk(b"", "lz4", packed=packed, size=100)),
        ("ok",),
        whole=True,
    )
    private = record(0x91, bytes((100 << 20) - HEAD))
    honest = chunk(private)
    yield Damaged("bomb: twenty honest chunks of 100 MB", _inserted(sound, honest * 20), ("ok",), whole=True)
    false = _false_chunk(6 << 20, 1, "lz4") + lz4.frame.compress(np.random.default_rng(1).bytes(1 << 10))
    yield Damaged(
        "bomb: false lz4 chunks inside each other", _inserted(sound, _torn(false * 7000)), ("ok",), whole=True
    )
    false = _false_chunk(4 << 20, 4 << 20, "")
    yield Damaged(
        "bomb: false plain chunks inside each other", _inserted(sound, _torn(false * 100_000)), ("ok",), whole=True
    )
    false = _false_chunk(6 << 20, 6 << 20, "zstd") + zstandard.compress(bytes(6 << 20))
    yield Damaged(
        "bomb: false zstd chunks inside each other", _inserted(sound, _torn(false * 10_000)), ("ok",), whole=True
    )


def _false_chunk(packed: int, size: int, compression: str) -> bytes:
    """The head of a chunk that declares `packed` bytes and a CRC of 1."""
    head = struct.pack("<QQQI", 0, 0, size, 1) + text(compression) + struct.pack("<Q", packed)
    return struct.pack("<BQ", 0x06, len(head) + packed) + head


def _torn(content: bytes) -> bytes:
    """Content where a record should begin and none does: reading must find its way behind it."""
    return b"\x05" + b"\xff" * 8 + content


def _other_writers(sound: bytes) -> Iterator[Damaged]:
    def frames(pack: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        return lambda records: b"".join(pack(records[at : at + 9000]) for at in range(0, len(records), 9000))

    for name in ("zstd", "lz4"):
        many = frames(PACK[name])
        yield Damaged(
            f"{name} chunks of several frames",
            repacked(sound, lambda r, n=name, m=many: chunk(r, n, packed=m(r))),  # type: ignore[misc]
            ("ok",),
            whole=True,
        )
    stream = zstandard.ZstdCompressor(write_content_size=False)
    yield Damaged(
        "zstd frames without a size",
        repacked(sound, lambda r: chunk(r, packed=stream.compress(r))),
        ("ok",),
        whole=True,
    )
    for name in ("lz4", ""):
        yield Damaged(
            f"{name or 'plain'} chunks, no index", repacked(sound, lambda r, n=name: chunk(r, n)), ("ok",), whole=True
        )  # type: ignore[misc]
    bare = repacked(sound, lambda r: chunk(r, "", crc=0))
    yield Damaged("no CRC", bare, ("ok",), whole=True, checked=False)
    rng = np.random.default_rng(4)
    for number, at in enumerate(rng.integers(100, len(bare) - 100, 8)):
        yield Damaged(f"no CRC, flip {number}", flip(bare, int(at)), (*USABLE, *CONTRADICTORY), checked=False)
    loose = ended(b"".join(inner(sound, place) for place in chunks(sound)))
    yield Damaged("no chunks", loose, ("ok",), whole=True, checked=False)
    yield Damaged("no chunks, cut", loose[: len(loose) // 2], LOSSY, checked=False)
    at = _inside(inner(sound, chunks(sound)[0]))[60].start + len(ended(b"")) - 2 * HEAD - 24 - len(MAGIC) + 3
    yield Damaged("no chunks, a wrong length", flip(loose, at), USABLE, checked=False)
    empty = chunk(b"")
    yield Damaged("empty chunks", _inserted(sound, empty * 50), ("ok",), whole=True)
    yield Damaged("private records and attachments", _inserted(sound, _harmless()), ("ok",), whole=True)
    yield Damaged(
        "a chunk of unknown compression",
        _inserted(sound, record(0x06, struct.pack("<QQQI", 0, 0, 1, 1) + text("brotli") + struct.pack("<Q", 1) + b"x")),
        ("ok",),
        whole=True,
    )
    statistics = next(p for p in places(sound) if p.opcode == 0x0B)
    changed = put(sound, statistics.body, struct.pack("<Q", 7))
    footer = places(sound)[-1]
    start = next(p for p in places(sound) if p.opcode == 0x0F).end
    crc = zlib.crc32(changed[start : footer.end - 4])
    yield Damaged(
        "statistics that count wrong", put(changed, footer.end - 4, struct.pack("<I", crc)), USABLE, whole=True
    )


def _floods(sound: bytes) -> Iterator[Damaged]:
    """Few bytes of input that could cost much time: all below 10 MB."""
    loose = ended(b"".join(inner(sound, place) for place in chunks(sound)))
    torn = bytearray(loose)
    for place in places(loose)[30::3]:
        if place.opcode == 0x05:
            torn[place.start + 5] ^= 1
    yield Damaged("every third loose record damaged", bytes(torn), (*USABLE, *NOTHING), checked=False)
    body = inner(sound, chunks(sound)[0])
    start = b"".join(body[p.start : p.end] for p in _inside(body) if p.opcode in (3, 4))
    one = next(body[p.start : p.end] for p in _inside(body) if p.opcode == 5)
    broken = flip(one, 5, 0)
    holes = ended(start + (one * 7 + broken) * (9_000_000 // (8 * len(one))))
    yield Damaged("a 9 MB file with a hole at every eighth record", holes, NOTHING, checked=False)
    many = b"".join(channel(i, 1, f"/t{i}") for i in range(10, 60_000))
    yield Damaged("60,000 channels", _inserted(sound, many), (*USABLE, *NOTHING))
    same = b"".join(channel(i, 1, "/imu/data_raw") for i in range(10, 60_000))
    yield Damaged("60,000 channels of one topic", _inserted(sound, same), (*USABLE, *NOTHING))
    bare = b"".join(sound[place.start : place.end] for place in chunks(sound))
    for name, flood in (("many topics", many), ("one topic", same)):
        yield Damaged(f"60,000 channels of {name}, no summary", ended(bare + flood), NOTHING)
    again = b"".join(channel(i, 1, f"/again{i}") for i in range(10, 4000))
    again += b"".join(channel(i, 1, f"/again{i}/{k}") for i in range(10, 4000) for k in range(40))
    yield Damaged("160,000 redefinitions", _inserted(sound, again), CONTRADICTORY)
    schemas = b"".join(schema(i, f"a/msg/A{i}", "a/msg/B b\n" * 3) for i in range(10, 60_000))
    yield Damaged("60,000 schemas", _inserted(sound, schemas), USABLE, whole=True)
    deep = "".join(f"T{i} t\n{'=' * 80}\nMSG: a/T{i}\n" for i in range(20_000)) + "float64 x\n"
    yield Damaged(
        "a schema nested 20,000 deep",
        _inserted(sound, schema(9, "a/msg/T", deep) + channel(9, 9, "/deep")),
        USABLE,
        whole=True,
    )
    loop = "a/msg/T t\n" * 50
    yield Damaged(
        "a schema that contains itself",
        _inserted(sound, schema(9, "a/msg/T", loop) + channel(9, 9, "/loop")),
        USABLE,
        whole=True,
    )
    wide = "float64[1000000] x\n" * 1000
    yield Damaged(
        "a schema of a billion numbers",
        _inserted(sound, schema(9, "a/msg/T", wide) + channel(9, 9, "/wide")),
        USABLE,
        whole=True,
    )
    notes = b"".join(record(0x0C, text(f"n{i}") + text(text("k") + text("v" * 20))) for i in range(60_000))
    yield Damaged("60,000 metadata records", _inserted(sound, notes), ("ok",), whole=True)
    tiny = chunk(b"") * 100_000
    yield Damaged("100,000 empty chunks", _inserted(sound, tiny), ("ok",), whole=True)
    small = chunk(record(0x90, b"") * 110_000)
    yield Damaged("a chunk of 110,000 records that are no messages", _inserted(sound, small), USABLE)
    bad = channel(1, 1, "/imu/data_raw")[:-1] + b"\xff"
    yield Damaged(
        "text that is not UTF-8", _inserted(sound, record(0x0C, text(b"\xff\xfe") + text(b""))), USABLE, whole=True
    )
    yield Damaged("a channel whose metadata is cut", _inserted(sound, bad), USABLE, whole=True)
    yield Damaged("9 MB of magic bytes behind the file", sound + MAGIC * 1_100_000, USABLE, whole=True)
    yield Damaged("9 MB of 0x06", MAGIC + b"\x06" * 9_000_000, NOTHING)


def _no_logs() -> Iterator[Damaged]:
    rng = np.random.default_rng(9)
    yield Damaged("empty", b"", NOTHING)
    yield Damaged("magic alone", MAGIC, NOTHING)
    yield Damaged("magic twice", MAGIC * 2, NOTHING)
    yield Damaged("no record but the end", ended(b""), NOTHING)
    yield Damaged("zeros", bytes(1 << 20), NOTHING)
    yield Damaged("noise", rng.bytes(1 << 20), NOTHING)
    yield Damaged("magic and noise", MAGIC + rng.bytes(1 << 20), NOTHING)
    yield Damaged("a CSV by another name", b"t_s,gx,gy,gz\n" + b"0.1,1,2,3\n" * 1000, NOTHING)


def _inserted(sound: bytes, piece: bytes) -> bytes:
    """The sound file with something between its second and third chunk, and the footer's place of the summary moved."""
    at = chunks(sound)[2].start
    content = sound[:at] + piece + sound[at:]
    footer = len(content) - len(MAGIC) - FOOTER
    start, offsets = struct.unpack_from("<QQ", content, footer + HEAD)
    moved = put(content, footer + HEAD, struct.pack("<QQ", start + len(piece), offsets + len(piece)))
    crc = zlib.crc32(moved[start + len(piece) : footer + FOOTER - 4])
    return put(moved, footer + FOOTER - 4, struct.pack("<I", crc))


def _inside(records: bytes) -> list[Place]:
    return places(MAGIC + records + MAGIC)[:0] or [
        Place(p.opcode, p.start - len(MAGIC), p.body - len(MAGIC), p.end - len(MAGIC))
        for p in places(MAGIC + records + MAGIC)
    ]


def _shuffled(records: bytes, rng: np.random.Generator) -> bytes:
    lines = [records[p.start : p.end] for p in _inside(records)]
    return b"".join(lines[i] for i in rng.permutation(len(lines)))


def _harmless() -> bytes:
    attachment = record(
        0x09, bytes(16) + text("notes.txt") + text("text/plain") + struct.pack("<Q", 5) + b"hello" + bytes(4)
    )
    return record(0x80, b"private") + attachment + record(0xFF, b"") + record(0x0C, text("pilot") + text(b""))
