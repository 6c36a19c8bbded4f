"""Temperatures that are none: they make no slope, and it is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from history_rows import lead, rows

from fieldcal.trends.drift_table import drift_table
from fieldcal.warehouse.publish import publish


def trends(root: Path, warm: list[float | None]) -> pl.DataFrame:
    rng = np.random.default_rng(0)
    records, ids = [], []
    for k, degc in enumerate(warm):
        first = {**lead("v", f"f{k}", 7 * k), "session_id": f"s{k}"}
        ids.append(first["flight_id"])
        common = {**first, "sensor": "gyroscope", "method": "joint", "parameter": "zero_bias", "unit": "rad/s"}
        value = 0.01 + 1e-4 * rng.normal()
        records.append({**common, "axis": "x", "value": value, "sd": 1e-4, "status": "ok", "temperature_degc": degc})
    publish(root, "v", {"calibration": rows("calibration", *records)}, ids)
    return drift_table(root)


def test_counts_are_no_temperature(tmp_path: Path) -> None:
    row = trends(tmp_path, [20.0, -9019.2, 25.0, 500.8, 30.0, 22.0, 35.0]).row(0, named=True)
    assert (row["temperature_min_degc"], row["temperature_max_degc"]) == (20.0, 35.0)
    assert row["n_flights"] == 5
    assert row["reason"].endswith("29 % of its temperatures are outside -60 to 150 °C and are not used.")
    assert abs(row["value_at_25degc"] - 0.01) < 4.0 * row["sd"]


def test_a_stuck_temperature_is_told_and_not_used(tmp_path: Path) -> None:
    row = trends(tmp_path, [36.53, 36.53, 36.530000001, 36.53, 36.53, 36.53]).row(0, named=True)
    assert row["reason"].endswith("Its temperature is 36.53 °C in all 6 sessions: it is stuck, and not used.")
    assert (row["slope_per_degc"], row["temperature_min_degc"]) == (None, None)


@pytest.mark.parametrize("warm", [[20.0, 20.0], [36.53, 36.53, 36.54, 36.53, 36.53], [None] * 6])
def test_nothing_is_said_of_what_may_be(tmp_path: Path, warm: list[float | None]) -> None:
    assert "temperature" not in (trends(tmp_path, warm)["reason"][0] or "")
