"""The demo's table beside the truth: the rows that count, each with its error in its own sd."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path

import pytest

import fieldcal
from fieldcal.cli.present.constants import constant
from fieldcal.cli.present.demo import beside_truth, first_flight
from fieldcal.names import SENSORS
from fieldcal.schemas.rows import CalibrationRow
from fieldcal.simulation.archive import Truth
from fieldcal.words.measures import measure
from fieldcal.words.rows import typed


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[CalibrationRow], Truth]:
    archive = tmp_path_factory.mktemp("demo") / "archive"
    (log,) = fieldcal.write_flights(archive, fieldcal.Experiment(seed=9, duration_s=25.0))
    found = fieldcal.calibrate(log)
    truth: Truth = json.loads(Path(log.with_name(log.stem + ".truth.json")).read_text())
    return typed(found.rows.iter_rows(named=True), CalibrationRow), truth


def cells(rows: list[CalibrationRow], truth: Truth) -> list[list[str]]:
    return beside_truth(rows, truth, "flight").rows


def by_name(rows: list[CalibrationRow]) -> dict[str, list[CalibrationRow]]:
    found: dict[str, list[CalibrationRow]] = {}
    for row in rows:
        found.setdefault(constant(row["sensor"], row["axis"], row["parameter"]), []).append(row)
    return found


def method_shown(line: list[str], rows: list[CalibrationRow]) -> str:
    """Whose value it is."""
    (own,) = [r["method"] for r in by_name(rows)[line[0]] if measure(r["value"], r["sd"], r["unit"]) == line[1]]
    return own


def test_only_rows_that_count_are_shown(flight: tuple[list[CalibrationRow], Truth]) -> None:
    rows, truth = flight
    shown = cells(rows, truth)
    assert len(shown) == len(SENSORS) * 2 * 3
    assert {method_shown(line, rows) for line in shown} == {"joint"}  # a clean flight: what `auto` takes


def test_the_error_is_that_of_the_row_in_its_sd(flight: tuple[list[CalibrationRow], Truth]) -> None:
    rows, truth = flight
    for line in cells(rows, truth):
        (row,) = [r for r in by_name(rows)[line[0]] if r["method"] == "joint"]
        triad = truth["constants"][row["sensor"]]
        true = (triad["scale"] if row["parameter"] == "scale" else triad["zero"])["xyz".index(row["axis"])]
        assert row["value"] is not None
        assert row["sd"] is not None
        assert float(line[-1]) == pytest.approx((row["value"] - true) / row["sd"], abs=0.051)


def test_of_several_that_count_the_most_exact_is_shown(flight: tuple[list[CalibrationRow], Truth]) -> None:
    """A serial night publishes equation error and output error side by side."""
    rows, truth = flight
    serial: list[CalibrationRow] = [{**r, "status": "ok", "reason_code": None} for r in rows if r["method"] != "joint"]
    methods = {line[0].split()[0]: method_shown(line, serial) for line in cells(serial[::-1], truth)}
    assert methods == {"mag": "ellipsoid_robust", "accel": "ellipsoid_robust", "gyro": "output_error"}


def test_a_refused_constant_is_left_out(flight: tuple[list[CalibrationRow], Truth]) -> None:
    rows, truth = flight
    refused: list[CalibrationRow] = [{**r, "status": "refused"} if r["sensor"] == "gyroscope" else r for r in rows]
    assert {line[0].split()[0] for line in cells(refused, truth)} == {"mag", "accel"}


def test_the_fleet_flew_yesterday_and_when_it_flies_again_as_it_did(tmp_path: Path) -> None:
    now = dt.datetime(2026, 11, 30, 1, 0, tzinfo=dt.UTC)
    assert first_flight(tmp_path, now) == dt.datetime(2026, 11, 1, 8, 0, tzinfo=dt.UTC)
    (tmp_path / "sim-1" / "2026-11-02").mkdir(parents=True)
    assert first_flight(tmp_path, now) == dt.datetime(2026, 11, 2, 8, 0, tzinfo=dt.UTC)
