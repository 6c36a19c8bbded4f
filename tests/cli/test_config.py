"""`fieldcal config`: what it says of a right and of a wrong file, and that what it prints is true."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from fieldcal.cli.main import run
from fieldcal.config.configuration import Document, load, parse

FLEET = """
[defaults]
profile = "onboard"
method = "joint"
field = { latitude_deg = 52.5, longitude_deg = 13.4 }
[defaults.parameters]
attitude = "svd"
[vehicles."a b"]
units = { gyroscope = "counts" }
lever_arm_m = [0.1, 0, 1e-7]
method = { gyroscope = "serial" }
csv = { separator = ";", imu = { t = "\u00e9\\"x" } }
[vehicles.c]
profile = "paper"
imu_id = "7"
field = { north_east_down = [20, 0, 40], unit = "uT" }
"""


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    (tmp_path / "fieldcal.toml").write_text(FLEET, encoding="utf-8")
    return tmp_path


def said(capsys: pytest.CaptureFixture[str], *tokens: str, code: int = 0) -> tuple[str, str]:
    capsys.readouterr()
    assert run(["config", *tokens]) == code
    told = capsys.readouterr()
    return told.out, told.err


def test_a_right_file_is_counted(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for given in (archive, archive / "fieldcal.toml"):
        out, err = said(capsys, "check", str(given))
        assert "no mistakes" in out
        assert "a b, c" in out
        assert err == ""
    assert json.loads(said(capsys, "check", str(archive), "--json")[0])["vehicles"] == ["a b", "c"]


def test_every_mistake_is_told(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = archive / "fieldcal.toml"
    file.write_text("[vehicles.a]\nworld = 'up'\n[vehicles.b]\nprofil = 'full'\n[alerts]\nidle_days = 0\n")
    out, err = said(capsys, "check", str(file), code=2)
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"fieldcal: {file}: ") for line in lines)
    for part in ("vehicles.a.world", 'did you mean "profile"', "alerts.idle_days"):
        assert sum(part in line for line in lines) == 1, part
    told = json.loads(said(capsys, "check", str(file), "--json", code=2)[0])
    assert told["ok"] is False
    assert [f"fieldcal: {mistake}" for mistake in told["mistakes"]] == lines
    # Every other command says the first, and that there are more.
    assert "And 2 more mistakes" in said(capsys, "show", str(file), code=2)[1]


def test_a_file_that_is_not_there_or_no_toml(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "cannot be read" in said(capsys, "check", str(tmp_path), code=2)[1]
    (tmp_path / "fieldcal.toml").write_text("[vehicles.a\n")
    assert "is not TOML" in said(capsys, "check", str(tmp_path), code=2)[1]


@pytest.mark.parametrize("vehicle", ["a b", "c", "unknown"])
def test_what_is_shown_is_a_file_that_gives_the_same_vehicle(
    archive: Path, capsys: pytest.CaptureFixture[str], vehicle: str
) -> None:
    out, err = said(capsys, "show", str(archive), "--vehicle", vehicle)
    assert set(tomllib.loads(out)["vehicles"]) == {vehicle}
    assert parse(out, None).vehicle(vehicle) == load(archive / "fieldcal.toml").vehicle(vehicle)
    assert ("does not name" in err) == (vehicle == "unknown")


def test_each_value_is_shown_with_where_it_comes_from(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def found(*tokens: str) -> dict[str, tuple[Any, str]]:
        rows = json.loads(said(capsys, "show", str(archive), *tokens, "--json")[0])["settings"]
        return {row["key"]: (row["value"], row["from"]) for row in rows}

    a, c, other = found("--vehicle", "a b"), found("--vehicle", "c"), found()
    own = '[vehicles."a b"]'
    assert a["method.gyroscope"] == ("serial", own)
    assert a["method.magnetometer"] == ("joint", "[defaults]")
    assert a["lever_arm_m"] == ([0.1, 0.0, 1e-7], own)
    assert a["csv.imu.t"][1] == own
    assert a["csv.decimal"] == (None, "default")
    assert a["parameters.attitude"] == ("svd", "[defaults]")
    assert a["parameters.ellipsoid"] == ("two_step", "profile onboard")
    assert a["parameters.vps_min_peak"] == (0.5, "default")
    assert a["field.latitude_deg"] == (52.5, "[defaults]")
    assert c["parameters.ellipsoid"] == ("li", "profile paper")
    assert c["field.north_east_down"] == ([20.0, 0.0, 40.0], "[vehicles.c]")
    assert "field.latitude_deg" not in c
    assert c["imu_id"] == ("7", "[vehicles.c]")
    assert other["profile"] == ("onboard", "[defaults]")
    assert "imu_id" not in other


def test_the_schema_knows_every_key_with_unit_and_limits(capsys: pytest.CaptureFixture[str]) -> None:
    schema = json.loads(said(capsys, "schema")[0])
    assert set(schema["properties"]) == set(Document.model_fields)
    assert schema["additionalProperties"] is False
    parameters = schema["$defs"]["Parameters"]["properties"]
    cutoff = parameters["smoothing_cutoff_hz"]
    assert (cutoff["minimum"], cutoff["maximum"], cutoff["unit"]) == (0.0, 500.0, "Hz")
    assert parameters["attitude"]["enum"] == ["quest", "davenport", "svd", "triad", "euler"]
    assert all(parameter["description"] for parameter in parameters.values())
    units = schema["$defs"]["VehicleTable"]["properties"]["units"]["properties"]
    assert units["gyroscope"]["enum"] == ["counts", "rad/s", "deg/s"]
