"""The demo's table beside the truth: the rows that count, each with its error in its own sd."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import fieldcal
from fieldcal.cli.present.demo import beside_truth
from fieldcal.names import SENSORS
from fieldcal.schemas.rows import CalibrationRow
from fieldcal.simulation.archive import Truth
from fieldcal.words.rows import typed


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[CalibrationRow], Truth]:
    archive = tmp_path_factory.mktemp("demo") / "archive"
    (log,) = fieldcal.write_flights(archive, fieldcal.Experiment(seed=9, duration_s=25.0))
    found = fieldcal.calibrate(log)
    truth: Truth = json.loads(Path(log.with_name(log.stem + ".truth.json")).read_text())
    return typed(found.rows.iter_rows(named=True), CalibrationRow), truth


def cells(rows: list[CalibrationRow], truth: Truth) -> list[list[str]]:
    columns = [[str(cell) for cell in column.cells] for column in beside_truth(rows, truth, "flight").columns]
    return [list(line) for line in zip(*columns, strict=True)]


def place(row: CalibrationRow) -> tuple[str, ...]:
    return row["sensor"], row["method"], row["parameter"], row["axis"]


def test_only_rows_that_count_are_shown(flight: tuple[list[CalibrationRow], Truth]) -> None:
    rows, truth = flight
    shown = cells(rows, truth)
    assert len(shown) == len(SENSORS) * 2 * 3
    assert {tuple(line[:4]) for line in shown} <= {place(row) for row in rows if row["status"] == "ok"}
    assert {line[1] for line in shown} == {"joint"}  # a clean flight: what `auto` takes


def test_the_error_is_that_of_the_row_in_its_sd(flight: tuple[list[CalibrationRow], Truth]) -> None:
    rows, truth = flight
    by_place = {place(row): row for row in rows}
    for line in cells(rows, truth):
        sensor, _, parameter, axis = line[:4]
        row = by_place[tuple(line[:4])]
        triad = truth["constants"][sensor]
        true = (triad["scale"] if parameter == "scale" else triad["zero"])["xyz".index(axis)]
        assert row["value"] is not None
        assert row["sd"] is not None
        assert float(line[-1]) == pytest.approx((row["value"] - true) / row["sd"], abs=0.051)


def test_of_several_that_count_the_most_exact_is_shown(flight: tuple[list[CalibrationRow], Truth]) -> None:
    """A serial night publishes equation error and output error side by side."""
    rows, truth = flight
    serial: list[CalibrationRow] = [{**r, "status": "ok", "reason_code": None} for r in rows if r["method"] != "joint"]
    methods = {line[0]: line[1] for line in cells(serial[::-1], truth)}
    assert methods == {
        "magnetometer": "ellipsoid_robust",
        "accelerometer": "ellipsoid_robust",
        "gyroscope": "output_error",
    }


def test_a_refused_constant_is_left_out(flight: tuple[list[CalibrationRow], Truth]) -> None:
    rows, truth = flight
    refused: list[CalibrationRow] = [{**r, "status": "refused"} if r["sensor"] == "gyroscope" else r for r in rows]
    assert {line[0] for line in cells(refused, truth)} == {"magnetometer", "accelerometer"}
