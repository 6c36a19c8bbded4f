"""A Prefect server for the length of one command, on 127.0.0.1, unless `PREFECT_API_URL` names one.

It runs in a process of its own, which ends when this one does, however that ends. Two commands that start at once wait
for each other while the database is prepared. Prefect must not be imported before `prepare_environment`.
"""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from fieldcal.errors import FieldcalError

START_TIMEOUT_S = 180.0
ANSWER_TIMEOUT_S = 5.0
LAST_RECORDS_S = 1.1

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
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
}


def prepare_environment(root: Path) -> None:
    """Settings that Prefect reads when it is imported; what the user has set stays. Its files go below `root`."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    home = root / "prefect"
    os.environ.setdefault("PREFECT_HOME", str(home.resolve()))
    if Path(os.environ["PREFECT_HOME"]) == home.resolve():
        home.mkdir(parents=True, exist_ok=True)
        home.chmod(0o700)


class Server:
    """The server of one command. `start` returns at once, `wait` when it answers.

    Parameters
    ----------
    root : Path
        Data root; the server's own log is `prefect/server.log` below it.
    """

    def __init__(self, root: Path) -> None:
        self._home = Path(os.environ["PREFECT_HOME"])
        self._log = self._home / "server.log"
        self._process: subprocess.Popen[bytes] | None = None
        self._lock: int | None = None
        self._url = os.environ.get("PREFECT_API_URL")
        self._own = not self._url

    def start(self) -> None:
        """Begin to start the server, if one is needed; Prefect, once imported, finds its address in the environment."""
        if not self._own:
            return
        self._home.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(self._home / "server.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        port = _free_port()
        self._url = f"http://127.0.0.1:{port}/api"
        os.environ["PREFECT_API_URL"] = self._url
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "flows.server", str(port)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env={
                    **os.environ,
                    **{k: os.environ.get(k, v) for k, v in EMBEDDED.items()},
                    "PYTHONPATH": _python_path(),
                },
                start_new_session=True,
            )

    def wait(self) -> str:
        """Wait until the server answers; its address.

        Raises
        ------
        FieldcalError
            `prefect_unavailable`.
        """
        give_up = time.monotonic() + (START_TIMEOUT_S if self._own else ANSWER_TIMEOUT_S)
        while not _answers(f"{self._url}/health"):
            if self._process is not None and self._process.poll() is not None:
                raise FieldcalError("prefect_unavailable", f"The Prefect server could not start; see {self._log}.")
            if time.monotonic() > give_up:
                raise FieldcalError("prefect_unavailable", self._silence())
            time.sleep(0.05)
        self._release()
        return str(self._url)

    def stop(self) -> None:
        """Stop the server, if it is ours, after it had time to write its last records."""
        self._release()
        if self._process is None:
            return
        os.environ.pop("PREFECT_API_URL", None)
        process, self._process = self._process, None
        if process.poll() is None:
            time.sleep(LAST_RECORDS_S)
            process.terminate()
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if process.stdin is not None:
            process.stdin.close()

    def _silence(self) -> str:
        if self._own:
            return f"The Prefect server did not answer within {START_TIMEOUT_S:.0f} s; see {self._log}."
        return (
            f"No Prefect server answers at PREFECT_API_URL={self._url}. Start it (`prefect server start`), or unset "
            "PREFECT_API_URL to use the one that comes with fieldcal."
        )

    def _release(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


@contextmanager
def running_server(root: Path) -> Iterator[Server]:
    """A server that was begun to start; call its `wait` before the first flow."""
    prepare_environment(root)
    with Server(root) as server:
        yield server


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=ANSWER_TIMEOUT_S) as answer:
            return bool(answer.status == 200)
    except (OSError, ValueError, urllib.error.URLError):
        return False


def _python_path() -> str:
    here = str(Path(__file__).resolve().parent.parent)
    return os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])


def _serve(port: int) -> None:
    """Be the server, until the process that started this one closes its end of stdin (or dies)."""

    def watch() -> None:
        sys.stdin.buffer.read()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
    import uvicorn
    from prefect.server.api.server import create_app

    app = create_app(ephemeral=True, final=True)
    uvicorn.run(app, host="127.0.0.1", port=port, log_level="error", lifespan="on", timeout_graceful_shutdown=2)


if __name__ == "__main__":
    _serve(int(sys.argv[1]))
