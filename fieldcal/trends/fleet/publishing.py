"""A table of the whole fleet, published where a vehicle's rows are others than it has."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish


def publish_where_other(root: Path, name: str, table: pl.DataFrame) -> set[str]:
    """Have every vehicle's table of this name be its rows of `table`; the vehicles whose table changed.

    Raises
    ------
    WarehouseError
        As `fieldcal.warehouse.publish.publish`.
    """
    own, there = (_by_vehicle(rows) for rows in (table, Warehouse(root).scan(name).collect()))
    return {
        vehicle_id
        for vehicle_id in sorted(own.keys() | there.keys())
        if not own.get(vehicle_id, table.clear()).equals(there.get(vehicle_id, table.clear()))
        and publish(root, vehicle_id, {name: own.get(vehicle_id, table.clear())}, ())
    }


def _by_vehicle(rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
    return {str(vehicle_id): own for (vehicle_id,), own in rows.partition_by("vehicle_id", as_dict=True).items()}
