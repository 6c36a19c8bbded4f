"""Damaged DataFlash files: what is lost is counted and told, nothing that was not recorded comes out, none crashes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from damaged_dataflash import KINDS, damage, sizes_of, starts_of
from dataflash_support import UTC_AT_BOOT_NS, DataflashFlight
from logs_support import vehicle

from fieldcal.errors import UnreadableLog
from fieldcal.logs import LogSummary, open_log
from fieldcal.logs.ingest import read_flight

DAMAGED_INPUTS = 300
SECONDS_EACH = 5.0
LOST = {"damaged_record", "truncated", "unknown_channel", "malformed_message", "channel_redefined"}
Rows = dict[str, set[tuple[float, ...]]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = DataflashFlight(120).write(tmp_path_factory.mktemp("whole") / "a.bin")
    return path.read_bytes()


@pytest.fixture(scope="module")
def recorded(whole: bytes, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    path = tmp_path_factory.mktemp("recorded") / "a.bin"
    path.write_bytes(whole)
    return delivered(path)[0]


def delivered(path: Path) -> tuple[Rows, LogSummary]:
    """Rows by table at times since boot, and the summary."""
    reader = open_log(path, vehicle())
    rows: Rows = {}
    for table, columns in reader.batches():
        since_boot = columns["t_ns"] - (UTC_AT_BOOT_NS if reader.summary.epoch_known else 0)
        kept = [since_boot, *(v for n, v in columns.items() if n not in ("t_ns", "velocity_sd_mps"))]
        rows.setdefault(table, set()).update(zip(*(column.tolist() for column in kept), strict=True))
    return rows, reader.summary


def told(summary: LogSummary) -> Mapping[str, tuple[int, bool]]:
    return {str(f.code): (f.count, f.loses_data) for f in summary.findings if f.code in LOST}


def test_a_whole_file_tells_of_no_loss(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(whole)
    rows, summary = delivered(tmp_path / "a.bin")
    assert told(summary) == {}
    assert {table: len(of) for table, of in rows.items()} == {
        "imu": 120,
        "imu.1": 120,
        "temperature": 120,
        "temperature.1": 120,
        "magnetometer": 24,
        "position": 9,
        "gnss_velocity": 9,
        "vps": 30,
        "power": 24,
    }


@pytest.mark.parametrize("missing", [1, 2, 20])
def test_a_cut_within_the_last_message_is_told(tmp_path: Path, whole: bytes, missing: int) -> None:
    (tmp_path / "a.bin").write_bytes(whole[:-missing])
    _, summary = delivered(tmp_path / "a.bin")
    assert told(summary) == {"truncated": (1, True)}


@pytest.mark.parametrize("there", [1, 2, 3, 30])
def test_of_a_message_that_begins_at_the_end_nothing_is_taken_and_those_before_it_are_whole(
    tmp_path: Path, whole: bytes, there: int
) -> None:
    starts = starts_of(whole, sizes_of(whole))
    assert starts is not None
    (tmp_path / "a.bin").write_bytes(whole[: starts[-1] + there])
    rows, summary = delivered(tmp_path / "a.bin")
    assert told(summary) == {"truncated": (1, True)}
    assert sum(map(len, rows.values())) == 120 * 4 + 24 * 2 + 9 * 2 + 30 - 2  # one IMU message


def test_a_file_that_ends_with_a_whole_block_is_as_the_autopilot_left_it(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(whole[: len(whole) // 512 * 512])
    _, summary = delivered(tmp_path / "a.bin")
    assert told(summary) == {"truncated": (1, False)}


def test_lost_bytes_are_counted_and_both_sides_of_them_are_read(tmp_path: Path, whole: bytes, recorded: Rows) -> None:
    starts = starts_of(whole, sizes_of(whole))
    assert starts is not None
    first, second = starts[len(starts) // 2], starts[len(starts) // 2 + 1]
    (tmp_path / "a.bin").write_bytes(whole[: first + 5] + whole[second - 3 :])
    rows, summary = delivered(tmp_path / "a.bin")
    assert told(summary) == {"damaged_record": (1, True)}
    lost = sum(len(recorded[table] - rows[table]) for table in recorded)
    assert lost in (1, 2)  # an IMU message is a row of imu and one of temperature
    damaged = next(f for f in summary.findings if f.code == "damaged_record")
    assert f"8 bytes in 1 place(s), the first at byte {first}" in damaged.sentence


def test_messages_of_an_undefined_type_are_told(tmp_path: Path, whole: bytes) -> None:
    place = whole.index(b"BAT\0")
    (tmp_path / "a.bin").write_bytes(whole[:place] + b"\0" + whole[place + 1 :])
    rows, summary = delivered(tmp_path / "a.bin")
    assert "power" not in rows
    assert told(summary) == {"unknown_channel": (1, True)}


def test_fields_that_a_message_lacks_are_told(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(whole.replace(b"GyrX", b"GyrW", 1))
    tables, facts = read_flight(tmp_path / "a.bin", vehicle())
    assert (tables, facts["reason_code"]) == ({}, "no_imu")
    assert "the 240 messages IMU lack fields" in (facts["reason"] or "")
    (tmp_path / "b.bin").write_bytes(whole.replace(b"MagX", b"MagW", 1))
    rows, summary = delivered(tmp_path / "b.bin")
    assert "magnetometer" not in rows
    assert told(summary) == {"malformed_message": (24, True)}


def test_a_definition_that_contradicts_itself_is_told(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(whole.replace(b"MagX", b"MagY", 1))
    rows, summary = delivered(tmp_path / "a.bin")
    assert "magnetometer" not in rows
    assert told(summary) == {"malformed_message": (24, True)}


@pytest.mark.parametrize("seed", range(DAMAGED_INPUTS))
def test_damaged_inputs(tmp_path: Path, whole: bytes, recorded: Rows, seed: int) -> None:
    damaged = damage(whole, seed)
    (tmp_path / "a.bin").write_bytes(damaged.content)
    begin = time.monotonic()
    with contextlib.suppress(UnreadableLog):  # anything else fails the test
        rows, summary = delivered(tmp_path / "a.bin")
        if damaged.told:
            assert told(summary), damaged.places
            for table, of in rows.items():
                assert of <= recorded[table], damaged.places
    _, facts = read_flight(tmp_path / "a.bin", vehicle())
    assert facts["verdict"] in ("ok", "partial", "quarantined", "rejected")
    assert time.monotonic() - begin < SECONDS_EACH


def test_the_damaged_inputs_are_of_all_kinds_and_most_can_be_told(whole: bytes) -> None:
    inputs = [damage(whole, seed) for seed in range(DAMAGED_INPUTS)]
    assert {one.kind for one in inputs} == set(KINDS)
    tellable = [one for one in inputs if one.kind not in ("anything", "zeros")]
    assert sum(one.told for one in tellable) > 0.9 * len(tellable)


def test_a_file_made_of_heads_takes_no_longer(tmp_path: Path, whole: bytes) -> None:
    heads = np.frombuffer(b"\xa3\x95\x84\0\0" * 100_000, np.uint8)
    (tmp_path / "a.bin").write_bytes(whole + heads.tobytes())
    begin = time.monotonic()
    _, summary = delivered(tmp_path / "a.bin")
    assert time.monotonic() - begin < SECONDS_EACH
    assert told(summary)
