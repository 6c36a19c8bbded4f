"""`fieldcal pooled`: what all flights of a unit know together, as the last night published it."""

from __future__ import annotations

from typing import Literal

import polars as pl

import fieldcal
from fieldcal.cli.options import AsCsv, AsJson, Root, UnusedConfig

SHOWN = (
    "vehicle_id",
    "unit_id",
    "sensor",
    "parameter",
    "axis",
    "status",
    "value_at_25degc",
    "sd",
    "slope_per_degc",
    "slope_per_degc_sd",
    "unit",
    "session_sd",
    "n_flights",
    "n_sessions",
    "change_at",
    "reason",
)


def pooled(
    *,
    vehicle: str | None = None,
    sensor: Literal["magnetometer", "accelerometer", "gyroscope"] | None = None,
    parameter: str | None = None,
    flights: bool = False,
    as_json: AsJson = False,
    as_csv: AsCsv = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """Constants of each unit by what all its flights know together, those whose rows are refused too.

    Parameters
    ----------
    vehicle
        Only units that flew on this vehicle last.
    sensor
        Only this sensor.
    parameter
        scale, zero, cross, lever_arm, delay, ...
    flights
        Instead how much each flight contributed: the share of what was known then that would not have been without it;
        none where it contradicts the others and was left out.
    """
    from fieldcal.cli.show import print_frame

    rows = fieldcal.Warehouse(warehouse).pooled(vehicle=vehicle, sensor=sensor, parameter=parameter)
    if flights:
        place = ["vehicle_id", "unit_id", "sensor", "parameter", "axis"]
        each = rows.select(*place, "flights", "shares", "left_out").explode("flights", "shares")
        out = pl.col("left_out").list.contains(pl.col("flights"))
        shown = each.select(*place, flight_id="flights", share="shares", left_out=out)
        print_frame(shown, as_json=as_json, as_csv=as_csv)
        return 0
    print_frame(rows if as_json else rows.select(SHOWN), as_json=as_json, as_csv=as_csv)
    return 0
