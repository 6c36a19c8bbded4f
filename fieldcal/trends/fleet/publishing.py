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
    warehouse = Warehouse(root)
    own = {str(vehicle_id): rows for (vehicle_id,), rows in table.partition_by("vehicle_id", as_dict=True).items()}
    there = set(warehouse.scan(name).select("vehicle_id").unique().collect()["vehicle_id"])
    return {
        vehicle_id
        for vehicle_id in sorted(own.keys() | there)
        if not own.get(vehicle_id, table.clear()).equals(warehouse.scan(name, vehicle_id=vehicle_id).collect())
        and publish(root, vehicle_id, {name: own.get(vehicle_id, table.clear())}, ())
    }
