"""Hostile names, full and read-only disks, links in circles: what is there stays readable, the reason is a sentence."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from outside_ci import outside_ci

from fieldcal.batch.flights import one_flight
from fieldcal.batch.jobs import find_jobs
from fieldcal.batch.publish_flights import publish_vehicle
from fieldcal.config.configuration import Configuration
from fieldcal.config.find import configuration_of, find_source
from fieldcal.flight.threads import one_thread
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.upkeep.verify import verify

REPOSITORY = Path(__file__).parents[2]
FILE_LIMIT_BYTES = 60_000

FOLDER_NAMES = [
    "plain",
    "two words",
    " leading",
    "trailing ",
    "dots...",
    "x..",
    "a\\b",
    "C:\\x",
    "%2e%2e",
    "%2F%2Fetc",
    "~",
    "~root",
    "_hidden",
    "__HIVE_DEFAULT_PARTITION__",
    "vehicle_id=x",
    "a=b/c".replace("/", "∕"),
    "con",
    "-rf",
    "--warehouse",
    "$(id)",
    "`id`",
    "a;b|c&d",
    "'quoted'",
    '"double"',
    "new\nline",
    "tab\there",
    "bell\a",
    "Ä ö ß",
    "日本語",
    "e\u0301",
    "é",
    "\u202eright to left",
    "🚁",
    "NULL",
    "nan",
    "x" * 200,
]
MAPPED_NAMES = ["../../outside", "/etc/passwd", "a/b/c", "."]
"""No folder can be called so, but a configuration can say so."""


def write_log(path: Path, seed: int) -> None:
    """A small sound log of its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.random.default_rng(seed).normal(size=(60, 9))
    lines = ["t_s,gx,gy,gz,ax,ay,az,mx,my,mz"]
    lines += [f"{row * 0.005:.3f}," + ",".join(f"{v:.6f}" for v in values[row]) for row in range(60)]
    path.write_text("\n".join(lines) + "\n")


def night(archive: Path, root: Path) -> Configuration:
    """Every log through all steps and into the history, without a server."""
    settings = configuration_of(find_source(None, archive))
    published: dict[str, list[Any]] = {}
    with one_thread():
        for job in find_jobs(archive, settings):
            outcome = one_flight(root, job, settings)
            published.setdefault(job.vehicle_id, []).append((job, outcome.records))
    for vehicle_id, flights in published.items():
        publish_vehicle(root, vehicle_id, flights, settings)
    return settings


def test_hostile_names_stay_inside_and_come_back_exactly(tmp_path: Path) -> None:
    names = FOLDER_NAMES + MAPPED_NAMES
    assert len(names) == len(set(names)) >= 40
    archive, root = tmp_path / "archive", tmp_path / "deep" / "er" / "root"
    for seed, name in enumerate(FOLDER_NAMES):
        write_log(archive / name / name[::-1].strip(".") / "log.csv", seed)
    entries = []
    for seed, name in enumerate(MAPPED_NAMES):
        write_log(archive / f"mapped-{seed}" / "s" / "log.csv", 1000 + seed)
        entries.append(f"{{ glob = 'mapped-{seed}/s/log.csv', vehicle = '{name}', session = '{name}' }}")
    (archive / "fieldcal.toml").write_text(f"[archive]\nlogs = [{', '.join(entries)}]\n")
    before = sorted(archive.rglob("*"))
    night(archive, root)
    rows = Warehouse(root).scan("flight").select("vehicle_id", "session_id").collect().rows()
    wanted = [(name, name[::-1].strip(".")) for name in FOLDER_NAMES] + [(name, name) for name in MAPPED_NAMES]
    assert sorted(rows) == sorted(wanted)
    assert sorted(archive.rglob("*")) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["archive", "deep"]
    assert [path.name for path in (tmp_path / "deep" / "er").iterdir()] == ["root"]
    assert all(path.resolve().is_relative_to(root) for path in root.rglob("*"))
    assert verify(root)["ok"]
    signals = Warehouse(root).scan("imu").select("vehicle_id").unique().collect()
    assert set(signals["vehicle_id"]) == set(names)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("disk") / "archive"
    write_flights(folder, Experiment(seed=8, duration_s=20.0, sets=1))
    return folder


@pytest.fixture
def grown(archive: Path, tmp_path: Path) -> tuple[Path, Path, dict[str, Any]]:
    """An archive, a warehouse that knows its first log, and what verify said of it; a second log has come since."""
    own = tmp_path / "archive"
    (own / "sim-1" / "one").mkdir(parents=True)
    (log,) = archive.glob("sim-1/*/flight-01.mcap")
    (own / "sim-1" / "one" / "a.mcap").write_bytes(log.read_bytes())
    (own / "fieldcal.toml").write_bytes((archive / "fieldcal.toml").read_bytes())
    root = tmp_path / "root"
    night(own, root)
    first = verify(root)
    assert first["ok"]
    write_log(own / "sim-1" / "two" / "small.csv", 5)
    second = write_flights(tmp_path / "more", Experiment(seed=9, duration_s=20.0, sets=1))[0]
    (own / "sim-1" / "two" / "b.mcap").write_bytes(second.read_bytes())
    return own, root, first


def still_readable(root: Path, first: dict[str, Any]) -> None:
    after = verify(root)
    assert after["ok"], after["damaged"]
    assert after["content_sha256"] == first["content_sha256"]
    assert Warehouse(root).sql("SELECT count(*) AS n FROM flight")["n"].to_list() == [1]
    assert Warehouse(root).scan("calibration").select(pl.len()).collect().item() > 0
    assert not [path for path in root.rglob("*.tmp") if path.stat().st_size > FILE_LIMIT_BYTES]


LIMITED_NIGHT = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
from fieldcal.cli.main import run
sys.exit(run(["nightly", sys.argv[2], "--warehouse", sys.argv[3]]))
"""


@outside_ci
def test_a_full_disk_ends_the_night_with_a_sentence(
    grown: tuple[Path, Path, dict[str, Any]], prefect_server: str
) -> None:
    own, root, first = grown
    command = [sys.executable, "-c", LIMITED_NIGHT, str(FILE_LIMIT_BYTES), str(own), str(root)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=False)
    assert done.returncode == 1, done.stderr
    told = done.stderr.splitlines()[-1]
    assert str(root) in told
    assert "ulimit -f" in told
    assert "Traceback" not in done.stderr
    still_readable(root, first)


# Everything is imported first: a user without rights may not even reach Python's own folders.
UNPRIVILEGED = """
import json, os, sys
from pathlib import Path
import fieldcal.flight.calibrate, fieldcal.cli.doctor, fieldcal.cli.show, fieldcal.cli.present.night
import fieldcal.warehouse.query, fieldcal.warehouse.questions
from fieldcal.batch.flights import flights
from fieldcal.batch.jobs import find_jobs
from fieldcal.config.find import configuration_of, find_source
from fieldcal.provenance.run_key import code_digest
from fieldcal.cli import main as cli
archive, root = Path(sys.argv[1]), Path(sys.argv[2])
digest = code_digest()
import polars, duckdb, prefect
"".encode("utf-8-sig")
if os.geteuid() == 0:
    os.setegid(65534)
    os.seteuid(65534)
source = find_source(None, archive)
jobs = [job.plain() for job in find_jobs(archive, configuration_of(source))]
answer = flights(str(root), source, jobs, digest)
from fieldcal.warehouse.errors import WarehouseError
print(json.dumps({"error": answer["error"], "code": cli._explained(WarehouseError(*answer["error"]))}))
"""


def test_a_root_that_cannot_be_written_ends_the_night_with_a_sentence(
    grown: tuple[Path, Path, dict[str, Any]],
) -> None:
    own, root, first = grown
    folders = [root, *(path for path in root.rglob("*") if path.is_dir())]
    for path in root.parents:
        if path == Path(tempfile.gettempdir()):
            break
        path.chmod(path.stat().st_mode | 0o055)
    for folder in folders:
        folder.chmod(0o555)
    try:
        command = [sys.executable, "-c", UNPRIVILEGED, str(own), str(root)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=False)
        assert done.returncode == 0, done.stderr
        answer = json.loads(done.stdout)
        code, told = answer["error"]
        assert code == "permission_denied"
        assert str(root) in told
        assert "give this user the right to it or name another --warehouse" in told
        assert answer["code"] == 1
    finally:
        for folder in folders:
            folder.chmod(0o755)
    still_readable(root, first)


def test_a_log_that_may_not_be_read_costs_itself_alone(tmp_path: Path, archive: Path) -> None:
    own = tmp_path / "archive"
    write_log(own / "v" / "s" / "good.csv", 1)
    write_log(own / "v" / "s" / "bad.csv", 2)
    (own / "v" / "s" / "bad.csv").chmod(0)
    settings = configuration_of(find_source(None, own))
    jobs = {Path(job.path).name: job for job in find_jobs(own, settings)}
    assert set(jobs) == {"good.csv", "bad.csv"}
    if os.geteuid() != 0:
        outcome = one_flight(tmp_path / "root", jobs["bad.csv"], settings)
        assert outcome.facts["reason_code"] == "not_readable"
    assert one_flight(tmp_path / "root", jobs["good.csv"], settings).facts["verdict"] == "no_result"


def test_links_in_circles_and_out_of_the_archive_are_not_followed(tmp_path: Path) -> None:
    own = tmp_path / "archive"
    write_log(own / "v" / "s" / "log.csv", 1)
    write_log(tmp_path / "secret" / "s" / "log.csv", 2)
    (own / "v" / "s" / "self.csv").symlink_to(own / "v" / "s" / "self.csv")
    (own / "v" / "s" / "a.csv").symlink_to(own / "v" / "s" / "b.csv")
    (own / "v" / "s" / "b.csv").symlink_to(own / "v" / "s" / "a.csv")
    (own / "v" / "round").symlink_to(own / "v")
    (own / "w").symlink_to(own)
    (own / "x").symlink_to(tmp_path / "secret")
    (own / "v" / "s" / "folder").mkdir()
    (own / "v" / "s" / "folder" / "imu.csv").symlink_to(tmp_path / "secret" / "s" / "log.csv")
    night(own, tmp_path / "root")
    flights = Warehouse(tmp_path / "root").scan("flight").select("log_uri", "verdict").collect()
    secret = [uri for uri in flights["log_uri"] if "x/" in uri or "folder" in uri]
    assert secret == []
    assert "v/s/log.csv" in flights["log_uri"].to_list()
