"""The estimate by a receiver's velocity on autopilots' logs: simulated ones, perfect but for a drifting gyroscope and a
receiver that is 180 ms late, and a recorded one whose readings come too slowly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from example_logs import PARENT, needs_examples

from fieldcal.flight.calibrate import identify, read, run_stages
from fieldcal.geometry.rotation import Array

pytestmark = needs_examples
LOGS = PARENT / "autopilot-logs"
LAG_S, MOST_LAG_S = 0.18, 0.25
# The autopilot asks its receiver that often, and stamps what it then finds.
POLL_S = 0.02
# SIM_DRIFT_SPEED 0.05 °/s a minute on all axes: what the true attitude of these logs shows, rad/s.
DRIFTED = {"data_00000004.BIN": (0.00124, 0.00117, 0.00122), "data_00000054.BIN": (0.00129, 0.00131, 0.00125)}
MOST_SD = 3.0


def rows_of(path: Path) -> pl.DataFrame:
    return run_stages(read(*identify(path))).tables["joint.calibration"]


def values(rows: pl.DataFrame, sensor: str, parameter: str) -> tuple[Array, Array]:
    own = rows.filter(sensor=sensor, parameter=parameter, status="ok")
    return own["value"].to_numpy(), own["sd"].to_numpy()


@pytest.mark.parametrize("name", list(DRIFTED))
def test_simulated_autopilots_come_out_perfect_and_late(name: str) -> None:
    rows = rows_of(LOGS / "copter-4.1-sitl" / "session-1" / name)
    assert set(rows["method"]) == {"velocity"}
    for sensor in ("gyroscope", "accelerometer", "magnetometer"):
        scale, sd = values(rows, sensor, "scale")
        assert len(scale) >= 1
        assert np.all(np.abs(scale - 1.0) < MOST_SD * sd), sensor
    for sensor in ("accelerometer", "magnetometer"):
        zero, sd = values(rows, sensor, "zero")
        assert len(zero) == 3
        assert np.all(np.abs(zero) < MOST_SD * sd), sensor
    zero, sd = values(rows, "gyroscope", "zero")
    assert np.all(np.abs(zero - DRIFTED[name]) < MOST_SD * sd)
    lag, sd = values(rows, "accelerometer", "gnss_lag")
    assert np.all((lag > LAG_S - MOST_SD * sd) & (lag < LAG_S + POLL_S + MOST_SD * sd))
    arm, sd = values(rows, "accelerometer", "gnss_lever_arm")
    assert np.all(np.abs(arm) < MOST_SD * sd)


def test_a_flight_logged_more_slowly_than_it_shakes_has_no_scale_of_it() -> None:
    rows = rows_of(LOGS / "copter-3.4.4" / "session-1" / "log_0036.bin")
    scales = rows.filter(sensor="accelerometer", parameter="scale", method="velocity")
    assert set(scales["status"]) == {"refused"}
    assert "undersampled" in scales["reason_code"].to_list()
    lag, _ = values(rows, "accelerometer", "gnss_lag")
    assert np.all((lag > 0.0) & (lag < MOST_LAG_S))
