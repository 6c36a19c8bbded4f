"""What `drift` says of constants that are pooled is what the smoother says: on a fleet with a step, a drift, a spoiled
flight and an exchanged sensor all ways to ask agree."""

from __future__ import annotations

import datetime as dt
import json
import shutil
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal
from pooled import NAMES, SCATTER, START, Truth
from pooled_support import publish_unit

import fieldcal
from fieldcal.cli.main import run
from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor
from fieldcal.report import write_vehicle_report
from fieldcal.trends.drift_table import drift_table, update_drift
from fieldcal.trends.fleet.groups import groups
from fieldcal.trends.pooled.table import pooled_table
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish

VEHICLES, SESSIONS, AT, SPOILED = 6, 10, 6, 4
STEPPED, DRIFTING = ("gyroscope", "zero", "x"), ("accelerometer", "zero", "y")
STEP, PER_SESSION = 15.0, 3.0
MOVING = ("step", "drifting")
OF_SENSOR = {sensor: np.array([name[0] == sensor for name in NAMES]) for sensor in Sensor}
SIZE = np.array([SCATTER[name[:2]] for name in NAMES])


def moved(vehicle: int, session: int, constants: Array) -> Array:
    """Vehicle 0 steps, 1 drifts, 2 is spoiled once, 3 gets another gyroscope."""
    if vehicle == 0 and session >= AT:
        return constants + STEP * SIZE * (np.arange(18) == NAMES.index(STEPPED))
    if vehicle == 1:
        return constants + PER_SESSION * session * SIZE * (np.arange(18) == NAMES.index(DRIFTING))
    if vehicle == 2 and session == SPOILED:
        return constants + 40.0 * SIZE * OF_SENSOR[Sensor.GYROSCOPE]
    if vehicle == 3 and session >= AT:
        other = [0.05 if name[1] == "gain" else 0.02 for name in NAMES]
        return constants + np.array(other) * OF_SENSOR[Sensor.GYROSCOPE]
    return constants


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Truth]]:
    root, truths = tmp_path_factory.mktemp("verdicts"), []
    for vehicle in range(VEHICLES):
        rng = np.random.default_rng([5, vehicle])
        truths.append(Truth(rng, SESSIONS))
        publish_unit(root, vehicle, rng, truths[-1], SESSIONS, lambda session: 30, moved=partial(moved, vehicle))
    update_drift(root)
    return root, truths


def test_a_fleet_asked_a_vehicle_at_a_time_is_the_same_fleet(
    fleet: tuple[Path, list[Truth]], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, asked = fleet[0], []

    def one_by_one(root: Path, tables: Sequence[str], *_: int) -> Iterator[list[str]]:
        for vehicles in groups(root, tables, 1):
            asked.append(vehicles)
            yield vehicles

    monkeypatch.setattr("fieldcal.trends.fleet.rows.groups", one_by_one)
    monkeypatch.setattr("fieldcal.trends.pooled.table.groups", one_by_one)
    assert_frame_equal(drift_table(root), Warehouse(root).scan("drift").collect(), check_exact=True)
    assert_frame_equal(pooled_table(root), Warehouse(root).scan("pooled").collect(), check_exact=True)
    assert asked == 3 * [[f"v{k}"] for k in range(VEHICLES)]


def of(rows: pl.DataFrame) -> dict[tuple[str, ...], dict[str, Any]]:
    return {(r["vehicle_id"], r["sensor"], r["parameter"], r["axis"]): r for r in rows.iter_rows(named=True)}


def test_what_moves_is_told_where_it_moved(fleet: tuple[Path, list[Truth]]) -> None:
    root, truths = fleet
    drift = of(Warehouse(root).scan("drift").collect())
    step = drift["v0", *STEPPED]
    assert step["status"] == "step"
    assert abs(step["change_at"] - START - dt.timedelta(days=float(truths[0].day[AT]))) < dt.timedelta(hours=1)
    size = STEP * SIZE[NAMES.index(STEPPED)]
    assert abs(step["change_size"] - size) < 4.0 * step["change_size_sd"] < size
    slope = drift["v1", *DRIFTING]
    assert slope["status"] == "drifting"
    rate = PER_SESSION * SIZE[NAMES.index(DRIFTING)] * SESSIONS / (truths[1].day[-1] - truths[1].day[0])
    assert slope["slope_per_day"] == pytest.approx(rate, rel=0.3)
    at = [truths[1].walked[-1] + PER_SESSION * (SESSIONS - 1) * SIZE * (np.arange(18) == NAMES.index(DRIFTING))]
    assert abs(slope["value_at_25degc"] - at[0][NAMES.index(DRIFTING)]) < 4.0 * slope["sd"]
    others = [row for key, row in drift.items() if key[0] in ("v4", "v5")]
    assert not [row for row in others if row["status"] in MOVING]
    bias = drift["v0", "gyroscope", "zero_bias", "x"]
    assert (bias["status"], bias["change_at"]) == ("step", step["change_at"])
    assert bias["change_size"] == pytest.approx(
        -size / truths[0].walked[-1][NAMES.index(("gyroscope", "gain", "x"))], rel=0.3
    )


def test_all_ways_to_ask_say_the_same_of_what_moved(
    fleet: tuple[Path, list[Truth]], capsys: pytest.CaptureFixture[str]
) -> None:
    root = fleet[0]
    warehouse = fieldcal.Warehouse(root)

    def printed(*command: str) -> list[dict[str, Any]]:
        assert run([*command, "--warehouse", str(root)]) == 0
        return json.loads(capsys.readouterr().out)

    pooled = of(pl.DataFrame(printed("pooled", "--json"), infer_schema_length=None))
    drift = of(pl.DataFrame(printed("drift", "--json"), infer_schema_length=None))
    latest = of(warehouse.sql("FROM latest_calibration"))
    pages = {name: write_vehicle_report(root, name).read_text(encoding="utf-8") for name in ("v0", "v1")}
    flown = {f"v{k}": warehouse.calibration_at(f"v{k}") for k in range(VEHICLES)}
    assert len(pooled) == 18 * VEHICLES
    for key, own in pooled.items():
        told, sql = drift[key], latest[key]
        for column in ("n_flights", "value_at_25degc", "sd", "slope_per_degc", "slope_per_day", "change_at"):
            assert told[column] == own[column], (key, column)
        assert (told["status"] in MOVING) == (own["status"] in MOVING), key
        assert (sql["source"], sql["value_at_25degc"], sql["drift_status"]) == (
            "pooled",
            own["value_at_25degc"],
            told["status"],
        )
        triad, i = flown[key[0]].triads[Sensor(key[1])], "xyz".index(key[3])
        value = triad.scale[i, i] if key[2] == "scale" else triad.zero[i]
        assert value == pytest.approx(own["value_at_25degc"], rel=1e-12)
        if own["left_out"]:
            assert own["left_out"] == [f"002-{SPOILED:04d}"]
            assert f"Left out, for it contradicts the others: 002-{SPOILED:04d}." in told["reason"]
    assert {key[0] for key, own in pooled.items() if own["left_out"]} == {"v2"}
    moving = {
        key[0]: {row["reason"] for other, row in drift.items() if other[0] == key[0] and row["status"] in MOVING}
        for key in pooled
    }
    assert {vehicle for vehicle, reasons in moving.items() if reasons} == {"v0", "v1", "v3"}
    for vehicle in ("v0", "v1"):
        assert any(reason.split(" before")[0].split(" in 30")[0] in pages[vehicle] for reason in moving[vehicle])


def test_an_exchanged_sensor_is_not_pooled_with_the_one_that_flies(fleet: tuple[Path, list[Truth]]) -> None:
    root, truths = fleet
    pooled = Warehouse(root).scan("pooled", vehicle_id="v3").collect()
    gyroscope = pooled.filter(sensor="gyroscope")
    assert gyroscope["n_flights"].to_list() == [SESSIONS - AT] * 6
    assert set(gyroscope["status"]) == {"step"}
    assert gyroscope["reason"].str.starts_with("The sensor was exchanged").all()
    now = moved(3, SESSIONS - 1, truths[3].walked[-1])
    for row in gyroscope.iter_rows(named=True):
        own = now[NAMES.index((row["sensor"], "gain" if row["parameter"] == "scale" else "zero", row["axis"]))]
        truth = 1.0 / own if row["parameter"] == "scale" else own
        assert abs(row["value_at_25degc"] - truth) < 4.0 * row["sd"]
    assert set(pooled.filter(sensor="accelerometer")["n_flights"]) == {SESSIONS}


def test_a_flight_that_was_linearised_too_far_from_the_unit_is_left_out_and_told(
    fleet: tuple[Path, list[Truth]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its equations as they would be at an accelerometer's scale 30 % away, where they do not hold."""
    root = Path(shutil.copytree(fleet[0], tmp_path / "copy"))
    own = Warehouse(root).scan("information", vehicle_id="v4").collect()
    odd = (pl.col("flight_id") == "004-0003") & (pl.col("sensor") == "accelerometer") & (pl.col("parameter") == "gain")
    moved_there = own.with_columns(
        linearised_at=pl.when(odd).then(pl.col("linearised_at") * 1.3).otherwise("linearised_at")
    )
    publish(root, "v4", {"information": moved_there}, own["flight_id"].unique().to_list())
    update_drift(root)
    rows = Warehouse(root).scan("pooled", vehicle_id="v4").collect()
    assert (
        rows["reason"].str.contains("1 left out: made at scales up to 3.. times as far from these as they hold").all()
    )
    assert set(rows["n_flights"]) == {SESSIONS - 1}
    capsys.readouterr()
    assert run(["pooled", "--vehicle", "v4", "--flights", "--json", "--warehouse", str(root)]) == 0
    far = {row["flight_id"]: row["distance"] for row in json.loads(capsys.readouterr().out)}
    assert 2.5 < far.pop("004-0003") < 3.5
    assert max(far.values()) < 0.3
