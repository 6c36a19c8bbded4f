"""The Prefect server: shared, gone when unused, true about killed runs, and never the reason why a result is lost."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from outside_ci import outside_ci

from fieldcal.errors import FieldcalError
from fieldcal.flows import housekeeping
from fieldcal.flows.alive import FOLDER, dead
from fieldcal.flows.connection import answers, connected
from fieldcal.flows.run import run_night
from fieldcal.flows.server import Server, prepare_environment
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment

REPOSITORY = Path(__file__).parents[2]
ENDS_WITHIN_S = 15.0

USE_A_SERVER = """
import sys, time
from pathlib import Path
from fieldcal.flows.server import running_server
with running_server(Path(sys.argv[1])) as server:
    print(server.wait(), flush=True)
    sys.stdin.readline()
"""

FAIL = """
import resource, sys
from pathlib import Path
import httpx
from fieldcal.flows.server import Server
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
try:
    with Server(Path(sys.argv[1])).explained():
        raise httpx.ConnectError("500 Internal Server Error for url 'http://127.0.0.1'")
except Exception as error:
    print(error.reason_code, error.sentence)
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("server") / "archive"
    write_flights(folder, Experiment(seed=8, duration_s=25.0))
    return folder


def user(root: Path) -> subprocess.Popen[str]:
    """A process that uses the root's own server until it is told to end."""
    return subprocess.Popen(
        [sys.executable, "-c", USE_A_SERVER, str(root)],
        cwd=REPOSITORY,
        env={name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def address(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@outside_ci
def test_two_commands_at_once_share_a_server_that_ends_with_the_last(tmp_path: Path) -> None:
    first, second = user(tmp_path), user(tmp_path)
    url = address(first)
    assert url.startswith("http://127.0.0.1:")
    assert address(second) == url
    first.kill()
    first.wait()
    time.sleep(3.0)
    assert answers(url)
    second.communicate("\n")
    give_up = time.monotonic() + ENDS_WITHIN_S
    while answers(url):
        assert time.monotonic() < give_up, "nobody uses the server any more"
        time.sleep(0.2)


def test_nothing_listens_beyond_this_machine(prefect_server: str) -> None:
    port = int(prefect_server.split(":")[2].split("/")[0])
    listening = set()
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            if state == "0A" and int(local.split(":")[1], 16) == port:
                listening.add(local.split(":")[0])
    assert listening == {f"{int.from_bytes(socket.inet_aton('127.0.0.1'), 'little'):08X}"}


def test_a_server_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/api"
    monkeypatch.setenv("PREFECT_API_URL", url)
    monkeypatch.setattr("fieldcal.flows.server.ANSWER_TIMEOUT_S", 0.2)
    with Server(tmp_path) as server, pytest.raises(FieldcalError, match="PREFECT_API_URL") as caught:
        server.wait()
    assert url in caught.value.sentence
    assert caught.value.reason_code == "prefect_unavailable"


@pytest.mark.parametrize(
    ("file_bytes", "reason_code", "told"),
    [(10_000_000, "disk_full", "ulimit -f"), (30_000_000, "prefect_unavailable", "server.log")],
)
def test_a_server_that_fails_is_told_with_what_the_disk_refuses_it(
    file_bytes: int, reason_code: str, told: str, tmp_path: Path
) -> None:
    """Its database could grow by another few MB, or not."""
    with (tmp_path / "prefect.db").open("wb") as file:
        file.truncate(9_000_000)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    command = [sys.executable, "-c", FAIL, str(tmp_path), str(file_bytes)]
    found = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=True).stdout
    assert found.startswith(f"{reason_code} The Prefect server failed (500 Internal Server Error)")
    assert told in found
    assert {path.name for path in tmp_path.iterdir()} == {"prefect.db"}


def test_nothing_is_sent_to_others() -> None:
    prepare_environment(Path("fieldcal-data"))
    assert os.environ["DO_NOT_TRACK"] == "1"
    assert os.environ["PREFECT_SERVER_ANALYTICS_ENABLED"] == "false"


def flow_runs(url: str) -> dict[str, str]:
    from prefect.client.orchestration import get_client

    with connected(url), get_client(sync_client=True) as client:
        return {str(run.id): str(run.state_type.value) for run in client.read_flow_runs() if run.state_type}


@outside_ci
def test_a_killed_run_is_ended_at_the_next_start(archive: Path, tmp_path: Path, prefect_server: str) -> None:
    root = tmp_path / "warehouse"
    process = subprocess.Popen(
        [sys.executable, "-m", "fieldcal", "nightly", str(archive), "--warehouse", str(root)],
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    give_up = time.monotonic() + 60
    while not list((root / "stages").glob("*/*/*/run.json")):
        assert process.poll() is None
        assert time.monotonic() < give_up
        time.sleep(0.02)
    assert dead(root) == []
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    (mark,) = dead(root)
    assert flow_runs(prefect_server)[mark.name] == "RUNNING"
    run_night(archive, root)
    states = flow_runs(prefect_server)
    assert states[mark.name] == "CRASHED"
    assert list((root / FOLDER).iterdir()) == []


@outside_ci
def test_old_runs_and_all_beyond_many_are_removed_with_their_tasks(
    archive: Path, tmp_path: Path, prefect_server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId, TaskRunFilter, TaskRunFilterFlowRunId

    before = set(flow_runs(prefect_server))
    run_night(archive, tmp_path / "warehouse")
    (own,) = set(flow_runs(prefect_server)) - before

    def tasks() -> int:
        of_run = TaskRunFilter(flow_run_id=TaskRunFilterFlowRunId(any_=[UUID(own)]))
        with connected(prefect_server), get_client(sync_client=True) as client:
            return len(client.read_task_runs(task_run_filter=of_run))

    give_up = time.monotonic() + 20
    while not tasks():
        assert time.monotonic() < give_up
        time.sleep(0.2)
    housekeeping.tidy_prefect(tmp_path, prefect_server, own_server=True)
    assert own in flow_runs(prefect_server)

    real = housekeeping._ended_before

    def narrowed(days: float) -> FlowRunFilter:
        return FlowRunFilter(id=FlowRunFilterId(any_=[UUID(own)]), end_time=real(days).end_time)

    monkeypatch.setattr(housekeeping, "_ended_before", narrowed)
    monkeypatch.setattr(housekeeping, "KEPT_DAYS", 0)
    monkeypatch.setattr(housekeeping, "EVERY_S", 0.0)
    housekeeping.tidy_prefect(tmp_path, prefect_server, own_server=True)
    assert own not in flow_runs(prefect_server)
    assert tasks() == 0

    monkeypatch.setattr(housekeeping, "KEPT_DAYS", 30)
    run_night(archive, tmp_path / "warehouse")
    (own,) = set(flow_runs(prefect_server)) - before
    housekeeping.tidy_prefect(tmp_path, prefect_server, own_server=True)
    assert own in flow_runs(prefect_server)
    monkeypatch.setattr(housekeeping, "MOST_RUNS", 0)
    housekeeping.tidy_prefect(tmp_path, prefect_server, own_server=True)
    assert own not in flow_runs(prefect_server)


class Planted:
    """Runs when it is unpickled."""

    def __init__(self, told: Path) -> None:
        self.told = told

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.told,)


def test_a_planted_pickle_does_not_run(archive: Path, tmp_path: Path, prefect_server: str) -> None:
    import cloudpickle

    root, told = tmp_path / "warehouse", tmp_path / "it-ran"
    run_night(archive, root)
    pickle.loads(cloudpickle.dumps(Planted(tmp_path / "it-can-run")))
    assert (tmp_path / "it-can-run").exists()
    planted = cloudpickle.dumps(Planted(told))
    record = b'{"metadata": {"serializer": {"type": "pickle"}}, "result": "' + planted.hex().encode() + b'"}'
    storage = Path(os.environ["PREFECT_HOME"]) / "storage"
    storage.mkdir(exist_ok=True)
    for path in sorted((root / "stages").rglob("*")):
        if path.is_file():
            (storage / path.parent.name).write_bytes(record)
            path.write_bytes(planted if path.suffix == ".parquet" else record)
    result = run_night(archive, root)
    assert result["stages_cached"] == 0
    assert result["ok"] == 1
    assert not told.exists()


@pytest.mark.parametrize("failed", [False, True])
def test_a_night_of_which_stages_failed_is_red_in_prefect_and_told_all_the_same(
    failed: bool, archive: Path, prefect_server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefect.client.orchestration import get_client

    from fieldcal.flows import nightly

    refusals = [{"stage": "joint", "status": "failed", "reason_code": "stage_failed", "reason": "ZeroDivisionError"}]
    log = {"log_uri": "sim-1/s/f.mcap", "reason": "ZeroDivisionError", "refusals": refusals if failed else []}
    monkeypatch.setattr(nightly, "carry_out", lambda *given: {"logs": [log]})
    began = time.time()
    assert run_night(archive, tmp_path)["logs"] == [log]
    with connected(prefect_server), get_client(sync_client=True) as client:
        runs = [run for run in client.read_flow_runs() if run.start_time and run.start_time.timestamp() > began - 1.0]
    (state,) = [run.state for run in runs if run.name.startswith("archive, ")]
    assert state is not None
    assert state.is_failed() == failed
    assert ("sim-1/s/f.mcap: ZeroDivisionError" in str(state.message)) == failed
