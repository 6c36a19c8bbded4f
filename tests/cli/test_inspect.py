"""`fieldcal inspect` and `fieldcal init`: what they tell agrees with what was written, and what they write holds."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ulog_support import GYRO_ID, parts_of
from ulog_support import flight as ulog_flight

import fieldcal
from fieldcal.cli.main import run
from fieldcal.config.configuration import load, parse
from fieldcal.config.find import CONFIG_NAME
from fieldcal.flight.calibrate import identify
from fieldcal.flight.inspection import inspect_as, inspect_log
from fieldcal.logs import find_logs
from fieldcal.logs.ingest import read_flight, settings_of

DURATION_S, RATE_HZ = 12.0, 185.0
FLOWN = fieldcal.Experiment(seed=3, duration_s=DURATION_S)
PLACE = "field = { latitude_deg = 38.99, longitude_deg = -76.94 }"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Format → a log whose archive has no fieldcal.toml."""
    found = {}
    for kind in ("mcap", "csv", "ulog"):
        archive = tmp_path_factory.mktemp("inspect") / kind
        found[kind] = fieldcal.write_flights(archive, FLOWN, log_format=kind)[0]
        (archive / CONFIG_NAME).unlink()
    return found


@pytest.fixture
def archive(logs: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of the MCAP archive."""
    return Path(shutil.copytree(logs["mcap"].parents[2], tmp_path / "archive"))


def shown(capsys: pytest.CaptureFixture[str], *tokens: str, code: int = 0) -> str:
    capsys.readouterr()
    assert run(tokens) == code
    return capsys.readouterr().out


def document(capsys: pytest.CaptureFixture[str], log: Path, *options: str) -> dict[str, Any]:
    return dict(json.loads(shown(capsys, "inspect", str(log), "--json", *options)))


def write_csv(folder: Path, header: str, readings: np.ndarray, name: str = "log.csv") -> Path:
    """A CSV log at 100 Hz, its time in s from 0."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{i / 100:.2f}," + ",".join(f"{value:.6f}" for value in row) for i, row in enumerate(readings)]
    (folder / name).write_text("\n".join([header, *rows]) + "\n")
    return folder / name


@pytest.mark.parametrize("kind", ["mcap", "csv", "ulog"])
def test_streams_and_clock_are_those_that_were_flown(
    capsys: pytest.CaptureFixture[str], logs: dict[str, Path], kind: str
) -> None:
    found = document(capsys, logs[kind])
    assert (found["log_format"], found["verdict"], found["vehicle_id"]) == (kind, "ok", "sim-1")
    imu = next(stream for stream in found["streams"] if stream["table"] == "imu")
    assert imu["rows"] == pytest.approx(DURATION_S * RATE_HZ, abs=2)
    assert imu["rate_hz"] == pytest.approx(RATE_HZ, rel=0.01)
    assert (imu["first_s"], found["duration_s"]) == (0.0, pytest.approx(DURATION_S, abs=0.02))
    begins = None if kind == "csv" else "2026-01-12T08:00:00+00:00"
    assert found["started_at"] == begins
    assert ("Unix" in found["clock"]) == (kind != "csv")


def test_units_and_frames_say_where_they_are_known_from(
    capsys: pytest.CaptureFixture[str], logs: dict[str, Path], tmp_path: Path
) -> None:
    def told(kind: str, *options: str) -> tuple[set[tuple[str, str]], set[str]]:
        found = document(capsys, logs[kind], *options)
        units = {(one["unit"], one["unit_from"]) for one in found["sensors"]}
        return units, {one["value_from"] for one in found["conventions"]}

    assert told("mcap") == ({("counts", "log")}, {"log"})
    assert told("csv") == ({("unknown", "unknown")}, {"default"})
    units = 'units = { gyroscope = "counts", accelerometer = "counts", magnetometer = "counts" }'
    own = tmp_path / "own.toml"
    own.write_text(f'[defaults]\nworld = "enu"\nbody = "flu"\ngravity_sign = "specific_force"\n{units}\n')
    assert told("csv", "--config", str(own)) == ({("counts", "configuration")}, {"configuration"})


def test_the_median_length_betrays_the_unit(tmp_path: Path) -> None:
    log = write_csv(tmp_path / "v" / "s", "t_s,ax,ay,az", np.tile([0.0, 6.0, 8.0], (50, 1)))
    by_sensor = {str(one.sensor): one for one in inspect_log(log).sensors}
    assert by_sensor["accelerometer"].median_length == pytest.approx(10.0)
    assert (by_sensor["gyroscope"].rows, by_sensor["magnetometer"].rows) == (0, 0)


def test_a_gap_is_shown_and_a_lone_gyroscope_is_not_promised(tmp_path: Path) -> None:
    log = write_csv(tmp_path / "v" / "s", "t_s,gx,gy,gz", np.random.default_rng(1).normal(size=(300, 3)))
    lines = log.read_text().splitlines()
    log.write_text("\n".join([*lines[:101], *lines[201:]]) + "\n")
    found = inspect_log(log)
    assert found.streams[0].longest_gap_s == pytest.approx(1.01)
    assert found.would_do[0].startswith("gyroscope: not calibrated")
    assert found.would_do[-1] == "VPS: none in the log"


def test_an_autopilots_units_on_board_are_listed(capsys: pytest.CaptureFixture[str], logs: dict[str, Path]) -> None:
    listed = {(one["sensor"], one["unit_id"]): one for one in document(capsys, logs["ulog"])["units_on_board"]}
    assert all(one["primary"] and not one["filtered"] and not one["corrected"] for one in listed.values())
    assert ("magnetometer", "1002") in listed
    assert "sensor_mag" in shown(capsys, "inspect", str(logs["ulog"]))


@pytest.mark.parametrize("kind", ["mcap", "csv", "ulog"])
def test_the_lines_state_what_holds_already(logs: dict[str, Path], kind: str) -> None:
    """Pasted as they are they change no setting of the flight and leave nothing to paste but the place."""
    _, plain = identify(logs[kind])
    found = inspect_as(logs[kind], plain)
    pasted = parse('[vehicles."sim-1"]\n' + "\n".join(found.settings), None).vehicle("sim-1")
    before, after = (settings_of(read_flight(logs[kind], vehicle)[1], vehicle) for vehicle in (plain, pasted))
    assert after == before
    again = inspect_as(logs[kind], pasted).settings
    assert [line for line in again if not line.startswith(("#", "polarity."))] == []


def test_a_place_changes_the_field_and_needs_no_line(
    capsys: pytest.CaptureFixture[str], logs: dict[str, Path], tmp_path: Path
) -> None:
    own = tmp_path / "own.toml"
    own.write_text(f"[defaults]\n{PLACE}\n")
    assumed = document(capsys, logs["mcap"])
    placed = document(capsys, logs["mcap"], "--config", str(own))
    assert assumed["field_used"]["source"] == "assumed"
    assert any("latitude_deg" in line for line in assumed["settings"])
    assert "configured place" in placed["field_used"]["source"]
    # Washington, D.C.: about 50 microtesla in all, steeply down
    assert np.linalg.norm(placed["field_used"]["north_east_down"]) == pytest.approx(50.0, abs=2.0)
    assert not any("latitude_deg" in line for line in placed["settings"])


@pytest.mark.parametrize("kind", ["mcap", "csv", "ulog"])
def test_the_screen_is_80_wide_and_its_block_is_toml(
    capsys: pytest.CaptureFixture[str], logs: dict[str, Path], kind: str
) -> None:
    told = shown(capsys, "inspect", str(logs[kind]))
    lines = told.splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) <= 45
    assert list(tomllib.loads(told[told.index("[vehicles.") :])["vehicles"]) == ["sim-1"]


def test_an_unreadable_log_is_rejected_with_its_sentence(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    log = tmp_path / "v" / "s" / "empty.mcap"
    log.parent.mkdir(parents=True)
    log.touch()
    told = shown(capsys, "inspect", str(log), code=3)
    assert "rejected: " in told
    assert json.loads(shown(capsys, "inspect", str(log), "--json", code=3))["reason_code"] == "empty_file"
    assert shown(capsys, "inspect", str(log.with_name("none.mcap")), code=2) == ""


def test_inspect_leaves_everything_as_it_was(capsys: pytest.CaptureFixture[str], archive: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in archive.rglob("*")}
    shown(capsys, "inspect", str(next(archive.rglob("*.mcap"))))
    assert {path: path.stat().st_mtime_ns for path in archive.rglob("*")} == before


@pytest.mark.parametrize("place", ["archive", "beside", "current directory"])
def test_a_configuration_near_the_log_holds_and_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, archive: Path, tmp_path: Path, place: str
) -> None:
    (log,) = archive.rglob("*.mcap")
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    assert document(capsys, log)["configuration"] is None
    places = {"current directory": here, "beside": log.parent, "archive": archive}
    for holder in places.values():  # each above the one before
        (holder / CONFIG_NAME).write_text('[defaults]\nworld = "enu"\n')
        if holder == places[place]:
            break
    file = places[place] / CONFIG_NAME
    told = shown(capsys, "inspect", str(log)).splitlines()
    assert {f"by        {file}", f"by        {os.path.relpath(file)}"} & set(told)
    found = document(capsys, log)
    assert found["configuration"] == str(file)
    assert {"key": "world", "value": "enu", "value_from": "configuration"} in found["conventions"]
    capsys.readouterr()
    run(["calibrate", str(log), "--method", "serial"])
    assert f"Configuration: {file}" in capsys.readouterr().err


def test_parameters_by_which_an_autopilot_corrected_are_shown(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log = tmp_path / "v" / "s" / "f.ulg"
    log.parent.mkdir(parents=True)
    known = {"CAL_GYRO0_ID": GYRO_ID, "CAL_GYRO0_XOFF": 0.125, "CAL_GYRO0_YOFF": 0.0}
    log.write_bytes(b"".join(parts_of(ulog_flight(), parameters=known)))
    told = shown(capsys, "inspect", str(log))
    assert f"applied   gyroscope {GYRO_ID}: CAL_GYRO0_XOFF 0.125\n" in told


def test_init_writes_what_passes_the_check_and_changes_nothing(
    capsys: pytest.CaptureFixture[str], archive: Path
) -> None:
    before = find_logs(archive)
    told = shown(capsys, "init", str(archive))
    written = archive / CONFIG_NAME
    assert written.read_text() == told
    assert shown(capsys, "config", "check", str(archive)).count("no mistakes") == 1
    found = load(written)
    assert found.vehicles == ("sim-1",)
    assert found.vehicle("sim-1") == load(None).vehicle("sim-1")  # so that a night is as without it
    assert find_logs(archive, found.logs) == before
    live = "\n".join(line.removeprefix("# ") for line in told.splitlines() if line.startswith("# units."))
    assert tomllib.loads(live)["units"]["gyroscope"] == "counts"


def test_init_never_writes_over_a_file(capsys: pytest.CaptureFixture[str], archive: Path) -> None:
    (archive / CONFIG_NAME).write_text("# mine\n")
    assert run(["init", str(archive)]) == 2
    assert CONFIG_NAME in capsys.readouterr().err
    assert (archive / CONFIG_NAME).read_text() == "# mine\n"
    (archive / CONFIG_NAME).unlink()
    (archive / CONFIG_NAME).symlink_to(archive.parent / "elsewhere.toml")
    assert run(["init", str(archive)]) == 2
    assert not (archive.parent / "elsewhere.toml").exists()


def test_init_without_logs_says_what_to_do(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "notes.docx").touch()
    assert run(["init", str(tmp_path)]) == 3
    told = capsys.readouterr()
    assert (told.out, "fieldcal doctor --archive" in told.err) == ("", True)
    assert not (tmp_path / CONFIG_NAME).exists()
    assert run(["init", str(tmp_path / "nowhere")]) == 2


def test_init_finds_logs_that_lie_deeper_or_flatter(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    archive = tmp_path / "fleet"
    readings = np.random.default_rng(2).normal(size=(30, 3))
    places = {
        "flat.csv": ("fleet", "flat"),
        "quad/one.csv": ("quad", "quad"),
        "quad/s1/usual.csv": ("quad", "s1"),
        "quad/2026/05-11/deep.CSV": ("quad", "05-11"),
        "wing[1]/2026/05/11/a.csv": ("wing[1]", "2026-05-11"),
        "wing[1]/2026/06/11/b.csv": ("wing[1]", "2026-06-11"),
        "bare/s2/imu.csv": ("bare", "s2"),  # the session's folder is the log
    }
    for place in places:
        write_csv((archive / place).parent, "t_s,ax,ay,az", readings, Path(place).name)
    # what a glob of one star a folder would take too: within a log, and hidden
    write_csv(archive / "quad" / "s1" / "folder", "t_s,ax,ay,az", readings, "imu.csv")
    write_csv(archive / "quad" / ".trash" / "x", "t_s,ax,ay,az", readings)
    shown(capsys, "init", str(archive))
    found = {
        log.log_uri: (log.vehicle_id, log.session_id) for log in find_logs(archive, load(archive / CONFIG_NAME).logs)
    }
    expected = {"bare/s2" if uri == "bare/s2/imu.csv" else uri: ids for uri, ids in places.items()}
    assert found == {**expected, "quad/s1/folder": ("quad", "s1")}


def test_init_bears_hostile_names_and_logs_that_cannot_be_read(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    names = ['a"]\n[alerts]\nidle_days = 1 #', "b\x7f\\", "übermut"]
    for name in names:
        session = tmp_path / name / "s"
        session.mkdir(parents=True)
        (session / 'x"\nidle = 1.mcap').write_bytes(b"no log")
    told = shown(capsys, "init", str(tmp_path))
    assert set(load(tmp_path / CONFIG_NAME).vehicles) == set(names)
    assert told.count("No log can be read") == len(names)


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are UTF-8 there")
def test_init_bears_names_that_are_no_text(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for place in (b"v/s/log.mcap", b"v/s/log\xff.mcap", b"\xff/s/log.mcap", b"v/s/deeper\xff/log.mcap"):
        path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + place))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    told = shown(capsys, "init", str(tmp_path))
    assert load(tmp_path / CONFIG_NAME).vehicles == ("v",)
    assert "rename them: 3 logs" in told


def test_a_date_that_no_field_model_covers_is_told(tmp_path: Path) -> None:
    log = write_csv(tmp_path / "v" / "s", "t_s,mx,my,mz,ax,ay,az", np.random.default_rng(4).normal(size=(40, 6)))
    header, *rows = log.read_text().splitlines()
    in_2005 = [f"{1.12e9 + i / 100:.2f},{row.partition(',')[2]}" for i, row in enumerate(rows)]
    log.write_text("\n".join([header, *in_2005]) + "\n")
    (tmp_path / CONFIG_NAME).write_text(f"[defaults]\n{PLACE}\n")
    found = inspect_log(log)
    assert found.started_at is not None
    assert found.started_at.startswith("2005-06-28")
    assert found.field_used is not None
    assert found.field_used.north_east_down is None
    assert "2005" in found.field_used.source
