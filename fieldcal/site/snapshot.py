"""The history read once, and asked by many pages."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import polars as pl

from fieldcal.exports.calibration_at import CONSTANTS_OF_VEHICLE
from fieldcal.report.history import REFUSALS_OF_VEHICLE
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse import Warehouse

if TYPE_CHECKING:
    from fieldcal.warehouse.sql import Limits, SqlValue

OF_ALL = {
    REFUSALS_OF_VEHICLE: REFUSALS_OF_VEHICLE.replace("vehicle_id = ? AND ", ""),
    CONSTANTS_OF_VEHICLE: CONSTANTS_OF_VEHICLE.replace(" AND a.vehicle_id = ?", ""),
}
"""What is asked of one vehicle, the last parameter → the same of all."""
MANY_ROWS = ("calibration", "fit", "information", "moments", "run")


class Snapshot(Warehouse):
    """A warehouse as it is at the first question: tables and answers are kept, so that the thousandth page costs what
    it shows. Of tables that have many rows a flight one vehicle's are, the one whose pages are being made: those of a
    whole fleet would not fit."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._tables: dict[str, pl.DataFrame] = {}
        self._vehicle: tuple[str, dict[str, pl.DataFrame]] = "", {}
        self._flights: dict[str, dict[str, pl.DataFrame]] = {}
        self._parts: dict[tuple[str, str], dict[str, pl.DataFrame]] = {}
        self._answers: dict[tuple[str, tuple[SqlValue, ...]], pl.DataFrame] = {}

    def scan(self, table: str, *, vehicle_id: str | None = None, flight_id: str | None = None) -> pl.LazyFrame:
        """As `Warehouse.scan`; signals are read anew."""
        if table not in HISTORY_TABLES:
            return super().scan(table, vehicle_id=vehicle_id, flight_id=flight_id)
        if table in MANY_ROWS:
            if vehicle_id is None:
                return super().scan(table, flight_id=flight_id)
            rows = self._of_vehicle(table, vehicle_id)
            return (rows if flight_id is None else self._of_flight(table, rows, flight_id)).lazy()
        rows = self._whole(table)
        for column, wanted in (("vehicle_id", vehicle_id), ("flight_id", flight_id)):
            if wanted is not None and (column == "vehicle_id" or vehicle_id is None):
                rows = self._part(table, column, rows).get(wanted, rows.clear())
        if vehicle_id is not None and flight_id is not None:
            rows = rows.filter(pl.col("flight_id") == flight_id)
        return rows.lazy()

    def sql(self, query: str, parameters: Sequence[SqlValue] | None = None, **limits: Unpack[Limits]) -> pl.DataFrame:
        """As `Warehouse.sql`; what each vehicle's page asks is asked of the whole fleet at once."""
        if query in OF_ALL and parameters:
            return self.sql(OF_ALL[query], parameters[:-1], **limits).filter(pl.col("vehicle_id") == parameters[-1])
        key = (query, tuple(parameters or ()))
        if key not in self._answers:
            self._answers[key] = super().sql(query, parameters, **limits)
        return self._answers[key]

    def sharing_units(self, vehicle_id: str) -> list[str]:
        """The vehicle and those others that carried any of its units."""
        return sorted({vehicle_id, *self._sharing.get(vehicle_id, ())})

    @cached_property
    def _sharing(self) -> dict[str, list[str]]:
        carried = super().scan("calibration").select("vehicle_id", "unit_id").unique().collect()
        both = carried.join(carried, on="unit_id", suffix="_other").select("vehicle_id", "vehicle_id_other").unique()
        return {str(own): rows["vehicle_id_other"].to_list() for (own,), rows in both.group_by("vehicle_id")}

    def _whole(self, table: str) -> pl.DataFrame:
        if table not in self._tables:
            self._tables[table] = super().scan(table).collect()
        return self._tables[table]

    def _of_vehicle(self, table: str, vehicle_id: str) -> pl.DataFrame:
        if self._vehicle[0] != vehicle_id:
            self._vehicle, self._flights = (vehicle_id, {}), {}
        kept = self._vehicle[1]
        if table not in kept:
            kept[table] = super().scan(table, vehicle_id=vehicle_id).collect()
        return kept[table]

    def _of_flight(self, table: str, rows: pl.DataFrame, flight_id: str) -> pl.DataFrame:
        if table not in self._flights:
            self._flights[table] = _by(rows, "flight_id")
        return self._flights[table].get(flight_id, rows.clear())

    def _part(self, table: str, column: str, rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
        key = (table, column)
        if key not in self._parts:
            self._parts[key] = _by(rows, column)
        return self._parts[key]


def _by(rows: pl.DataFrame, column: str) -> dict[str, pl.DataFrame]:
    parts = rows.partition_by(column, as_dict=True, maintain_order=True)
    return {str(name): part for (name,), part in parts.items()}
