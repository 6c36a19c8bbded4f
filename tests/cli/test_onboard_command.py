"""`fieldcal onboard`: sources that compile, with what fieldcal.toml says of the vehicle."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from onboard_support import WARNINGS, needs

from fieldcal.cli.main import run

CONFIG = """
[vehicles."quad-1"]
field = { north_east_down = [20.0, 0.0, 40.0], unit = "uT" }
gravity_sign = "specific_force"
polarity = { magnetometer = [1, 1, -1] }
[vehicles."quad-1".parameters]
ellipsoid_max_condition = 30.0
"""


def test_sources_with_a_vehicles_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    needs("cc")
    config = tmp_path / "fieldcal.toml"
    config.write_text(CONFIG)
    folder = tmp_path / "controller"
    options = ["--vehicle", "quad-1", "--config", str(config), "--imu-rate", "400", "--forgetting", "0.999"]
    assert run(["onboard", str(folder), *options]) == 0
    written = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert written == [folder / f"fieldcal_onboard{end}" for end in (".h", ".c", "_config.h")]
    header = written[2].read_text()
    for told in (
        "configuration, quad-1.",
        "FIELD_NORM 44.721359549995796f",
        "GRAVITY_SIGN -1.0f",
        "MAGNETOMETER_POLARITY {1.0f, 1.0f, -1.0f}",
        "MAX_CONDITION 30.0f",
        "ACCELEROMETER_IN_MEAN 8u",
        "BLOCK_SAMPLES 10 ",
        "FORGETTING 0.999f",
    ):
        assert told in header
    subprocess.run(["cc", *WARNINGS, "-c", folder / "fieldcal_onboard.c", "-o", tmp_path / "onboard.o"], check=True)


def test_wrong_options_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["onboard", str(tmp_path / "none"), "--imu-rate", "0"]) == 2
    assert "rates are positive" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
