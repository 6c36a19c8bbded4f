"""Incremental drift: only IMUs whose history changed are regressed, and the table is that of a cold run, exactly."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from drift_history import TAU, publish_fleet
from history_rows import START, rows

from fieldcal.trends.drift_table import bends_of, drift_table, history_in_groups, table_of, update_drift
from fieldcal.trends.evidence_cache import PLACE, Memory
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.publish import publish

STEP = 12.0 * TAU
UNITS, CHANGED = 8, 5


def spoil(unit: int, sensor: str, axis: str, session: int, value: float) -> float:
    """Unit 0 steps, 2 steps up and down again, 1 drifts."""
    if unit in (0, 2) and axis == "x":
        return value + STEP * (session >= 15 if unit == 0 else 7 <= session < 16)
    return value + 0.5 * TAU * session if (unit, axis) == (1, "y") else value


@pytest.fixture
def root(tmp_path: Path) -> Path:
    publish_fleet(tmp_path, UNITS, spoil=spoil)
    return tmp_path


def another_flight(root: Path) -> None:
    """One more session of one unit."""
    vehicle = f"v{CHANGED:02d}"
    history = Warehouse(root).scan("calibration", vehicle_id=vehicle).collect()
    last = history.filter(pl.col("session_id") == "s023").with_columns(
        flight_id=pl.lit("new"), session_id=pl.lit("s024"), value=pl.col("value") + TAU
    )
    last = last.with_columns(started_at=pl.lit(START + dt.timedelta(days=7 * 24), dtype=pl.Datetime("us", "UTC")))
    lead = last.select("flight_id", "vehicle_id", "imu_id", "session_id", "started_at").row(0, named=True)
    flight = rows("flight", {**lead, "log_uri": "x", "verdict": "ok", "temperature_mean_degc": 20.0})
    publish(root, vehicle, {"calibration": last, "flight": flight}, ["new"])


def regressed(root: Path) -> tuple[pl.DataFrame, int]:
    memory = Memory(root, "code")
    table = table_of(history_in_groups(root), bends_of(root), memory)
    memory.save()
    return table, memory.regressed


def test_only_what_changed_is_regressed_and_the_table_is_that_of_a_cold_run(root: Path) -> None:
    first, count = regressed(root)
    assert count == UNITS
    assert set(first["status"]) >= {"step", "drifting", "stable"}
    again, count = regressed(root)
    assert count == 0
    assert again.equals(first)
    another_flight(root)
    warm, count = regressed(root)
    assert count == 1
    cold = drift_table(root)
    assert warm.equals(cold)
    changed = warm.join(first, on=["imu_id", "sensor", "method", "parameter", "axis"], suffix="_before")
    moved = changed.filter(pl.col("value_at_25degc") != pl.col("value_at_25degc_before"))
    assert set(moved["imu_id"]) == {f"imu-{CHANGED:02d}"}
    assert (changed["fleet_z"] != changed["fleet_z_before"]).all()  # the fleet is judged anew


def test_the_history_says_the_same_whichever_way_it_came(root: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    update_drift(root)
    another_flight(root)
    update_drift(root)
    other = tmp_path_factory.mktemp("cold")
    publish_fleet(other, UNITS, spoil=spoil)
    another_flight(other)
    update_drift(other)
    assert content_sha256(root) == content_sha256(other)


@pytest.mark.parametrize("damage", ["flipped", "cut", "empty", "another", "gone"])
def test_a_damaged_memory_is_not_used(root: Path, damage: str) -> None:
    first, _ = regressed(root)
    path = root / PLACE
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[len(data) // 2] ^= 1
    content = {"cut": bytes(data[:-100]), "empty": b"", "another": b"x" * 200}.get(damage, bytes(data))
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(content)
    table, count = regressed(root)
    assert count == UNITS
    assert table.equals(first)
    assert regressed(root)[1] == 0


def test_other_code_or_other_values_are_regressed(root: Path) -> None:
    flights = pl.concat(history_in_groups(root))
    memory = Memory(root, "code")
    table_of([flights], memory=memory)
    memory.save()
    other = Memory(root, "other code")
    table_of([flights], memory=other)
    assert other.regressed == UNITS
    one = (pl.col("imu_id") == "imu-02") & (pl.col("flight_id") == "v02-003") & (pl.col("axis") == "z")
    nudged = flights.with_columns(sd=pl.when(one).then(np.nextafter(2e-4, 1.0)).otherwise("sd"))
    memory = Memory(root, "code")
    table_of([nudged], memory=memory)
    assert memory.regressed == 1
