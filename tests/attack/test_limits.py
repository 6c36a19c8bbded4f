"""No log takes more of the machine than it may, and none that does costs another its night."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from outside_ci import outside_ci

from fieldcal.batch.limits import watchdog, why_ended
from fieldcal.batch.steps import FlightWork
from fieldcal.config.configuration import Configuration, Document, Limits, LimitsTable, Vehicle, load
from fieldcal.config.reader_settings import reader_settings
from fieldcal.flight.job import Job
from fieldcal.flows.run import dry_run, run_night
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.stages.pipeline import INGEST
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.sealed import seal
from fieldcal.warehouse.upkeep.verify import verify

PATIENCE_S = 20.0
ROWS_TOO_MANY = 600_000
WATCHED = """
import json, os, subprocess, sys, time
program, line, deed = sys.argv[1:]
dog = subprocess.Popen([sys.executable, "-I", "-S", program, str(os.getpid())], stdin=subprocess.PIPE, bufsize=0)
dog.stdin.write(line.encode() + b"\\n")
if deed == "sleep":
    time.sleep(60)
if deed == "count":
    while True:
        pass
if deed == "hoard":
    held = []
    while True:
        held.append(bytearray(b"x") * (1 << 20))
        time.sleep(0.001)
if deed == "be done":
    dog.stdin.write(b"{}\\n")
    time.sleep(1.5)
dog.stdin.close()
print(dog.wait())
"""
"""A process with a watchdog, and what it does then."""


@pytest.mark.parametrize(
    ("deed", "limit"), [("sleep", "seconds"), ("count", "cpu_seconds"), ("hoard", "memory_mb"), ("be done", None)]
)
def test_who_takes_more_than_its_limit_is_killed_and_the_reason_is_written(
    tmp_path: Path, deed: str, limit: str | None
) -> None:
    limits = {"seconds": 60.0, "cpu_seconds": 60.0, "memory_mb": 500.0}
    limits |= {"seconds": 1.0, "cpu_seconds": 0.5, "memory_mb": 100.0} if limit is None else {}
    limits |= {"memory_mb": 100.0} if limit == "memory_mb" else {limit: 0.5} if limit is not None else {}
    place = tmp_path / "ended" / "log.json"
    told = {"work": 1, "place": str(place), "limits": {name: (most, name) for name, most in limits.items()}}
    began = time.monotonic()
    command = [sys.executable, "-c", WATCHED, watchdog.__file__, json.dumps(told), deed]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    if limit is None:
        assert (done.returncode, done.stdout, list(tmp_path.iterdir())) == (0, "0\n", []), done.stderr
    else:
        assert done.returncode == -signal.SIGKILL, done.stderr
        assert [path.read_text() for path in place.parent.iterdir()] == [limit]
        assert time.monotonic() - began < PATIENCE_S / 2


@pytest.mark.skipif(shutil.which("ps") is None, reason="needs ps, as where there is no /proc")
def test_ps_tells_what_proc_tells() -> None:
    cpu_s, held_mb = watchdog.taken(os.getpid())
    told_cpu_s, told_mb = watchdog._told_by_ps(os.getpid())
    assert told_cpu_s == pytest.approx(cpu_s, abs=1.5)
    assert told_mb >= held_mb > 10.0


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight, and beside it, in the same batch, a table of far more rows than the limits allow to go through."""
    folder = tmp_path_factory.mktemp("limits") / "archive"
    write_flights(folder, Experiment(seed=3, duration_s=20.0, sets=1))
    session = folder / "huge" / "s"
    session.mkdir(parents=True)
    axes = [f"{sensor}{axis}" for sensor in "agm" for axis in "xyz"]
    block = "".join(",".join(f"{(n * k) % 997 / 100:.2f}" for k in range(2, 11)) + "\n" for n in range(1000))
    (session / "huge.csv").write_text(",".join(axes) + "\n" + block * (ROWS_TOO_MANY // 1000))
    (folder / "fieldcal.toml").write_text("[vehicles.huge.csv]\nrate_hz = 200\n[limits]\ncpu_seconds = 5\n")
    return folder


@outside_ci
def test_a_night_goes_on_without_the_log_that_takes_too_much_and_remembers_it(
    archive: Path, tmp_path: Path, prefect_server: str
) -> None:
    result = run_night(archive, tmp_path)
    entries: dict[str, Any] = {log["log_uri"]: log for log in result["logs"]}
    huge = entries.pop("huge/s/huge.csv")
    assert (huge["verdict"], huge["reason_code"]) == ("rejected", "over_limits")
    assert "more than the 5 s of the processor" in huge["reason"]
    assert "limits.cpu_seconds" in huge["reason"]
    assert [entry["verdict"] for entry in entries.values()] == ["ok"]
    row = Warehouse(tmp_path).scan("flight").collect().row(0, named=True)
    assert (row["log_uri"], row["verdict"], row["reason_code"]) == ("huge/s/huge.csv", "rejected", "over_limits")
    assert verify(tmp_path)["ok"]
    assert dry_run(archive, tmp_path, None, None)["stages_to_run"] == 0
    raised = archive.parent / "raised.toml"
    raised.write_text((archive / "fieldcal.toml").read_text().replace("= 5", "= 6"))
    planned = dry_run(archive, tmp_path, raised, None)["logs"]
    assert [log["log_uri"] for log in planned if log["would_run"]] == ["huge/s/huge.csv"]


def test_a_note_holds_until_limits_configuration_or_content_change(tmp_path: Path) -> None:
    configuration = load(None)
    vehicle = configuration.vehicle("v")
    job = Job("/a/v/s/log.csv", "v/s/log.csv", "v", "s", "csv", "0" * 64, "0" * 16)
    _note(tmp_path, job, vehicle, configuration.limits)
    assert why_ended(tmp_path, job, vehicle, configuration.limits) == "so"
    other = vehicle.model_copy(update={"world": "enu"})
    assert why_ended(tmp_path, job, other, configuration.limits) is None
    assert why_ended(tmp_path, job, vehicle, Limits(memory_mb=1.0)) is None
    changed = Job(**{**job.plain(), "sha256": "1" * 64})
    assert why_ended(tmp_path, changed, vehicle, configuration.limits) is None
    (tmp_path / "night" / "ended" / f"{job.flight_id}.json").write_text("torn")
    assert why_ended(tmp_path, job, vehicle, configuration.limits) is None


def test_limits_enter_no_run_key(tmp_path: Path) -> None:
    narrow = Configuration(None, Document(limits=LimitsTable(seconds=1.0, cpu_seconds=1.0, memory_mb=1.0)))
    assert reader_settings(narrow.vehicle("v")) == reader_settings(load(None).vehicle("v"))
    assert narrow.vehicle("v").settings() == load(None).vehicle("v").settings()
    job = Job("/a/v/s/log.csv", "v/s/log.csv", "v", "s", "csv", "0" * 64, "0" * 16)
    keys = [FlightWork(tmp_path, job, load(None).vehicle("v"), own).key(INGEST) for own in (None, narrow.limits)]
    assert keys[0] == keys[1]


def _note(root: Path, job: Job, vehicle: Vehicle, limits: Limits) -> None:
    from fieldcal.batch.limits import _circumstances, _place

    place = _place(root, job.flight_id)
    place.parent.mkdir(parents=True)
    place.write_bytes(seal({"of": _circumstances(job, vehicle, limits), "why": "so"}))
