"""Workers that share nothing with the night but an object store: a real scheduler, a process each with a home of its
own, one of them killed; a work pool. The results are those of one machine."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import NamedTuple

import pytest
from object_store import keys, machine, running_store, upload
from outside_ci import outside_ci

from fieldcal.batch.documents import Batch
from fieldcal.batch.elsewhere.heard import heard
from fieldcal.batch.elsewhere.same import made_by
from fieldcal.batch.elsewhere.work import FarAnswer, FarBatch, far, take_in, work
from fieldcal.batch.night import plan_night
from fieldcal.batch.steps import STEPS
from fieldcal.cli.main import run
from fieldcal.errors import FieldcalError
from fieldcal.flows.cluster.answers import FarAnswers, taken_in
from fieldcal.flows.cluster.dask import check_versions
from fieldcal.flows.connection import connected
from fieldcal.flows.pool import BATCH_DEPLOYMENT
from fieldcal.flows.run import run_night
from fieldcal.provenance.run_key import code_digest
from fieldcal.remote.archive import local_archive
from fieldcal.remote.cache import FOLDER
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.upkeep.verify import verify

LOGS = "s3://logs/cluster"
N_FLIGHTS = 2
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
    """Two vehicles, a flight each, here and in a store; and what one machine makes of them."""
    folder, root = tmp_path_factory.mktemp("archive"), tmp_path_factory.mktemp("one") / "warehouse"
    write_flights(folder, Experiment(seed=4, duration_s=20.0), vehicles=N_FLIGHTS)
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


@pytest.fixture
def a_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The caches of a worker on another machine, which takes what goes to the scheduler `tcp://elsewhere`."""
    caches = tmp_path / "of-a-worker"

    def answers(scheduler: str, inputs: Sequence[Batch]) -> FarAnswers:
        assert scheduler == "tcp://elsewhere"
        for given in inputs:
            sent = json.loads(json.dumps(far(given)))
            with machine(caches):
                answer = work(sent)
            yield given, json.loads(json.dumps(answer))

    monkeypatch.setattr("fieldcal.flows.nightly.far_dask_answers", answers)
    return caches


ELSEWHERE = {"runner": "dask", "scheduler": "tcp://elsewhere"}


def test_results_come_by_way_of_the_store_and_are_those_of_one_machine(
    whole: Whole, a_worker: Path, tmp_path: Path
) -> None:
    url = "s3://warehouse/elsewhere"
    with machine(tmp_path / "night"):
        root = Warehouse(url).root
        result = run_night(local_archive(LOGS), root, None, None, 3, **ELSEWHERE)
        assert (result["ok"], result["stages_run"]) == (N_FLIGHTS, N_FLIGHTS * len(STEPS))
        assert content_sha256(root) == whole.content
        assert keys(url, "handed-over") == {}
        uploaded = Counter(key.partition("-")[0] for key in keys(url, "objects"))
        assert set(uploaded.values()) == {1}
        again = run_night(local_archive(LOGS), root, None, None, 3, **ELSEWHERE)
        assert (again["ok"], again["stages_run"]) == (N_FLIGHTS, 0)
    assert not list((a_worker / "batches").iterdir())
    with machine(tmp_path / "somebody"):
        assert verify(Warehouse(url).root)["damaged"] == []
        assert Warehouse(url).scan("imu").collect()["flight_id"].n_unique() == N_FLIGHTS


def test_a_worker_with_other_versions_is_named_before_anything_is_computed(whole: Whole, tmp_path: Path) -> None:
    given: FarBatch = {
        "number": 0,
        "root": "s3://warehouse/never",
        "source": {"path": None, "text": ""},
        "jobs": [],
        "code": code_digest(),
        "logs": {},
        "made_by": {**made_by(), "Python": "3.99", "numpy": "2.4.99"},
    }
    with machine(tmp_path):
        answer = work(given)
    told = (
        rf"^Worker .+, process {os.getpid()} has fieldcal (.+), Python 3\.\d+, numpy 2\..+, the night fieldcal \1, "
        r"Python 3\.99, numpy 2\.4\.99: install the same on both, then run it again\.$"
    )
    assert answer["answer"]["error"] is not None
    assert answer["answer"]["error"][0] == "code_changed"
    assert re.match(told, answer["answer"]["error"][1])
    assert not list(tmp_path.iterdir())
    assert keys("s3://warehouse/never") == {}


class Scheduler:
    """A scheduler's answers."""

    def __init__(self, **workers: object) -> None:
        self.workers = workers

    def run(self, function: object, on_error: str) -> dict[str, object]:
        assert (function, on_error) == (made_by, "return")
        return self.workers


def test_all_workers_of_a_scheduler_are_asked_first() -> None:
    check_versions(Scheduler(a=made_by(), b=made_by()))
    check_versions(Scheduler())  # they may come later
    with pytest.raises(FieldcalError, match=r"^Worker b has fieldcal 0\.0\.9, the night "):
        check_versions(Scheduler(a=made_by(), b={**made_by(), "fieldcal": "0.0.9"}))
    with pytest.raises(FieldcalError, match=r"^Worker a does not run this fieldcal \(ModuleNotFoundError"):
        check_versions(Scheduler(a=ModuleNotFoundError("fieldcal"), b=made_by()))


@pytest.mark.parametrize("runner", ["dask", "pool"])
def test_the_command_says_in_one_sentence_which_worker_has_other_versions(
    whole: Whole, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, runner: str
) -> None:
    """Before any batch goes to a scheduler, and by the answer of a pool's worker."""
    older = {**made_by(), "numpy": "2.4.99"}

    def pool(inputs: Sequence[Batch]) -> FarAnswers:
        for given in inputs:
            with machine(tmp_path / "worker"):
                yield given, work({**far(given), "made_by": older})

    monkeypatch.setattr("fieldcal.flows.cluster.dask.scheduler_client", lambda _: nullcontext(Scheduler(w1=older)))
    monkeypatch.setattr("fieldcal.flows.nightly.far_pool_answers", pool)
    where = ["--scheduler", "tcp://elsewhere"] if runner == "dask" else []
    with machine(tmp_path / "night"):
        command = ["nightly", LOGS, "--warehouse", f"s3://warehouse/older-{runner}"]
        assert run([*command, "--runner", runner, *where]) == 1
    *before, told = capsys.readouterr().err.splitlines()
    assert before == [f"{N_FLIGHTS} logs, {N_FLIGHTS} of them new or changed"]
    has = "w1 has .*numpy 2.4.99, the night .*numpy" if runner == "dask" else ".+ has .*, the night .*numpy 2.4.99"
    assert re.search(rf"^fieldcal: Worker {has}.*: install the same on both, then run it again\.$", told)
    with machine(tmp_path / "somebody"):
        assert Warehouse(f"s3://warehouse/older-{runner}").scan("flight").collect().is_empty()


def test_the_night_says_what_its_workers_log(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldcal.flows.cluster.answers.run_take_in", lambda number, worker, root, answer: answer)
    given: Batch = {"number": 0, "root": "/nowhere", "source": {}, "jobs": [], "code": ""}
    with heard() as lines:
        logging.getLogger("some.library").warning("the store was slow")
        logging.getLogger("some.library").info("not this")
    logging.getLogger("some.library").warning("nor this")
    answer: FarAnswer = {"answer": {"outcomes": [], "error": None}, "handed": None, "worker": "w", "logged": lines}
    assert [told for told, _ in taken_in(iter([(given, answer)]))] == [given]
    assert capsys.readouterr().err.splitlines()[0] == "Worker w: some.library: the store was slow"


@outside_ci
def test_a_log_that_its_worker_does_not_survive_is_calibrated_by_the_night_and_its_batch_is_whole(
    whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answers(scheduler: str, inputs: Sequence[Batch]) -> FarAnswers:
        yield from ((given, RuntimeError("killed 4 workers")) for given in inputs)

    monkeypatch.setattr("fieldcal.flows.nightly.far_dask_answers", answers)
    with machine(tmp_path):
        root = Warehouse("s3://warehouse/lost").root
        assert run_night(local_archive(LOGS), root, None, None, 3, **ELSEWHERE)["ok"] == N_FLIGHTS
        assert content_sha256(root) == whole.content


def test_readings_that_nobody_published_for_days_are_not_trusted_to_be_there(
    whole: Whole, a_worker: Path, tmp_path: Path
) -> None:
    with machine(tmp_path / "night"):
        root, archive = Warehouse("s3://warehouse/late").root, local_archive(LOGS)
        night = plan_night(archive, root)
        jobs = [job.plain() for job in night.missing()]
        given: Batch = {"number": 0, "root": str(root), "source": night.source, "jobs": jobs, "code": code_digest()}
        sent = far(given)
        with machine(a_worker):
            answer = work(sent)
        take_in(root, answer)
        assert plan_night(archive, root).missing() == []
        for note in (root / "remote" / "handed-over").glob("*/*.json"):
            os.utime(note, (time.time() - 4 * 86400,) * 2)
        assert len(plan_night(archive, root).missing()) == N_FLIGHTS


@outside_ci
def test_workers_that_see_only_the_store_give_the_same_though_one_is_killed(whole: Whole, tmp_path: Path) -> None:
    url, night = "s3://warehouse/cluster", tmp_path / "of-the-night"
    with cluster(tmp_path / "elsewhere", night) as own:
        killed: list[int] = []
        thread = killer(own, killed)
        with machine(night):
            where = {"runner": "dask", "scheduler": own.address}
            result = run_night(local_archive(LOGS), Warehouse(url).root, None, None, 3, **where)
            thread.join()
            assert (result["ok"], result["stages_run"]) == (N_FLIGHTS, N_FLIGHTS * len(STEPS))
            found = verify(Warehouse(url).root)
            assert (found["damaged"], found["content_sha256"]) == ([], whole.content)
            again = run_night(local_archive(LOGS), Warehouse(url).root, None, None, 3, **where)
            assert again["stages_run"] == 0
        assert len(killed) == 1
        assert own.workers[killed[0]].poll() == -signal.SIGKILL
        assert [home.name for home in own.homes if (home / "told").exists()] == []
        others = [home for n, home in enumerate(own.homes) if n not in killed]
        assert all(not list((home / ".cache" / "fieldcal" / "batches").iterdir()) for home in others)
    assert keys(url, "handed-over") == {}


SERVES = "from fieldcal.flows.nightly import batch; batch.serve('fieldcal')"


@outside_ci
def test_a_pool_whose_workers_see_only_the_store_gives_the_same_though_a_flow_run_is_killed(
    whole: Whole, tmp_path: Path, prefect_server: str
) -> None:
    """The deployment is served by a process elsewhere, whose flow runs are processes: the first is killed."""
    home, night, url = tmp_path / "elsewhere", tmp_path / "of-the-night", "s3://warehouse/pool"
    home.mkdir()
    (home / "sitecustomize.py").write_text(TELLS)
    others = {k: v for k, v in os.environ.items() if k != FOLDER and not k.startswith("XDG_")}
    own = {"HOME": str(home), "PYTHONPATH": str(home), "NIGHTS_FOLDER": str(night), "TOLD": str(home / "told")}
    own |= {"PREFECT_HOME": str(home / "prefect"), "PREFECT_API_URL": prefect_server}
    with connected(prefect_server):
        others |= {k: v for k, v in os.environ.items() if k.startswith("PREFECT_API_")}
        served = subprocess.Popen(
            [sys.executable, "-c", SERVES], cwd=home, env={**others, **own}, start_new_session=True
        )
    try:
        wait_for_deployment(prefect_server)
        killed: list[int] = []
        thread = threading.Thread(target=kill_first_batch, args=(home, killed), daemon=True)
        thread.start()
        with machine(night):
            result = run_night(local_archive(LOGS), Warehouse(url).root, None, None, 3, runner="pool")
            thread.join()
            assert (result["ok"], content_sha256(Warehouse(url).root)) == (N_FLIGHTS, whole.content)
        assert len(killed) == 1
        assert not (home / "told").exists()
        assert keys(url, "handed-over") == {}
    finally:
        os.killpg(served.pid, signal.SIGKILL)
        served.wait()


def wait_for_deployment(url: str) -> None:
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    give_up = time.monotonic() + 60
    with connected(url), get_client(sync_client=True) as client:
        while True:
            try:
                client.read_deployment_by_name(BATCH_DEPLOYMENT)
                return
            except ObjectNotFound:
                assert time.monotonic() < give_up
                time.sleep(0.2)


def kill_first_batch(home: Path, killed: list[int]) -> None:
    """Kill the process that has the first data root of a batch open."""
    give_up = time.monotonic() + 120
    while time.monotonic() < give_up and not killed:
        for root in (home / ".cache" / "fieldcal" / "batches").glob("[!.]*"):
            for descriptor in Path("/proc").glob("[0-9]*/fd/*"):
                try:
                    if os.readlink(descriptor) == str(root):
                        killed.append(int(descriptor.parts[2]))
                        os.kill(killed[0], signal.SIGKILL)
                        return
                except OSError:
                    continue
        time.sleep(0.01)
