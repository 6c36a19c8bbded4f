"""What a vehicle flies with, from the warehouse: `calibration_at` a temperature as constants of three triads."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Literal, TypedDict

import numpy as np
import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.exports.calibration import Constants, Origin, Triad, cubic_about
from fieldcal.exports.flights import Flights
from fieldcal.geometry.rotation import Array
from fieldcal.names import INERTIAL_FIRST, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.stages.tables import AXES
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.questions import existing, units_flown
from fieldcal.words.rows import typed

CONSTANTS_OF_VEHICLE = """
SELECT a.*, l.slope_per_degc, l.slope_per_degc_sd, l.curve_per_degc2, l.curve_per_degc3,
    l.temperature_min_degc, l.temperature_max_degc
FROM calibration_at(?) AS a
JOIN latest_calibration AS l USING (unit_id, sensor, parameter, axis)
WHERE a.parameter IN ('scale', 'zero') AND a.vehicle_id = ?
"""


class _Axis(TypedDict):
    """A row of the answer: one parameter and axis."""

    imu_id: str
    unit_id: str
    is_primary: bool
    parameter: str
    axis: str
    value: float
    sd: float | None
    unit: str
    flight_id: str
    started_at: datetime | None
    why: str
    slope_per_degc: float | None
    slope_per_degc_sd: float | None
    curve_per_degc2: float | None
    curve_per_degc3: float | None
    temperature_min_degc: float | None
    temperature_max_degc: float | None


_Number = Literal["value", "sd", "slope_per_degc", "curve_per_degc2", "curve_per_degc3"]
_CURVE: tuple[_Number, ...] = ("slope_per_degc", "curve_per_degc2", "curve_per_degc3")


def constants_of(
    root: Path,
    vehicle_id: str,
    temperature_degc: float | None = None,
    unit_id: str | None = None,
    warehouse: Warehouse | None = None,
) -> Constants:
    """Constants at a temperature (default 25 °C) of the primary units that flew last on the vehicle, or of one unit.

    Scale and zero are what is looked up: the two hardly depend on each other, and the offset follows from both. Of a
    gyroscope in an autopilot's log its zeros are enough: an autopilot has a place for nothing else of it, and ordinary
    flights hardly show its scales.

    Raises
    ------
    FieldcalError
        `no_calibration`: no sensor of the vehicle has all its axes calibrated, or the vehicle is not known.
    """
    at = REFERENCE_DEGC if temperature_degc is None else float(temperature_degc)
    warehouse = warehouse or existing(root)
    rows = warehouse.sql(CONSTANTS_OF_VEHICLE, [at, vehicle_id])
    units = rows["unit_id"].unique().sort().to_list()
    if rows.is_empty():
        known = warehouse.scan("calibration").select("vehicle_id").unique().sort("vehicle_id").collect()["vehicle_id"]
        there = ", ".join(known.head(20).to_list()) or "none"
        raise FieldcalError(
            ReasonCode.NO_CALIBRATION, f"No calibration of vehicle {vehicle_id!r} is known; there is: {there}."
        )
    if unit_id is None:
        own = rows.join(units_flown(warehouse, vehicle_id), on=["sensor", "unit_id"], how="semi")
    else:
        own = rows.filter(pl.col("unit_id") == unit_id)
    if own.is_empty():
        told = "" if unit_id is None else f" of unit {unit_id!r}; there is: {', '.join(units)}"
        raise FieldcalError(ReasonCode.NO_CALIBRATION, f"No calibration of vehicle {vehicle_id!r} is known{told}.")
    flights = Flights(warehouse, vehicle_id)
    constants = _constants(vehicle_id, own, at, flights)
    if not constants.triads:
        raise FieldcalError(
            ReasonCode.NO_CALIBRATION,
            f'No sensor of {vehicle_id!r} has all its axes calibrated; `fieldcal sql "FROM refusals"` says why.',
        )
    if unit_id is not None:
        return constants
    beside = [rows.filter(pl.col("unit_id") == one) for one in flights.further]
    further = [_constants(vehicle_id, part, at, flights) for part in beside if not part.is_empty()]
    return replace(constants, further=tuple(one for one in further if one.triads))


def what_flies(
    root: Path, vehicle_id: str, temperature_degc: float | None = None, *, warehouse: Warehouse | None = None
) -> Constants:
    """`constants_of` the units that flew last, with the origin of every sensor, also of those without constants; no
    triads where none has any.

    Raises
    ------
    FieldcalError
        `no_calibration`: the vehicle is not known.
    """
    warehouse = warehouse or existing(root)
    flights = Flights(warehouse, vehicle_id)
    flown = units_flown(warehouse, vehicle_id).rows(named=True)
    try:
        known = constants_of(root, vehicle_id, temperature_degc, warehouse=warehouse)
    except FieldcalError as error:
        if error.reason_code != ReasonCode.NO_CALIBRATION or not flown:
            raise
        known = Constants(vehicle_id, flown[0]["imu_id"], {}, "")
    missing = [one for one in flown if one["sensor"] not in known.triads]
    origins = {
        one["sensor"]: flights.origin(one["sensor"], flights.latest(one["sensor"], one["unit_id"])) for one in missing
    }
    return replace(
        known,
        unit_ids={**known.unit_ids, **{one["sensor"]: one["unit_id"] for one in missing}},
        origins={**known.origins, **{sensor: origin for sensor, origin in origins.items() if origin is not None}},
    )


def _constants(vehicle_id: str, rows: pl.DataFrame, at: float, flights: Flights) -> Constants:
    """Constants from the rows of units; without triads where no sensor has all its axes."""
    origins: dict[str, Origin] = {}
    triads: dict[str, Triad] = {}
    for sensor in INERTIAL_FIRST:
        if (own := rows.filter(sensor=sensor)).is_empty():
            continue
        origin = flights.origin(sensor, own)
        holds_zeros_alone = sensor == Sensor.GYROSCOPE and origin is not None and origin.loaded is not None
        if (triad := _triad(own, at, scale_needed=not holds_zeros_alone)) is not None:
            triads[sensor] = triad
            if origin is not None:
                origins[sensor] = origin
    last = rows.sort(FLOWN_ORDER, nulls_last=False).row(-1, named=True)
    as_of = "" if last["started_at"] is None else last["started_at"].isoformat()
    ids = {s: str(rows.filter(sensor=s)["unit_id"][0]) for s in triads}
    rate_hz = flights.imu_rate_hz(str(last["flight_id"]))
    return Constants(vehicle_id, str(last["imu_id"]), triads, as_of, ids, origins, imu_rate_hz=rate_hz)


def _triad(rows: pl.DataFrame, at: float, *, scale_needed: bool) -> Triad | None:
    """One sensor's constants; None unless every axis has a zero and, where it is needed, a scale."""
    found = {(row["parameter"], row["axis"]): row for row in typed(rows.iter_rows(named=True), _Axis)}
    if any(("zero", axis) not in found for axis in AXES):
        return None
    if any(("scale", axis) not in found for axis in AXES):
        return None if scale_needed else _zeros_alone(found, at)
    full = all(
        (row := found.get(("scale", a + b))) is not None and row["flight_id"] == found["scale", a]["flight_id"]
        for a in AXES
        for b in AXES
    )
    names = [[a + b if full else a if a == b else "" for b in AXES] for a in AXES]

    def matrix(column: _Number) -> np.ndarray:
        return np.array([[_or_zero(found[("scale", n)][column]) if n else 0.0 for n in row] for row in names])

    def vector(parameter: str, column: _Number) -> np.ndarray:
        return np.array([found[parameter, axis][column] for axis in AXES], dtype=float)  # NaN where it is not known

    slope, square, cube = _zero_over_temperature(found, at)
    return Triad(
        scale=matrix("value"),
        zero=vector("zero", "value"),
        scale_per_degc=matrix("slope_per_degc"),
        zero_per_degc=slope,
        zero_per_degc2=square,
        zero_per_degc3=cube,
        zero_per_degc_sd=_slope_sd([found["zero", axis] for axis in AXES]),
        scale_sd=vector("scale", "sd"),
        zero_sd=vector("zero", "sd"),
        unit=_calibrated_unit(found),
        logged_unit=str(found["zero", "x"]["unit"]),
        temperature_degc=at,
        flown_degc=_flown_degc(found.values()),
        why=tuple(
            f"{parameter} {axis}: {found[parameter, axis]['why']}" for parameter in ("scale", "zero") for axis in AXES
        ),
    )


def _zeros_alone(found: Mapping[tuple[str, str], _Axis], at: float) -> Triad:
    """A sensor whose scales are 1 by its unit, as no flight tells them."""
    zeros = [found["zero", axis] for axis in AXES]
    slope, square, cube = _zero_over_temperature(found, at)
    return Triad(
        scale=np.eye(3),
        zero=np.array([row["value"] for row in zeros]),
        scale_per_degc=np.zeros((3, 3)),
        zero_per_degc=slope,
        zero_per_degc2=square,
        zero_per_degc3=cube,
        zero_per_degc_sd=_slope_sd(zeros),
        scale_sd=np.full(3, np.nan),
        zero_sd=np.array([np.nan if row["sd"] is None else row["sd"] for row in zeros]),
        unit=str(zeros[0]["unit"]),
        logged_unit=str(zeros[0]["unit"]),
        temperature_degc=at,
        flown_degc=_flown_degc(zeros),
        why=("scale: no flight tells it; 1", *(f"zero {axis}: {found['zero', axis]['why']}" for axis in AXES)),
        scale_nominal=True,
    )


def _zero_over_temperature(found: Mapping[tuple[str, str], _Axis], at: float) -> tuple[Array, Array, Array]:
    """Slope and bend of the zeros: the curve about 25 °C, brought to the temperature that is asked for."""
    first, second, third = (np.array([_or_zero(found["zero", axis][column]) for axis in AXES]) for column in _CURVE)
    return cubic_about(first, second, third, at - REFERENCE_DEGC)


def _flown_degc(rows: Iterable[_Axis]) -> tuple[float, float] | None:
    """The temperatures that all trends cover; None without a slope."""
    spans = [
        (low, high)
        for row in rows
        if row["slope_per_degc"] is not None
        and (low := row["temperature_min_degc"]) is not None
        and (high := row["temperature_max_degc"]) is not None
    ]
    return (max(low for low, _ in spans), min(high for _, high in spans)) if spans else None


def _slope_sd(rows: list[_Axis]) -> np.ndarray:
    """(3,): infinite where no slope is known, 0 where nobody knows how well."""
    known = [None if row["slope_per_degc"] is None else row["slope_per_degc_sd"] or 0.0 for row in rows]
    return np.array([np.inf if sd is None else sd for sd in known])


def _calibrated_unit(found: dict[tuple[str, str], _Axis]) -> str:
    """Unit of the result: a scale's unit is it per logged unit, or "1" where both are the same."""
    scale, logged = str(found["scale", "x"]["unit"]), str(found["zero", "x"]["unit"])
    divisor = f"/({logged})" if "/" in logged else f"/{logged}"
    return logged if scale == "1" else scale.removesuffix(divisor)


def _or_zero(value: float | None) -> float:
    return 0.0 if value is None else float(value)
