"""A warehouse that an older release wrote: read as far as no row needs what it lacks, else refused in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import polars.testing
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from history_rows import flight
from older_history import age, rewrite

from fieldcal.schemas import TABLES
from fieldcal.schemas.rows import may_be_null
from fieldcal.warehouse import Warehouse, WarehouseError
from fieldcal.warehouse.layout import history_path, signal_path
from fieldcal.warehouse.publish import publish, read_history
from fieldcal.warehouse.signals import read_signal, signal_writer
from fieldcal.warehouse.upkeep.verify import verify

READ: dict[str, Callable[[Path, str], pl.DataFrame]] = {
    "polars": lambda root, table: Warehouse(root).scan(table, vehicle_id="a").collect(),
    "sql": lambda root, table: Warehouse(root).sql(f"SELECT * FROM {table} WHERE vehicle_id = 'a'"),
    "whole": lambda root, table: read_history(root, table, "a"),
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two vehicles, a flight each."""
    for vehicle_id in "ab":
        publish(tmp_path, vehicle_id, flight(vehicle_id, f"{vehicle_id}1"), [f"{vehicle_id}1"])
    return tmp_path


@pytest.mark.parametrize("read", READ.values(), ids=READ)
@pytest.mark.parametrize("table", ["flight", "calibration", "run"])
def test_columns_that_a_file_is_older_than_are_null(
    root: Path, table: str, read: Callable[[Path, str], pl.DataFrame]
) -> None:
    """All at once that a row may lack; the others keep values, types and order."""
    young = sorted(may_be_null(table) - {"started_at"})
    before = read(root, table)
    age(root, history_path(root, table, "a"), table, young)
    expected = before.with_columns(pl.lit(None, before.schema[name]).alias(name) for name in young)
    assert any(before[name].null_count() < before.height for name in young)
    polars.testing.assert_frame_equal(read(root, table), expected)
    assert verify(root)["ok"]


@pytest.mark.parametrize("read", READ.values(), ids=READ)
@pytest.mark.parametrize("table", ["calibration", "run"])
def test_rows_from_before_units_were_told_apart_are_of_the_primary_one(
    root: Path, table: str, read: Callable[[Path, str], pl.DataFrame]
) -> None:
    """Their unit is the vehicle's IMU, as it is today where a log tells of one alone."""
    before = read(root, table)
    age(root, history_path(root, table, "a"), table, ["unit_id", "is_primary"])
    assert before["unit_id"].to_list() == before["imu_id"].to_list()
    polars.testing.assert_frame_equal(read(root, table), before)
    publish(root, "a", flight("a", "a2", 1), ["a2"])
    assert read_history(root, table, "a")["unit_id"].null_count() == 0


def test_files_of_both_forms_are_asked_as_one_table(root: Path) -> None:
    age(root, history_path(root, "flight", "a"), "flight", ["verifiable"])
    rows = [("a1", None), ("b1", True)]
    warehouse = Warehouse(root)
    assert warehouse.scan("flight").select("flight_id", "verifiable").sort("flight_id").collect().rows() == rows
    assert warehouse.sql("SELECT flight_id, verifiable FROM flight ORDER BY flight_id").rows() == rows
    assert warehouse.sql("SELECT DISTINCT vehicle_id FROM latest_calibration").height == 2


def test_what_is_published_brings_the_file_up_to_date(root: Path) -> None:
    path = history_path(root, "flight", "a")
    age(root, path, "flight", ["verifiable"])
    publish(root, "a", flight("a", "a2", 1), ["a2"])
    assert read_history(root, "flight", "a").select("flight_id", "verifiable").rows() == [("a1", None), ("a2", True)]
    assert set(pq.read_schema(path).names) == set(TABLES["flight"].column_names)
    publish(root, "a", flight("a", "a1"), ["a1"])
    assert read_history(root, "flight", "a")["verifiable"].to_list() == [True, True]


def test_a_column_that_is_no_longer_is_left_out(root: Path) -> None:
    path = history_path(root, "flight", "a")
    before = read_history(root, "flight", "a")
    rows = pq.read_table(path, partitioning=None)
    rewrite(root, path, rows.append_column("former", pa.array([1.0])), TABLES["flight"].version - 1)
    for read in READ.values():
        polars.testing.assert_frame_equal(read(root, "flight"), before)


@pytest.mark.parametrize("read", READ.values(), ids=READ)
@pytest.mark.parametrize(
    ("table", "change", "version", "told"),
    [
        (
            "flight",
            lambda rows: rows.drop_columns(["verdict"]),
            -1,
            "missing verdict.* version 1, this release knows version 2.* run `fieldcal upgrade`",
        ),
        ("flight", lambda rows: rows.drop_columns(["flight_id"]), -1, "missing flight_id"),
        (
            "flight",
            lambda rows: rows.set_column(
                rows.column_names.index("duration_s"),
                rows.schema.field("duration_s").with_metadata({"unit": "ms"}),
                rows["duration_s"],
            ),
            -1,
            "duration_s is in ms instead of s",
        ),
        (
            "flight",
            lambda rows: rows.set_column(
                rows.column_names.index("n_samples"), "n_samples", rows["n_samples"].cast(pa.float64())
            ),
            -1,
            "n_samples is double instead of int64",
        ),
        (
            "flight",
            lambda rows: rows,
            1,
            "version 3, this release knows version 2.* A newer fieldcal wrote it: update fieldcal",
        ),
    ],
)
def test_what_cannot_be_read_is_refused_with_what_to_do(
    root: Path,
    table: str,
    change: Callable[[pa.Table], pa.Table],
    version: int,
    told: str,
    read: Callable[[Path, str], pl.DataFrame],
) -> None:
    path = history_path(root, table, "a")
    rewrite(root, path, change(pq.read_table(path, partitioning=None)), TABLES[table].version + version)
    with pytest.raises(WarehouseError, match=told) as caught:
        read(root, table)
    assert caught.value.reason_code == "schema_mismatch"
    assert str(path) in caught.value.sentence


def test_signals_lack_what_their_log_lacked(tmp_path: Path) -> None:
    t_ns, readings = np.arange(3), dict.fromkeys(TABLES["power"].column_names[1:], np.arange(3.0))
    with signal_writer(tmp_path, "power", "a", "a1") as writer:
        writer.write({"t_ns": t_ns, **readings})
    path = signal_path(tmp_path, "power", "a", "a1")
    age(tmp_path, path, "power", ["throttle"])
    assert read_signal(tmp_path, "power", "a", "a1")["throttle"].to_list() == [None] * 3
    asked = Warehouse(tmp_path).scan("power", vehicle_id="a", flight_id="a1").collect()
    assert asked["throttle"].to_list() == [None] * 3
    assert asked["current_a"].to_list() == [0.0, 1.0, 2.0]
    age(tmp_path, path, "power", ["t_ns"])
    with pytest.raises(WarehouseError, match="missing t_ns"):
        read_signal(tmp_path, "power", "a", "a1")
