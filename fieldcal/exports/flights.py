"""What the history tells of the flights that a vehicle's constants come from: where readings came from, what flew."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from typing import Any, cast

import polars as pl

from fieldcal.config.loaded import Loaded
from fieldcal.exports.calibration import Origin
from fieldcal.names import Rotation
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.stages.composition import ORIGIN
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting


class Flights:
    """The flights of a vehicle."""

    def __init__(self, warehouse: Warehouse, vehicle_id: str) -> None:
        self._warehouse = warehouse
        self._vehicle_id = vehicle_id

    @cached_property
    def further(self) -> list[str]:
        """unit_id of each unit that was on board the latest flight, of those not withdrawn, beside the primary ones."""
        rows = self._warehouse.scan("calibration", vehicle_id=self._vehicle_id)
        rows = rows.filter(counting(self._warehouse.root))
        latest = rows.sort(FLOWN_ORDER, nulls_last=False).select("flight_id").last().collect()
        if latest.is_empty():
            return []
        own = rows.filter(pl.col("flight_id") == latest["flight_id"][0], ~pl.col("is_primary"))
        return own.select("unit_id").unique().sort("unit_id").collect()["unit_id"].to_list()

    def latest(self, sensor: str, unit_id: str) -> pl.DataFrame:
        """Rows of a unit's sensor in the latest flight that counts, for `origin`, whether calibrated or refused."""
        rows = self._warehouse.scan("calibration", vehicle_id=self._vehicle_id)
        rows = rows.filter(counting(self._warehouse.root), pl.col("sensor") == sensor, pl.col("unit_id") == unit_id)
        return rows.sort(FLOWN_ORDER, nulls_last=False).tail(1).collect()

    def origin(self, sensor: str, rows: pl.DataFrame) -> Origin | None:
        """Where a sensor's readings came from in the latest flight among rows of it; None where the history does not
        tell, as one of before this was kept.

        `rows`: columns flight_id, unit_id, is_primary, started_at, sequence.
        """
        last = rows.sort(FLOWN_ORDER, nulls_last=False).row(-1, named=True)
        runs = self._runs.filter(pl.col("flight_id") == last["flight_id"])
        own = runs.filter("is_primary") if last["is_primary"] else runs.filter(unit_id=last["unit_id"])
        if own.is_empty():
            return None
        told = json.loads(own["measured"][0] or "{}").get(ORIGIN)
        if told is None:
            return None
        temperature = (
            self._warehouse.scan("calibration", vehicle_id=self._vehicle_id)
            .filter(
                pl.col("flight_id") == last["flight_id"],
                pl.col("unit_id") == last["unit_id"],
                pl.col("sensor") == sensor,
                pl.col("parameter") == "zero",
                pl.col("status") == "ok",
            )
            .select("temperature_degc")
            .drop_nulls()
            .collect()
        )
        return origin_of(told, sensor, None if temperature.is_empty() else float(temperature["temperature_degc"][0]))

    def imu_rate_hz(self, flight_id: str) -> float | None:
        """Rate of a flight's readings; None where it is not known."""
        rows = self._warehouse.scan("flight", vehicle_id=self._vehicle_id).filter(pl.col("flight_id") == flight_id)
        found = rows.select("imu_rate_hz").collect()["imu_rate_hz"].to_list()
        return found[0] if found else None

    @cached_property
    def _runs(self) -> pl.DataFrame:
        rows = self._warehouse.scan("run", vehicle_id=self._vehicle_id).filter(pl.col("stage") == "composition")
        return rows.select("flight_id", "unit_id", "is_primary", "measured").collect()


def origin_of(told: Mapping[str, Any], sensor: str, temperature_degc: float | None) -> Origin:
    """What stage `composition` measured, of one sensor."""
    own = told["loaded"].get(sensor)
    loaded = None
    if own is not None:
        loaded = Loaded(own["autopilot"], own["device_id"], _rotation(own["rotation"]), own["parameters"])
    turn = _rotation(told["rotation_body_from_sensor"])
    return Origin(
        loaded,
        told["body"],
        told["gravity_sign"],
        turn,
        temperature_degc,
        told["horizontal_field_g"],
        told.get("horizontal_share"),  # not kept at first
    )


def _rotation(rows: list[list[float]]) -> Rotation:
    return cast(Rotation, tuple(tuple(row) for row in rows))
