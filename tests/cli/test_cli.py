"""The command line as a user meets it: documents, exit codes, sentences."""

from __future__ import annotations

import ast
import csv
import io
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

import fieldcal
from fieldcal import schemas
from fieldcal.cli.fly import Format
from fieldcal.cli.main import run
from fieldcal.cli.present.night import print_night
from fieldcal.cli.present.screen import console
from fieldcal.exports import FORMATS
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment

REPOSITORY = Path(__file__).parents[2]


def at_rest(path: Path) -> None:
    """Twelve seconds on the bench, at their end turned by 45° about z and back."""
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 12.0, 0.01)
    readings = np.tile([0.0, 0.0, -9.81, 0.0, 0.0, 0.0], (len(t), 1)) + 0.01 * rng.normal(size=(len(t), 6))
    readings[-100:, 5] += np.pi * np.deg2rad(45.0) * np.sin(2.0 * np.pi * t[:100])
    path.parent.mkdir(parents=True)
    names = ["t [s]", *(f"{kind}{axis} [{unit}]" for kind, unit in (("a", "m/s^2"), ("g", "rad/s")) for axis in "xyz")]
    np.savetxt(path, np.column_stack([t, readings]), "%.9g", ",", header=",".join(names), comments="")


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "archive"
    write_flights(folder, Experiment(seed=5, duration_s=25.0))
    (folder / "sim-1" / "2026-01-12" / "empty.mcap").write_bytes(b"")
    at_rest(folder / "bench" / "2026-01-12" / "rest.csv")
    return folder


@pytest.fixture(scope="module")
def log(archive: Path) -> Path:
    return archive / "sim-1" / "2026-01-12" / "flight-01.mcap"


@pytest.fixture(scope="module")
def warehouse(archive: Path, tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> Path:
    root = tmp_path_factory.mktemp("cli") / "warehouse"
    assert run(["nightly", str(archive), "--warehouse", str(root)]) == 3
    return root


def document(capsys: pytest.CaptureFixture[str], *tokens: str, code: int = 0) -> Any:
    """stdout of a command as JSON."""
    capsys.readouterr()
    assert run(tokens) == code
    return json.loads(capsys.readouterr().out)


def sentence(capsys: pytest.CaptureFixture[str], *tokens: str, code: int) -> str:
    """What a failing command says: one line on stderr, nothing on stdout."""
    capsys.readouterr()
    assert run(tokens) == code
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert "Traceback" not in told.err
    return told.err


def test_help_is_quick_and_names_the_commands() -> None:
    began = time.monotonic()
    told = subprocess.run([sys.executable, "-m", "fieldcal", "--help"], cwd=REPOSITORY, capture_output=True, text=True)
    assert time.monotonic() - began < 1.5
    for name in ("demo", "calibrate", "nightly", "session", "history", "sql", "simulate", "verify"):
        assert name in told.stdout


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys; from fieldcal.cli.main import app; "
        "print([m for m in ('prefect', 'polars', 'scipy') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True)
    assert told.stdout == "[]\n"


COMPLETED = """
source /dev/stdin
asked() {
  COMP_WORDS=(fieldcal "$@"); COMP_CWORD=$#; COMPREPLY=()
  _fieldcal fieldcal "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
  echo "${COMPREPLY[*]}"
}
asked nig; asked history --sens; asked drift --sensor gyro; asked alerts te; asked export v --format px
"""


def test_bash_completes_commands_options_and_their_values(capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert run(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    done = subprocess.run(["bash", "-c", COMPLETED], input=script, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["nightly", "--sensor", "gyroscope", "test", "px4"]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_are_completed_too(capsys: pytest.CaptureFixture[str], shell: str) -> None:
    capsys.readouterr()
    assert run(["completion", shell]) == 0
    told = capsys.readouterr().out
    assert "nightly" in told
    assert "--sensor" in told or "-l sensor" in told


def test_every_export_can_be_chosen() -> None:
    (documented,) = re.findall(r"to : \{(.*)\}", str(fieldcal.export.__doc__))
    assert get_args(Format) == tuple(FORMATS)
    assert ast.literal_eval(f"({documented})") == tuple(FORMATS)


def test_calibrate_prints_the_tables_as_one_document(capsys: pytest.CaptureFixture[str], log: Path) -> None:
    found = document(capsys, "calibrate", str(log), "--json")
    assert list(found) == ["flight", "calibration", "fit", "sync", "run"]
    for name in ("flight", "sync"):
        assert set(found[name]) == {column.name for column in schemas.table_columns(name)}
    for name in ("calibration", "fit", "run"):
        assert set(found[name][0]) == {column.name for column in schemas.table_columns(name)}
    assert found["flight"]["vehicle_id"] == "sim-1"
    assert found["flight"]["session_id"] == "2026-01-12"
    truth = json.loads(log.with_name("flight-01.truth.json").read_text())
    own = [row for row in found["calibration"] if row["sensor"] == "magnetometer" and row["status"] == "ok"]
    scale = [row["value"] for row in own if row["parameter"] == "scale"]
    assert scale == pytest.approx(truth["constants"]["magnetometer"]["scale"], rel=0.1)
    assert found["sync"]["lag_s"] == pytest.approx(truth["lag_s"], abs=0.005)


def test_calibrate_shows_a_table_to_people(capsys: pytest.CaptureFixture[str], log: Path) -> None:
    capsys.readouterr()
    assert run(["calibrate", str(log)]) == 0
    told = capsys.readouterr().out
    for word in ("ok", "mag x", "gyro x", "°/s/count", "±", "TIC", "VPS clock: lag"):
        assert word in told


def test_calibrate_says_what_the_night_says(capsys: pytest.CaptureFixture[str], log: Path, warehouse: Path) -> None:
    alone = document(capsys, "calibrate", str(log), "--json")
    query = "SELECT sensor, method, parameter, axis, value, sd FROM calibration"
    night = document(capsys, "sql", query, "--json", "--warehouse", str(warehouse))
    keys = list(night[0])
    assert sorted(map(str, night)) == sorted(str({key: row[key] for key in keys}) for row in alone["calibration"])


def test_parameters_can_be_overruled(capsys: pytest.CaptureFixture[str], log: Path) -> None:
    own = document(capsys, "calibrate", str(log), "--json", "--profile", "onboard", "--set", "ellipsoid=li")
    assert {row["method"] for row in own["calibration"]} == {"ellipsoid", "equation_error"}


def test_a_rejected_log_is_told_and_ends_in_3(capsys: pytest.CaptureFixture[str], archive: Path) -> None:
    found = document(capsys, "calibrate", str(archive / "sim-1/2026-01-12/empty.mcap"), "--json", code=3)
    assert found["flight"]["verdict"] == "rejected"
    assert found["flight"]["reason_code"] == "empty_file"
    assert (found["calibration"], found["fit"], found["sync"]) == ([], [], None)


def test_the_night_as_json(capsys: pytest.CaptureFixture[str], archive: Path, warehouse: Path) -> None:
    found = document(capsys, "nightly", str(archive), "--warehouse", str(warehouse), "--json", code=3)
    print_night(console(), found, warehouse)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("3 logs: 1 ok, 1 no_result, 1 rejected; 0 stages run")
    assert lines[1] == "Fleet: 0 of 2 vehicles fine to fly"
    assert [line for line in lines if len(line) > 80 and not line.startswith(("Report:", "Site:"))] == []
    counts = {"ok", "partial", "no_result", "quarantined", "rejected"}
    assert set(found) - counts - {"stages_run", "stages_cached", "seconds", "logs", "unread"} == {
        "stage_seconds",
        "server_seconds",
        "changes",
        "report",
        "site",
    }
    assert (found["ok"], found["no_result"], found["rejected"], found["stages_run"]) == (1, 1, 1, 0)
    assert {"log_uri", "flight_id", "verdict", "reason_code", "reason"} <= set(found["logs"][0])
    planned = document(
        capsys, "session", str(archive / "sim-1/2026-01-12"), "--warehouse", str(warehouse), "--dry-run", "--json"
    )
    assert (planned["stages_to_run"], len(planned["logs"])) == (0, 2)


def test_a_log_without_any_constant_is_told_with_the_motion_that_it_wanted(
    capsys: pytest.CaptureFixture[str], archive: Path, warehouse: Path
) -> None:
    found = document(capsys, "calibrate", str(archive / "bench/2026-01-12/rest.csv"), "--json", code=3)
    assert (found["flight"]["verdict"], found["flight"]["reason_code"]) == ("no_result", "too_little_motion")
    said = (
        "it turned by at most 0° about x, 0° about y, 45° about z: turn it by 90° or more, to and fro, about x, y, z."
    )
    assert said in found["flight"]["reason"]
    query = "SELECT verdict, reason FROM flight WHERE vehicle_id = 'bench'"
    assert document(capsys, "sql", query, "--json", "--warehouse", str(warehouse)) == [
        {"verdict": "no_result", "reason": found["flight"]["reason"]}
    ]


def test_every_table_fits_80_columns_and_breaks_no_number(
    capsys: pytest.CaptureFixture[str], archive: Path, warehouse: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(warehouse.parent)  # paths are long on their own account
    at, place = ("--warehouse", warehouse.name), os.path.relpath(archive)
    commands = [
        ("calibrate", str(log)),
        ("nightly", place, "--dry-run", *at),
        ("history", *at),
        ("drift", *at),
        ("drift", "--sensor", "fit", *at),
        ("sql", "SELECT * FROM latest_calibration", *at),
        ("sql", "SELECT log_uri, reason FROM flight", *at),
        ("refit", "--vehicle", "sim-1", *at),
        ("schemas",),
        ("schemas", "drift"),
        ("doctor", "--archive", place, *at),
        ("inspect", os.path.relpath(log)),
    ]
    numbers = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")
    for command in commands:
        capsys.readouterr()
        assert run(command) in (0, 3)
        told = capsys.readouterr().out
        assert told
        long = [line for line in told.splitlines() if len(line) > 80]
        assert [line for line in long if not line.startswith("fieldcal sql ")] == [], command  # to be copied
        if "±" not in told or command[0] not in ("history", "drift"):
            continue
        run([*command, "--wide"])
        wide = capsys.readouterr().out
        for line in filter(lambda line: "±" in line, told.splitlines()):
            assert all(number in wide for number in numbers.findall(line)), line


def test_wide_shows_everything(capsys: pytest.CaptureFixture[str], warehouse: Path) -> None:
    capsys.readouterr()
    rows = document(capsys, "drift", "--json", "--warehouse", str(warehouse))
    assert run(["drift", "--wide", "--warehouse", str(warehouse)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert set(told[1].split()) == {*rows[0], "written"}
    assert len([line for line in told if "sim-1" in line]) == len(rows)
    run(["sql", "FROM calibration", "--warehouse", str(warehouse)])
    assert "Not shown:" in capsys.readouterr().out


def test_the_history_in_three_forms(capsys: pytest.CaptureFixture[str], warehouse: Path) -> None:
    asked = ["history", "--warehouse", str(warehouse), "--sensor", "gyroscope", "--parameter", "scale"]
    rows = document(capsys, *asked, "--json")
    assert {row["axis"] for row in rows} == {"x", "y", "z"}
    assert {row["sensor"] for row in rows} == {"gyroscope"}
    run([*asked, "--csv"])
    listed = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [float(row["value"]) for row in listed] == [row["value"] for row in rows]
    assert document(capsys, *asked, "--json", "--since", "2026-02-01") == []
    assert run(asked) == 0
    assert "gyro x scale" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["history", "drift"])
@pytest.mark.parametrize(
    ("option", "misspelt", "nearest"),
    [("--vehicle", "sim1", "there is sim-1"), ("--parameter", "scales", "there is scale"), ("--vehicle", "x", "sim-1")],
)
def test_a_name_that_the_history_does_not_have_is_told_with_the_nearest(
    capsys: pytest.CaptureFixture[str], warehouse: Path, command: str, option: str, misspelt: str, nearest: str
) -> None:
    told = sentence(capsys, command, option, misspelt, "--warehouse", str(warehouse), code=2)
    assert misspelt in told
    assert nearest in told


def test_sql_reads_and_nothing_else(capsys: pytest.CaptureFixture[str], warehouse: Path) -> None:
    at = ("--warehouse", str(warehouse))
    assert document(capsys, "sql", "SELECT count(*) AS n FROM flight", "--json", *at) == [{"n": 3}]
    assert "read" in sentence(capsys, "sql", "DROP TABLE flight", *at, code=2)
    assert "flihgt" in sentence(capsys, "sql", "SELECT * FROM flihgt", *at, code=2)


def test_verify_finds_a_flipped_bit(capsys: pytest.CaptureFixture[str], warehouse: Path, archive: Path) -> None:
    at = ("--warehouse", str(warehouse), "--json")
    sound = document(capsys, "verify", "--archive", str(archive), *at)
    assert sound["ok"]
    path = next((warehouse / "signals" / "imu").rglob("*.parquet"))
    data = path.read_bytes()
    path.write_bytes(data[:1000] + bytes([data[1000] ^ 1]) + data[1001:])
    try:
        assert len(document(capsys, "verify", *at, code=1)["damaged"]) == 1
    finally:
        path.write_bytes(data)
    assert sound["content_sha256"] == document(capsys, "verify", *at)["content_sha256"]


def test_simulate_writes_what_it_is_asked(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    made = ("simulate", str(tmp_path), "--format", "csv", "--duration", "12", "--no-vps", "--json")
    logs = document(capsys, *made, "--lever-arm", "0.05,0.02,-0.03", "--dip-deg", "60", "--seed", "7")["logs"]
    assert [Path(path).name for path in logs] == ["flight-01"]
    assert not (Path(logs[0]) / "vps.csv").exists()
    assert "lever_arm_m = [0.05, 0.02, -0.03]" in (tmp_path / "fieldcal.toml").read_text()
    assert json.loads((Path(logs[0]).parent / "flight-01.truth.json").read_text())["seed"] == 7
    again = [*made, "--lever-arm", "0.05,0.02,-0.03", "--dip-deg", "60", "--seed", "8"]
    assert len(document(capsys, *again)["logs"]) == 1  # the same configuration
    (tmp_path / "fieldcal.toml").write_text("# mine\n")
    assert "stays: give another folder" in sentence(capsys, *again, code=2)
    assert (tmp_path / "fieldcal.toml").read_text() == "# mine\n"


@pytest.mark.parametrize(
    ("tokens", "word"),
    [
        (["nightly"], "ARCHIVE"),
        (["nightyl", "x"], "nightly"),
        (["nightly", "/no/such/folder"], "/no/such/folder"),
        (["session", "/no/such/folder"], "/no/such/folder"),
        (["calibrate", "/no/such/log.mcap"], "/no/such/log.mcap"),
        (["history", "--since", "yesterday", "--warehouse", "."], "--since"),
        (["simulate", "x", "--lever-arm", "1,2"], "--lever-arm"),
        (["simulate", "x", "--lost-share", "1.5"], "--lost-share"),
        (["simulate", "x", "--flights", "1.5"], "--flights"),
        (["nightly", ".", "--workers", "1.5"], "--workers"),
        (["serve", ".", "--workers", "2.5"], "--workers"),
    ],
)
def test_mistakes_in_use_end_in_2(capsys: pytest.CaptureFixture[str], tokens: list[str], word: str) -> None:
    assert word in sentence(capsys, *tokens, code=2)


def test_mistakes_in_the_configuration_end_in_2(
    capsys: pytest.CaptureFixture[str], log: Path, archive: Path, tmp_path: Path
) -> None:
    assert "smoothing_cutoff_hz" in sentence(capsys, "calibrate", str(log), "--set", "smoothing_cutof_hz=3", code=2)
    assert "smoothing_cutoff_hz" in sentence(capsys, "calibrate", str(log), "--set", "smoothing_cutoff_hz=-1", code=2)
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[defaults]\ngravity_mps = 9.81\n")
    told = sentence(capsys, "nightly", str(archive), "--config", str(wrong), "--warehouse", str(tmp_path / "w"), code=2)
    assert "gravity_mps2" in told
    assert not (tmp_path / "w").exists()


def test_an_archive_in_which_nothing_is_recognised_ends_in_3_with_the_next_step(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    unknown = tmp_path / "archive" / "v" / "s" / "flight.tlog"
    unknown.parent.mkdir(parents=True)
    unknown.write_bytes(b"x")
    for tokens in (["nightly", str(tmp_path / "archive")], ["session", str(unknown.parent)]):
        assert run([*tokens, "--dry-run", "--warehouse", str(tmp_path / "w")]) == 3
        told = capsys.readouterr()
        assert "v/s/flight.tlog (no known kind of log)" in told.out
        assert "fieldcal doctor --archive" in told.err


def test_no_warehouse_is_a_failure(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for command in (["history"], ["sql", "SELECT 1"], ["verify"]):
        assert "nightly" in sentence(capsys, *command, "--warehouse", str(tmp_path / "none"), code=1)


def test_a_server_that_does_not_answer_is_named(
    capsys: pytest.CaptureFixture[str], archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    monkeypatch.setattr("fieldcal.flows.server.ANSWER_TIMEOUT_S", 0.3)
    told = sentence(capsys, "nightly", str(archive), "--warehouse", str(tmp_path / "w"), code=1)
    assert "http://127.0.0.1:9/api" in told
