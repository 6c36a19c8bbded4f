"""What is told of tables and views is what they have; and the history as one DuckDB file says what the history says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import duckdb
import polars as pl
import polars.testing
import pytest
from history_rows import flight

from fieldcal.cli.main import run
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.reference import relations
from fieldcal.warehouse.views import AT, VIEWS

KNOWN = relations()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    for vehicle_id in ("a", "7"):
        for day in range(3):
            publish(folder, vehicle_id, flight(vehicle_id, f"{vehicle_id}{day}", day), [f"{vehicle_id}{day}"])
    return folder


@pytest.mark.parametrize("name", [*HISTORY_TABLES, *VIEWS])
def test_columns_are_those_that_are_answered_and_the_example_is_a_question(name: str, root: Path) -> None:
    told = KNOWN[name]
    described = Warehouse(root).sql(f"DESCRIBE SELECT * FROM {AT.get(name, name)}")
    assert [column.name for column in told.columns] == described["column_name"].to_list()
    assert all(column.meaning for column in told.columns)
    assert name in told.example
    Warehouse(root).sql(told.example)


@pytest.mark.parametrize("view", [view for view in VIEWS if view not in AT])
def test_views_are_scanned_as_tables_are(view: str, root: Path) -> None:
    own = Warehouse(root).scan(view).collect()
    polars.testing.assert_frame_equal(own, Warehouse(root).sql(f"FROM {view}"))
    if "vehicle_id" in own.columns:
        narrowed = Warehouse(root).scan(view, vehicle_id="a").collect()
        polars.testing.assert_frame_equal(narrowed, own.filter(vehicle_id="a"))


def test_the_reference_on_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["schemas", "--json"]) == 0
    assert {one["name"] for one in json.loads(capsys.readouterr().out)} == set(KNOWN)
    assert run(["schemas", "calibration", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)
    assert next(column["name"] for column in told["columns"] if column["key"]) == "flight_id"
    assert run(["schemas", "latest_calibration", "--markdown"]) == 0
    assert "| value_at_25degc | double |" in capsys.readouterr().out
    assert run(["schemas"]) == 0
    assert run(["schemas", "sync"]) == 0
    assert 'fieldcal sql "SELECT' in capsys.readouterr().out
    assert run(["schemas", "calibratoin"]) == 2
    assert "there is calibration" in capsys.readouterr().err


def test_the_history_in_one_file(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "deep" / "fleet.duckdb"
    asked = ["export-warehouse", "--duckdb", str(file), "--warehouse", str(root)]
    assert run([*asked, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tables"]["flight"] == 6
    with duckdb.connect(str(file), read_only=True) as engine:
        for name in [*HISTORY_TABLES, *VIEWS]:
            said = AT.get(name, name)
            found = cast(pl.DataFrame, pl.from_arrow(engine.execute(f"FROM {said}").to_arrow_table()))
            own = Warehouse(root).sql(f"FROM {said}")
            assert found.columns == own.columns
            assert sorted(map(str, found.rows())) == sorted(map(str, own.cast(dict(found.schema)).rows()))
        comments = engine.execute("SELECT comment FROM duckdb_columns() WHERE column_name = 'lag_sd_s'").fetchall()
    assert comments[0][0].startswith("[s] ")
    assert run(asked) == 2
    assert "--replace" in capsys.readouterr().err
    assert run([*asked, "--replace"]) == 0
    assert [path.name for path in file.parent.iterdir()] == ["fleet.duckdb"]
