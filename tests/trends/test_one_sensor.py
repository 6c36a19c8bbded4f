"""Another sensor under the same id: told, and not averaged with the one that flies."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from history_rows import START, lead, rows

from fieldcal.trends.drift_table import drift_table, update_drift
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish

SCALES = {"A": np.array([1.02, 0.985, 1.01]), "B": np.array([0.99, 1.015, 1.0])}
ZEROS = {"A": -0.02, "B": 0.03}
SCALE_SD, ZERO_SD, SESSION_SD = 5e-4, 3e-4, 1e-4
PER_DEGC = 2e-4


def night(
    root: Path, sensors: str, *, scale: dict[int, np.ndarray] | None = None, collinear: bool = False, dated: bool = True
) -> pl.DataFrame:
    """Trends of a gyroscope of which flight k was with sensor `sensors[k]`; warmer from flight to flight or at random.

    `scale`: other scales of single flights. Flight ids run against time."""
    rng = np.random.default_rng(3)
    records, flights, ids = [], [], []
    for k, sensor in enumerate(sensors):
        warm = 10.0 + 7.0 * (k % 5) if collinear else float(rng.uniform(0.0, 40.0))
        first = {**lead("v", f"f{99 - k}", 30 * k if dated else None), "session_id": f"s{k}", "sequence": f"s{k:03d}"}
        ids.append(first["flight_id"])
        common = {**first, "sensor": "gyroscope", "method": "joint", "status": "ok", "temperature_degc": warm}
        own = (scale or {}).get(k, SCALES[sensor])
        for axis, value in zip("xyz", own, strict=True):
            scales = {"parameter": "scale", "value": value + SCALE_SD * rng.normal(), "sd": SCALE_SD, "unit": "1"}
            zero = ZEROS[sensor] + PER_DEGC * (warm - 25.0) + np.hypot(ZERO_SD, SESSION_SD) * rng.normal()
            records += [
                {**common, "axis": axis, **scales},
                {**common, "axis": axis, "parameter": "zero_bias", "value": zero, "sd": ZERO_SD, "unit": "rad/s"},
            ]
        flights.append({**first, "log_uri": f"v/s{k}/f", "verdict": "ok", "temperature_mean_degc": warm})
    publish(root, "v", {"calibration": rows("calibration", *records), "flight": rows("flight", *flights)}, ids)
    return drift_table(root).filter(parameter="zero_bias")


@pytest.mark.parametrize(("sensors", "kept"), [("AAAAABB", 2), ("AAAAAABBBBBBB", 7), ("ABABABAB", 4), ("AABBAA", 4)])
@pytest.mark.parametrize("collinear", [False, True])
def test_flights_of_the_sensor_that_flies_count_alone(tmp_path: Path, sensors: str, kept: int, collinear: bool) -> None:
    """Also where temperature rises with time, so that a slope on both could explain the exchange."""
    table = night(tmp_path, sensors, collinear=collinear)
    since = len(sensors.rstrip(sensors[-1]))
    assert set(table["status"]) == {"step"}
    assert table["n_flights"].to_list() == [kept] * 3
    assert set(table["change_at"]) == {START + dt.timedelta(days=30 * since)}
    for row in table.iter_rows(named=True):
        assert f"of {len(sensors)} flights are up to" in row["reason"]
        alternate = sensors[-1] in sensors[:since]
        assert row["reason"].startswith("Two sensors alternate" if alternate else "The sensor was exchanged")
        slope_left = 0.0 if row["slope_per_degc"] is not None else PER_DEGC * 20.0
        assert abs(row["value_at_25degc"] - ZEROS[sensors[-1]]) < 4.0 * row["sd"] + slope_left


def test_with_few_flights_of_the_new_sensor_the_latest_is_flown(tmp_path: Path) -> None:
    night(tmp_path, "AAAAABB")
    update_drift(tmp_path)
    latest = Warehouse(tmp_path).sql("FROM latest_calibration WHERE parameter = 'zero_bias'")
    assert set(latest["source"]) == {"flight"}
    assert set(latest["flight_id"]) == {"f93"}


def test_the_order_is_that_of_names_where_no_clock_tells(tmp_path: Path) -> None:
    table = night(tmp_path, "AAAABBB", dated=False)
    assert set(table["status"]) == {"step"}
    assert table["n_flights"].to_list() == [3] * 3
    assert table["change_at"].null_count() == 3
    assert "before the flight" not in table["reason"][0]


@pytest.mark.parametrize(
    "odd",
    [
        SCALES["A"] * [1.03, 1.0, 1.0],  # one axis alone
        SCALES["A"] * [1.01, 0.99, 1.01],  # less than parts differ by
    ],
)
def test_a_scale_that_is_a_little_off_is_the_same_sensor(tmp_path: Path, odd: np.ndarray) -> None:
    table = night(tmp_path, "AAAAAAAA", scale={7: odd})
    assert table["n_flights"].to_list() == [8] * 3
    assert set(table["status"]) == {"stable"}


def test_flights_that_are_like_no_other_are_spoiled_not_of_another_sensor(tmp_path: Path) -> None:
    """Two that a magnet spoiled, each in its own way, amid ten: no exchange; the others' value stands."""
    odd = {3: SCALES["A"] * [1.2, 0.85, 1.15], 7: SCALES["A"] * [0.8, 1.25, 0.9]}
    table = night(tmp_path, "AAAAAAAAAAAA", scale=odd)
    assert set(table["status"]) == {"stable"}
    assert table["n_flights"].to_list() == [12] * 3
    scales = drift_table(tmp_path).filter(parameter="scale")
    assert scales["n_flights"].to_list() == [10] * 3, "set aside, flight by flight"
    assert "sensor" not in "".join(r or "" for r in scales["reason"])
    np.testing.assert_allclose(scales["value_at_25degc"].to_numpy(), SCALES["A"], atol=4.0 * SCALE_SD)


def test_a_new_sensor_is_told_from_a_spoiled_flight_by_its_second(tmp_path: Path) -> None:
    first = night(tmp_path / "one", "AAAAAAAB")
    assert not first["reason"].str.contains("The sensor was exchanged").any()
    second = night(tmp_path / "two", "AAAAAAABB")
    assert second["reason"].str.starts_with("The sensor was exchanged").all()
    assert second["n_flights"].to_list() == [2] * 3


def test_what_is_uncertain_is_the_same_sensor(tmp_path: Path) -> None:
    """3 % off at 6 sd or less proves nothing."""
    records: list[dict[str, Any]] = []
    for k in range(6):
        first = {**lead("v", f"f{k}", k), "session_id": f"s{k}"}
        common = {**first, "sensor": "gyroscope", "method": "joint", "status": "ok", "unit": "1", "parameter": "scale"}
        records += [{**common, "axis": a, "value": 1.0 + 0.03 * (k == 5), "sd": 0.006} for a in "xyz"]
    publish(tmp_path, "v", {"calibration": rows("calibration", *records)}, [f"f{k}" for k in range(6)])
    assert drift_table(tmp_path)["n_flights"].to_list() == [6] * 3
