"""Where the batches run makes no difference: processes, a Dask cluster, any order of files, hash seed and time zone."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from distributed import LocalCluster
from outside_ci import outside_ci

from fieldcal.batch.steps import STEPS
from fieldcal.errors import FieldcalError
from fieldcal.flight.job import Job
from fieldcal.flows.connection import connected
from fieldcal.flows.pool import hand_over
from fieldcal.flows.run import run_night
from fieldcal.flows.runners import LARGEST_BATCH, LARGEST_BATCH_BYTES, Parallel, batches
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.content import content_sha256

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runners") / "archive"
    write_flights(folder, Experiment(seed=6, duration_s=20.0), vehicles=2, flights=3)
    return folder


@pytest.fixture(scope="module")
def content(archive: Path, tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> str:
    """What one process makes of the archive."""
    root = tmp_path_factory.mktemp("one") / "warehouse"
    assert run_night(archive, root)["ok"] == 6
    return content_sha256(root)


@pytest.fixture
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as own:
        yield own


def test_a_dask_cluster_gives_the_same(archive: Path, content: str, tmp_path: Path, cluster: LocalCluster) -> None:
    where = {"runner": "dask", "scheduler": cluster.scheduler_address}
    result = run_night(archive, tmp_path, None, None, 2, **where)
    assert (result["ok"], result["stages_run"]) == (6, 6 * len(STEPS))
    assert content_sha256(tmp_path) == content
    with cluster.get_client() as client:
        worked = client.run(lambda: "fieldcal.flows.tasks" in sys.modules)
    assert list(worked.values()) == [True, True]


@outside_ci
def test_every_stage_of_a_batch_is_a_task_of_the_night_in_two_processes(
    archive: Path, content: str, tmp_path: Path, prefect_server: str
) -> None:
    before = set(tasks_of_runs(prefect_server))
    n_batches = len(batches([job(0)] * 6, 2))
    run_night(archive, tmp_path, None, None, 2)
    give_up = time.monotonic() + 20
    while True:
        (own,) = set(tasks_of_runs(prefect_server)) - before
        tasks = tasks_of_runs(prefect_server)[own]
        if tasks["run_stage"] == n_batches * len(STEPS) or time.monotonic() > give_up:
            break
        time.sleep(0.2)
    assert tasks == {"run_stage": n_batches * len(STEPS), "run_batch": n_batches, "run_publish": 2}


def tasks_of_runs(url: str) -> dict[str, Counter[str]]:
    """How many completed tasks of each kind the server knows, by flow run."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import TaskRunFilter, TaskRunFilterFlowRunId

    found: dict[str, Counter[str]] = {}
    with connected(url), get_client(sync_client=True) as client:
        for run in client.read_flow_runs():
            of_run = TaskRunFilter(flow_run_id=TaskRunFilterFlowRunId(any_=[run.id]))
            tasks = client.read_task_runs(task_run_filter=of_run)
            done = [task for task in tasks if task.state is not None and task.state.is_completed()]
            found[str(run.id)] = Counter(task.task_key.split("-")[0] for task in done)
    return found


@outside_ci
def test_a_missing_scheduler_is_told(archive: Path, tmp_path: Path, prefect_server: str) -> None:
    with pytest.raises(FieldcalError, match=r"No Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        run_night(archive, tmp_path, None, None, 2, runner="dask", scheduler="tcp://127.0.0.1:9")


def test_a_missing_work_pool_is_told(archive: Path, tmp_path: Path, prefect_server: str) -> None:
    with pytest.raises(FieldcalError, match="prefect deploy"):
        run_night(archive, tmp_path, None, None, 2, runner="pool")


@outside_ci
@pytest.mark.parametrize(
    ("workers", "seed", "zone"),
    [("2", "1", "Asia/Tokyo"), ("4", "0", "America/New_York")],
)
def test_workers_order_seed_and_time_zone_make_no_difference(
    archive: Path, content: str, tmp_path: Path, workers: str, seed: str, zone: str
) -> None:
    shuffled = tmp_path / "archive"
    for path in sorted(archive.rglob("*"), key=lambda path: path.name, reverse=True):
        if path.is_file():
            target = shuffled / path.relative_to(archive)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    at = ("--warehouse", str(tmp_path / "w"))
    subprocess.run(
        [sys.executable, "-m", "fieldcal", "nightly", str(shuffled), *at, "--workers", workers],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONHASHSEED": seed, "TZ": zone},
        capture_output=True,
        check=True,
    )
    assert content_sha256(tmp_path / "w") == content


def job(number: int) -> Job:
    return Job(f"/a/{number}", f"v/s/{number}", "v", "s", "mcap", None, f"{number:016x}")


@pytest.mark.parametrize(("n_jobs", "workers"), [(0, 2), (1, 1), (3, 2), (200, 2), (1000, 4), (500, 1)])
def test_batches_hold_every_job_once_and_shrink(n_jobs: int, workers: int) -> None:
    jobs = [job(number) for number in range(n_jobs)]
    dealt = batches(jobs, workers)
    sizes = [len(batch) for batch in dealt]
    assert [one for batch in dealt for one in batch] == jobs
    assert sizes == sorted(sizes, reverse=True)
    assert max(sizes, default=0) <= LARGEST_BATCH
    if n_jobs > 4 * workers:
        assert sizes[-1] <= 4


def test_batches_of_large_logs_are_small() -> None:
    third = LARGEST_BATCH_BYTES // 3
    jobs = [replace(job(n), stamp=(size, 1, 2, 3)) for n, size in enumerate([third] * 7 + [10 * third] * 2 + [1] * 3)]
    dealt = batches(jobs, 1)
    assert [one for batch in dealt for one in batch] == jobs
    assert max(sum(one.size_bytes for one in batch) for batch in dealt if len(batch) > 1) <= LARGEST_BATCH_BYTES
    assert [len(batch) for batch in dealt if batch[0].size_bytes > LARGEST_BATCH_BYTES] == [1, 1]


def test_no_log_runs_in_this_process_and_no_process_starts_for_nothing() -> None:
    assert Parallel(1).spawned(50) == 1
    assert Parallel(4).spawned(1) == 1
    assert Parallel(2).spawned(2) == 2
    assert Parallel(2).spawned(0) == Parallel(1, "dask").spawned(1) == 0


def test_an_answer_of_the_pool_is_read_once_and_whole(tmp_path: Path) -> None:
    from fieldcal.flows.pool import _folder, _taken

    root = str(tmp_path)
    hand_over(root, "a", {"outcomes": [], "error": None})
    assert _taken(root, "a", "Completed") == {"outcomes": [], "error": None}
    assert isinstance(_taken(root, "a", "Completed"), FieldcalError)
    hand_over(root, "b", {"outcomes": [], "error": None})
    place = _folder(root) / "b.json"
    place.write_bytes(place.read_bytes().replace(b"[]", b"{}"))
    assert isinstance(_taken(root, "b", "Completed"), FieldcalError)
