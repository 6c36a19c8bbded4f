"""`fieldcal pooled`: what all flights of a unit know together, as the last night published it; `fieldcal plan`: which
half a minute of motion would tell most beside it."""

from __future__ import annotations

from typing import Literal

import fieldcal
from fieldcal.cli.options import AsCsv, AsJson, Root, UnusedConfig

MOST_SHOWN = 6
"""Constants beside the best manoeuvre, those that it helps most first."""

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
    import polars as pl

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


def plan(vehicle: str, /, *, as_json: AsJson = False, warehouse: Root = None, config: UnusedConfig = None) -> int:
    """What to fly next: the manoeuvre that would help most, and the standard deviations to expect after it.

    Parameters
    ----------
    vehicle
        The vehicle: its primary unit, by what all its flights know together (fieldcal pooled).
    """
    from dataclasses import asdict

    from fieldcal.cli.show import print_json

    found = fieldcal.Warehouse(warehouse).plan(vehicle)
    if as_json:
        print_json(asdict(found))
        return 0
    best = found.manoeuvres[0]
    print(f"{found.vehicle_id} ({found.unit_id}): {best.words}.")
    print(f"Constants not known well enough: {best.refused_now} now, {best.refused_after} after it.")
    for one in sorted(best.expected, key=lambda e: -(min(e.sd_now, 1e9) / e.sd_after))[:MOST_SHOWN]:
        now = "not known" if one.sd_now == float("inf") else f"sd {one.sd_now:.2g} {one.unit}"
        after = "not known" if one.sd_after == float("inf") else f"{one.sd_after:.2g} {one.unit}"
        print(f"  {one.constant}: {now} → {after} (limit {one.limit:.2g} {one.unit})")
    for other in found.manoeuvres[1:]:
        print(f"Or {other.words}: {other.refused_after} not known well enough, sd smaller by {other.gain:.2f}.")
    return 0
