"""Workers that share nothing with the night but an object store: a real scheduler, a process each with a home of its
own, one of them killed; a work pool. The results are those of one machine."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
from object_store import keys, machine, running_store, upload

from fieldcal.flows.run import run_night
from fieldcal.remote.archive import local_archive
from fieldcal.remote.cache import FOLDER
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.upkeep.verify import verify

LOGS = "s3://logs/fleet"
TELLS = """
import os, sys
night, told = os.environ["NIGHTS_FOLDER"], os.environ["TOLD"]

def hook(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and night in str(arguments[0]):
        with_own = os.open(told, os.O_WRONLY | os.O_CREAT | os.O_APPEND) if str(arguments[0]) != told else None
        if with_own is not None:
            os.write(with_own, f"{event} {arguments[0]}\\n".encode())
            os.close(with_own)

sys.addaudithook(hook)
"""
"""A worker tells of whatever it opens of the night's."""


class Whole(NamedTuple):
    archive: Path
    content: str


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> Iterator[Whole]:
    """Two vehicles, two flights each, here and in a store; and what one machine makes of them."""
    folder, root = tmp_path_factory.mktemp("archive"), tmp_path_factory.mktemp("one") / "warehouse"
    write_flights(folder, Experiment(seed=4, duration_s=20.0), vehicles=2, flights=2)
    run_night(folder, root, None, None, 2)
    with running_store():
        upload(folder, LOGS)
        yield Whole(folder, content_sha256(root))


class Cluster(NamedTuple):
    address: str
    workers: list[subprocess.Popen[bytes]]
    homes: list[Path]


@contextmanager
def cluster(folder: Path, nights_folder: Path, code: str = TELLS) -> Iterator[Cluster]:
    """A scheduler and three workers, each a process with a home, a working folder and caches of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with ExitStack() as ended:

        def start(kind: str, own: Path, *words: str) -> subprocess.Popen[bytes]:
            own.mkdir(parents=True)
            (own / "sitecustomize.py").write_text(code)
            others = {k: v for k, v in os.environ.items() if k != FOLDER and not k.startswith(("XDG_", "PREFECT_"))}
            own_environment = {"HOME": str(own), "PYTHONPATH": str(own), "TMPDIR": str(own)}
            told = {"NIGHTS_FOLDER": str(nights_folder), "TOLD": str(own / "told")}
            program = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard", *words]
            process = subprocess.Popen(program, cwd=own, env={**others, **own_environment, **told}, **silent)
            ended.callback(process.wait)
            ended.callback(process.kill)
            return process

        start("scheduler", folder / "scheduler", "--host", "127.0.0.1", "--port", address.rpartition(":")[2])
        homes = [folder / f"worker-{n}" for n in range(3)]
        words = ("--no-nanny", "--nthreads", "1", "--local-directory", "scratch")
        workers = [start("worker", home, address, *words) for home in homes]
        wait_for(address, 3)
        yield Cluster(address, workers, homes)


def wait_for(address: str, n_workers: int) -> None:
    from distributed import Client

    with Client(address, timeout="60s", set_as_default=False) as client:
        client.wait_for_workers(n_workers, timeout=60)


def killer(cluster: Cluster, killed: list[int]) -> threading.Thread:
    """Kills the first worker that is at a batch."""

    def kill() -> None:
        give_up = time.monotonic() + 120
        while time.monotonic() < give_up:
            for n, home in enumerate(cluster.homes):
                if any((home / ".cache" / "fieldcal" / "batches").glob("*/signals")):
                    cluster.workers[n].send_signal(signal.SIGKILL)
                    killed.append(n)
                    return
            time.sleep(0.01)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    return thread


def test_workers_that_see_only_the_store_give_the_same_though_one_is_killed(whole: Whole, tmp_path: Path) -> None:
    url, night = "s3://warehouse/cluster", tmp_path / "of-the-night"
    with cluster(tmp_path / "elsewhere", night) as own:
        killed: list[int] = []
        thread = killer(own, killed)
        with machine(night):
            where = {"runner": "dask", "scheduler": own.address}
            result = run_night(local_archive(LOGS), Warehouse(url).root, None, None, 3, **where)
            thread.join()
            assert (result["ok"], result["stages_run"]) == (4, 4 * 20)
            found = verify(Warehouse(url).root)
            assert (found["damaged"], found["content_sha256"]) == ([], whole.content)
            again = run_night(local_archive(LOGS), Warehouse(url).root, None, None, 3, **where)
            assert again["stages_run"] == 0
            assert not list((Warehouse(url).root / "signals").glob("*/*/*"))  # went by its own way
            assert Warehouse(url).scan("imu").collect().height > 1000
        assert len(killed) == 1
        assert own.workers[killed[0]].poll() == -signal.SIGKILL
        assert [home.name for home in own.homes if (home / "told").exists()] == []
        others = [home for n, home in enumerate(own.homes) if n not in killed]
        assert all(not list((home / ".cache" / "fieldcal" / "batches").iterdir()) for home in others)
    assert keys(url, "handed-over") == {}
