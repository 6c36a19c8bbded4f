"""Asking: lazily in polars, in SQL, and nothing but asking in SQL."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import polars as pl
import polars.testing
import pytest
from history_rows import START, flight, lead, rows

from fieldcal import schemas
from fieldcal.warehouse import Warehouse, WarehouseError
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.signals import read_signal, signal_writer


@pytest.fixture(scope="module")
def warehouse(tmp_path_factory: pytest.TempPathFactory) -> Warehouse:
    """Two vehicles, five flights, one refusal, one drift row."""
    root = tmp_path_factory.mktemp("warehouse")
    for day, name in enumerate(("a1", "a2", "a3")):
        publish(root, "a", flight("a", name, day, value=1.0 + day), [name])
    publish(root, "b", flight("b", "b1", 0, value=5.0), ["b1"])
    bad = lead("b", "b2", 5)
    publish(
        root,
        "b",
        {
            "flight": rows(
                "flight",
                {**bad, "log_uri": "b/x/b2.mcap", "verdict": "partial", "reason_code": "truncated", "reason": "cut"},
            ),
            "calibration": rows(
                "calibration",
                {
                    **bad,
                    "sensor": "gyroscope",
                    "method": "output_error",
                    "parameter": "scale",
                    "axis": "x",
                    "value": 9.0,
                    "sd": 4.0,
                    "unit": "1",
                    "status": "refused",
                    "reason_code": "scale_sd",
                },
            ),
            "fit": rows(
                "fit",
                *(
                    {
                        **bad,
                        "quantity": quantity,
                        "method": "quest",
                        "reference": "vps",
                        "signal": "raw",
                        "sample": "all",
                        "tic": tic,
                        "rms": 8.1,
                        "rms_unit": "deg",
                        "n_samples": 10,
                    }
                    for quantity, tic in (("attitude", 0.03), ("body_rate", 0.2))
                ),
            ),
            "run": rows(
                "run",
                {
                    **bad,
                    "stage": "accelerometer",
                    "status": "refused",
                    "reason_code": "condition",
                    "measured": '{"condition": 211}',
                },
            ),
        },
        ["b2"],
    )
    publish(
        root,
        "a",
        {
            "drift": rows(
                "drift",
                {
                    "vehicle_id": "a",
                    "imu_id": "imu-of-a",
                    "sensor": "gyroscope",
                    "method": "output_error",
                    "parameter": "scale",
                    "axis": "x",
                    "unit": "1",
                    "n_flights": 3,
                    "value_at_25degc": 2.0,
                    "sd": 0.03,
                    "slope_per_degc": 0.5,
                    "slope_per_degc_sd": 0.004,
                    "status": "stable",
                },
            )
        },
        [],
    )
    return Warehouse(root)


def test_scan_gives_typed_lazy_frames(warehouse: Warehouse, tmp_path: Path) -> None:
    assert warehouse.scan("flight").collect().height == 5
    only_a = warehouse.scan("calibration", vehicle_id="a").filter(pl.col("method") == "output_error").collect()
    assert only_a.height == 9
    assert warehouse.scan("flight", flight_id="b1").collect()["vehicle_id"].to_list() == ["b"]
    for table in schemas.HISTORY_TABLES:
        empty = Warehouse(tmp_path).scan(table).collect()
        assert empty.is_empty()
        assert empty.schema == warehouse.scan(table).collect().schema
    assert warehouse.scan("flight", vehicle_id="nobody").collect().is_empty()
    with pytest.raises(ValueError, match="no table 'flights' to ask; there are flight"):
        warehouse.scan("flights")


def test_the_root_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FIELDCAL_WAREHOUSE", str(tmp_path))
    assert Warehouse().root == tmp_path
    assert Warehouse("given").root == Path("given")
    monkeypatch.delenv("FIELDCAL_WAREHOUSE")
    assert Warehouse().root == Path("fieldcal-data")


def test_signals_come_with_their_ids(tmp_path: Path) -> None:
    for vehicle_id in ("v", "x" * 500):
        for flight_id in ("f1", "../f2"):
            with signal_writer(tmp_path, "temperature", vehicle_id, flight_id) as writer:
                writer.write({"t_ns": np.arange(3), "temperature_degc": np.full(3, 20.0)})
    warehouse = Warehouse(tmp_path)
    assert warehouse.scan("temperature").collect().height == 12
    one = warehouse.scan("temperature", vehicle_id="x" * 500, flight_id="../f2").collect()
    assert one["vehicle_id"].unique().to_list() == ["x" * 500]
    assert one["flight_id"].unique().to_list() == ["../f2"]
    assert warehouse.scan("temperature", flight_id="f1").collect().height == 6
    assert read_signal(tmp_path, "temperature", "v", "f1").height == 3
    assert warehouse.scan("vps").collect().columns[:3] == ["flight_id", "vehicle_id", "t_ns"]


def test_sql_answers_like_polars(warehouse: Warehouse) -> None:
    query = "SELECT flight_id, avg(value) AS mean FROM calibration WHERE vehicle_id = ? GROUP BY 1 ORDER BY 1"
    expected = (
        warehouse.scan("calibration", vehicle_id="a")
        .group_by("flight_id")
        .agg(mean=pl.col("value").mean())
        .sort("flight_id")
    )
    polars.testing.assert_frame_equal(warehouse.sql(query, ["a"]), expected.collect())
    at = warehouse.sql("SELECT started_at FROM flight WHERE flight_id = 'a1'")
    assert at["started_at"].to_list() == [START]
    assert warehouse.sql("SELECT count(*) AS n FROM calibration c JOIN flight f USING (flight_id)")["n"].to_list() == [
        25
    ]
    for reading in (
        "DESCRIBE calibration",
        "SHOW TABLES",
        "EXPLAIN SELECT 1",
        "FROM flight",
        "WITH x AS (SELECT 1) FROM x",
    ):
        assert warehouse.sql(reading).height


def test_sql_over_nothing_is_empty(tmp_path: Path) -> None:
    nothing = Warehouse(tmp_path / "none")
    for name in (*schemas.HISTORY_TABLES, "latest_calibration", "history", "refusals", "calibration_at(20)"):
        assert nothing.sql(f"SELECT * FROM {name}").is_empty()
    assert not (tmp_path / "none").exists()


def test_latest_calibration_prefers_the_trend_then_the_latest_good_value(warehouse: Warehouse) -> None:
    latest = warehouse.sql("FROM latest_calibration")
    assert latest.height == 6
    found = {(r["imu_id"], r["axis"]): r for r in latest.iter_rows(named=True)}
    assert (
        found["imu-of-a", "x"] | {"value_at_25degc": 2.0, "sd": 0.03, "source": "drift", "slope_per_degc": 0.5}
        == found["imu-of-a", "x"]
    )
    assert (
        found["imu-of-a", "y"] | {"value_at_25degc": 3.0, "sd": 0.01, "source": "flight", "flight_id": "a3"}
        == found["imu-of-a", "y"]
    )
    assert found["imu-of-b", "x"]["value_at_25degc"] == 5.0
    assert set(latest["method"]) == {"output_error"}


def test_calibration_at_a_temperature(warehouse: Warehouse) -> None:
    at = warehouse.sql("SELECT * FROM calibration_at(35) WHERE imu_id = 'imu-of-a' ORDER BY axis")
    assert at["value"].to_list() == pytest.approx([7.0, 3.0, 3.0])
    assert at["sd"].to_list() == pytest.approx([0.05, 0.01, 0.01])


def test_other_views(warehouse: Warehouse) -> None:
    assert warehouse.sql("FROM history").height == 25
    assert warehouse.sql("FROM history LIMIT 1")["log_uri"].to_list() == ["a/spring/a1.mcap"]
    assert warehouse.sql("FROM worst_tic")["tic"].to_list() == [0.2, 0.03]
    refusals = warehouse.sql("FROM refusals")
    assert refusals["level"].to_list() == ["log", "parameter", "stage"]
    assert refusals["reason_code"].to_list() == ["truncated", "scale_sd", "condition"]
    drift = warehouse.sql(
        "FROM drift_by_temperature WHERE imu_id = 'imu-of-a' AND method = 'output_error' AND axis = 'x'"
    )
    assert drift.select("temperature_from_degc", "n_flights", "value", "spread").row(0) == pytest.approx(
        (20.0, 3, 2.0, 1.0)
    )


@pytest.mark.parametrize(
    "query",
    [
        "SELECT * FROM read_csv('{file}')",
        "SELECT * FROM '{file}'",
        "SELECT * FROM read_text('{file}')",
        "SELECT * FROM read_parquet('{file}')",
        "SELECT * FROM glob('{folder}/*')",
        "SELECT * FROM sniff_csv('{file}')",
        "SELECT * FROM query('SELECT * FROM read_text(''{file}'')')",
        "COPY (SELECT 1) TO '{folder}/out.csv'",
        "COPY flight TO '{folder}/out.parquet'",
        "EXPORT DATABASE '{folder}/out'",
        "ATTACH '{folder}/out.db' AS x",
        "ATTACH ':memory:' AS x",
        "INSTALL httpfs",
        "LOAD httpfs",
        "SET memory_limit = '100GB'",
        "SET enable_external_access = true",
        "RESET lock_configuration",
        "PRAGMA threads = 64",
        "CREATE TABLE x AS SELECT 1",
        "CREATE VIEW flight2 AS SELECT 1",
        "DROP VIEW flight",
        "DELETE FROM flight",
        "INSERT INTO flight SELECT * FROM flight",
        "UPDATE flight SET verdict = 'ok'",
        "CALL pragma_version()",
        "SELECT 1; SELECT 2",
        "SELECT 1; COPY (SELECT 1) TO '{folder}/out.csv'",
        "EXPLAIN ANALYZE COPY (SELECT 1) TO '{folder}/out.csv'",
        "PREPARE p AS SELECT 1",
        "BEGIN",
        "",
        "-- nothing",
    ],
)
def test_sql_does_nothing_but_ask(warehouse: Warehouse, tmp_path: Path, query: str) -> None:
    (tmp_path / "secret.csv").write_text("secret\n1\n")
    with pytest.raises(WarehouseError) as caught:
        warehouse.sql(query.format(file=tmp_path / "secret.csv", folder=tmp_path))
    assert caught.value.reason_code in ("sql_refused", "sql_wrong")
    assert caught.value.sentence.endswith(".") or caught.value.reason_code == "sql_wrong"
    assert [path.name for path in tmp_path.iterdir()] == ["secret.csv"]
    assert warehouse.sql("SELECT count(*) AS n FROM flight")["n"].to_list() == [5]


def test_sql_does_not_see_python(warehouse: Warehouse) -> None:
    frame_here = pl.DataFrame({"a": [1]})
    with pytest.raises(WarehouseError, match="frame_here"):
        warehouse.sql("SELECT * FROM frame_here")
    assert frame_here.height == 1


def test_mistakes_are_explained(warehouse: Warehouse) -> None:
    with pytest.raises(WarehouseError, match="syntax error") as caught:
        warehouse.sql("SELEC 1")
    assert caught.value.reason_code == "sql_wrong"
    with pytest.raises(WarehouseError, match="vehicel_id"):
        warehouse.sql("SELECT vehicel_id FROM flight")


def test_time_memory_and_size_are_bounded(warehouse: Warehouse) -> None:
    endless = "SELECT count(*) FROM range(10000000) a, range(10000000) b WHERE a.range * b.range % 7 = 3"
    begun = time.monotonic()
    with pytest.raises(WarehouseError, match=r"longer than 0\.3 s") as caught:
        warehouse.sql(endless, timeout_s=0.3)
    assert caught.value.reason_code == "sql_timeout"
    assert time.monotonic() - begun < 3.0
    with pytest.raises(WarehouseError, match="larger than 5 MB") as caught:
        warehouse.sql("SELECT * FROM range(100000000)", max_result_mb=5)
    assert caught.value.reason_code == "sql_too_large"
    with pytest.raises(WarehouseError, match="more than 50 MB") as caught:
        warehouse.sql("SELECT range % 9999991 AS k, list(range) FROM range(20000000) GROUP BY k", memory_mb=50)
    assert caught.value.reason_code == "sql_too_large"
