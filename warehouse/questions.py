"""Questions to the history that have a command of their own."""

from __future__ import annotations

from collections.abc import Collection
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting
from fieldcal.warehouse.errors import no_warehouse

MOST_NAMED = 5
COLUMNS = (
    "started_at",
    "vehicle_id",
    "imu_id",
    "unit_id",
    "session_id",
    "dated_by",
    "flight_id",
    "sensor",
    "method",
    "parameter",
    "axis",
    "value",
    "sd",
    "unit",
    "temperature_degc",
    "status",
    "reason_code",
)


def calibration_history(
    root: Path, vehicle: str | None, sensor: str | None, parameter: str | None, since: str | None
) -> pl.DataFrame:
    """Rows of `calibration`, oldest flight first, flights of unknown time at the end.

    Raises
    ------
    FieldcalError
        `not_found`: the history has no such vehicle, sensor or parameter. `wrong_option`: `since` is no date.
    """
    rows = those_asked_for(existing(root), "calibration", vehicle, sensor, parameter)
    if since is not None:
        rows = rows.filter(pl.col("started_at") >= moment_of("--since", since))
    order = ["started_at", "vehicle_id", "sequence", "flight_id", "unit_id", "sensor", "method", "parameter", "axis"]
    return rows.sort(order, nulls_last=True).select(COLUMNS).collect()


def those_asked_for(
    warehouse: Warehouse, table: str, vehicle: str | None, sensor: str | None, parameter: str | None
) -> pl.LazyFrame:
    """Rows of a table of these alone. A name that the history does not have is a mistake, not an empty answer.

    Raises
    ------
    FieldcalError
        `not_found`, with the nearest that there is.
    """
    rows = warehouse.scan(table, vehicle_id=vehicle)
    if vehicle is not None and rows.head(1).collect().is_empty():
        known_vehicle(warehouse, vehicle)
    for column, wanted in (("sensor", sensor), ("parameter", parameter)):
        if wanted is None:
            continue
        rows = rows.filter(pl.col(column) == wanted)
        if not rows.head(1).collect().is_empty():
            continue
        known = warehouse.scan(table).select(pl.col(column).unique()).collect()[column].to_list()
        if known and wanted not in known:
            told = f"No {column} {wanted!r} is in table {table}; {nearest(wanted, known)}."
            raise FieldcalError(ReasonCode.NOT_FOUND, told)
    return rows


def known_vehicle(warehouse: Warehouse, vehicle_id: str) -> None:
    """Make sure that the history has flights of a vehicle.

    Raises
    ------
    FieldcalError
        `not_found`, with the nearest that there are.
    """
    known = warehouse.scan("flight").select(pl.col("vehicle_id").unique()).collect()["vehicle_id"].to_list()
    if vehicle_id not in known:
        told = f'No flight of a vehicle "{vehicle_id}" is in the history; {nearest(vehicle_id, known)}.'
        raise FieldcalError(ReasonCode.NOT_FOUND, told)


def nearest(wanted: str, known: Collection[str]) -> str:
    """What there is instead of a name that is not: those most like it, else the first."""
    from difflib import get_close_matches

    near = get_close_matches(wanted, sorted(known), n=3, cutoff=0.5) or sorted(known)[:MOST_NAMED]
    return f"there is {', '.join(near)}" if near else "the history is empty"


def units_flown(warehouse: Warehouse, vehicle_id: str | None = None) -> pl.DataFrame:
    """vehicle_id, imu_id, unit_id, sensor: what each vehicle flew with last, calibrated or refused: the primary unit of
    each sensor, on the IMU of its latest flight that was not withdrawn."""
    last = (
        warehouse.scan("calibration", vehicle_id=vehicle_id)
        .filter("is_primary", counting(warehouse.root))
        .select("vehicle_id", "imu_id", "unit_id", "sensor", *FLOWN_ORDER)
        .unique()  # a flight has a hundred rows of a sensor
        .sort(FLOWN_ORDER, nulls_last=False)
        .with_columns(now=pl.col("imu_id").last().over("vehicle_id"))
        .filter(pl.col("imu_id") == pl.col("now"))
    )
    ids = pl.col("imu_id", "unit_id").last()
    return last.group_by("vehicle_id", "sensor").agg(ids).sort("vehicle_id", "sensor").collect(engine="streaming")


def existing(root: Path) -> Warehouse:
    """The warehouse at `root`.

    Raises
    ------
    WarehouseError
        `no_warehouse`.
    """
    if not root.is_dir():
        raise no_warehouse(root)
    return Warehouse(root)


def moment_of(option: str, text: str) -> datetime:
    """The moment that an option of the command line names; UTC where it has no zone.

    Raises
    ------
    FieldcalError
        `wrong_option`.
    """
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise FieldcalError(
            ReasonCode.WRONG_OPTION, f'{option} needs a date such as 2026-05-04, not "{text}".'
        ) from error
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
