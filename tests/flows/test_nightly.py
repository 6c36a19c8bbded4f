"""The night end to end on simulated logs: what it leaves, what it re-runs, what it survives."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from older_history import age
from outside_ci import outside_ci

from fieldcal.batch.documents import Batch
from fieldcal.batch.flights import flights
from fieldcal.batch.outcome import Outcome
from fieldcal.batch.steps import STEPS
from fieldcal.cli.main import run
from fieldcal.flows.run import dry_run, run_night
from fieldcal.flows.runners import Answers
from fieldcal.schemas import FLIGHT_TABLES
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import SCALE, Experiment
from fieldcal.stages.joint.information import equations_of
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.warehouse import Warehouse, WarehouseError
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.layout import history_files
from fieldcal.warehouse.store import table_bytes
from fieldcal.warehouse.upkeep.verify import verify

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two vehicles, a short flight each."""
    folder = tmp_path_factory.mktemp("simulated") / "archive"
    write_flights(folder, Experiment(seed=3, duration_s=25.0), vehicles=2, sessions=1, flights=1)
    return folder


@pytest.fixture(scope="session")
def first_night(simulated: Path, tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> tuple[Path, Any]:
    """Warehouse of a night over `simulated`, and its JSON. Not to be changed: copy it."""
    root = tmp_path_factory.mktemp("first") / "warehouse"
    return root, run_night(simulated, root, None, None, 1)


@pytest.fixture
def warehouse(first_night: tuple[Path, Any], tmp_path: Path) -> Path:
    """A copy of the first night's warehouse."""
    return Path(shutil.copytree(first_night[0], tmp_path / "warehouse"))


@pytest.fixture
def archive(simulated: Path, tmp_path: Path) -> Path:
    """A copy of the archive."""
    return Path(shutil.copytree(simulated, tmp_path / "archive"))


def file_hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def ran(result: dict[str, Any], root: Path, before: dict[str, set[str]]) -> set[str]:
    """Names of the stages that have a run folder now and had not before."""
    return {stage for stage, keys in run_folders(root).items() if keys - before.get(stage, set())}


def run_folders(root: Path) -> dict[str, set[str]]:
    folders: dict[str, set[str]] = {}
    for record in (root / "stages").glob("*/*/*/run.json"):
        folders.setdefault(record.parts[-4], set()).add("/".join(record.parts[-3:-1]))
    return folders


def below(*changed: str) -> set[str]:
    """The named stages and all that read from them, directly or not."""
    found = set(changed)
    for stage in PIPELINE:
        if found & {name.split(".")[0] for name in stage.reads.values()}:
            found.add(stage.name)
    return found


def test_a_night_fills_every_table(first_night: tuple[Path, Any]) -> None:
    root, result = first_night
    assert (result["ok"], len(result["logs"])) == (2, 2)
    assert (result["stages_run"], result["stages_cached"]) == (2 * len(STEPS), 0)
    warehouse = Warehouse(root)
    rows = {table: warehouse.scan(table).collect() for table in FLIGHT_TABLES}
    assert all(frame["flight_id"].n_unique() == 2 for frame in rows.values())
    assert set(rows["run"]["stage"]) == set(STEPS)
    assert set(rows["calibration"]["sensor"]) == {"magnetometer", "accelerometer", "gyroscope"}
    assert rows["calibration"]["run_key"].null_count() == 0
    assert rows["flight"]["started_at"].null_count() == 0
    assert rows["flight"]["log_uri"].to_list()[0] == "sim-1/2026-01-12/flight-01.mcap"
    assert warehouse.scan("imu").collect()["flight_id"].n_unique() == 2
    assert verify(root)["ok"]


def test_a_night_leaves_moments_that_refit_solves(first_night: tuple[Path, Any], capsys: Any) -> None:
    root, _ = first_night
    asked = "SELECT sensor, n_samples, json_array_length(sums, '$.sums') AS n FROM moments WHERE vehicle_id = 'sim-1'"
    kept = Warehouse(root).sql(asked).sort("sensor")
    assert kept["sensor"].to_list() == ["accelerometer", "gyroscope", "magnetometer"]
    assert kept["n"].to_list() == [34, 33, 34]
    assert run(["refit", "--vehicle", "sim-1", "--sessions", "2026-01-12", "--json", "--warehouse", str(root)]) == 0
    found = {(r["sensor"], r["parameter"], r["axis"]): r for r in json.loads(capsys.readouterr().out)}
    for sensor, truth in SCALE.items():
        for axis, value in zip("xyz", truth, strict=True):
            row = found[sensor, "scale", axis]
            assert row["method"] == "moments"
            assert abs(row["value"] / value - 1.0) < max(4.0 * row["sd"] / abs(row["value"]), 0.03)


def test_what_each_flight_knows_of_all_constants_is_in_the_history(first_night: tuple[Path, Any]) -> None:
    """As a list for each parameter, in SQL too; with it the flight's rows follow: no prior was known of counts."""
    warehouse = Warehouse(first_night[0])
    rows = warehouse.sql("FROM information ORDER BY flight_id, place")
    calibration = warehouse.scan("calibration").filter(method="joint").collect()
    for (flight_id,), own in rows.group_by("flight_id"):
        found = equations_of(own)
        sd = np.sqrt(np.diagonal(np.linalg.inv(found.information)))
        for (sensor, parameter, axis), value, error in zip(found.names, found.reference, sd, strict=True):
            if parameter not in ("gain", "zero"):
                continue
            name = "scale" if parameter == "gain" else "zero"
            row = calibration.filter(flight_id=flight_id, sensor=sensor, parameter=name, axis=axis).row(0, named=True)
            expected = 1.0 / row["value"] if parameter == "gain" else row["value"]
            expected_sd = row["sd"] / row["value"] ** 2 if parameter == "gain" else row["sd"]
            assert value == pytest.approx(expected, rel=1e-9)
            assert 0.7 < error / expected_sd < 1.4, (sensor, parameter, axis)
    largest = warehouse.sql(
        "SELECT sensor, max(1 / sqrt(information[place + 1]) / abs(linearised_at)) AS least_sd FROM information "
        "WHERE parameter = 'gain' AND status = 'ok' GROUP BY sensor"
    )
    assert (largest["least_sd"] < 0.02).all()
    several = pl.concat([rows.with_columns(flight_id=pl.lit(f"{k}") + pl.col("flight_id")) for k in range(4)])
    one_more = len(table_bytes(several, "information")) - len(table_bytes(several.head(-rows.height), "information"))
    assert one_more < 2 * 4096, "bytes of two flights"


def test_an_unchanged_night_runs_nothing_and_changes_no_byte(simulated: Path, warehouse: Path) -> None:
    before = {part: file_hashes(warehouse / part) for part in ("tables", "stages", "signals", "checksums")}
    result = run_night(simulated, warehouse, None, None, 1)
    assert (result["stages_run"], result["stages_cached"], result["ok"]) == (0, 2 * len(STEPS), 2)
    assert {part: file_hashes(warehouse / part) for part in before} == before


@outside_ci
def test_a_history_of_an_older_release_is_shown_and_brought_up_to_date(simulated: Path, warehouse: Path) -> None:
    before = content_sha256(warehouse), file_hashes(warehouse / "tables")
    young = {
        "flight": ["verifiable", "n_samples", "findings"],
        "calibration": ["temperature_degc"],
        "fit": ["tic_bias"],
        "sync": ["runner_up"],
        "run": ["versions"],
        "drift": ["best_known_at"],
    }
    for table, columns in young.items():
        for path in history_files(warehouse, table):
            age(warehouse, path, table, columns)
    assert content_sha256(warehouse) != before[0]
    flight_id = Warehouse(warehouse).scan("flight").collect()["flight_id"][0]
    for command in (
        "history",
        "drift",
        "report",
        "site",
        "report --vehicle sim-1",
        f"report --flight {flight_id}",
        "export sim-1",
    ):
        assert run([*command.split(), "--warehouse", str(warehouse)]) == 0, command
    result = run_night(simulated, warehouse, None, None, 1)
    assert (result["stages_run"], result["ok"]) == (0, 2)
    shutil.rmtree(warehouse / "tables" / "export")  # the only thing that these commands write
    assert (content_sha256(warehouse), file_hashes(warehouse / "tables")) == before


def test_a_night_on_a_history_that_it_cannot_read_says_what_to_do(simulated: Path, warehouse: Path) -> None:
    content = content_sha256(warehouse)
    paths = history_files(warehouse, "flight")
    age(warehouse, paths[0], "flight", ["verdict"])
    with pytest.raises(
        WarehouseError, match="run `fieldcal upgrade`; move away a file that it leaves, and run the night"
    ) as caught:
        run_night(simulated, warehouse, None, None, 1)
    assert caught.value.reason_code == "schema_mismatch"
    for path in paths:
        path.unlink()
    run_night(simulated, warehouse, None, None, 1)
    assert content_sha256(warehouse) == content
    assert verify(warehouse)["ok"]


@outside_ci
def test_a_changed_cut_off_runs_smoothing_and_what_reads_from_it(archive: Path, warehouse: Path) -> None:
    config = archive / "fieldcal.toml"
    original = config.read_text()
    before, content = run_folders(warehouse), content_sha256(warehouse)
    config.write_text("[defaults.parameters]\nsmoothing_cutoff_hz = 6.0\n\n" + original)
    changed = run_night(archive, warehouse, None, None, 1)
    own = {stage.name for stage in PIPELINE if "smoothing_cutoff_hz" in stage.settings}
    assert ran(changed, warehouse, before) <= below(*own)
    assert ran(changed, warehouse, before) >= {"smoothing", "attitude", "gyro_equation", "verify"}
    assert "manoeuvre" not in ran(changed, warehouse, before)
    assert content_sha256(warehouse) != content
    config.write_text(original)
    assert run_night(archive, warehouse, None, None, 1)["stages_run"] == 0
    assert content_sha256(warehouse) == content


def test_a_deleted_or_edited_result_is_made_again(simulated: Path, warehouse: Path) -> None:
    content = content_sha256(warehouse)
    shutil.rmtree(warehouse / "stages" / "accelerometer")
    edited = next((warehouse / "stages" / "verify").rglob("run.json"))
    edited.write_bytes(edited.read_bytes()[:-1])
    signal_file = next((warehouse / "signals" / "vps").rglob("*.parquet"))
    signal_file.unlink()
    tables = file_hashes(warehouse / "tables")
    result = run_night(simulated, warehouse, None, None, 1)
    assert result["stages_run"] == 2 + 1 + 1
    assert (content_sha256(warehouse), file_hashes(warehouse / "tables")) == (content, tables)
    assert verify(warehouse)["ok"]


def test_bad_logs_cost_themselves_alone(archive: Path, warehouse: Path) -> None:
    session = archive / "sim-1" / "2026-01-12"
    whole = (session / "flight-01.mcap").read_bytes()
    (session / "cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    (session / "empty.mcap").write_bytes(b"")
    (session / "noise.mcap").write_bytes(os.urandom(1000))
    (session / "other.ulg").write_bytes(b"ULog\x01\x12\x35\x01")
    (session / "short.csv").write_text("t_s,gx,gy\n0.0,1,2\n")
    result = run_night(archive, warehouse, None, None, 1)
    verdicts = {Path(log["log_uri"]).name: log["verdict"] for log in result["logs"]}
    assert {name: verdicts[name] for name in ("cut.mcap", "empty.mcap", "noise.mcap", "other.ulg", "short.csv")} == {
        "cut.mcap": "partial",
        "empty.mcap": "rejected",
        "noise.mcap": "rejected",
        "other.ulg": "rejected",
        "short.csv": "rejected",
    }
    assert result["ok"] == 2
    assert all(log["reason_code"] and log["reason"] for log in result["logs"] if log["verdict"] != "ok")
    rows = Warehouse(warehouse).scan("flight").collect()
    assert rows.height == 7
    again = run_night(archive, warehouse, None, None, 1)
    assert again["stages_run"] == 0


def test_a_stage_that_breaks_costs_its_flight_alone(
    archive: Path, warehouse: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fieldcal.batch import steps

    shutil.rmtree(warehouse / "stages" / "vps_sync")
    real = steps.run_stage

    def broken(stage: Any, tables: Any, settings: Any) -> Any:
        if stage.name == "vps_sync" and len(tables["ingest.imu"]) % 2 == odd:
            raise RuntimeError("no such luck")
        return real(stage, tables, settings)

    lengths = Warehouse(warehouse).scan("flight").select("n_samples").collect()["n_samples"].to_list()
    odd = lengths[0] % 2
    struck = sum(length % 2 == odd for length in lengths)

    def here(number: int, inputs: Sequence[Batch], ahead: object = None) -> Answers:
        """Batches in this process, where the stage is broken."""
        for given in inputs:
            yield given, flights(given["root"], given["source"], given["jobs"], given["code"])

    monkeypatch.setattr(steps, "run_stage", broken)
    monkeypatch.setattr("fieldcal.flows.nightly.process_answers", here)
    result = run_night(archive, warehouse, None, None, 1)
    assert (result["partial"], result["ok"]) == (struck, 2 - struck)
    failed = Warehouse(warehouse).scan("run").filter(pl.col("status") == "failed").collect()
    assert failed.height == struck
    assert "no such luck" in failed["measured"][0]
    monkeypatch.undo()
    mended = run_night(archive, warehouse, None, None, 1)
    assert mended["ok"] == 2


def test_a_copy_is_told_and_stored_once(archive: Path, warehouse: Path) -> None:
    session = archive / "sim-1" / "2026-01-12"
    shutil.copy(session / "flight-01.mcap", archive / "sim-1" / "2026-01-12" / "a-copy.mcap")
    result = run_night(archive, warehouse, None, None, 1)
    copy = next(log for log in result["logs"] if log["log_uri"].endswith("a-copy.mcap"))
    assert copy["copy_of"] == "sim-1/2026-01-12/flight-01.mcap"
    assert copy["copy_of"] in copy["reason"]
    assert (result["stages_run"], Warehouse(warehouse).scan("flight").collect().height) == (0, 2)


def test_a_log_that_moves_or_grows_leaves_no_ghost(archive: Path, warehouse: Path) -> None:
    (archive / "sim-2" / "moved").mkdir()
    (archive / "sim-1" / "2026-01-12" / "flight-01.mcap").rename(archive / "sim-2" / "moved" / "flight-01.mcap")
    changed = archive / "sim-2" / "2026-01-12" / "flight-01.mcap"
    data = changed.read_bytes()
    changed.write_bytes(data[: len(data) * 3 // 4])
    run_night(archive, warehouse, None, None, 1)
    rows = Warehouse(warehouse).scan("flight").select("log_uri", "vehicle_id", "verdict").collect()
    assert sorted(rows.iter_rows()) == [
        ("sim-2/2026-01-12/flight-01.mcap", "sim-2", "partial"),
        ("sim-2/moved/flight-01.mcap", "sim-2", "ok"),
    ]


class Bar:
    """A watcher that cannot be pickled, as a progress bar cannot."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.told: list[tuple[str, int]] = []

    def planned(self, flights: int, missing: int, done: int) -> None:
        self.told.append(("planned", missing))

    def done(self, outcome: Outcome) -> None:
        self.told.append((outcome.job.vehicle_id, len(outcome.ran)))


def test_two_processes_give_the_same_content(
    simulated: Path, first_night: tuple[Path, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bar = Bar()
    result = run_night(simulated, tmp_path / "two", None, None, 2, bar)
    assert bar.told[0] == ("planned", 2)
    assert sorted(bar.told[1:]) == [("sim-1", len(STEPS)), ("sim-2", len(STEPS))]
    assert "lost" not in capsys.readouterr().err
    assert (result["ok"], result["stages_run"]) == (2, 2 * len(STEPS))
    assert content_sha256(tmp_path / "two") == content_sha256(first_night[0])
    assert file_hashes(tmp_path / "two" / "tables") == file_hashes(first_night[0] / "tables")


def test_a_session_is_the_night_of_one_folder(simulated: Path, first_night: tuple[Path, Any], tmp_path: Path) -> None:
    root = tmp_path / "warehouse"
    result = run_night(simulated, root, None, simulated / "sim-2" / "2026-01-12", 1)
    assert [log["log_uri"].split("/")[0] for log in result["logs"]] == ["sim-2"]
    run_night(simulated, root, None, simulated / "sim-1" / "2026-01-12", 1)
    assert content_sha256(root) == content_sha256(first_night[0])


def test_a_dry_run_changes_nothing(archive: Path, warehouse: Path, tmp_path: Path) -> None:
    assert dry_run(archive, tmp_path / "nothing", None, None)["stages_to_run"] == 2 * len(STEPS)
    assert not (tmp_path / "nothing").exists()
    shutil.rmtree(warehouse / "stages" / "verify")
    before = file_hashes(warehouse)
    plan = dry_run(archive, warehouse, None, None)
    assert plan["unread"] == []
    would_run = {"verify": "no result yet", "choice": "new input: verify", "composition": "new input: choice"}
    assert [log["would_run"] for log in plan["logs"]] == [would_run] * 2
    assert file_hashes(warehouse) == before


def command(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "fieldcal", *arguments],
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def wait_for_stages(root: Path, count: int, process: subprocess.Popen[bytes]) -> None:
    give_up = time.monotonic() + 60
    while len(list((root / "stages").glob("*/*/*/run.json"))) < count:
        assert process.poll() is None
        assert time.monotonic() < give_up
        time.sleep(0.01)


@outside_ci
@pytest.mark.parametrize("stages_done", [3, 16])
def test_a_killed_night_ends_like_an_uninterrupted_one(
    simulated: Path, first_night: tuple[Path, Any], tmp_path: Path, stages_done: int
) -> None:
    root = tmp_path / "warehouse"
    process = command("nightly", str(simulated), "--warehouse", str(root))
    wait_for_stages(root, stages_done, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    result = run_night(simulated, root, None, None, 1)
    assert result["stages_cached"] >= stages_done
    assert content_sha256(root) == content_sha256(first_night[0])
    assert verify(root)["ok"]


@pytest.mark.parametrize("workers", [pytest.param(1, marks=outside_ci), 2])
def test_an_interrupt_ends_the_night_in_two_seconds(
    simulated: Path, first_night: tuple[Path, Any], tmp_path: Path, workers: int
) -> None:
    where = ("--warehouse", str(tmp_path / "warehouse"), "--workers", str(workers))
    process = command("nightly", str(simulated), *where)
    wait_for_stages(tmp_path / "warehouse", 2, process)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, talk = process.communicate(timeout=10)
    assert time.monotonic() - began < 2.5
    assert process.returncode == 130
    assert b"Interrupted; what is done is kept" in talk
    assert b"Traceback" not in talk
