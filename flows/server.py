"""The Prefect server of a data root, on 127.0.0.1: started by the first command that needs it, shared by the others.

Every command holds a lock of the operating system while it uses the server, and the server ends when nobody does, so
a killed command leaves nothing behind. With `PREFECT_API_URL` set that server is used and none is started. Prefect must
not be imported before `prepare_environment`.

Whoever can ask the server can have commands run, so it lets in only those who know its secret, a new one for every
server. The secret is shown to nobody else: the port is taken before anybody is told of it and belongs to the server
until it ends, and an address that was recorded counts only while the server holds a lock that ends with it.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import Self

import fieldcal
from fieldcal.errors import FieldcalError
from fieldcal.file_locks import fcntl
from fieldcal.flows.alive import is_held
from fieldcal.flows.connection import (
    ANSWER_TIMEOUT_S,
    OF_THE_USER,
    SECRET,
    URL,
    answers,
    environment_for,
    kept_secret,
    need_entry,
    new_secret,
    no_answer,
    of_ours,
)
from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode
from fieldcal.warehouse.errors import WarehouseError, disk

START_TIMEOUT_S = 180.0
USERS = "server.users"
LIVES = "server.lives"
ADDRESS = "server.json"
DATABASE = "prefect.db"
ROOM_BYTES = 4_000_000
"""What a database, or its write-ahead log, grows by in a night, generously."""

QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_INTERNAL_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_CLI_PROMPT": "false",
    "PREFECT_CLIENT_MAX_RETRIES": "1",  # with a server that was killed every request waits for all of them, in vain
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
# Events are three quarters of the database, and over once their triggers have heard them.
FOR_SERVING = {
    "PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED": "events,flow_runs",
    "PREFECT_SERVER_EVENTS_RETENTION_PERIOD": "P1D",
}
# Not even the user's own settings open the server to pages of other origins.
CLOSED = {"PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "true"}


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
    """Address of the server that `fieldcal serve` started for this root; None when none lives."""
    return _recorded(home_of(root, serving=True))


def has_served(root: Path) -> bool:
    """Whether `fieldcal serve` ever started a server for this root."""
    return (home_of(root, serving=True) / ADDRESS).exists()


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
        self.own = not os.environ.get(URL)
        self._url = os.environ.get(URL, "")
        self._secret = os.environ.get(SECRET)
        self._home = home.resolve()
        self._serving = serving
        self._process: subprocess.Popen[bytes] | None = None
        self._using: int | None = None
        self._starting: int | None = None
        self._former: dict[str, str | None] = {}

    @property
    def home(self) -> Path:
        """Folder of the server's files."""
        return self._home

    def lives(self) -> bool:
        """Whether it does, as far as the lock tells that a server of ours holds until it ends."""
        return not self.own or is_held(self._home / LIVES)

    def start(self) -> None:
        """Take the server that runs, or begin to start one; Prefect, once imported, finds it in the environment."""
        if self.own:
            self._home.mkdir(parents=True, exist_ok=True)
            # The first waits while a server is ending, the second while another command starts one.
            self._using = _locked(self._home / USERS, fcntl.LOCK_SH)
            self._starting = _locked(self._home / "server.lock", fcntl.LOCK_EX)
            running = _recorded(self._home)
            if running is None:
                self._begin()
            else:
                self._url, self._secret = running, kept_secret(self._home)
        ours = environment_for(self._url, self._secret)
        self._former = {name: os.environ.get(name) for name in ours}
        os.environ.update(ours)

    def wait(self) -> str:
        """Wait until the server answers; its address.

        Raises
        ------
        FieldcalError
            `prefect_unavailable`, `wrong_secret`.
        """
        give_up = time.monotonic() + (START_TIMEOUT_S if self.own else ANSWER_TIMEOUT_S)
        while not answers(self._url):
            if self.own and not is_held(self._home / LIVES):
                raise self._failure("The Prefect server could not start")
            if time.monotonic() > give_up:
                raise FieldcalError(ReasonCode.PREFECT_UNAVAILABLE, self._silence())
            time.sleep(0.05)
        with self.explained():
            need_entry(self._url, of_ours(self._home) if self.own else OF_THE_USER)
        self._release_start()
        return self._url

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Within the block the server's failures are sentences: what the disk refuses it, else where it tells more.

        Raises
        ------
        FieldcalError
            `disk_full` or what else the disk says; `prefect_unavailable`.
        """
        from httpx import HTTPError

        try:
            yield
        except HTTPError as error:
            told = str(error).split(" for url", 1)[0].strip() or type(error).__name__
            raise self._failure(f"The Prefect server failed ({told})") from error

    def _failure(self, what: str) -> FieldcalError:
        if not self.own:
            return FieldcalError(ReasonCode.PREFECT_UNAVAILABLE, f"{what}: {self._url}. Look at its log.")
        try:
            _grow_like_its_database(self._home)
        except WarehouseError as error:
            return FieldcalError(error.reason_code, f"{what}: {error.sentence}")
        return FieldcalError(ReasonCode.PREFECT_UNAVAILABLE, f"{what}; see {self._home / 'server.log'}.")

    def stop(self) -> None:
        """Use it no longer. A server of ours ends by itself when nobody does."""
        self._release_start()
        if self._using is not None:
            os.close(self._using)
            self._using = None
        for name, value in self._former.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        self._former = {}

    def _release_start(self) -> None:
        if self._starting is not None:
            os.close(self._starting)
            self._starting = None

    def _begin(self) -> None:
        extra = {**EMBEDDED, **(FOR_SERVING if self._serving else FOR_A_COMMAND)}
        with ExitStack() as held:
            port = held.enter_context(_port())
            origin = f"http://127.0.0.1:{port.getsockname()[1]}"
            self._url, self._secret = f"{origin}/api", new_secret(self._home)
            _replace(self._home / ADDRESS, json.dumps({"url": self._url}))  # before the lock makes it count
            lives = held.enter_context(open(_locked(self._home / LIVES, fcntl.LOCK_EX)))
            kept = (port.fileno(), lives.fileno())
            with (self._home / "server.log").open("ab") as log:
                self._process = subprocess.Popen(
                    [
                        sys.executable,
                        "-P",
                        "-m",
                        "fieldcal.flows.server_process",
                        str(port.fileno()),
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
                        **environment_for(self._url, self._secret),
                        **CLOSED,
                        "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": origin,
                        "PREFECT_SERVER_API_AUTH_STRING": self._secret,
                        "PREFECT_HOME": str(self._home),
                        "PYTHONPATH": _python_path(),
                    },
                    pass_fds=kept,  # the port, and the lock that says the server lives
                    start_new_session=True,
                )
        _replace(self._home / ADDRESS, json.dumps({"url": self._url, "pid": self._process.pid}))

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


def _grow_like_its_database(home: Path) -> None:
    """Write, for a moment, a file that needs as much of the disk as the server's database needs to grow.

    The server itself cannot always tell: where a file may not grow, its log may not either.

    Raises
    ------
    WarehouseError
        What the disk says.
    """
    with disk(home / DATABASE, "written"), TemporaryFile(dir=home) as file:
        length = max((path.stat().st_size for path in home.glob(f"{DATABASE}*")), default=0)
        file.truncate(length)  # a hole: costs no space, but counts against a limit of a file's length
        file.seek(length)
        file.write(bytes(ROOM_BYTES))
        file.flush()
        os.fsync(file.fileno())


def _recorded(home: Path) -> str | None:
    """Address of the server that runs for `home`; None when none lives, whoever may be at its port now."""
    if not is_held(home / LIVES):
        return None
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


def _port() -> socket.socket:
    """A port of 127.0.0.1 that is taken from now on; nobody is listening yet."""
    port = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    port.bind(("127.0.0.1", 0))
    return port


def _python_path() -> str:
    here = str(Path(fieldcal.__file__).parents[1])
    return os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
