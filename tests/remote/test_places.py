"""Where a place may be a URL, and what is told where it may not."""

from __future__ import annotations

from pathlib import Path

import pytest
from object_store import keys, running_store, upload

from fieldcal.cli.main import run
from fieldcal.errors import FieldcalError
from fieldcal.flight.job import file_stamp
from fieldcal.remote.cache import ARCHIVES, FOLDER, WAREHOUSES, called, copy_of, note_copy
from fieldcal.remote.content import stand_in
from fieldcal.remote.places import archive_at, log_at, session_at
from fieldcal.remote.sent import received, sent
from fieldcal.remote.url import above

URL = "s3://logs/fleet"


@pytest.mark.parametrize(
    "words", [["init", URL], ["serve", URL], ["serve", "--watch", URL], ["trigger", URL], ["doctor", "--archive", URL]]
)
def test_commands_that_take_folders_say_so(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(words) == 2
    assert f"takes a folder on this machine, not {URL}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_paths_stay_paths(tmp_path: Path) -> None:
    (tmp_path / "v" / "s").mkdir(parents=True)
    assert archive_at(tmp_path) == tmp_path
    assert session_at(tmp_path / "v" / "s") == (tmp_path, tmp_path / "v" / "s")
    assert log_at("a/b.csv") == Path("a/b.csv")
    with pytest.raises(FieldcalError, match="There is no archive at"):
        archive_at(tmp_path / "none")


def test_a_way_up_ends_at_the_bucket() -> None:
    assert above("s3://logs/fleet/v/s/", 2) == ("s3://logs/fleet", "v/s")
    assert above("s3://logs/v/s", 2) == ("s3://logs", "v/s")
    with pytest.raises(FieldcalError, match="names no session"):
        above("s3://logs/s", 2)


def test_a_copy_is_called_by_its_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    assert called(note_copy(WAREHOUSES, URL) / "tables") == f"{URL}/tables"
    assert called(copy_of(WAREHOUSES, "s3://logs/other")) == str(copy_of(WAREHOUSES, "s3://logs/other"))
    assert called(tmp_path / "folder") == str(tmp_path / "folder")


@pytest.mark.parametrize("layout", ["file", "folder", "file again"])
def test_a_log_is_named_for_another_machine_whatever_lay_there_before(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    monkeypatch.setenv(FOLDER, str(here))
    log = note_copy(ARCHIVES, URL) / "v" / "s" / "flight"
    files = [log / "a", log / "b"] if layout == "folder" else [log]
    for n, file in enumerate(files):
        file.parent.mkdir(parents=True, exist_ok=True)
        stand_in(file, 1000 + n, 5_000_000_000 + n)
    named = sent(log)
    assert named is not None
    assert sent(tmp_path / "elsewhere") is None
    monkeypatch.setenv(FOLDER, str(there))
    former = note_copy(ARCHIVES, URL) / "v" / "s" / "flight"
    lay = {"file": former.parent, "folder": former, "file again": former / "c"}[layout]
    lay.parent.mkdir(parents=True)
    stand_in(lay, 7, 7)
    place = received(named)
    assert place == former
    assert file_stamp(place) == tuple(
        value for n in range(len(files)) for value in (1000 + n, *[5_000_000_000 + n] * 2, 0)
    )
    with pytest.raises(ValueError, match="another log"):
        received({**named, "files": {"v/s/other": [1, 1]}})


def test_a_store_of_these_tests_begins_empty_whatever_another_of_the_process_held(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("1")
    with running_store():
        upload(tmp_path, URL)
        assert list(keys(URL)) == ["a.csv"]
    with running_store():
        assert keys(URL) == {}
