"""`fieldcal doctor` finds what a night would stumble over, says what to do, and changes nothing."""

from __future__ import annotations

import fcntl
import importlib.metadata
import json
import os
import shutil
import socket
from pathlib import Path
from typing import Any

import pytest

from fieldcal.cli import doctor
from fieldcal.cli.main import run
from fieldcal.warehouse.layout import lock_path, prepare


def checks(root: Path, archive: Path | None = None) -> dict[str, doctor.Check]:
    return {check.check: check for check in doctor.examine(root, archive).checks}


@pytest.fixture(autouse=True)
def no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PREFECT_API_URL", raising=False)


def test_a_sound_machine_is_ok_and_nothing_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "new" / "root"
    assert run(["doctor", "--warehouse", str(root), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ok"]
    assert {check["status"] for check in told["checks"]} <= {"ok", "warning"}
    names = [check["check"] for check in told["checks"]]
    wanted = {"python", "fieldcal", "polars", "prefect", "warehouse", "permissions", "disk", "locks", "server"}
    assert wanted <= set(names)
    assert list(tmp_path.iterdir()) == []
    assert run(["doctor", "--warehouse", str(root)]) == 0
    assert "ok       permissions" in capsys.readouterr().out


def test_versions_are_held_against_what_was_tested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = ["numpy>=2.4,<3", "scipy>=999", "no-such-library>=1", 'mypy>=1; extra == "test"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: wanted)
    found = checks(tmp_path)
    assert found["numpy"].status == "ok"
    assert found["scipy"].status == "warning"
    assert "tested with >=999" in found["scipy"].found
    assert found["no-such-library"].status == "failed"
    assert found["no-such-library"].advice == "pip install 'no-such-library>=1'"
    assert "mypy" not in found


def test_a_root_that_is_a_file_or_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("x")
    assert checks(tmp_path / "file")["warehouse"].status == "failed"

    def refuse(**_: Any) -> None:
        raise OSError(30, os.strerror(30))

    monkeypatch.setattr(doctor.tempfile, "TemporaryFile", refuse)
    found = checks(tmp_path)["permissions"]
    assert found.status == "failed"
    assert f"{tmp_path} cannot be written: read-only file system" in found.found
    assert run(["doctor", "--warehouse", str(tmp_path)]) == 1


@pytest.mark.parametrize(("free", "status"), [(50 << 20, "failed"), (1 << 30, "warning"), (1 << 40, "ok")])
def test_free_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int, status: str) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=free)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: usage)
    assert checks(tmp_path)["disk"].status == status


def test_a_held_lock_and_an_open_cache_are_told(tmp_path: Path) -> None:
    prepare(tmp_path)
    (tmp_path / "stages").chmod(0o755)
    lock = lock_path(tmp_path, "morpheus")
    with lock.open("w") as stream:
        assert checks(tmp_path)["locks"].found == "free"
        fcntl.flock(stream, fcntl.LOCK_EX)
        assert "morpheus" in checks(tmp_path)["locks"].found
    assert checks(tmp_path)["cache"].status == "warning"


def test_a_server_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{probe.getsockname()[1]}/api"
    monkeypatch.setenv("PREFECT_API_URL", address)
    found = checks(tmp_path)["server"]
    assert found.status == "failed"
    assert address in found.advice


def test_a_server_that_answers(tmp_path: Path, prefect_server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_API_URL", prefect_server)
    assert checks(tmp_path)["server"].status == "ok"


def test_an_archive_that_is_not_there(tmp_path: Path) -> None:
    assert checks(tmp_path, tmp_path / "none")["archive"].status == "failed"
    assert checks(tmp_path, tmp_path)["archive"].status == "ok"


def test_an_archive_with_what_is_no_log(tmp_path: Path) -> None:
    session = tmp_path / "a" / "s"
    session.mkdir(parents=True)
    (session / "flight.dat").write_text("x")
    found = checks(tmp_path / "root", tmp_path)["archive"]
    assert found.status == "warning"
    assert "a/s/flight.dat (no known kind of log)" in found.found
