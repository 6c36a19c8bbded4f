"""Logs that were compressed as a whole."""

from __future__ import annotations

from pathlib import Path

import pytest
import zstandard
from logs_support import Flight, vehicle

from fieldcal.errors import UnreadableLog
from fieldcal.logs import log_format, read_log


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    return Flight(400).write(tmp_path / "a.mcap", chunk_size=20_000)


@pytest.mark.parametrize("end", [".zstd", ".zst", ".ZSTD"])
@pytest.mark.parametrize("frames", [1, 3])
def test_the_content_is_read_as_it_is(plain: Path, end: str, frames: int) -> None:
    content = plain.read_bytes()
    size = len(content) // frames + 1
    packed = plain.with_name(plain.name + end)
    packed.write_bytes(b"".join(zstandard.compress(content[i : i + size]) for i in range(0, len(content), size)))
    assert log_format(packed) == "mcap"
    expected, _ = read_log(plain, vehicle())
    found, summary = read_log(packed, vehicle())
    assert {table: frame.equals(expected[table]) for table, frame in found.items()} == dict.fromkeys(expected, True)
    assert summary.findings == []
    assert summary.verifiable


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_what_stands_before_damage_is_read(plain: Path, damage: str) -> None:
    packed = plain.with_name("b.mcap.zstd")
    content = plain.read_bytes()
    # Many frames, as of a recorder that flushes: what one of them holds is whole or not.
    parts = [zstandard.compress(content[i : i + 4096]) for i in range(0, len(content), 4096)]
    kept = parts[: len(parts) // 2]
    if damage == "cut":
        packed.write_bytes(b"".join(kept))
    else:
        packed.write_bytes(b"".join(kept) + b"\x00" * 40 + b"".join(parts[len(kept) :]))
    found, summary = read_log(packed, vehicle())
    assert 0.3 * 400 < len(found["imu"]) < 0.6 * 400
    assert "truncated" in {finding.code for finding in summary.findings if finding.loses_data}


def test_a_file_that_unpacks_to_more_than_is_allowed_is_read_up_to_there(
    plain: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldcal.logs.unpacked.FREE_BYTES", 100_000)
    monkeypatch.setattr("fieldcal.logs.unpacked.CAP_RATIO", 1)
    content = plain.read_bytes()
    packed = plain.with_name("b.mcap.zstd")
    packed.write_bytes(zstandard.compress(content + bytes(10_000_000)))
    assert len(content) < len(packed.read_bytes()) + 100_000
    _, summary = read_log(packed, vehicle())
    assert any("are not unpacked from a file of its size" in finding.sentence for finding in summary.findings)


@pytest.mark.parametrize(("content", "code"), [(b"", "empty_file"), (b"no zstd at all", "not_readable")])
def test_what_does_not_unpack_is_refused(tmp_path: Path, content: bytes, code: str) -> None:
    (tmp_path / "a.mcap.zstd").write_bytes(content)
    with pytest.raises(UnreadableLog, match=r"a\.mcap\.zstd") as refused:
        read_log(tmp_path / "a.mcap.zstd", vehicle())
    assert refused.value.reason_code == code


def test_nothing_stays_behind(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    packed = plain.with_name("b.mcap.zstd")
    packed.write_bytes(zstandard.compress(plain.read_bytes()))
    read_log(packed, vehicle())
    assert list(scratch.iterdir()) == []
