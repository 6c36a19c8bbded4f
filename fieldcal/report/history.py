"""What several reports ask of the history."""

from __future__ import annotations

import json
from datetime import datetime
from typing import TypedDict

import polars as pl

from fieldcal.names import Status
from fieldcal.report.words import day
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.stages.beside.warm_up import METHOD as WARM_UP
from fieldcal.warehouse import Warehouse

REFUSALS_OF_VEHICLE = (
    "SELECT * FROM refusals WHERE vehicle_id = ? AND level <> 'parameter'"
    " ORDER BY started_at DESC NULLS LAST, flight_id, level, unit_id, what"
)


class LatestCalibration(TypedDict):
    """What the reports read of a row of the view `latest_calibration`."""

    sensor: str
    method: str
    parameter: str
    axis: str
    value_at_25degc: float
    sd: float | None
    unit: str
    temperature_degc: float | None
    started_at: datetime | None
    source: str
    why: str


class RefusedRow(TypedDict):
    """What the reports read of a row of the view `refusals`. `detail` of a stage is JSON: what it measured."""

    started_at: datetime | None
    flight_id: str
    level: str
    unit_id: str | None
    what: str
    status: str
    reason_code: str | None
    detail: str | None


class UsableFlight(TypedDict):
    """A row of `usable_flights`."""

    vehicle_id: str
    flight_id: str
    started_at: datetime | None


def newest(warehouse: Warehouse) -> datetime | None:
    """Start of the newest flight of the fleet; None while no log's clock has a known epoch."""
    moment: datetime | None = warehouse.scan("flight").select(pl.col("started_at").max()).collect().item()
    return moment


def usable_flights(warehouse: Warehouse, vehicle_id: str | None = None) -> pl.DataFrame:
    """Flights that gave at least one constant, oldest first: vehicle_id, flight_id, started_at."""
    return (
        warehouse.scan("calibration", vehicle_id=vehicle_id)
        .filter((pl.col("status") == Status.OK) & pl.col("value").is_not_null() & (pl.col("method") != WARM_UP))
        .select("vehicle_id", *FLOWN_ORDER)
        .unique()
        .sort("vehicle_id", *FLOWN_ORDER, nulls_last=False)
        .collect(engine="streaming")
    )


def last_usable(warehouse: Warehouse) -> pl.DataFrame:
    """vehicle_id, imu_id, unit_id, sensor, last_at: latest flight with a time that calibrated each sensor."""
    return (
        warehouse.scan("calibration")
        .filter((pl.col("status") == Status.OK) & pl.col("started_at").is_not_null())
        .group_by("vehicle_id", "imu_id", "unit_id", "sensor")
        .agg(last_at=pl.col("started_at").max())
        .sort("vehicle_id", "imu_id", "unit_id", "sensor")
        .collect(engine="streaming")
    )


def as_of_sentence(as_of: datetime | None, given: bool) -> str:
    """What ages on the page count to."""
    if as_of is None:
        return "No log's clock has a known epoch: ages are unknown."
    what = "the moment asked for" if given else "the start of the newest flight in the warehouse"
    return f"Ages count to {day(as_of)} UTC, {what}."


def refusals_of(warehouse: Warehouse, vehicle_id: str) -> pl.DataFrame:
    """Flights and stages of a vehicle that were refused, the latest first."""
    return warehouse.sql(REFUSALS_OF_VEHICLE, [vehicle_id])


def reason_of(row: RefusedRow) -> str:
    """Why a row of the view `refusals` is there: its sentence, else its code."""
    detail = row["detail"]
    if row["level"] == "stage":
        detail = (json.loads(detail) if detail else {}).get("reason")
    return str(detail or row["reason_code"] or "")
