"""Units of which nothing changed are not pooled again, and the table is that of a cold run, exactly."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from pooled import NAMES, SCATTER, UNITS, Truth, led

from fieldcal.estimation.normal_equations import NormalEquations
from fieldcal.names import Sensor
from fieldcal.stages.joint.information import table_of as rows_of_equations
from fieldcal.trends.pooled.memory import PLACE, Memory
from fieldcal.trends.pooled.table import table_of
from fieldcal.trends.pooled.units import first_that_tell

VEHICLES, SESSIONS = 3, 4


@pytest.fixture(scope="module")
def information() -> pl.DataFrame:
    """Flights that show every constant."""
    rows = []
    for vehicle in range(VEHICLES):
        rng = np.random.default_rng([5, vehicle])
        truth = Truth(rng, SESSIONS)
        for session in range(SESSIONS):
            look = rng.normal(size=(40, 18)) / np.array([SCATTER[name[:2]] for name in NAMES])
            reading = look @ truth.of_flight(session, 20.0) + rng.normal(size=40)
            nominal = np.array([1.0 if name[1] == "gain" else 0.0 for name in NAMES])
            found = NormalEquations(NAMES, nominal, look.T @ (reading - look @ nominal), look.T @ look)
            own = rows_of_equations(found, [None] * 18, {Sensor(s): (u, u) for s, u in UNITS.items()})
            own = own.with_columns(temperature_degc=pl.lit(20.0))
            rows.append(led(own, vehicle, session, session, truth.day[session]))
    return pl.concat(rows)


def pooled(folder: Path, information: pl.DataFrame, code: str = "code") -> tuple[pl.DataFrame, int]:
    memory = Memory(folder, code)
    table = table_of(information, memory)
    memory.save()
    return table, memory.pooled


def another_flight(information: pl.DataFrame) -> pl.DataFrame:
    """One more session of the last unit."""
    last = information.filter(pl.col("flight_id") == information["flight_id"][-1])
    return pl.concat(
        [
            information,
            last.with_columns(
                flight_id=pl.lit("new"),
                session_id=pl.lit("new"),
                started_at=pl.col("started_at") + dt.timedelta(days=7),
            ),
        ]
    )


def test_only_what_changed_is_pooled(tmp_path: Path, information: pl.DataFrame) -> None:
    first, count = pooled(tmp_path, information)
    assert (count, first.height) == (VEHICLES, VEHICLES * len(NAMES))
    again, count = pooled(tmp_path, information.sample(fraction=1.0, shuffle=True, seed=1))
    assert count == 0
    assert again.equals(first)
    more = another_flight(information)
    warm, count = pooled(tmp_path, more)
    assert 1 <= count <= VEHICLES  # all, where the fleet's movement is now another
    assert warm.equals(table_of(more))
    assert not warm.equals(first)
    assert pooled(tmp_path, more, "other code")[1] == VEHICLES


def test_a_unit_that_flew_once_too_little_is_pooled_with_nobody(tmp_path: Path, information: pl.DataFrame) -> None:
    once = information.filter((pl.col("vehicle_id") != "v0") | (pl.col("session_id") == information["session_id"][0]))
    table, count = pooled(tmp_path, once)
    assert count == VEHICLES - 1
    assert set(table["vehicle_id"]) == {"v1", "v2"}


@pytest.mark.parametrize("damage", ["flipped", "cut", "empty", "another", "gone"])
def test_a_damaged_memory_is_not_used(tmp_path: Path, information: pl.DataFrame, damage: str) -> None:
    first, _ = pooled(tmp_path, information)
    path = tmp_path / PLACE
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[len(data) // 2] ^= 1
    content = {"cut": bytes(data[:-100]), "empty": b"", "another": b"x" * 200}.get(damage, bytes(data))
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(content)
    table, count = pooled(tmp_path, information)
    assert count == VEHICLES
    assert table.equals(first)
    assert pooled(tmp_path, information)[1] == 0


@pytest.mark.parametrize(("sessions", "told"), [(1, 1), (5, 5), (31, 31), (32, 32), (40, 32), (63, 32), (64, 64)])
def test_one_flight_more_leaves_what_many_sessions_tell(sessions: int, told: int) -> None:
    session = [f"s{k // 2}" for k in range(2 * sessions)]
    rows = pl.DataFrame({"vehicle_id": "v", "session_id": session, "flight_id": range(2 * sessions)})
    first = first_that_tell(rows)
    assert first["session_id"].unique(maintain_order=True).to_list() == [f"s{k}" for k in range(told)]
    assert first["flight_id"].to_list() == list(range(2 * told))
