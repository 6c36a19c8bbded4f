"""The Prefect server of a data root, on 127.0.0.1: started by the first command that needs it, shared by the others.

Every command holds a lock of the operating system while it uses the server, and the server ends when nobody does, so
a killed command leaves nothing behind. With `PREFECT_API_URL` set that server is used and none is started. Prefect must
not be imported before `prepare_environment`.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

import fieldcal
from fieldcal.errors import FieldcalError
from fieldcal.file_locks import fcntl
from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode

START_TIMEOUT_S = 180.0
ANSWER_TIMEOUT_S = 5.0
USERS = "server.users"
ADDRESS = "server.json"

QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_CLI_PROMPT": "false",
    "PREFECT_RESULTS_DEFAULT_SERIALIZER": "json",
    "PREFECT_SERVER_ALLOW_EPHEMERAL_MODE": "false",
}
# The flush interval is whole seconds: Prefect truncates it, and 0 keeps a core busy.
EMBEDDED = {
    "PREFECT_UI_ENABLED": "false",
    "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "200",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_READ_BATCH_SIZE": "200",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
}
# A server for one night needs no events; one that hosts schedules and triggers does.
FOR_A_COMMAND = {
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
}
FOR_SERVING = {"PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED": "events,flow_runs"}


def prepare_environment(root: Path, *, serving: bool = False) -> None:
    """Settings that Prefect reads when it is imported; what the user has set stays. Its files go below `root`."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    home = home_of(root, serving=serving)
    os.environ.setdefault("PREFECT_HOME", str(home))
    if Path(os.environ["PREFECT_HOME"]) == home:
        home.mkdir(parents=True, exist_ok=True)
        home.chmod(0o700)


def home_of(root: Path, *, serving: bool) -> Path:
    """Where Prefect keeps its files. `fieldcal serve` has a server, and a database, of its own."""
    home = root.resolve() / "prefect"
    return home / "serve" if serving else home


def serving_address(root: Path) -> str | None:
    """Address of the server that `fieldcal serve` started for this root; None when none is recorded."""
    return _recorded(home_of(root, serving=True))


class Server:
    """The server as one command uses it. `start` returns at once, `wait` when it answers.

    Parameters
    ----------
    home : Path
        Prefect's folder; the server's own log is `server.log` there.
    serving : bool
        Whether it hosts schedules and triggers.
    """

    def __init__(self, home: Path, *, serving: bool = False) -> None:
        self.own = not os.environ.get("PREFECT_API_URL")
        self._url = os.environ.get("PREFECT_API_URL", "")
        self._home = home.resolve()
        self._serving = serving
        self._process: subprocess.Popen[bytes] | None = None
        self._using: int | None = None
        self._starting: int | None = None

    def start(self) -> None:
        """Take the server that runs, or begin to start one; Prefect, once imported, finds it in the environment."""
        if not self.own:
            return
        self._home.mkdir(parents=True, exist_ok=True)
        self._using = _locked(self._home / USERS, fcntl.LOCK_SH)  # waits while a server is ending
        self._starting = _locked(self._home / "server.lock", fcntl.LOCK_EX)  # waits while another command starts one
        running = _recorded(self._home)
        if running is not None and answers(running):
            self._url = running
        else:
            self._begin()
        os.environ["PREFECT_API_URL"] = self._url

    def wait(self) -> str:
        """Wait until the server answers; its address.

        Raises
        ------
        FieldcalError
            `prefect_unavailable`.
        """
        give_up = time.monotonic() + (START_TIMEOUT_S if self.own else ANSWER_TIMEOUT_S)
        while not answers(self._url):
            if self._process is not None and self._process.poll() is not None:
                raise FieldcalError(
                    ReasonCode.PREFECT_UNAVAILABLE,
                    f"The Prefect server could not start; see {self._home / 'server.log'}.",
                )
            if time.monotonic() > give_up:
                raise FieldcalError(ReasonCode.PREFECT_UNAVAILABLE, self._silence())
            time.sleep(0.05)
        if self._process is not None:
            record = {"url": self._url, "pid": self._process.pid}
            _replace(self._home / ADDRESS, json.dumps(record))
        self._release_start()
        return self._url

    def stop(self) -> None:
        """Use it no longer. A server of ours ends by itself when nobody does."""
        if not self.own:
            return
        self._release_start()
        if self._using is not None:
            os.close(self._using)
            self._using = None
        os.environ.pop("PREFECT_API_URL", None)

    def _release_start(self) -> None:
        if self._starting is not None:
            os.close(self._starting)
            self._starting = None

    def _begin(self) -> None:
        port = _free_port()
        self._url = f"http://127.0.0.1:{port}/api"
        extra = {**EMBEDDED, **(FOR_SERVING if self._serving else FOR_A_COMMAND)}
        with (self._home / "server.log").open("ab") as log:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-m",
                    "fieldcal.flows.server_process",
                    str(port),
                    str(self._home / USERS),
                    *self._kind(),
                ],
                cwd=self._home,  # Prefect's migrations put the current folder on the path, whatever lies there
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={
                    **os.environ,
                    **{name: os.environ.get(name, value) for name, value in extra.items()},
                    "PREFECT_API_URL": self._url,
                    "PREFECT_HOME": str(self._home),
                    "PYTHONPATH": _python_path(),
                },
                start_new_session=True,
            )

    def _kind(self) -> list[str]:
        return ["serving"] if self._serving else []

    def _silence(self) -> str:
        if self.own:
            return f"The Prefect server did not answer within {START_TIMEOUT_S:.0f} s; see {self._home / 'server.log'}."
        return no_answer(self._url)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


@contextmanager
def running_server(root: Path, *, serving: bool = False) -> Iterator[Server]:
    """A server that was begun to start; call its `wait` before the first flow."""
    prepare_environment(root, serving=serving)
    with Server(Path(os.environ["PREFECT_HOME"]), serving=serving) as server:
        yield server


def answers(url: str) -> bool:
    """Whether a Prefect server answers at an API address."""
    try:
        with urllib.request.urlopen(f"{url}/health", timeout=ANSWER_TIMEOUT_S) as answer:
            return bool(answer.status == 200)
    except (OSError, ValueError, urllib.error.URLError):
        return False


def no_answer(url: str) -> str:
    """What to say of a server of the user's own that does not answer."""
    return (
        f"No Prefect server answers at PREFECT_API_URL={url}. Start it (`prefect server start`), or unset "
        "PREFECT_API_URL to use the one that comes with fieldcal."
    )


def _recorded(home: Path) -> str | None:
    """Address of the server that was last started there."""
    try:
        found: Json = json.loads((home / ADDRESS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return str(found["url"]) if isinstance(found, dict) and "url" in found else None


def _replace(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_text(text, encoding="utf-8")
    beside.replace(path)


def _locked(path: Path, how: int) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    fcntl.flock(descriptor, how)
    return descriptor


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _python_path() -> str:
    here = str(Path(fieldcal.__file__).parents[1])
    return os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
