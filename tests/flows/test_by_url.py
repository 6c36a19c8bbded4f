"""The night by URL as a command: what is planned, several machines at once, one of them killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from object_store import asking_for_credentials, keys, machine, running_store, upload
from outside_ci import outside_ci

from fieldcal.cli.main import run
from fieldcal.flows.run import run_night
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.upkeep.verify import verify

LOGS = "s3://logs/fleet"


class Whole(NamedTuple):
    archive: Path
    content: str


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two vehicles, a flight each, here and in a store."""
    folder = tmp_path_factory.mktemp("archive")
    write_flights(folder, Experiment(seed=4, duration_s=20.0), vehicles=2)
    with running_store():
        upload(folder, LOGS)
        yield folder


@pytest.fixture(scope="module")
def whole(archive: Path, tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> Whole:
    """What an undisturbed night on one machine makes of it."""
    root = tmp_path_factory.mktemp("whole") / "warehouse"
    run_night(archive, root)
    return Whole(archive, content_sha256(root))


def command(cache: Path, *words: str) -> subprocess.Popen[bytes]:
    """A command on a machine of its own."""
    environment = {**os.environ, "FIELDCAL_CACHE_DIR": str(cache)}
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    return subprocess.Popen([sys.executable, "-m", "fieldcal", *words], env=environment, **silent)


def test_a_night_by_url_is_planned_by_the_command(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with machine(tmp_path):
        assert run(["nightly", LOGS, "--warehouse", "s3://warehouse/planned", "--dry-run", "--json"]) == 0
        assert len(json.loads(capsys.readouterr().out)["logs"]) == 2
        assert run(["session", f"{LOGS}/sim-1/none", "--warehouse", "s3://warehouse/planned", "--dry-run"]) == 2
        assert f"There is no session folder at {LOGS}/sim-1/none." in capsys.readouterr().err
    assert keys("s3://warehouse/planned") == {}


def test_a_night_with_wrong_credentials_is_one_sentence(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with machine(tmp_path), asking_for_credentials():
        assert run(["nightly", LOGS, "--warehouse", "s3://warehouse/refused"]) == 1
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert told[0].startswith(f"fieldcal: {LOGS}: the store refuses access")


@outside_ci
def test_a_night_and_a_session_on_two_machines_at_once_give_the_union(whole: Whole, tmp_path: Path) -> None:
    url = "s3://warehouse/at-once"
    (session,) = (whole.archive / "sim-2").iterdir()
    both = [
        command(tmp_path / "1", "nightly", LOGS, "--warehouse", url),
        command(tmp_path / "2", "session", f"{LOGS}/sim-2/{session.name}", "--warehouse", url),
    ]
    assert [one.wait() for one in both] == [0, 0]
    with machine(tmp_path / "3"):
        found = verify(Warehouse(url).root)
    assert (found["damaged"], found["content_sha256"]) == ([], whole.content)


@outside_ci
@pytest.mark.parametrize("seconds", [0.0, 0.3, 1.0])
def test_a_night_that_is_killed_is_ended_by_another_machine(whole: Whole, tmp_path: Path, seconds: float) -> None:
    url = f"s3://warehouse/killed-{seconds}"
    victim = command(tmp_path / "1", "nightly", LOGS, "--warehouse", url)
    while not keys(url, "objects") and victim.poll() is None:
        time.sleep(0.02)
    time.sleep(seconds)
    os.killpg(victim.pid, signal.SIGKILL)
    assert victim.wait() == -signal.SIGKILL
    assert command(tmp_path / "2", "nightly", LOGS, "--warehouse", url).wait() == 0
    for name in ("2", "3", "1"):
        with machine(tmp_path / name):
            found = verify(Warehouse(url).root)
        assert (found["damaged"], found["content_sha256"]) == ([], whole.content), name
