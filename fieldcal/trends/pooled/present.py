"""Information of the sensors that fly now alone: what the table `drift` knows to be another sensor's is not pooled."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import polars as pl

from fieldcal.names import Status
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.trends.one_sensor import RECOGNISED, Exchanges, of_present_sensor
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting


def information_that_counts(root: Path, vehicles: Sequence[str] | None = None) -> tuple[pl.DataFrame, Exchanges]:
    """(rows of `information` of flights that nobody withdrew, what was exchanged); of these vehicles, which have all
    flights of their units (`fleet.groups`), else of all."""
    warehouse = Warehouse(root)

    def of(table: str) -> pl.LazyFrame:
        if vehicles is None:
            return warehouse.scan(table)
        return pl.concat([warehouse.scan(table, vehicle_id=vehicle) for vehicle in vehicles])

    scales = of("calibration").filter(
        pl.col("sensor").is_in([str(sensor) for sensor in RECOGNISED]),
        pl.col("parameter") == "scale",
        pl.col("status") == Status.OK,
    )
    order = ["unit_id", "sensor", *FLOWN_ORDER, "method", "axis"]
    known = scales.select(*order, "parameter", "value", "sd").sort(order, nulls_last=False).collect()
    return of_present(of("information").filter(counting(root)).collect(), known)


def of_present(information: pl.DataFrame, scales: pl.DataFrame) -> tuple[pl.DataFrame, Exchanges]:
    """(`information` in which rows of sensors that were exchanged are `absent`, what was exchanged).

    `scales`: rows of `calibration`. Of flights that tell no scale those before the exchange are another sensor's too;
    where two sensors alternate nobody knows, and the innovation test judges."""
    kept, exchanged = of_present_sensor(scales)
    if not exchanged or information.is_empty():
        return information, exchanged
    gone = scales.join(kept, on=["unit_id", "sensor", "flight_id"], how="anti").select("unit_id", "sensor", "flight_id")
    first = [
        (unit_id, sensor, one.since)
        for (unit_id, sensor), one in exchanged.items()
        if one.since is not None and not one.back_and_forth
    ]
    since = pl.DataFrame(
        first,
        schema={"unit_id": pl.String(), "sensor": pl.String(), "since": information.schema["started_at"]},
        orient="row",
    )
    told = information.join(
        gone.unique().with_columns(gone=pl.lit(True)),
        left_on=["sensor_unit_id", "sensor", "flight_id"],
        right_on=["unit_id", "sensor", "flight_id"],
        how="left",
        maintain_order="left",
    ).join(
        since,
        left_on=["sensor_unit_id", "sensor"],
        right_on=["unit_id", "sensor"],
        how="left",
        maintain_order="left",
    )
    other = pl.col("gone").fill_null(False) | (pl.col("started_at") < pl.col("since")).fill_null(False)
    absent = pl.when(other & (pl.col("status") == Status.OK)).then(pl.lit(str(Status.ABSENT)))
    return told.with_columns(status=absent.otherwise("status")).select(information.columns), exchanged
