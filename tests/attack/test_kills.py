"""Whatever is killed, in whatever surroundings: the night ends in time with its results, and leaves nobody behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from outside_ci import outside_ci

from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.upkeep.verify import verify

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 120.0
GONE_WITHIN_S = 5.0
ENDS_WITHIN_S = 30.0
CLEAN = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
NOWHERE = "127.0.0.1:9"
PROXIES = dict.fromkeys(("HTTP_PROXY", "http_proxy", "HTTPS_PROXY", "https_proxy"), f"http://{NOWHERE}")
PROXIES |= dict.fromkeys(("ALL_PROXY", "all_proxy"), f"socks5://{NOWHERE}")
PROXIES |= {"NO_PROXY": "intranet.example", "no_proxy": "intranet.example"}


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kills") / "archive"
    write_flights(folder, Experiment(seed=3, duration_s=20.0, sets=1), vehicles=2)
    return folder


def night(archive: Path, root: Path, **surroundings: str) -> subprocess.Popen[str]:
    """A night on two workers with a server of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "fieldcal", "nightly", str(archive), "--warehouse", str(root), "--workers=2", "--json"],
        cwd=REPOSITORY,
        env={**CLEAN, **surroundings},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def workers(process: subprocess.Popen[str]) -> list[int]:
    """Processes of the pool."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    lines = {int(child): Path(f"/proc/{child}/cmdline") for child in children}
    return [child for child, line in lines.items() if line.exists() and b"spawn_main" in line.read_bytes()]


def server(root: Path, home: str = "prefect") -> int:
    record: int = json.loads((root / home / "server.json").read_text())["pid"]
    return record


def descendants(pid: int) -> list[int]:
    children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [*children, *(below for child in children for below in descendants(child))]


def lives(pid: int) -> bool:
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


def wait_for(process: subprocess.Popen[str], holds: Callable[[], Any]) -> Any:
    give_up = time.monotonic() + PATIENCE_S
    while not (found := holds()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < give_up
        time.sleep(0.02)
    return found


def some_stage(root: Path) -> bool:
    return any((root / "stages").glob("*/*/*/run.json"))


@outside_ci
def test_a_night_behind_a_proxy_ends_without_its_first_worker_and_without_its_server(
    archive: Path, tmp_path: Path
) -> None:
    """A proxy that leads nowhere; a worker killed while the pool starts; the server killed in mid-night."""
    process = night(archive, tmp_path, **PROXIES)
    os.kill(wait_for(process, lambda: workers(process))[0], signal.SIGKILL)
    wait_for(process, lambda: some_stage(tmp_path))
    os.kill(server(tmp_path), signal.SIGKILL)
    killed = time.monotonic()
    told, talk = process.communicate(timeout=PATIENCE_S)
    assert time.monotonic() - killed < ENDS_WITHIN_S
    assert process.returncode == 0, talk
    result = json.loads(told)
    assert result["ok"] == len(result["logs"]) == 2
    assert "Prefect's server was lost" in talk
    assert "one by one" not in talk
    assert "Traceback" not in talk
    assert verify(tmp_path)["ok"]


@outside_ci
def test_a_killed_night_leaves_nobody_behind(archive: Path, tmp_path: Path) -> None:
    process = night(archive, tmp_path)
    wait_for(process, lambda: some_stage(tmp_path))
    left = [*workers(process), server(tmp_path)]
    assert len(left) == 3
    assert all(lives(pid) for pid in left)
    process.kill()
    process.wait()
    give_up = time.monotonic() + GONE_WITHIN_S
    while any(lives(pid) for pid in left):
        assert time.monotonic() < give_up, [pid for pid in left if lives(pid)]
        time.sleep(0.05)


@outside_ci
def test_serve_ends_with_its_server_and_leaves_nobody_behind(archive: Path, tmp_path: Path) -> None:
    """The server is killed while a session runs: a sentence, exit code 1, and the session is run again by a night."""
    command = [sys.executable, "-m", "fieldcal"]
    process = subprocess.Popen(
        [*command, "serve", str(archive), "--warehouse", str(tmp_path)],
        cwd=REPOSITORY,
        env=CLEAN,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    told = [process.stderr.readline() for _ in range(3)]
    assert "Serving at" in told[0]
    (session, *_) = (archive / "sim-1").iterdir()
    asked = [*command, "trigger", str(session), "--warehouse", str(tmp_path)]
    subprocess.run(asked, cwd=REPOSITORY, env=CLEAN, check=True, timeout=PATIENCE_S)
    wait_for(process, lambda: some_stage(tmp_path))
    left = descendants(process.pid)
    os.kill(server(tmp_path, "prefect/serve"), signal.SIGKILL)
    killed = time.monotonic()
    _, talk = process.communicate(timeout=PATIENCE_S)
    assert time.monotonic() - killed < 2 * GONE_WITHIN_S
    assert process.returncode == 1
    assert "fieldcal: The Prefect server ended (" in talk
    assert "Traceback" not in talk
    while any(lives(pid) for pid in left):
        assert time.monotonic() - killed < 3 * GONE_WITHIN_S, [pid for pid in left if lives(pid)]
        time.sleep(0.05)
    assert night(archive, tmp_path).wait(PATIENCE_S) == 0
    assert verify(tmp_path)["ok"]


def test_who_hosts_for_a_server_that_is_gone_ends() -> None:
    program = """
import time
from fieldcal.flows.farewell import end_with_server
answers = iter([True, False])
end_with_server(lambda: next(answers), "It is gone.")
time.sleep(60)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30)
    assert (ended.returncode, ended.stderr) == (1, "fieldcal: It is gone.\n")
