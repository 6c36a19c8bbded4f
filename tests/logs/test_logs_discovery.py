"""Which logs an archive holds, and what identifies them."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from logs_support import vehicle

from fieldcal.config.configuration import LogsMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs import find_logs, flight_id, log_sha256, open_log
from fieldcal.logs.discovery import LOG_FORMATS
from fieldcal.schemas.columns import LOG_FORMAT


def touch(path: Path, content: str = "x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    root = tmp_path / "archive"
    for name in (
        "b/s1/two.mcap",
        "b/s1/one.CSV",
        "a/s2/f.ulg",
        "a/s1/f.bin",
        "a/s1/folder/imu.csv",
        "a/s1/folder/vps.csv",
    ):
        touch(root / name)
    for name in ("a/s1/notes.txt", "a/s1/.hidden.mcap", "a/s1/empty_folder/vps.csv", "fieldcal.toml", "loose.mcap"):
        touch(root / name)
    return root


def test_logs_are_listed_in_order_with_vehicle_and_session(archive: Path) -> None:
    found = [(log.log_uri, log.vehicle_id, log.session_id, log.log_format) for log in find_logs(archive)]
    assert found == [
        ("a/s1/f.bin", "a", "s1", "dataflash"),
        ("a/s1/folder", "a", "s1", "csv"),
        ("a/s2/f.ulg", "a", "s2", "ulog"),
        ("b/s1/one.CSV", "b", "s1", "csv"),
        ("b/s1/two.mcap", "b", "s1", "mcap"),
    ]


def test_the_column_names_the_formats_that_discovery_gives() -> None:
    assert LOG_FORMAT.meaning.split(": ")[1].split(", ") == list(dict.fromkeys(LOG_FORMATS.values()))


def test_links_out_of_the_archive_and_loops_are_not_followed(archive: Path, tmp_path: Path) -> None:
    outside = touch(tmp_path / "outside" / "s" / "secret.mcap")
    (archive / "a" / "s1" / "out.mcap").symlink_to(outside)
    (archive / "c").symlink_to(outside.parent.parent)
    (archive / "a" / "s1" / "loop.mcap").symlink_to(archive / "a" / "s1" / "loop.mcap")
    (archive / "a" / "up").symlink_to(archive)
    (archive / "a" / "s3").symlink_to(archive / "a" / "s2")
    (archive / "a" / "s1" / "dangling.mcap").symlink_to(tmp_path / "nowhere.mcap")
    uris = [log.log_uri for log in find_logs(archive)]
    assert not any("out" in uri or "loop" in uri or uri.startswith("c/") or "dangling" in uri for uri in uris)
    assert "a/s3/f.ulg" in uris


def test_archives_of_another_shape_are_mapped(archive: Path) -> None:
    touch(archive / "deep" / "x" / "y" / "log.mcap")
    mapping = [
        LogsMap(glob="*.mcap", vehicle="solo"),
        LogsMap(glob="b/*/*", vehicle="B"),
        LogsMap(glob="deep/**/*.mcap", session="all"),
    ]
    found = {log.log_uri: (log.vehicle_id, log.session_id) for log in find_logs(archive, mapping)}
    assert found["loose.mcap"] == ("solo", "loose")
    assert found["b/s1/two.mcap"] == ("B", "s1")
    assert found["deep/x/y/log.mcap"] == ("deep", "all")
    assert found["a/s1/f.bin"] == ("a", "s1")


def test_the_hash_is_of_the_content_not_of_the_place(archive: Path, tmp_path: Path) -> None:
    one = archive / "b" / "s1" / "two.mcap"
    assert log_sha256(one) == hashlib.sha256(b"x").hexdigest()
    assert log_sha256(one) == log_sha256(touch(tmp_path / "elsewhere.mcap"))
    assert flight_id(log_sha256(one)) == hashlib.sha256(b"x").hexdigest()[:16]
    folder = archive / "a" / "s1" / "folder"
    before = log_sha256(folder)
    touch(folder / "notes.txt")
    assert log_sha256(folder) == before
    touch(folder / "vps.csv", "y")
    assert log_sha256(folder) != before
    for name in ("imu.csv", "vps.csv"):
        touch(tmp_path / "copy" / name, (folder / name).read_text())
    assert log_sha256(tmp_path / "copy") == log_sha256(folder)


@pytest.mark.parametrize(
    ("name", "code"),
    [("f.db", "format_not_supported"), ("f.dat", "format_not_supported")],
)
def test_formats_that_are_not_read(tmp_path: Path, name: str, code: str) -> None:
    with pytest.raises(UnreadableLog, match="Convert it") as caught:
        open_log(touch(tmp_path / name), vehicle())
    assert caught.value.reason_code == code


def test_a_log_that_is_gone(tmp_path: Path) -> None:
    with pytest.raises(UnreadableLog) as caught:
        open_log(tmp_path / "gone.mcap", vehicle())
    assert caught.value.reason_code == "not_found"
