"""Damaged and hostile MCAP files: every message of every intact chunk, nothing altered, nothing silently missing."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import lz4.frame
import numpy as np
import polars as pl
import pytest
import zstandard
from logs_support import Flight, vehicle
from mcap.writer import Writer

from fieldcal.errors import UnreadableLog
from fieldcal.logs import LogSummary, read_log
from fieldcal.logs.mcap import chunks as mcap_chunks
from fieldcal.logs.mcap.records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER_BYTES,
    MAGIC,
    MESSAGE_INDEX,
    SCHEMA,
    Fields,
    Record,
    read_chunk_head,
    read_record,
)
from fieldcal.logs.mcap.write import encode_cdr

GYRO = ["gyroscope_x", "gyroscope_y", "gyroscope_z"]


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(400)


@pytest.fixture(scope="module")
def whole(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A sound file of about a dozen chunks."""
    return flight.write(tmp_path_factory.mktemp("whole") / "log.mcap", chunk_size=30_000).read_bytes()


def test_a_cut_at_every_chunk_boundary_keeps_the_chunks_before_it(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    kept_before = -1
    for record in chunks(whole):
        for cut in (record.end - 1, record.end, record.end + 1):
            tables, summary = read_or_none(tmp_path, whole[:cut])
            rows = sum(frame.height for frame in tables.values())
            expected = messages_of(whole, lambda chunk, limit=cut: chunk.end <= limit)
            assert rows == expected
            if expected:
                assert codes(summary) == ["truncated"]
                assert summary.findings[0].loses_data
                assert_subset(tables, flight)
        assert expected > kept_before
        kept_before = expected


def test_a_flip_inside_a_chunk_costs_that_chunk_and_says_what(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    for record in chunks(whole)[1:6]:
        damaged = flipped(whole, (record.body + record.end) // 2)
        tables, summary = read_or_none(tmp_path, damaged)
        lost = messages_of(whole, lambda chunk, hit=record.start: chunk.start == hit)
        assert sum(frame.height for frame in tables.values()) == 1600 - lost
        assert codes(summary) == ["damaged_chunk"]
        assert "/imu/data_raw" in summary.findings[0].sentence
        assert_subset(tables, flight)


def test_damage_to_a_chunk_that_defines_the_channels_is_survived_with_the_summary(
    whole: bytes, flight: Flight, tmp_path: Path
) -> None:
    first = chunks(whole)[0]
    tables, _ = read_or_none(tmp_path, flipped(whole, first.end - 40))
    assert 0 < tables["imu"].height < 400
    assert_subset(tables, flight)


@pytest.mark.parametrize("shift", [0, 1, 2, 5, 7])
def test_a_wrong_record_length_of_a_chunk_costs_nothing(
    whole: bytes, flight: Flight, tmp_path: Path, shift: int
) -> None:
    damaged = flipped(whole, chunks(whole)[3].start + 1 + shift)
    tables, summary = read_or_none(tmp_path, damaged)
    assert sum(frame.height for frame in tables.values()) >= 1600 - (0 if shift < 5 else 160)
    assert {finding.code for finding in summary.findings} <= {"damaged_record", "damaged_chunk"}
    assert_subset(tables, flight)


def test_overwritten_stretches_cost_only_the_chunks_they_touch(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    generator = np.random.default_rng(5)
    for _ in range(12):
        start = int(generator.integers(len(MAGIC), len(whole) - 2000))
        end = start + int(generator.integers(1, 1500))
        for filler in (b"\xff", b"\0"):
            damaged = whole[:start] + filler * (end - start) + whole[end:]
            tables, summary = read_or_none(tmp_path, damaged)
            expected = messages_of(whole, lambda chunk, a=start, b=end: chunk.end <= a or chunk.start >= b)
            assert sum(frame.height for frame in tables.values()) >= expected
            assert_honest(tables, summary, flight)


def test_missing_stretches_cost_only_the_chunks_they_touch(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    generator = np.random.default_rng(6)
    for _ in range(12):
        start = int(generator.integers(len(MAGIC), len(whole) - 2000))
        end = start + int(generator.integers(1, 1500))
        tables, summary = read_or_none(tmp_path, whole[:start] + whole[end:])
        expected = messages_of(whole, lambda chunk, a=start, b=end: chunk.end <= a or chunk.start >= b)
        first = chunks(whole)[0]
        if start >= first.end:
            assert sum(frame.height for frame in tables.values()) >= expected
        assert_honest(tables, summary, flight)


def test_a_chunk_that_stands_twice_is_read_once(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    record = chunks(whole)[2]
    twice = whole[: record.end] + whole[record.start : record.end] + whole[record.end :]
    tables, summary = read_or_none(tmp_path, twice)
    assert all(frame.height == 400 for frame in tables.values())
    assert "duplicate_chunk" in codes(summary)
    assert_subset(tables, flight)


def test_damage_before_the_first_record_and_in_the_magic(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    for place in (0, 5, 8, 9, 20):
        tables, summary = read_or_none(tmp_path, flipped(whole, place))
        assert all(frame.height == 400 for frame in tables.values())
        assert not any(finding.loses_data for finding in summary.findings)


def test_damage_to_the_summary_costs_no_message(whole: bytes, tmp_path: Path) -> None:
    for place in (-1, -20, -60, -300):
        tables, summary = read_or_none(tmp_path, flipped(whole, len(whole) + place))
        assert all(frame.height == 400 for frame in tables.values())
        assert not any(finding.loses_data for finding in summary.findings)
        assert summary.verifiable


@pytest.mark.parametrize("what", [SCHEMA, CHANNEL])
def test_a_redefinition_is_fatal(whole: bytes, tmp_path: Path, what: int) -> None:
    if what == CHANNEL:
        body = struct.pack("<HH", 1, 2) + text("/imu/data_raw") + text("cdr") + struct.pack("<I", 0)
    else:
        body = struct.pack("<H", 1) + text("sensor_msgs/msg/Imu") + text("ros2msg") + text("float64 x")
    place = chunks(whole)[1].start
    changed = whole[:place] + record_of(what, body) + whole[place:]
    _, summary = read_or_none(tmp_path, changed)
    fatal = [finding for finding in summary.findings if finding.fatal]
    assert [finding.code for finding in fatal] == ["channel_redefined"]


def test_a_missing_chunk_is_noticed_by_the_files_own_count(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    start, end = chunks(whole)[4].start, chunks(whole)[5].start
    gone = end - start
    filler = record_of(0x90, b"\0" * (gone - 9))
    tables, summary = read_or_none(tmp_path, whole[:start] + filler + whole[end:])
    assert codes(summary) == ["count_mismatch"]
    assert summary.findings[0].loses_data
    assert summary.findings[0].count == 1600 - sum(frame.height for frame in tables.values())


@pytest.mark.parametrize("declared", [10, 1 << 20, 300 << 20, 100 << 30, (1 << 64) - 1])
@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_bombs_and_wrong_sizes_stay_small(
    whole: bytes, flight: Flight, tmp_path: Path, declared: int, compression: str
) -> None:
    bomb = {"zstd": zstandard.compress(bytes(64 << 20)), "lz4": lz4.frame.compress(bytes(8 << 20)), "": bytes(1000)}
    chunk = chunk_of(bomb[compression], compression, declared, 0)
    place = chunks(whole)[1].start
    tables, summary = read_or_none(tmp_path, whole[:place] + chunk + whole[place:])
    assert sum(frame.height for frame in tables.values()) == 1600
    assert "damaged_chunk" in codes(summary)
    assert_subset(tables, flight)


def test_a_frame_that_declares_100_gb_is_refused_at_once() -> None:
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 100 << 30) + b"\x01\0\0" + bytes(8)
    chunk = chunk_of(frame, "zstd", 1000, 0)
    head = read_chunk_head(Fields(chunk, 9, len(chunk)))
    with pytest.raises(mcap_chunks.Damage):
        mcap_chunks.decompress(chunk, head)


def test_chunks_that_grow_too_much_are_left_out_beyond_a_total(
    whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldcal.logs.mcap.chunks.TOTAL_CAP_BYTES", 100_000)
    monkeypatch.setattr("fieldcal.logs.mcap.chunks.TOTAL_CAP_RATIO", 1)
    tables, summary = read_or_none(tmp_path, whole)
    assert "unpacking over 100000 bytes" in summary.findings[0].sentence
    assert any(finding.loses_data for finding in summary.findings)
    assert 0 < tables["imu"].height < 400


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunks_of_several_frames(flight: Flight, tmp_path: Path, compression: str) -> None:
    content = flight.write(tmp_path / "log.mcap", compression="none", chunk_size=30_000).read_bytes()
    pack = zstandard.compress if compression == "zstd" else lz4.frame.compress
    repacked = content[: chunks(content)[0].start]
    for chunk in chunks(content):
        head = read_chunk_head(Fields(content, chunk.body, chunk.end))
        records = content[head.start : head.end]
        frames = b"".join(pack(records[start : start + 9000]) for start in range(0, len(records), 9000))
        repacked += chunk_of(frames, compression, len(records), zlib.crc32(records))
    repacked += record_of(DATA_END, bytes(4)) + record_of(2, bytes(20)) + MAGIC
    tables, summary = read_or_none(tmp_path, repacked)
    assert all(frame.height == 400 for frame in tables.values())
    assert codes(summary) == []
    assert_subset(tables, flight)


@pytest.mark.parametrize("place", ["offset", "inside", "missing"])
def test_a_lying_message_index_changes_nothing(flight: Flight, tmp_path: Path, place: str) -> None:
    content = flight.write(tmp_path / "log.mcap", compression="none", chunk_size=30_000).read_bytes()
    changed = bytearray(content)
    for record in records(content):
        if record.opcode == MESSAGE_INDEX:
            first = record.body + 6 + 8
            offset = int.from_bytes(content[first : first + 8], "little")
            wrong = {"offset": 1 << 50, "inside": offset + 3, "missing": None}[place]
            if wrong is None:
                changed[record.body + 6 : record.body + 22] = content[record.body + 22 : record.body + 38]
            else:
                changed[first : first + 8] = wrong.to_bytes(8, "little")
    tables, summary = read_or_none(tmp_path, bytes(changed))
    assert all(frame.height == 400 for frame in tables.values())
    assert codes(summary) == []
    assert_subset(tables, flight)


def test_damage_in_a_file_without_chunks(flight: Flight, tmp_path: Path) -> None:
    imu = flight.channels()[0]
    path = tmp_path / "loose.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False, enable_data_crcs=True)
        writer.start()
        schema = writer.register_schema(imu.schema_name, "ros2msg", imu.schema_text.encode())
        channel = writer.register_channel("/imu", "cdr", schema)
        for row, payload in enumerate(encode_cdr(imu)):
            writer.add_message(channel, row, payload.tobytes(), row)
        writer.finish()
    content = path.read_bytes()
    lengths = [record.start + 3 for record in records(content) if record.opcode == 5][100:140:10]
    changed = content
    for place in lengths:
        changed = flipped(changed, place)
    tables, summary = read_or_none(tmp_path, changed)
    assert tables["imu"].height == 396
    assert not summary.verifiable
    assert {"damaged_record", "count_mismatch"} <= set(codes(summary))
    assert_subset(tables, flight)


def test_random_flips_never_alter_and_never_lose_silently(whole: bytes, flight: Flight, tmp_path: Path) -> None:
    generator = np.random.default_rng(7)
    for _ in range(250):
        damaged = flipped(whole, int(generator.integers(len(whole))), int(generator.integers(8)))
        tables, summary = read_or_none(tmp_path, damaged)
        assert_honest(tables, summary, flight)


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "empty_file"),
        (b"not an mcap file at all, but long enough to hold a record or two" * 10, "not_mcap"),
        (MAGIC, "no_messages"),
        (MAGIC + bytes(100), "no_messages"),
        (MAGIC + b"\xff" * 5000, "no_messages"),
        (MAGIC * 500, "no_messages"),
    ],
)
def test_what_is_no_log_is_refused_with_a_reason(tmp_path: Path, content: bytes, code: str) -> None:
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(UnreadableLog) as caught:
        read_log(tmp_path / "log.mcap", vehicle())
    assert caught.value.reason_code == code
    assert "log.mcap" in caught.value.sentence


def records(content: bytes) -> Iterator[Record]:
    """The records of a sound file's data section."""
    position = len(MAGIC)
    while position < len(content) - len(MAGIC) - FOOTER_BYTES:
        record = read_record(content, position, len(content))
        yield record
        if record.opcode == DATA_END:
            return
        position = record.end


def chunks(content: bytes) -> list[Record]:
    """Its chunks."""
    return [record for record in records(content) if record.opcode == CHUNK]


def messages_of(content: bytes, wanted: Callable[[Record], bool]) -> int:
    """Messages in the chunks that are wanted, counted record by record."""
    total = 0
    for chunk in chunks(content):
        if not wanted(chunk):
            continue
        head = read_chunk_head(Fields(content, chunk.body, chunk.end))
        inner = zstandard.ZstdDecompressor().decompress(content[head.start : head.end])
        position = 0
        while position < len(inner):
            record = read_record(inner, position, len(inner))
            total += record.opcode == 5
            position = record.end
    return total


def read_or_none(tmp_path: Path, content: bytes) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    """What can be read of a file with this content; nothing of one that is refused."""
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    try:
        return read_log(path, vehicle())
    except UnreadableLog as error:
        summary = LogSummary("mcap")
        summary.add(error.reason_code, 1, error.sentence, loses_data=True)
        return {}, summary


def codes(summary: LogSummary) -> list[str]:
    return [finding.code for finding in summary.findings]


def flipped(content: bytes, place: int, bit: int = 4) -> bytes:
    changed = bytearray(content)
    changed[place] ^= 1 << bit
    return bytes(changed)


def record_of(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(content: str) -> bytes:
    return struct.pack("<I", len(content)) + content.encode()


def chunk_of(packed: bytes, compression: str, uncompressed_size: int, crc: int) -> bytes:
    head = struct.pack("<QQQI", 0, 0, uncompressed_size, crc) + text(compression)
    return record_of(CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def assert_subset(tables: dict[str, pl.DataFrame], flight: Flight) -> None:
    """Every delivered row is a row of the flight, once."""
    truths = {
        "imu": np.column_stack([flight.gyroscope, flight.accelerometer]),
        "magnetometer": flight.magnetometer,
        "temperature": flight.temperature[:, None],
        "vps": np.column_stack([flight.quaternion, flight.position]),
    }
    for table, frame in tables.items():
        stamps = flight.t_ns + (7 if table == "vps" else 0)
        delivered = frame["t_ns"].to_numpy()
        rows = np.searchsorted(stamps, delivered)
        assert len(np.unique(delivered)) == len(delivered)
        np.testing.assert_array_equal(stamps[rows], delivered)
        np.testing.assert_array_equal(frame.drop("t_ns").to_numpy(), truths[table][rows])


def assert_honest(tables: dict[str, pl.DataFrame], summary: LogSummary, flight: Flight) -> None:
    """Nothing altered, and what is missing is told."""
    if any(finding.fatal for finding in summary.findings):
        return
    assert_subset(tables, flight)
    if sum(frame.height for frame in tables.values()) < 1600:
        assert any(finding.loses_data for finding in summary.findings)
