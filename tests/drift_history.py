"""Published histories of a generated fleet, as nights would have left them."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from history_rows import START, rows

from fieldcal.warehouse.publish import publish

TAU, SD, PER_DEGC = 1e-3, 2e-4, 5e-5
"""rad/s, rad/s, rad/s per °C"""
UNIT_SPREAD = 0.02
SESSIONS = 24
SERIES = (("gyroscope", "output_error", "rad/s"), ("accelerometer", "ellipsoid_robust", "m/s^2"))


def publish_fleet(
    root: Path, units: int = 12, sessions: int = SESSIONS, *, seed: int = 0, spoil: Any = None
) -> dict[str, pl.DataFrame]:
    """`zero_bias` of two triads, one flight a session; `spoil(unit, sensor, axis, session, value)` changes values."""
    rng = np.random.default_rng(seed)
    published = {}
    for u in range(units):
        vehicle = f"v{u:02d}"
        warm = rng.uniform(-10.0, 45.0, sessions)
        records, flights, ids = [], [], []
        level = {(s, a): UNIT_SPREAD * rng.normal() for s, _, _ in SERIES for a in "xyz"}
        for k in range(sessions):
            first = {
                "flight_id": f"{vehicle}-{k:03d}",
                "vehicle_id": vehicle,
                "imu_id": f"imu-{u:02d}",
                "session_id": f"s{k:03d}",
                "started_at": START + dt.timedelta(days=7 * k),
            }
            ids.append(first["flight_id"])
            flights.append({**first, "log_uri": f"{vehicle}/{k}", "verdict": "ok", "temperature_mean_degc": warm[k]})
            for sensor, method, unit in SERIES:
                for axis in "xyz":
                    value = level[sensor, axis] + PER_DEGC * (warm[k] - 25.0) + np.hypot(TAU, SD) * rng.normal()
                    records.append(
                        {
                            **first,
                            "sensor": sensor,
                            "method": method,
                            "parameter": "zero_bias",
                            "axis": axis,
                            "value": value if spoil is None else spoil(u, sensor, axis, k, value),
                            "sd": SD,
                            "unit": unit,
                            "temperature_degc": warm[k],
                            "status": "ok",
                        }
                    )
        published[vehicle] = rows("calibration", *records)
        publish(root, vehicle, {"calibration": published[vehicle], "flight": rows("flight", *flights)}, ids)
    return published
