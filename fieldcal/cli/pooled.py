"""`fieldcal pooled`: what all flights of a unit know together, as the last night published it; `fieldcal plan`: which
half a minute of motion would tell most beside it."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

import fieldcal
from fieldcal.cli.options import AsCsv, AsJson, Root, UnusedConfig, Wide

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
    "curve_per_degc2",
    "curve_per_degc2_sd",
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
    at: datetime | None = None,
    flights: bool = False,
    wide: Wide = False,
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
    at
        What they were at another moment, by all flights before and after it: 2026-02-01, or with a time, UTC.
    flights
        Instead how much each flight contributed: the share of what was known then that would not have been without it;
        none where it contradicts the others and was left out. Distance beyond 1: its equations were made at scales too
        far from these to hold, and it is left out until its log is calibrated again.
    """
    import polars as pl

    from fieldcal.cli.present.history import as_written
    from fieldcal.cli.present.pooled import print_pooled
    from fieldcal.cli.present.screen import console
    from fieldcal.cli.show import print_frame

    rows = fieldcal.Warehouse(warehouse).pooled(vehicle=vehicle, sensor=sensor, parameter=parameter, at=at)
    if flights:
        place = ["vehicle_id", "unit_id", "sensor", "parameter", "axis"]
        # A row of an older night has none.
        unknown = pl.col("shares").list.eval(pl.when(pl.element().is_nan()).then(pl.element()))
        each = rows.select(*place, "flights", "shares", pl.coalesce("distances", unknown), "left_out")
        each = each.explode("flights", "shares", "distances")
        out = pl.col("left_out").list.contains(pl.col("flights"))
        shown = each.select(*place, flight_id="flights", share="shares", distance="distances", left_out=out)
        print_frame(shown, as_json=as_json, as_csv=as_csv, wide=wide)
        return 0
    if as_json or as_csv:
        print_frame(rows if as_json else rows.select(SHOWN), as_json=as_json, as_csv=as_csv)
    elif wide:
        print_frame(as_written(rows.select(SHOWN), "value_at_25degc"), as_json=False, as_csv=False, wide=True)
    else:
        print_pooled(console(), rows)
    return 0


def plan(
    vehicle: str,
    /,
    *,
    wide: Wide = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """What to fly next: the manoeuvre that would help most, and the standard deviations to expect after it.

    Parameters
    ----------
    vehicle
        The vehicle: its primary unit, by what all its flights know together (fieldcal pooled).
    """
    from dataclasses import asdict

    from fieldcal.cli.present.pooled import print_plan
    from fieldcal.cli.present.screen import console
    from fieldcal.cli.show import print_json

    found = fieldcal.Warehouse(warehouse).plan(vehicle)
    if as_json:
        print_json(asdict(found))
    else:
        print_plan(console(wide=wide), found)
    return 0
