"""Small history tables for the warehouse's tests."""

from __future__ import annotations

import datetime as dt
from typing import Any

import polars as pl

from fieldcal import schemas

START = dt.datetime(2026, 5, 4, 12, 0, tzinfo=dt.UTC)


def rows(table: str, *records: dict[str, Any]) -> pl.DataFrame:
    """A frame of `table` with these values; what a record does not name is null, its unit the primary one, alone."""
    empty = pl.from_arrow(schemas.arrow_schema(table).empty_table())
    assert isinstance(empty, pl.DataFrame)
    names = schemas.TABLES[table].column_names
    alone = [{"unit_id": record.get("imu_id"), "is_primary": True, **record} for record in records]
    return pl.DataFrame([{name: record.get(name) for name in names} for record in alone], schema=empty.schema)


def lead(vehicle_id: str, flight_id: str, day: int | None = 0) -> dict[str, Any]:
    """Lead columns of a flight; `day` None: a log whose clock has no epoch."""
    started_at = None if day is None else START + dt.timedelta(days=day)
    return {
        "flight_id": flight_id,
        "vehicle_id": vehicle_id,
        "imu_id": f"imu-of-{vehicle_id}",
        "session_id": "spring",
        "started_at": started_at,
    }


def flight(vehicle_id: str, flight_id: str, day: int | None = 0, value: float = 1.0) -> dict[str, pl.DataFrame]:
    """What a night publishes of one flight."""
    first = lead(vehicle_id, flight_id, day)
    parameter = {"sensor": "gyroscope", "parameter": "scale", "unit": "1", "status": "ok", "temperature_degc": 21.0}
    stages = {"status": "ok", "measured": '{"n": 3}', "run_key": "k" * 32, "versions": '{"numpy": "2"}'}
    return {
        "flight": rows(
            "flight", {**first, "log_uri": f"{vehicle_id}/spring/{flight_id}.mcap", "verdict": "ok", "verifiable": True}
        ),
        "calibration": rows(
            "calibration",
            *(
                {**first, **parameter, "method": method, "axis": axis, "value": value + shift, "sd": 0.01}
                for method, shift in (("equation_error", 0.1), ("output_error", 0.0))
                for axis in "xyz"
            ),
        ),
        "run": rows("run", *({**first, **stages, "stage": stage} for stage in ("ingest", "gyro_output"))),
    }
