"""Damaged ULog files: nothing that is not in the undamaged one, all that is whole, and a word on what is missing."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import ulog_damage
from ulog_support import flight, parts_of

from fieldcal.config.configuration import load
from fieldcal.errors import UnreadableLog
from fieldcal.logs import ingest, read_log
from fieldcal.logs.ulog import records, scan
from fieldcal.logs.ulog.file import UlogFile
from fieldcal.logs.ulog.write import message

CASES, A_BATCH = 300, 60
MOST_CASE_S = 2.0
MOST_S_A_MB = 5.0


@pytest.mark.parametrize("first", range(1, CASES, A_BATCH))
def test_a_damaged_file_gives_rows_of_the_undamaged_one_only(tmp_path: Path, first: int) -> None:
    parts = ulog_damage.small_log()
    path = tmp_path / "f.ulg"
    path.write_bytes(b"".join(parts))
    sound, _ = ulog_damage.rows_of(path)
    for seed in range(first, first + A_BATCH):
        judged = ulog_damage.judge(parts, ulog_damage.case(parts, seed), sound, path)
        assert judged.altered <= judged.undetectable, seed
        assert judged.excess <= 0, seed
        assert not judged.untold, seed
        assert judged.seconds < MOST_CASE_S, seed


def test_damage_at_a_blocks_border_is_seen_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = ulog_damage.small_log()
    path = tmp_path / "f.ulg"
    path.write_bytes(b"".join(parts))
    monkeypatch.setattr(scan, "BLOCK_BYTES", 400)
    monkeypatch.setattr(scan, "FIRST_MESSAGES", 2)
    sound, log = ulog_damage.rows_of(path)
    assert sum(sound.values()) == sum(part[2] == records.DATA for part in parts[1:])
    assert log.losses == scan.Losses()
    for seed in range(1, 41):
        judged = ulog_damage.judge(parts, ulog_damage.case(parts, seed), sound, path)
        assert judged.altered <= judged.undetectable, seed
        assert not judged.untold, seed


def test_what_looks_like_two_messages_in_damaged_bytes_is_none(tmp_path: Path) -> None:
    parts = parts_of(flight())
    half = len(parts) // 2
    of_imu = next(part for part in parts[half:] if part[2:5] == bytes([records.DATA, 0, 0]))
    looks = of_imu[:-8] + b"\x55" * 8
    content = b"".join(parts[:half]) + b"\xff" * 50 + looks + looks + b"\xff" * 50 + b"".join(parts[half:])
    path = tmp_path / "f.ulg"
    path.write_bytes(content)
    log = UlogFile(path)
    (topic,) = log.instances("sensor_combined")
    assert looks[5:] not in {row.tobytes() for row in log.rows(topic)}
    assert log.losses.places == 1


def test_the_judge_would_see_an_altered_row(tmp_path: Path) -> None:
    """A flip in a reading, which no reader can see, is what the judge must see."""
    parts = ulog_damage.small_log()
    path = tmp_path / "f.ulg"
    path.write_bytes(b"".join(parts))
    sound, _ = ulog_damage.rows_of(path)
    content = bytearray(b"".join(parts))
    content[-3] ^= 1
    flipped = ulog_damage.Damaged(bytes(content), np.arange(len(content)), (len(content) - 3, len(content) - 2))
    assert ulog_damage.judge(parts, flipped, sound, path).altered == 1


def facts_of(path: Path, content: bytes) -> dict[str, object]:
    path.write_bytes(content)
    return dict(ingest.read_flight(path, load(None).vehicle("v"))[1])


def test_a_cut_file_is_partial_and_keeps_what_is_whole(tmp_path: Path) -> None:
    parts = parts_of(flight())
    half = len(parts) // 2
    content = b"".join(parts[:half]) + parts[half][:20]
    facts = facts_of(tmp_path / "f.ulg", content)
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "truncated")
    assert "its last 20 bytes" in str(facts["reason"])
    log = UlogFile(tmp_path / "f.ulg")
    assert sum(log.count(topic) for topic in log.topics) == sum(part[2] == records.DATA for part in parts[1:half])


def test_zeros_behind_a_log_are_what_was_not_written(tmp_path: Path) -> None:
    parts = parts_of(flight())
    facts = facts_of(tmp_path / "f.ulg", b"".join(parts) + bytes(100_000))
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "truncated")
    log = UlogFile(tmp_path / "f.ulg")
    assert sum(log.count(topic) for topic in log.topics) >= sum(part[2] == records.DATA for part in parts[1:]) - 1


def test_bytes_in_between_are_passed_over_and_counted(tmp_path: Path) -> None:
    parts = parts_of(flight())
    half = len(parts) // 2
    assert parts[half - 1][2] == records.DATA
    content = b"".join(parts[:half]) + b"\xff" * 777 + b"".join(parts[half:])
    facts = facts_of(tmp_path / "f.ulg", content)
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "damaged_record")
    lost = 777 + len(parts[half - 1])
    assert f"{lost} bytes at 1 place(s)" in str(facts["reason"])
    assert "1 data message(s)" in str(facts["reason"])


def test_messages_of_a_topic_whose_definition_is_lost_are_counted(tmp_path: Path) -> None:
    parts = parts_of(flight())
    lost = [part for part in parts[1:] if part[2] == records.SUBSCRIPTION and part.endswith(b"telemetry_status")]
    content = b"".join(part for part in parts if part not in lost)
    facts = facts_of(tmp_path / "f.ulg", content)
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "unknown_channel")
    assert "80 data messages" in str(facts["reason"])


def test_a_second_subscription_of_a_number_changes_nothing(tmp_path: Path) -> None:
    parts = parts_of(flight())
    again = message(records.SUBSCRIPTION, bytes([0, 0, 0]) + b"telemetry_status")
    path = tmp_path / "f.ulg"
    path.write_bytes(b"".join(parts))
    sound, _ = read_log(path, load(None).vehicle("v"))
    path.write_bytes(b"".join([*parts[:-50], again, *parts[-50:]]))
    found, summary = read_log(path, load(None).vehicle("v"))
    assert all(found[name].equals(frame) for name, frame in sound.items())
    assert [finding.code for finding in summary.findings] == ["already_corrected"]


@pytest.mark.parametrize("kind", ["zeros", "ones", "noise", "texts", "broken often"])
def test_time_grows_with_the_file_only(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(3)
    size = 1_000_000
    sound = b"".join(parts_of(flight(20.0)))
    if kind == "broken often":
        broken = bytearray(sound)
        for at in range(4000, len(broken), 300):
            broken[at] ^= 0xFF
        tail = bytes(broken)
    else:
        text = message(records.TEXT, b"6" + bytes(8) + b"x" * 20) + b"\xff"
        tail = (
            sound[:20_000]
            + {
                "zeros": bytes(size),
                "ones": b"\xff" * size,
                "noise": rng.bytes(size),
                "texts": text * (size // len(text)),
            }[kind]
        )
    path = tmp_path / "f.ulg"
    path.write_bytes(tail)
    begin = time.process_time()
    UlogFile(path)
    assert time.process_time() - begin < MOST_S_A_MB * max(len(tail) / 1e6, 1.0)


@pytest.mark.parametrize("seed", range(40))
def test_nothing_but_unreadable_log_is_raised(tmp_path: Path, seed: int) -> None:
    """Flips anywhere, in definitions and texts too, many at once."""
    rng = np.random.default_rng(seed)
    content = bytearray(b"".join(parts_of(flight(1.0))))
    reach = len(content) if seed % 2 else 1200
    for at in rng.integers(0, reach, 1 + seed):
        content[at] = int(rng.integers(0, 256))
    path = tmp_path / "f.ulg"
    path.write_bytes(content)
    try:
        tables, facts = ingest.read_flight(path, load(None).vehicle("v"))
        assert facts["verdict"] != "rejected" or not tables
        read_log(path, load(None).vehicle("v"))
    except UnreadableLog:
        pass
