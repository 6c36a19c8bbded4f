"""What lies in an archive beside its logs is told by name, but for what nobody takes for a log."""

from __future__ import annotations

from pathlib import Path

import pytest
from bags import Truth, write_rosbag1, write_rosbag2

from fieldcal.config.configuration import LogsMap
from fieldcal.logs import find_logs
from fieldcal.logs.unread import MISPLACED, OUTSIDE, UNKNOWN, UNKNOWN_FOLDER, Unread, find_unread, told
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment


def unread(archive: Path, *logs: LogsMap, session: Path | None = None) -> list[tuple[str, str]]:
    found = {log.log_uri for log in find_logs(archive, logs)}
    return [(one.path, one.why) for one in find_unread(archive, found, session)]


def touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("x")


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    root = tmp_path / "archive"
    for name in (
        "a/s1/one.mcap", "a/s1/two.BAG", "a/s1/three.db3", "a/s1/four.mcap.zstd", "a/s1/five.bag.active",
        "a/s1/notes.txt", "a/s1/table.tsv", "a/s1/film.mp4", "a/s1/NGIMU/sensors.csv", "a/s2/x.csv",
        "a/s1/README.md", "a/s1/one.truth.json", "a/s1/.hidden", "fieldcal.toml", "a/s1/three.db3-wal",
        "a/plan.pdf", "a/loose.bag", "loose.mcap",
    ):  # fmt: skip
        touch(root / name)
    (root / "a" / "s1" / "empty").mkdir()
    (root / "a" / "s1" / "out.bin").symlink_to(tmp_path / "nowhere.bin")
    return root


def test_each_is_told_with_its_reason(archive: Path) -> None:
    assert unread(archive) == [
        ("a/loose.bag", MISPLACED),
        ("a/plan.pdf", UNKNOWN),
        ("a/s1/NGIMU", UNKNOWN_FOLDER),
        ("a/s1/film.mp4", UNKNOWN),
        ("a/s1/notes.txt", UNKNOWN),
        ("a/s1/out.bin", OUTSIDE),
        ("a/s1/table.tsv", UNKNOWN),
        ("loose.mcap", MISPLACED),
    ]
    assert unread(archive, session=archive / "a" / "s2") == []
    assert len(unread(archive, session=archive / "a" / "s1")) == 5


def test_logs_of_an_archive_of_another_shape_are_not_told(archive: Path) -> None:
    given = [LogsMap(glob="*.mcap"), LogsMap(glob="**/NGIMU/*.csv"), LogsMap(glob="**/loose.bag")]
    assert [path for path, _ in unread(archive, *given)] == [
        "a/plan.pdf", "a/s1/film.mp4", "a/s1/notes.txt", "a/s1/out.bin", "a/s1/table.tsv",
    ]  # fmt: skip


def test_folders_that_hold_logs_are_looked_through_however_deep(tmp_path: Path) -> None:
    for name in ("a/s/2026/raw/one.bin", "a/s/2026/raw/two.tlog", "a/s/2026/raw/three.ulg", "a/s/2026/film/x/y.mp4"):
        touch(tmp_path / name)
    assert unread(tmp_path, LogsMap(glob="a/s/*/raw/*.bin")) == [
        ("a/s/2026/film", UNKNOWN_FOLDER),
        ("a/s/2026/raw/three.ulg", MISPLACED),
        ("a/s/2026/raw/two.tlog", UNKNOWN),
    ]


def test_tables_of_other_names_are_logs_where_a_glob_with_their_end_names_them(archive: Path) -> None:
    def tables(*globs: str) -> list[str]:
        found = find_logs(archive, [LogsMap(glob=glob) for glob in globs])
        return [log.log_uri for log in found if log.log_uri.endswith((".tsv", ".txt"))]

    assert tables() == tables("*/*/*") == []
    assert tables("*/*/*.tsv") == ["a/s1/table.tsv"]
    notes = [log for log in find_logs(archive, [LogsMap(glob="**/*.txt")]) if "notes" in log.log_uri]
    assert [log.log_format for log in notes] == ["csv"]


def test_bags_are_logs_wherever_their_folder_lies(tmp_path: Path) -> None:
    truth, old = Truth(20), Truth(20, ros1=True)
    (tmp_path / "a" / "s").mkdir(parents=True)
    write_rosbag2(tmp_path / "a" / "s" / "in_session", truth.messages, truth.rows, "mcap")
    write_rosbag2(tmp_path / "a" / "is_session", truth.messages, truth.rows)
    write_rosbag1(tmp_path / "a" / "s" / "old.bag", old.messages, old.rows)
    found = [(log.log_uri, log.session_id, log.log_format) for log in find_logs(tmp_path)]
    assert found == [
        ("a/is_session", "is_session", "rosbag2"),
        ("a/s/in_session", "s", "rosbag2"),
        ("a/s/old.bag", "s", "rosbag1"),
    ]
    assert unread(tmp_path) == []


@pytest.mark.parametrize("log_format", ["mcap", "csv"])
def test_a_simulated_archive_has_nothing_unread(tmp_path: Path, log_format: str) -> None:
    write_flights(tmp_path, Experiment(duration_s=5.0), log_format=log_format)
    assert find_logs(tmp_path)
    assert unread(tmp_path) == []


def test_one_line_names_the_first_and_counts_the_others() -> None:
    some = [Unread(f"a/{n}.dat", UNKNOWN) for n in range(7)]
    assert told(some, 2) == (
        "7 files or folders are not read: a/0.dat (no known kind of log), a/1.dat (no known kind of log), and 5 more"
    )
    assert told(some[:1]) == "1 file or folder is not read: a/0.dat (no known kind of log)"
