"""The one parameter of each vehicle that the fleet's page draws: the least steady, else the gyroscope's."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from fieldcal.names import GRAVEST_FIRST, INERTIAL_FIRST, DriftStatus, Status
from fieldcal.report.plot import sparkline
from fieldcal.report.words import PARAMETERS, count, preferred, scientific
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.rows import DriftRow
from fieldcal.warehouse import Warehouse
from fieldcal.words.measures import rows_written, with_unit
from fieldcal.words.rows import typed

POINTS = 60
PLACE = ("sensor", "method", "parameter", "axis")
LEVELS = ("zero_bias", "bias", "scale")
Place = tuple[str, str, str, str]


def key_parameters(
    warehouse: Warehouse, flown: pl.DataFrame, trends: Mapping[str, pl.DataFrame]
) -> dict[str, tuple[str, str]]:
    """For each vehicle the key parameter of its present units (`units_flown`), in words and drawn. `trends`: their
    rows of `drift` by vehicle."""
    rows = (
        warehouse.scan("calibration")
        .filter((pl.col("status") == Status.OK) & pl.col("value").is_not_null())
        .select("vehicle_id", "unit_id", *PLACE, "value", "unit", *FLOWN_ORDER)
        .sort(FLOWN_ORDER, nulls_last=False)
        .collect()
    )
    place = ["vehicle_id", "unit_id", "sensor"]
    present = rows_written(rows, ("value",)).join(flown, on=place, how="semi", maintain_order="left")
    by_vehicle = present.partition_by("vehicle_id", as_dict=True)
    return {str(vehicle): _drawn(own, trends.get(str(vehicle))) for (vehicle,), own in by_vehicle.items()}


def _drawn(own: pl.DataFrame, drift: pl.DataFrame | None) -> tuple[str, str]:
    there: set[Place] = set(own.select(PLACE).unique().iter_rows())
    unsteady = _least_steady(drift, there)
    place = _gyroscope(there) if unsteady is None else _place(unsteady)
    shown = own.filter(*(pl.col(name) == value for name, value in zip(PLACE, place, strict=True))).tail(POINTS)
    values = shown["value"].to_list()
    step = None if unsteady is None else unsteady["change_at"]
    after = [i for i, at in enumerate(shown["started_at"]) if step is not None and at is not None and at >= step]
    name, own_unit = f"{place[0]} {place[2]} {place[3]}", shown["unit"][-1]
    span = f"{scientific(values[0])} to {scientific(values[-1])} {own_unit}".strip()
    label = f"{name} over {count(len(values), 'flight')}: {span}"
    marked = after[0] if after and after[0] else None
    return f"{name}: {with_unit(scientific(values[-1]), own_unit)}", sparkline(values, marked, label)


def _least_steady(drift: pl.DataFrame | None, there: set[Place]) -> DriftRow | None:
    """The row of the IMU's trends that is least steady and has a history to draw; None where all are steady."""
    rows = [] if drift is None else typed(drift.iter_rows(named=True), DriftRow)
    found = [
        row
        for row in rows
        if row["status"] not in (DriftStatus.STABLE, DriftStatus.INSUFFICIENT) and _place(row) in there
    ]
    return min(found, key=_steadiness, default=None)


def _steadiness(row: DriftRow) -> tuple[int, int, float, Place]:
    status = GRAVEST_FIRST.index(DriftStatus(row["status"])) if row["status"] in GRAVEST_FIRST else len(GRAVEST_FIRST)
    parameter = PARAMETERS.index(row["parameter"]) if row["parameter"] in PARAMETERS else len(PARAMETERS)
    return status, parameter, -abs(row["last_z"] or 0.0), _place(row)


def _place(row: DriftRow) -> Place:
    return row["sensor"], row["method"], row["parameter"], row["axis"]


def _gyroscope(there: set[Place]) -> Place:
    """Level of the gyroscope's first axis by its most exact method; of another sensor where there is none."""
    sensors = {place[0] for place in there}
    sensor = next(name for name in (*INERTIAL_FIRST, *sorted(sensors)) if name in sensors)
    method = preferred({place[1] for place in there if place[0] == sensor})
    parameters = {place[2] for place in there if place[:2] == (sensor, method)}
    parameter = next(name for name in (*LEVELS, *sorted(parameters)) if name in parameters)
    return sensor, method, parameter, min(place[3] for place in there if place[:3] == (sensor, method, parameter))
