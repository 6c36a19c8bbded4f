"""ROS 2 bags as the package rosbags writes them: both storages, each compression, several files, damage."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import yaml
import zstandard
from bags import Truth, write_rosbag2
from logs_support import vehicle

from fieldcal.errors import UnreadableLog
from fieldcal.logs import log_format, log_sha256, read_log
from fieldcal.logs.interface import Finding, LogSummary
from fieldcal.logs.rosbag2.metadata import read_metadata
from fieldcal.logs.rosbag2.parts import is_bag_folder
from fieldcal.logs.rosbag2.rows import Rows, open_read_only


@pytest.mark.parametrize(
    ("names", "bag"),
    [(("bag_0.mcap", "bag_1.mcap"), True), (("bag_0.mcap", "other.mcap"), False), (("bag.mcap",), False), ((), False)],
)
def test_without_metadata_every_file_is_named_after_its_folder(
    tmp_path: Path, names: tuple[str, ...], bag: bool
) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    assert is_bag_folder(folder) == bag


def codes(summary: LogSummary) -> dict[str, Finding]:
    return {str(finding.code): finding for finding in summary.findings}


def lossy(summary: LogSummary) -> list[Finding]:
    return [finding for finding in summary.findings if finding.loses_data]


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("compression", [None, "file", "message", "storage"])
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_every_storage_and_compression_gives_the_same(
    tmp_path: Path, storage: str, compression: str | None, version: int
) -> None:
    if (storage, compression) == ("sqlite3", "storage"):
        pytest.skip("only MCAP compresses itself")
    truth = Truth()
    folder = write_rosbag2(tmp_path / "bag", truth.messages, truth.rows, storage, compression, version)
    assert log_format(folder) == "rosbag2"
    frames, summary = read_log(folder, vehicle())
    truth.check(frames)
    # That writer gives MCAP no CRC; those of SQLite have none at all, which is no finding of a log.
    assert codes(summary).keys() <= ({"unverifiable"} if storage == "mcap" else set())
    assert summary.log_format == "rosbag2"
    assert summary.epoch_known
    assert summary.units == {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "T"}


@pytest.mark.parametrize("end", ["", ".zstd"])
def test_one_database_alone_is_a_log(tmp_path: Path, end: str) -> None:
    truth = Truth()
    file = database(tmp_path, truth)
    if end:
        packed = file.with_name(file.name + end)
        packed.write_bytes(zstandard.compress(file.read_bytes()))
        file = packed
    assert log_format(file) == "rosbag2"
    frames, summary = read_log(file, vehicle())
    truth.check(frames)
    assert summary.findings == []
    assert not summary.verifiable


def database(tmp_path: Path, truth: Truth) -> Path:
    (file,) = write_rosbag2(tmp_path / "bag", truth.messages, truth.rows).glob("*.db3")
    return file


def split(tmp_path: Path, storage: str, parts: int = 12) -> tuple[Path, Truth]:
    """A bag of several files: 10 stands after 9, though not by name."""
    whole = Truth(20 * parts)
    folder = tmp_path / "split"
    folder.mkdir()
    names, counts = [], {"/imu": 0, "/mag": 0}
    for number in range(parts):
        part = Truth(20, first=20 * number)
        rows = part.rows if number % 2 else part.rows[1:] + part.rows[:1]
        single = write_rosbag2(tmp_path / f"part{number}", part.messages, rows, storage)
        (file,) = [path for path in single.iterdir() if path.name != "metadata.yaml"]
        names.append(f"split_{number}{file.suffix}")
        shutil.copy(file, folder / names[-1])
        counts = {topic: count + 20 for topic, count in counts.items()}
    topics = [
        {"topic_metadata": {"name": topic, "type": "x"}, "message_count": count} for topic, count in counts.items()
    ]
    information = {"version": 9, "relative_file_paths": names, "topics_with_message_count": topics}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    whole.rows = []
    return folder, whole


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_files_are_read_in_order_as_one_log(tmp_path: Path, storage: str) -> None:
    folder, truth = split(tmp_path, storage)
    frames, summary = read_log(folder, vehicle())
    truth.check(frames)
    assert codes(summary).keys() <= {"unverifiable"}
    (folder / "metadata.yaml").unlink()
    assert log_format(folder) == "rosbag2"
    frames, summary = read_log(folder, vehicle())
    truth.check(frames)
    assert codes(summary).keys() - {"unverifiable"} == {"damaged_summary"}


def test_a_file_that_is_gone_is_told_by_name(tmp_path: Path) -> None:
    folder, truth = split(tmp_path, "mcap", 3)
    (folder / "split_2.mcap").unlink()
    frames, summary = read_log(folder, vehicle())
    truth.check(frames, slice(0, 40))
    (finding,) = lossy(summary)
    assert "lacks split_2.mcap" in finding.sentence


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_file_that_cannot_be_read_is_left_out_and_told(tmp_path: Path, storage: str) -> None:
    folder, truth = split(tmp_path, storage, 3)
    (file,) = folder.glob("split_2.*")
    file.write_bytes(b"\x5a" * 5000)
    frames, summary = read_log(folder, vehicle())
    truth.check(frames, slice(0, 40))
    (finding,) = lossy(summary)
    assert file.name in finding.sentence


def test_a_bag_that_counts_more_messages_than_it_holds_is_told(tmp_path: Path) -> None:
    truth = Truth()
    folder = write_rosbag2(tmp_path / "bag", truth.messages, truth.rows)
    text = (folder / "metadata.yaml").read_text()
    assert text.count("message_count: 300") == 2
    (folder / "metadata.yaml").write_text(text.replace("message_count: 300", "message_count: 311"))
    frames, summary = read_log(folder, vehicle())
    truth.check(frames)
    (finding,) = summary.findings
    assert (finding.code, finding.count, finding.loses_data) == ("count_mismatch", 22, True)


@pytest.mark.parametrize("version", [8, 9])
def test_metadata_is_read_as_a_yaml_library_reads_it(tmp_path: Path, version: int) -> None:
    truth = Truth(20)
    folder = write_rosbag2(tmp_path / "bag", truth.messages, truth.rows, version=version)
    split(tmp_path, "mcap", 3)
    for place in (folder, tmp_path / "split"):
        found = read_metadata(place)
        information = yaml.safe_load((place / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        topics = information["topics_with_message_count"]
        assert found.names == information["relative_file_paths"] != []
        assert found.counts == {topic["topic_metadata"]["name"]: topic["message_count"] for topic in topics} != {}
        assert found.damage is None


@pytest.mark.parametrize("text", ["a: [", "- 1", "rosbag2_bagfile_information: 3", "[" * 3000, "x: &a [*a]"])
def test_metadata_that_says_nothing_does_no_harm(tmp_path: Path, text: str) -> None:
    truth = Truth()
    folder = write_rosbag2(tmp_path / "bag", truth.messages, truth.rows)
    (folder / "metadata.yaml").write_text(f"# rosbag2_bagfile_information\n{text}")
    frames, _ = read_log(folder, vehicle())
    truth.check(frames)


def test_the_hash_of_a_folder_covers_its_files(tmp_path: Path) -> None:
    folder, _ = split(tmp_path, "mcap", 2)
    seen = {log_sha256(folder)}
    (folder / "notes.txt").write_text("x")
    assert log_sha256(folder) in seen
    for name in ("split_1.mcap", "metadata.yaml"):
        with (folder / name).open("ab") as stream:
            stream.write(b"\n")
        assert log_sha256(folder) not in seen
        seen.add(log_sha256(folder))


def test_a_folder_of_flights_is_no_bag(tmp_path: Path) -> None:
    for name in ("flight_0.mcap", "flight_1.mcap"):
        (tmp_path / name).write_bytes(b"x")
    assert log_format(tmp_path) is None
    (tmp_path / "metadata.yaml").write_text("author: someone\n")
    assert log_format(tmp_path) is None


# damage to a database ------------------------------------------------------------------------------------------------


def page_bytes(file: Path) -> int:
    with sqlite3.connect(file) as connection:
        return int(connection.execute("PRAGMA page_size").fetchone()[0])


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_of_a_database_that_was_cut_what_can_be_reached_is_read(tmp_path: Path, share: float) -> None:
    """SQLite puts pages that lead to others wherever there is room: rows before the cut may be out of reach."""
    truth = Truth(2000)
    file = database(tmp_path, truth)
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    frames, summary = read_log(file, vehicle())
    places = np.searchsorted(truth.t_ns, frames["imu"]["t_ns"].to_numpy())
    np.testing.assert_array_equal(frames["imu"]["gyroscope_x"].to_numpy(), truth.rate[places, 0])
    assert len(places) / 2000 == pytest.approx(share, abs=0.3)
    assert {"truncated", "damaged_record"} <= codes(summary).keys()
    assert all(finding.loses_data for finding in summary.findings)


def test_a_damaged_page_loses_its_own_rows_and_no_others(tmp_path: Path) -> None:
    truth = Truth(2000)
    file = database(tmp_path, truth)
    size = page_bytes(file)
    content = bytearray(file.read_bytes())
    middle = len(content) // size // 2 * size
    content[middle : middle + size] = b"\xff" * size
    file.write_bytes(content)
    frames, summary = read_log(file, vehicle())
    (finding,) = summary.findings
    assert (finding.code, finding.count, finding.loses_data) == ("damaged_record", 1, True)
    there = set(frames["imu"]["t_ns"].to_list())
    lost = [i for i, t in enumerate(truth.t_ns.tolist()) if t not in there]
    assert 1 <= len(lost) <= 20  # a page of 4 kB and messages of some 300 bytes, half of them of the IMU
    assert lost == list(range(lost[0], lost[-1] + 1))
    # Row ids begin at 1 and go to IMU and magnetometer in turns.
    assert (int(finding.sentence.split("behind row ")[1].split()[0]) + 1) // 2 == lost[0]


def test_rows_behind_damage_are_those_that_sqlite_reaches_by_their_ids(tmp_path: Path) -> None:
    """Truth: every row asked for by its own id, which needs no way past the damage."""
    truth = Truth(1500)
    file = database(tmp_path, truth)
    size = page_bytes(file)
    content = bytearray(file.read_bytes())
    for page in range(10, len(content) // size, 37):
        content[page * size : page * size + 200] = b"\x07" * 200
    file.write_bytes(content)
    connection = open_read_only(file)
    expected = []
    for rowid in range(1, 3001):
        try:
            row = connection.execute("SELECT data FROM messages NOT INDEXED WHERE rowid = ?", (rowid,)).fetchone()
        except sqlite3.DatabaseError:
            continue
        expected += [rowid] if row else []
    rows = Rows(connection, "messages", "data")
    assert [rowid for rowid, _ in rows] == expected
    assert len(expected) < 3000
    assert len(rows.gaps) >= 5


@pytest.mark.parametrize("seed", range(8))
def test_random_damage_never_crashes(tmp_path: Path, seed: int) -> None:
    truth = Truth(400)
    file = database(tmp_path, truth)
    generator = np.random.default_rng(seed)
    content = np.frombuffer(file.read_bytes(), np.uint8).copy()
    places = generator.integers(0 if seed % 2 else 100, len(content), 40)
    content[places] = generator.integers(0, 256, 40)
    file.write_bytes(content.tobytes())
    try:
        frames, summary = read_log(file, vehicle())
    except UnreadableLog:
        return
    imu, field = (len(frames[table]) if table in frames else 0 for table in ("imu", "magnetometer"))
    assert imu + field == 800 or lossy(summary)


@pytest.mark.parametrize("content", [b"SQLite format 3\0" + bytes(100), b"PK\x03\x04" + bytes(200), b"SQLite"])
def test_what_is_no_database_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.db3").write_bytes(content)
    with pytest.raises(UnreadableLog, match=r"a\.db3") as refused:
        read_log(tmp_path / "a.db3", vehicle())
    assert refused.value.reason_code == "not_bag"


def test_another_database_and_one_whose_tables_are_views_are_refused(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as connection:
        connection.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        connection.execute("CREATE VIEW messages AS SELECT 1 AS topic_id, 2 AS timestamp, 3 AS data")
    with pytest.raises(UnreadableLog, match="no tables topics and messages"):
        read_log(tmp_path / "a.db3", vehicle())


def test_messages_left_in_a_journal_are_told(tmp_path: Path) -> None:
    truth = Truth()
    file = database(tmp_path, truth)
    file.with_name(file.name + "-wal").write_bytes(b"x" * 100)
    frames, summary = read_log(file, vehicle())
    truth.check(frames)
    (finding,) = summary.findings
    assert finding.loses_data
    assert f"{file.name}-wal" in finding.sentence


def test_reading_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    truth = Truth()
    file = database(tmp_path, truth)
    before = {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in file.parent.iterdir()}
    read_log(file, vehicle())
    assert {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in file.parent.iterdir()} == before
