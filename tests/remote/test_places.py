"""Where a place may be a URL, and what is told where it may not."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldcal.cli.main import run
from fieldcal.errors import FieldcalError
from fieldcal.flows.runners import Parallel
from fieldcal.remote.cache import ARCHIVES, FOLDER, WAREHOUSES, called, copy_of, note_copy
from fieldcal.remote.places import archive_at, log_at, session_at
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


@pytest.mark.parametrize("parallel", [Parallel(2, "pool"), Parallel(2, "dask", "tcp://10.0.0.5:8786")])
def test_workers_that_see_no_copy_are_refused(
    parallel: Parallel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    parallel.reaches(tmp_path / "archive", tmp_path / "warehouse")
    with pytest.raises(FieldcalError, match=f"do not see the copy of {URL}"):
        parallel.reaches(note_copy(ARCHIVES, URL), tmp_path / "warehouse")
    Parallel(2, "dask").reaches(note_copy(ARCHIVES, URL), tmp_path / "warehouse")
