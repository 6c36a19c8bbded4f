"""The ledger of log digests: trusted only while a log is what it was, and never needed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fieldcal.batch import jobs
from fieldcal.batch.jobs import find_jobs
from fieldcal.batch.ledgers import logs as log_ledger
from fieldcal.batch.ledgers.logs import read_ledger, write_ledger
from fieldcal.config.configuration import load
from fieldcal.flight.job import Job
from fieldcal.logs import log_sha256


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(log_ledger, "SETTLED_NS", 0)
    session = tmp_path / "archive" / "v" / "s"
    session.mkdir(parents=True)
    (session / "a.mcap").write_bytes(b"one")
    (session / "b").mkdir()
    (session / "b" / "imu.csv").write_text("t_s,gx\n")
    return tmp_path / "archive"


def hashed(archive: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[list[Job], list[str]]:
    """The jobs, and the names of the logs that were read for them."""
    read: list[str] = []

    def counting(path: Path) -> str:
        read.append(path.name)
        return log_sha256(path)

    monkeypatch.setattr(jobs, "log_sha256", counting)
    return find_jobs(archive, load(None), None, read_ledger(root)), read


def test_only_what_changed_is_read(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "warehouse"
    first, read = hashed(archive, root, monkeypatch)
    assert sorted(read) == ["a.mcap", "b"]
    write_ledger(root, first)
    assert hashed(archive, root, monkeypatch) == (first, [])
    log = archive / "v" / "s" / "a.mcap"
    stat = log.stat()
    log.write_bytes(b"two")
    os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    again, read = hashed(archive, root, monkeypatch)
    assert read == ["a.mcap"]
    assert again[0].sha256 == log_sha256(log) != first[0].sha256
    (archive / "v" / "s" / "b" / "vps.csv").write_text("t_s\n")
    assert hashed(archive, root, monkeypatch)[1] == ["a.mcap", "b"]


def test_what_changed_a_moment_ago_is_not_remembered(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_ledger, "SETTLED_NS", 3_600_000_000_000)
    write_ledger(tmp_path, hashed(archive, tmp_path, monkeypatch)[0])
    assert read_ledger(tmp_path) == {}


def test_a_damaged_ledger_is_no_ledger(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "warehouse"
    write_ledger(root, hashed(archive, root, monkeypatch)[0])
    assert len(read_ledger(root)) == 2
    place = root / "night" / "logs.json"
    data = place.read_bytes()
    place.write_bytes(data.replace(b"a.mcap", b"c.mcap"))
    assert read_ledger(root) == {}
    place.unlink()
    assert read_ledger(root) == {}


def test_logs_that_are_gone_are_forgotten(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "warehouse"
    write_ledger(root, hashed(archive, root, monkeypatch)[0])
    (archive / "v" / "s" / "a.mcap").rename(archive / "v" / "s" / "c.mcap")
    write_ledger(root, hashed(archive, root, monkeypatch)[0])
    assert sorted(Path(path).name for path in read_ledger(root)) == ["b", "c.mcap"]
