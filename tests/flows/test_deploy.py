"""The schedule and the ground station's call, against real servers and processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from outside_ci import outside_ci

from fieldcal.batch.landing import Landing
from fieldcal.flows.connection import connected, kept_secret
from fieldcal.flows.server import home_of, serving_address
from fieldcal.flows.trigger import EVENT, session_digest
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse import Warehouse

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 120.0
CLEAN = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("deploy") / "archive"
    write_flights(folder, Experiment(seed=9, duration_s=25.0), vehicles=3)
    return folder


def sessions(archive: Path) -> list[Path]:
    return sorted(archive.glob("sim-*/*"))


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fieldcal", *arguments], cwd=REPOSITORY, env=CLEAN, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def served(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Warehouse for which `fieldcal serve` runs, with a server of its own."""
    root = tmp_path_factory.mktemp("served") / "warehouse"
    process = subprocess.Popen(
        [sys.executable, "-m", "fieldcal", "serve", str(archive), "--warehouse", str(root)],
        cwd=REPOSITORY,
        env=CLEAN,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert process.stderr.readline().startswith("Serving at http://127.0.0.1:")
    assert "fieldcal trigger" in process.stderr.readline()
    wait_for(lambda: len(deployed(root)) == 3)
    yield root
    process.send_signal(signal.SIGINT)
    process.wait(timeout=10)


def wait_for(holds: Callable[[], Any]) -> Any:
    give_up = time.monotonic() + PATIENCE_S
    while not (found := holds()):
        assert time.monotonic() < give_up
        time.sleep(0.5)
    return found


def vehicles(root: Path) -> set[str]:
    return set(Warehouse(root).scan("calibration").collect()["vehicle_id"])


def inside(root: Path) -> AbstractContextManager[None]:
    """With the secret of the server that is served for this root."""
    url = serving_address(root)
    assert url is not None
    return connected(url, kept_secret(home_of(root, serving=True)))


def deployed(root: Path) -> list[Any]:
    from prefect.client.orchestration import get_client

    with inside(root), get_client(sync_client=True) as client:
        return list(client.read_deployments())


def runs(root: Path, flow: str) -> list[Any]:
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowFilter, FlowFilterName

    named = FlowFilter(name=FlowFilterName(any_=[flow]))
    with inside(root), get_client(sync_client=True) as client:
        return list(client.read_flow_runs(flow_filter=named))


def test_a_triggered_session_is_in_the_history_and_runs_once(archive: Path, served: Path) -> None:
    folder = sessions(archive)[0]
    asked = json.loads(command("trigger", str(folder), "--warehouse", str(served), "--json").stdout)
    again = json.loads(command("trigger", str(folder), "--warehouse", str(served), "--json").stdout)
    assert (asked["created"], again["created"]) == (True, False)
    assert again["flow_run_id"] == asked["flow_run_id"]
    wait_for(lambda: "sim-1" in vehicles(served))
    told = command("history", "--vehicle", "sim-1", "--parameter", "scale", "--json", "--warehouse", str(served))
    assert {row["sensor"] for row in json.loads(told.stdout)} == {"magnetometer", "accelerometer", "gyroscope"}


@outside_ci
def test_an_event_does_the_same_once_however_often_it_comes(archive: Path, served: Path) -> None:
    from prefect.client.orchestration import get_client

    folder = sessions(archive)[1]
    before = len(runs(served, "session"))
    with inside(served), get_client(sync_client=True) as client:
        for _ in range(2):
            event = {
                "occurred": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                "event": EVENT,
                "resource": {"prefect.resource.id": "fieldcal.session"},
                "payload": {"folder": str(folder)},
                "id": str(uuid4()),
            }
            client._client.post("/events", json=[event]).raise_for_status()
    wait_for(lambda: "sim-2" in vehicles(served))
    wait_for(lambda: sum(run.state.is_final() for run in runs(served, "session-landed")) == 2)
    assert len(runs(served, "session")) == before + 1


def test_the_night_is_scheduled(served: Path) -> None:
    upcoming = wait_for(lambda: runs(served, "nightly"))
    assert all(run.auto_scheduled and run.expected_start_time.hour == 3 for run in upcoming)


@outside_ci
def test_without_a_server_it_fails_at_once_and_the_night_takes_the_session(
    archive: Path, tmp_path: Path, prefect_server: str
) -> None:
    from fieldcal.flows.run import run_night

    began = time.monotonic()
    told = command("trigger", str(sessions(archive)[2]), "--warehouse", str(tmp_path / "warehouse"))
    assert told.returncode == 1
    assert "fieldcal serve" in told.stderr
    assert told.stderr.count("\n") == 1
    assert time.monotonic() - began < 10
    run_night(archive, tmp_path / "warehouse", session=sessions(archive)[0])
    result = run_night(archive, tmp_path / "warehouse")
    assert "sim-3" in vehicles(tmp_path / "warehouse")
    assert result["stages_cached"] > 0


def test_a_server_without_the_deployment_is_told(
    archive: Path, tmp_path: Path, prefect_server: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from fieldcal.cli.main import run

    assert run(["trigger", str(sessions(archive)[0]), "--warehouse", str(tmp_path)]) == 1
    assert "no deployment session/fieldcal" in capsys.readouterr().err


@outside_ci
def test_a_wrong_schedule_is_a_usage_error(archive: Path, tmp_path: Path) -> None:
    told = command("serve", str(archive), "--warehouse", str(tmp_path / "w"), "--cron", "every night")
    assert (told.returncode, told.stderr.count("\n")) == (2, 1)
    assert "every night" in told.stderr


def test_the_digest_of_a_session_is_its_content(archive: Path, tmp_path: Path) -> None:
    folder = sessions(archive)[0]
    before = session_digest(folder)
    (tmp_path / "copy").mkdir()
    for path in folder.iterdir():
        (tmp_path / "copy" / path.name).write_bytes(path.read_bytes())
    assert session_digest(tmp_path / "copy") == before
    (tmp_path / "copy" / "another.mcap").write_bytes(b"")
    assert session_digest(tmp_path / "copy") != before


def test_a_session_has_landed_when_it_stopped_growing(tmp_path: Path) -> None:
    known = tmp_path / "v1" / "s1"
    known.mkdir(parents=True)
    (known / "a.mcap").write_bytes(b"1")
    landing = Landing(tmp_path, quiet_s=10.0)
    assert landing.finished(0.0) == []
    new = tmp_path / "v1" / "s2"
    new.mkdir()
    assert landing.finished(20.0) == []
    (new / "b.mcap").write_bytes(b"1")
    assert landing.finished(21.0) == []
    (new / "b.mcap").write_bytes(b"12")
    assert landing.finished(29.0) == []
    assert landing.finished(38.0) == []
    assert landing.finished(39.5) == [new]
    assert landing.finished(60.0) == []
    (known / "a.mcap").write_bytes(b"123")
    assert landing.finished(70.0) == []
    assert landing.finished(80.0) == [known]
