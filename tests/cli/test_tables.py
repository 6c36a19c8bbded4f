"""Tables for people, made of rows: units, digits, bars, and terminals that have ASCII alone."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from report_rows import publish_fleet

from fieldcal.cli.main import run
from fieldcal.cli.present.compared import print_compared
from fieldcal.cli.present.screen import Screen, console, table
from fieldcal.exports.autopilots.comparison import Compared
from fieldcal.words.measures import measure, written


@pytest.fixture(scope="module")
def warehouse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("tables")
    publish_fleet(root, {"alpha": "stable", "bravo": "step", "charlie": "drifting", "echo": "insufficient"}, 8)
    return root


def told(capsys: pytest.CaptureFixture[str], *tokens: str) -> list[str]:
    capsys.readouterr()
    assert run(tokens) == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    ("unit", "shown", "factor"),
    [
        ("rad/s", "°/s", 180.0 / np.pi),
        ("m/s^2", "mg", 1e3 / 9.80665),
        ("m/s²", "mg", 1e3 / 9.80665),
        ("T", "µT", 1e6),
        ("G", "µT", 100.0),
        ("rad/s/degC", "°/s/°C", 180.0 / np.pi),
        ("(rad/s/counts)/degC", "°/s/count/°C", 180.0 / np.pi),
        ("rad/s per m/s^2", "°/s/g", 180.0 / np.pi * 9.80665),
        ("1", "", 1.0),
        ("counts", "counts", 1.0),
        (None, "", 1.0),
    ],
)
def test_units_are_those_that_people_write(unit: str | None, shown: str, factor: float) -> None:
    assert written(unit) == (pytest.approx(factor), shown)


@pytest.mark.parametrize("power", range(-9, 9))
def test_a_value_has_the_digits_that_its_sd_earns(power: int) -> None:
    value, sd = 1.23456 * 10.0**power, 0.0123456 * 10.0**power
    number, plus_minus, shown_sd = measure(value, sd, "norm").replace("(", "").split()[:3]
    exponent = shown_sd.partition(")")[2]
    assert plus_minus == "±"
    assert float(f"{number}{exponent}") == pytest.approx(value, abs=0.05 * sd)
    assert shown_sd.partition(")")[0].replace(".", "").strip("0") == "12"


def test_what_is_not_steady_is_told_and_series_are_drawn(capsys: pytest.CaptureFixture[str], warehouse: Path) -> None:
    at = ("--warehouse", str(warehouse))
    lines = told(capsys, "drift", *at)
    assert max(map(len, lines)) <= 80
    assert any(line.startswith("gyro y zero bias") and "step" in line for line in lines)
    lines = told(capsys, "history", "--vehicle", "charlie", "--sensor", "gyroscope", "--parameter", "zero_bias", *at)
    assert max(map(len, lines)) <= 80
    drawn = [line for line in lines if line.startswith("gyro y") and line.rstrip().endswith(" 8")]
    assert len(drawn) == 1
    assert {"▁", "█"} <= set(drawn[0])


def test_ascii_terminals_are_told_in_ascii_and_within_80(warehouse: Path) -> None:
    plain = {**os.environ, "PYTHONIOENCODING": "ascii", "NO_COLOR": "1"}
    asked = ["history", "--vehicle", "charlie", "--parameter", "zero_bias", "--warehouse", str(warehouse)]
    done = subprocess.run([sys.executable, "-m", "fieldcal", *asked], capture_output=True, env=plain, check=True)
    lines = done.stdout.decode("ascii").splitlines()
    assert max(map(len, lines)) <= 80
    assert any("+-" in line and "deg/s" in line for line in lines)
    assert any("#" in line for line in lines)


def test_what_flies_is_compared_in_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    place = ("accelerometer", "board/1", "x")
    rows = [
        Compared(*place, "zero", "CAL_ACC0_XOFF", -0.98765, -0.4321, 0.0123, "m/s²", 56.6, "mg", True),
        Compared(*place, "scale", "CAL_ACC0_XSCALE", 0.99876, 1.00234, 0.00043, "", 3.58, "mg", False),
        Compared("magnetometer", "board/1", "z", "zero", None, 0.1, float("nan"), float("nan"), "G", None, "", False),
    ]
    print_compared(console(), rows, "quad-1")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any("-44.1 ± 1.3 mg" in line and "56.6 mg" in line for line in lines)
    assert "CAL_ACC0_XOFF (accel x zero)" in " ".join(lines)
    print_compared(console(wide=True), rows, "quad-1")
    assert "CAL_ACC0_XSCALE" in capsys.readouterr().out


def test_columns_that_do_not_fit_are_named() -> None:
    text = io.StringIO()
    screen = Screen()
    screen.file = text
    columns = [f"column_{i}" for i in range(12)]
    screen.print(table(columns, [[f"{i}.123456789" for i in range(12)]]))
    assert "Not shown: column_6" in text.getvalue()
    assert "5.123456789" in text.getvalue()
