"""Nobody gets in: what a local user, a web page and one who knows the secret can make `fieldcal serve` do."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from outside_ci import outside_ci

from fieldcal.batch.session_folder import archive_of
from fieldcal.errors import FieldcalError
from fieldcal.flows.alive import FOLDER as RUNNING
from fieldcal.flows.connection import SECRET, SECRET_FILE, connected, environment_for, kept_secret, new_secret
from fieldcal.flows.server import ADDRESS, home_of, serving_address
from fieldcal.flows.trigger import DEPLOYMENT, EVENT
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 120.0
GONE_WITHIN_S = 5.0
CLEAN = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
OPEN = {
    "PREFECT_SERVER_CSRF_PROTECTION_ENABLED": "false",
    "PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "false",
    "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": "*",
    "PREFECT_SERVER_API_AUTH_STRING": "",
}
"""Settings of the user's own that would let strangers in."""
FOREIGN = "http://evil.example"
TURNED_AWAY = (401, 403)
"""Without the secret; a change is asked for its token first."""

RUN_ALL = """
import json, os, sys
from fieldcal.cli.main import run
codes = []
for environment, tokens in json.loads(sys.argv[1]):
    os.environ.update(environment)
    codes.append(run(tokens))
print(json.dumps(codes))
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`archive` that is served, `elsewhere` that is not, and a link from the first into the second."""
    folder = tmp_path_factory.mktemp("strangers")
    for seed, name in enumerate(("archive", "elsewhere")):
        write_flights(folder / name, Experiment(seed=seed, duration_s=20.0, sets=1))
    (elsewhere,) = (folder / "elsewhere").glob("sim-1/*")
    (folder / "archive" / "sim-1" / "link").symlink_to(elsewhere)
    return folder


@pytest.fixture(scope="module")
def served(place: Path) -> Iterator[Path]:
    """Warehouse for which `fieldcal serve` runs."""
    root = place / "warehouse"
    process = subprocess.Popen(
        [sys.executable, "-m", "fieldcal", "serve", str(place / "archive"), "--warehouse", str(root)],
        cwd=REPOSITORY,
        env={**CLEAN, **OPEN},
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    told = [process.stderr.readline() for _ in range(3)]
    assert str(home_of(root, serving=True) / SECRET_FILE) in told[2], told
    assert secret(root) not in "".join(told)
    yield root
    process.send_signal(signal.SIGINT)
    process.wait(timeout=10)


def secret(root: Path) -> str:
    return kept_secret(home_of(root, serving=True))


def url(root: Path) -> str:
    found = serving_address(root)
    assert found is not None
    return found


def inside(root: Path) -> AbstractContextManager[None]:
    return connected(url(root), secret(root))


def outside_folders(place: Path) -> dict[str, Path]:
    (elsewhere,) = (place / "elsewhere").glob("sim-1/*")
    archive = place / "archive"
    return {
        "beside": elsewhere,
        "link": archive / "sim-1" / "link",
        "dots": archive / "sim-1" / ".." / ".." / "elsewhere" / "sim-1" / elsewhere.name,
        "above": place,
        "archive": archive,
        "root": Path("/tmp"),
        "nowhere": archive / "sim-1" / "nowhere",
    }


def asked(address: str, method: str = "GET", headers: dict[str, str] | None = None, body: Any = None) -> Any:
    """Status and headers of a request as a stranger makes it."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(address, data, headers or {}, method=method)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, dict(answer.headers)
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers)


def in_one_process(calls: list[tuple[dict[str, str], list[str]]]) -> tuple[list[int], list[str]]:
    """Exit codes of commands, each with its environment, and what they said on standard error."""
    done = subprocess.run(
        [sys.executable, "-c", RUN_ALL, json.dumps(calls)], env=CLEAN, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout), done.stderr.splitlines()


def wait_for(holds: Callable[[], Any]) -> Any:
    give_up = time.monotonic() + PATIENCE_S
    while not (found := holds()):
        assert time.monotonic() < give_up
        time.sleep(0.3)
    return found


def test_a_local_user_without_the_secret_is_turned_away(served: Path) -> None:
    for method, path, body in [
        ("GET", "/version", None),
        ("POST", "/deployments/filter", {}),
        ("POST", "/deployments/", {"name": "fieldcal", "flow_id": str(uuid4())}),
        ("POST", "/flow_runs/filter", {}),
        ("POST", "/automations/", {}),
        ("POST", "/events", []),
        ("GET", "/csrf-token?client=me", None),
    ]:
        assert asked(url(served) + path, method, {"Content-Type": "application/json"}, body)[0] in TURNED_AWAY, path
        wrong = {"Content-Type": "application/json", "Authorization": "Basic ZmllbGRjYWw6d3Jvbmc="}
        assert asked(url(served) + path, method, wrong, body)[0] in TURNED_AWAY, path


def test_a_web_page_of_another_origin_is_turned_away(served: Path) -> None:
    """Neither before the request, nor by one that a browser sends without asking."""
    wanted = {"Origin": FOREIGN, "Access-Control-Request-Method": "POST"}
    status, headers = asked(f"{url(served)}/deployments/filter", "OPTIONS", wanted)
    assert status == 400
    assert not {name for name in headers if name.lower() == "access-control-allow-origin"}
    simple = {"Origin": FOREIGN, "Content-Type": "text/plain"}
    status, headers = asked(f"{url(served)}/deployments/filter", "POST", simple, {})
    assert status in TURNED_AWAY
    assert not {name for name in headers if name.lower() == "access-control-allow-origin"}


def test_a_browser_that_holds_the_secret_needs_a_token_of_the_page_too(served: Path) -> None:
    import base64

    entry = {"Authorization": f"Basic {base64.b64encode(secret(served).encode()).decode()}"}
    assert asked(f"{url(served)}/version", "GET", entry)[0] == 200
    entry["Content-Type"] = "application/json"
    assert asked(f"{url(served)}/deployments/filter", "POST", entry, {})[0] == 403


def test_an_event_stream_without_the_secret_is_closed(served: Path) -> None:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    address = f"{url(served).replace('http', 'ws', 1)}/events/in"
    with connect(address, subprotocols=[Subprotocol("prefect")], proxy=None) as stream:
        stream.send(json.dumps({"type": "auth", "token": "fieldcal:wrong"}))
        with pytest.raises(ConnectionClosed):
            stream.recv(timeout=10)


def test_the_secret_is_in_one_file_that_nobody_else_reads(served: Path) -> None:
    kept = home_of(served, serving=True) / SECRET_FILE
    shown = secret(served).encode()
    assert len(shown) > 40
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert stat.S_IMODE(kept.parent.stat().st_mode) == 0o700
    assert [path for path in served.rglob("*") if path.is_file() and shown in path.read_bytes()] == [kept]
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            assert shown not in process.read_bytes()
        except OSError:
            continue


def test_the_server_is_closed_whatever_else_is_set_and_its_database_bounded(served: Path) -> None:
    from prefect.client.orchestration import get_client

    with inside(served), get_client(sync_client=True) as client:
        shown = client._client.get("/admin/settings")
    assert secret(served) not in shown.text
    server = shown.json()["server"]
    assert server["api"]["csrf_protection_enabled"]
    assert server["api"]["cors_allowed_origins"] == url(served).removesuffix("/api")
    assert server["events"]["retention_period"] in ("P1D", 86_400.0)
    assert set(server["services"]["db_vacuum"]["enabled"]) == {"events", "flow_runs"}


def test_every_server_has_a_secret_of_its_own(tmp_path: Path) -> None:
    (tmp_path / f".{SECRET_FILE}.{os.getpid()}").write_text("left behind, open to all")
    first = new_secret(tmp_path)
    assert kept_secret(tmp_path) == first
    assert new_secret(tmp_path) != first
    assert [path.name for path in tmp_path.iterdir()] == [SECRET_FILE]
    assert stat.S_IMODE((tmp_path / SECRET_FILE).stat().st_mode) == 0o600


def test_what_listens_where_a_server_was_is_never_asked(tmp_path: Path) -> None:
    """Whoever takes the port of a server that has ended would be shown the secret."""
    heard = []

    class Squatter(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            heard.append(self.path)
            self.send_response(200)
            self.end_headers()

    home = home_of(tmp_path, serving=True)
    home.mkdir(parents=True)
    new_secret(home)
    with HTTPServer(("127.0.0.1", 0), Squatter) as squatter:
        threading.Thread(target=squatter.serve_forever, daemon=True).start()
        (home / ADDRESS).write_text(json.dumps({"url": f"http://127.0.0.1:{squatter.server_port}/api"}))
        assert serving_address(tmp_path) is None
        squatter.shutdown()
    assert heard == []


def test_trigger_takes_only_folders_inside_the_archives(place: Path, served: Path) -> None:
    calls = [["trigger", str(folder)] for folder in outside_folders(place).values() if folder.is_dir()]
    (own,) = [path for path in (place / "archive").glob("sim-1/*") if not path.is_symlink()]
    calls.append(["trigger", str(own), "--config", str(place / "elsewhere" / "fieldcal.toml")])
    codes, told = in_one_process([({}, [*call, "--warehouse", str(served)]) for call in calls])
    assert codes == [2] * len(calls)
    assert len(told) == len(calls)
    assert all("inside the archives that are served" in line and "fieldcal session" in line for line in told[:-1])
    assert "fieldcal serve was started with config" in told[-1]


def test_the_folder_inside_is_found_past_links_and_dots(place: Path, tmp_path: Path) -> None:
    archive = place / "archive"
    (own,) = [path for path in archive.glob("sim-1/*") if not path.is_symlink()]
    (tmp_path / "link").symlink_to(archive)
    assert archive_of(tmp_path / "link" / "sim-1" / ".." / "sim-1" / own.name, [archive]) == (archive, own)
    assert archive_of(own, [tmp_path / "link"]) == (tmp_path / "link", tmp_path / "link" / "sim-1" / own.name)
    assert archive_of(own, [archive, archive / "sim-1"])[0] == archive / "sim-1"
    for folder in outside_folders(place).values():
        with pytest.raises(FieldcalError) as caught:
            archive_of(folder, [archive])
        assert caught.value.reason_code == "outside_archives"


def test_a_run_is_bound_to_what_serve_was_given(place: Path, tmp_path: Path) -> None:
    from fieldcal.flows.served import Served, served_landed, served_nightly, served_session

    served = Served(place / "archive", None, tmp_path / "warehouse", None, 1)
    given = served.parameters()
    for folder in outside_folders(place).values():
        with pytest.raises(FieldcalError, match="inside the archives"):
            served_session(served).fn(folder=str(folder), **given)
    (elsewhere,) = (place / "elsewhere").glob("sim-1/*")
    changes = {"archives": ["/"], "warehouse": str(tmp_path / "other"), "config": "/etc/passwd", "workers": 1000}
    for name, value in changes.items():
        with pytest.raises(FieldcalError, match=f"started with {name}"):
            served_session(served).fn(folder=str(elsewhere), **{**given, name: value})
        with pytest.raises(FieldcalError, match=f"started with {name}"):
            served_nightly(served).fn(**{**given, name: value})
    assert list(tmp_path.iterdir()) == []
    assert served_landed(served).name == "session-landed"


def test_an_overwritten_deployment_runs_nothing_of_its_own(place: Path, served: Path, tmp_path: Path) -> None:
    """With the secret: steps that pull code, another entrypoint, a run and an event on folders outside."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowFilter, FlowFilterName

    marks = [tmp_path / "pulled", tmp_path / "imported"]
    module = tmp_path / "evil.py"
    module.write_text(f"open({str(marks[1])!r}, 'w')\n")
    pull = {"prefect.deployments.steps.run_shell_script": {"script": f"touch {marks[0]}"}}
    overwritten = {"pull_steps": [pull], "entrypoint": f"{module}:session", "path": str(tmp_path)}
    folders = outside_folders(place)
    landed = FlowFilter(name=FlowFilterName(any_=["session-landed"]))
    with inside(served), get_client(sync_client=True) as client:
        deployment = client.read_deployment_by_name(f"session/{DEPLOYMENT}")
        client._client.patch(f"/deployments/{deployment.id}", json=overwritten)
        assert client.read_deployment(deployment.id).pull_steps == [pull]
        event = {
            "occurred": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "event": EVENT,
            "resource": {"prefect.resource.id": "fieldcal.session"},
            "payload": {"folder": str(folders["link"])},
            "id": str(uuid4()),
        }
        client._client.post("/events", json=[event])
        asked_for = client.create_flow_run_from_deployment(deployment.id, parameters={"folder": str(folders["beside"])})
        ended = wait_for(lambda: (now := client.read_flow_run(asked_for.id)).state.is_final() and now)
        assert ended.state.is_failed()
        assert "inside the archives" in str(ended.state.message)
        (by_event,) = wait_for(
            lambda: (found := client.read_flow_runs(flow_filter=landed)) and found[0].state.is_final() and found
        )
        assert by_event.state.is_failed()
        assert "inside the archives" in str(by_event.state.message)
        assert len(client.read_flow_runs(flow_filter=FlowFilter(name=FlowFilterName(any_=["session"])))) == 1
    assert not any(mark.exists() for mark in marks)
    assert not list((served / "tables").rglob("*.parquet"))


def test_serve_registers_its_deployments_anew(place: Path, served: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from prefect.client.orchestration import get_client

    from fieldcal.flows.deploy import register
    from fieldcal.flows.served import Served

    steps = [{"prefect.deployments.steps.set_working_directory": {"directory": "/tmp"}}]
    with inside(served), get_client(sync_client=True) as client:
        found = client.read_deployment_by_name(f"nightly/{DEPLOYMENT}")
        client._client.patch(
            f"/deployments/{found.id}", json={"pull_steps": steps, "parameters": {"archives": ["/"]}, "paused": True}
        )
        assert client.read_deployment(found.id).pull_steps == steps
        given = Served(place / "archive", None, served, None, 1)
        monkeypatch.setenv("DO_NOT_TRACK", "1")
        register(given, "0 3 * * *")
        after = client.read_deployment(found.id)
    assert not after.pull_steps
    assert after.parameters == given.parameters()
    assert not after.paused


@outside_ci
def test_a_stale_secret_is_one_sentence(place: Path, served: Path) -> None:
    """In the file of our own server; in the environment for the user's own; none there."""
    (own,) = [path for path in (place / "archive").glob("sim-1/*") if not path.is_symlink()]
    kept, stale = home_of(served, serving=True) / SECRET_FILE, "fieldcal:of-yesterday"
    right = kept.read_text()
    kept.write_text(stale)
    try:
        calls: list[tuple[dict[str, str], list[str]]] = [
            ({}, ["trigger", str(own), "--warehouse", str(served)]),
            (environment_for(url(served), stale), ["trigger", str(own)]),
            (
                {**environment_for(url(served)), SECRET: ""},
                ["nightly", str(place / "archive"), "--warehouse", str(place)],
            ),
        ]
        codes, told = in_one_process(calls)
    finally:
        kept.write_text(right)
    assert codes == [1, 1, 1]
    assert len(told) == 3
    assert f"does not take the secret that it was shown. The secret in {kept} is not the one" in told[0]
    assert "does not take the secret that it was shown. Set PREFECT_API_AUTH_STRING" in told[1]
    assert "asks for a secret. Set PREFECT_API_AUTH_STRING" in told[2]
    assert "of-yesterday" not in "".join(told)


@outside_ci
def test_serve_leaves_nobody_behind_when_it_is_killed(place: Path, served: Path) -> None:
    from prefect.client.orchestration import get_client

    (own,) = [path for path in (place / "archive").glob("sim-1/*") if not path.is_symlink()]
    server: int = json.loads((home_of(served, serving=True) / ADDRESS).read_text())["pid"]
    with inside(served), get_client(sync_client=True) as client:
        deployment = client.read_deployment_by_name(f"session/{DEPLOYMENT}")
        begun = client.create_flow_run_from_deployment(deployment.id, parameters={"folder": str(own)})
        mark = served / RUNNING / str(begun.id)
        wait_for(mark.exists)
    serving = parent(server)
    left = [pid for pid in processes() if parent(pid) == serving]
    assert len(left) >= 2
    os.kill(serving, signal.SIGKILL)
    give_up = time.monotonic() + GONE_WITHIN_S
    while alive := [pid for pid in left if parent(pid) is not None]:
        assert time.monotonic() < give_up, alive
        time.sleep(0.05)


def processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").glob("[0-9]*")]


def parent(pid: int) -> int | None:
    """Process that started this one; None when it is gone."""
    try:
        state, ppid = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]
    except OSError:
        return None
    return None if state == "Z" else int(ppid)


@outside_ci
def test_nobody_else_gives_work_to_a_dask_cluster_of_ours() -> None:
    from distributed import Client, LocalCluster

    from fieldcal.flows.runners import Parallel, _dask

    with LocalCluster(**{**_dask(Parallel(2, "dask")).cluster_kwargs, "n_workers": 0}) as cluster:
        address = str(cluster.scheduler_address)
        assert address.startswith("tls://127.0.0.1:")
        with pytest.raises((OSError, TypeError)):
            Client(address.replace("tls", "tcp", 1), timeout="2s")
        with pytest.raises((OSError, TypeError)):
            Client(address, timeout="2s")
