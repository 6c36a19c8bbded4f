"""ROS 1 bags as the package rosbags writes them: each compression, records in other orders, damage."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from bags import Truth, write_rosbag1
from logs_support import vehicle
from rosbags import rosbag1

from fieldcal.errors import UnreadableLog
from fieldcal.logs import log_format, read_log
from fieldcal.logs.interface import Finding, LogSummary
from fieldcal.logs.rosbag1.records import MAGIC, messages_of, walk

CHUNK_FIELD = b"op=\x05"


def lossy(summary: LogSummary) -> list[Finding]:
    return [finding for finding in summary.findings if finding.loses_data]


def bag(tmp_path: Path, truth: Truth, compression: str = "none") -> Path:
    return write_rosbag1(tmp_path / "a.bag", truth.messages, truth.rows, compression)


def chunks(content: bytes) -> list[int]:
    """Where the chunks' records begin, by rosbags' order of fields: it writes op first."""
    found, position = [], content.find(CHUNK_FIELD)
    while position >= 0:
        found.append(position - 8)
        position = content.find(CHUNK_FIELD, position + 1)
    return found


@pytest.mark.parametrize("compression", ["none", "lz4", "bz2"])
def test_every_compression_gives_the_same(tmp_path: Path, compression: str) -> None:
    truth = Truth(ros1=True)
    path = bag(tmp_path, truth, compression)
    assert log_format(path) == "rosbag1"
    assert len(chunks(path.read_bytes())) > 5
    frames, summary = read_log(path, vehicle())
    truth.check(frames)
    assert summary.findings == []
    assert (summary.log_format, summary.epoch_known, summary.verifiable) == ("rosbag1", True, False)
    assert summary.units == {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "T"}


def test_what_rosbags_reads_is_what_is_read(tmp_path: Path) -> None:
    """An oracle that goes by the index, which is not looked at here: every message with its time."""
    truth = Truth(ros1=True)
    path = bag(tmp_path, truth, "lz4")
    with rosbag1.Reader(path) as reader:
        times = [t for connection, t, _ in reader.messages() if connection.topic == "/imu"]
    by_log_time = vehicle().model_copy(update={"mcap": vehicle().mcap.model_copy(update={"time": "log"})})
    frames, _ = read_log(path, by_log_time)
    assert frames["imu"]["t_ns"].to_list() == times


def test_a_bag_that_was_not_closed_is_read_whole_and_told(tmp_path: Path) -> None:
    truth = Truth(ros1=True)
    content = bytearray(bag(tmp_path, truth, "bz2").read_bytes())
    place = content.index(b"index_pos=") + len(b"index_pos=")
    end = int.from_bytes(content[place : place + 8], "little")
    content[place : place + 8] = bytes(8)
    path = tmp_path / "b.bag.active"
    path.write_bytes(content[:end])
    assert log_format(path) == "rosbag1"
    frames, summary = read_log(path, vehicle())
    truth.check(frames)
    (finding,) = summary.findings
    assert (finding.code, finding.loses_data) == ("truncated", True)
    assert "did not close it" in finding.sentence


def field(name: str, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value


def record(header: bytes, data: bytes) -> bytes:
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def message(connection: int, t_ns: int, payload: bytes, order: str) -> bytes:
    time = field("time", struct.pack("<II", t_ns // 10**9, t_ns % 10**9))
    parts = {"o": field("op", b"\x02"), "c": field("conn", struct.pack("<I", connection)), "t": time}
    return record(b"".join(parts[letter] for letter in order), payload)


@pytest.mark.parametrize("orders", [["oct"], ["cot"], ["toc", "oct", "cto"]])
def test_fields_may_stand_in_any_order_even_by_turns(orders: list[str]) -> None:
    """ROS sorts fields by name, rosbags writes the kind first; time and payload look like nothing on purpose."""
    rng = np.random.default_rng(1)
    wanted = [(int(rng.integers(3)), int(rng.integers(2**31)) * 10**9 + 7, rng.bytes(i % 5)) for i in range(40)]
    parts = [message(*row, orders[i % len(orders)]) for i, row in enumerate(wanted)]
    content = np.frombuffer(b"".join(parts), np.uint8)
    starts, headers, damage = walk(content.data, 0, content.size)
    found, others, malformed = messages_of(content, starts, headers)
    assert (damage, others, malformed) == (None, [], 0)
    payloads = [content[a : a + n].tobytes() for a, n in zip(found.starts.tolist(), found.sizes.tolist(), strict=True)]
    assert list(zip(found.connections.tolist(), found.log_time_ns.tolist(), payloads, strict=True)) == wanted


def test_messages_outside_chunks_are_read(tmp_path: Path) -> None:
    """What a recorder leaves that died before it closed its first chunk: a chunk of no bytes, then its content."""
    truth = Truth(50, ros1=True)
    content = bag(tmp_path, truth).read_bytes()
    (begin, *_) = chunks(content)
    header = field("compression", b"none") + field("op", b"\x05") + field("size", bytes(4))
    size = int.from_bytes(content[begin : begin + 4], "little")
    inside = begin + 4 + size + 4
    end = inside + int.from_bytes(content[inside - 4 : inside], "little")
    (tmp_path / "b.bag").write_bytes(content[:begin] + record(header, b"") + content[inside:end])
    frames, summary = read_log(tmp_path / "b.bag", vehicle())
    n = len(frames["magnetometer"])
    assert n > 10
    truth.check({name: frame.head(n) for name, frame in frames.items()}, slice(0, n))
    assert [finding.code for finding in summary.findings] == ["truncated"]


# damage --------------------------------------------------------------------------------------------------------------


def per_chunk(truth: Truth, frames: dict[str, object]) -> int:
    return len(truth.t_ns) - len(frames["imu"])  # type: ignore[arg-type]


@pytest.mark.parametrize("compression", ["lz4", "bz2"])
@pytest.mark.parametrize("what", ["content", "length", "header length"])
def test_a_damaged_chunk_loses_its_own_messages_and_says_how_many(tmp_path: Path, compression: str, what: str) -> None:
    truth = Truth(ros1=True)
    path = bag(tmp_path, truth, compression)
    content = bytearray(path.read_bytes())
    begin = chunks(content)[2]
    header = int.from_bytes(content[begin : begin + 4], "little")
    if what == "content":
        content[begin + header + 100 : begin + header + 140] = b"\x55" * 40
    elif what == "length":
        content[begin + 4 + header : begin + 8 + header] = b"\xff\xff\xff\x7f"
    else:
        content[begin : begin + 4] = b"\xff\x00\x00\x00"
    path.write_bytes(content)
    frames, summary = read_log(path, vehicle())
    there = set(frames["imu"]["t_ns"].to_list())
    lost = [i for i, t in enumerate(truth.t_ns.tolist()) if t not in there]
    assert 1 <= len(lost) <= 40
    assert lost == list(range(lost[0], lost[-1] + 1))
    (finding,) = lossy(summary)
    assert finding.code == "damaged_chunk"
    assert f"/imu {len(lost)}" in finding.sentence


def test_a_length_that_is_wrong_within_a_chunk_loses_the_rest_of_it(tmp_path: Path) -> None:
    truth = Truth(ros1=True)
    path = bag(tmp_path, truth)
    content = bytearray(path.read_bytes())
    third = content.index(b"op=\x02", chunks(content)[2])
    content[third - 8 : third - 4] = b"\xff\xff\xff\x00"
    path.write_bytes(content)
    frames, summary = read_log(path, vehicle())
    lost = per_chunk(truth, frames)
    assert 1 <= lost <= 40
    (finding,) = lossy(summary)
    assert f"/imu {lost}" in finding.sentence


@pytest.mark.parametrize("compression", ["none", "lz4"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_bag_that_was_cut_is_read_up_to_there(tmp_path: Path, compression: str, share: float) -> None:
    truth = Truth(ros1=True)
    path = bag(tmp_path, truth, compression)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    frames, summary = read_log(path, vehicle())
    n = len(frames["magnetometer"])
    truth.check({name: frame.head(n) for name, frame in frames.items()}, slice(0, n))
    assert n / 300 == pytest.approx(share, abs=0.15)
    assert "truncated" in {finding.code for finding in lossy(summary)}


@pytest.mark.parametrize("seed", range(8))
def test_random_damage_never_crashes(tmp_path: Path, seed: int) -> None:
    truth = Truth(100, ros1=True)
    path = bag(tmp_path, truth, ["none", "lz4", "bz2"][seed % 3])
    generator = np.random.default_rng(seed)
    content = np.frombuffer(path.read_bytes(), np.uint8).copy()
    places = generator.integers(0 if seed % 2 else 5000, len(content), 30)
    content[places] = generator.integers(0, 256, 30)
    path.write_bytes(content.tobytes())
    try:
        frames, summary = read_log(path, vehicle())
    except UnreadableLog:
        return
    rows = sum(len(frames[table]) for table in ("imu", "magnetometer") if table in frames)
    assert rows == 200 or lossy(summary)


def test_a_chunk_that_declares_too_much_costs_nothing(tmp_path: Path) -> None:
    truth = Truth(ros1=True)
    path = bag(tmp_path, truth, "lz4")
    content = bytearray(path.read_bytes())
    place = content.index(b"size=", chunks(content)[1]) + 5
    content[place : place + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(content)
    frames, summary = read_log(path, vehicle())
    assert 0 < per_chunk(truth, frames) <= 40
    assert "the cap is" in lossy(summary)[0].sentence


@pytest.mark.parametrize(
    ("content", "code", "told"),
    [
        (b"", "empty_file", "empty"),
        (MAGIC + bytes(100), "no_messages", "no definition of any topic"),
        (b"#ROSBAG V1.2\n" + bytes(100), "not_bag", "rosbag fix"),
        (b"PK\x03\x04" + bytes(100), "not_bag", "does not begin like a ROS bag"),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path: Path, content: bytes, code: str, told: str) -> None:
    (tmp_path / "a.bag").write_bytes(content)
    with pytest.raises(UnreadableLog, match=told) as refused:
        read_log(tmp_path / "a.bag", vehicle())
    assert refused.value.reason_code == code
    assert "a.bag" in refused.value.sentence


def test_an_encrypted_bag_is_refused(tmp_path: Path) -> None:
    header = field("op", b"\x03") + field("index_pos", bytes(8)) + field("encryptor", b"rosbag/AesCbcEncryptor")
    (tmp_path / "a.bag").write_bytes(MAGIC + record(header, b" " * 100))
    with pytest.raises(UnreadableLog, match="rosbag decrypt"):
        read_log(tmp_path / "a.bag", vehicle())
