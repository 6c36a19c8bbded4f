"""Which vehicles are fine to fly with their constants, which are not, and why: said once, for whoever tells it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import polars as pl

from fieldcal.config.configuration import Alerts
from fieldcal.names import GRAVEST_FIRST, SENSORS, DriftStatus, Sensor, Standing, Status, Verdict
from fieldcal.report.history import usable_flights
from fieldcal.report.trend import change_sentence
from fieldcal.report.words import plain_name
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.reference import UNCONFIRMED_SD
from fieldcal.schemas.rows import DriftRow, FlightRow, UnfoldedRun
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.trends.changes import TELLING, last_usable
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting
from fieldcal.warehouse.questions import units_flown
from fieldcal.words.flights import is_consequence
from fieldcal.words.rows import typed, unfolded


@dataclass(frozen=True)
class Fitness:
    """A vehicle's standing. `reasons`: a sentence each, the gravest first; none where it is fine."""

    vehicle_id: str
    standing: Standing
    reasons: tuple[str, ...] = ()

    def why(self, most: int) -> str:
        """The gravest reasons, and how many others there are; "" where it is fine."""
        more = len(self.reasons) - most
        return " ".join(self.reasons[:most]) + (f" (and {more} more)" if more > 0 else "")


def ranked(fleet: Mapping[str, Fitness]) -> list[Fitness]:
    """What needs a look first."""
    order = list(Standing)
    return sorted(fleet.values(), key=lambda one: (order.index(one.standing), one.vehicle_id))


def fleet_fitness(
    warehouse: Warehouse, alerts: Alerts, now: datetime, vehicles: Collection[str] | None = None
) -> dict[str, Fitness]:
    """Each vehicle's standing, by its id. A calibration that is older than `alerts.expires_days` at `now` has expired.

    What counts: trends of the units that it flew with last, what its latest log is good for, and how old the constants
    of each sensor are.
    """
    flights = warehouse.scan("flight").filter(counting(warehouse.root)).sort(FLOWN_ORDER, nulls_last=False).collect()
    flown, drift = units_flown(warehouse), warehouse.scan("drift").collect()
    usable = usable_flights(warehouse)
    ages = last_usable(warehouse.root, warehouse)
    trends = _by_vehicle(
        flown.join(drift.drop("vehicle_id", "imu_id"), on=["unit_id", "sensor"], maintain_order="left_right")
    )
    latest, units, known = _by_vehicle(flights), _by_vehicle(flown), _by_vehicle(usable)
    dated = _by_vehicle(ages.join(flown, on=["vehicle_id", "unit_id", "sensor"], how="semi"))
    nothing = pl.DataFrame()
    every = sorted(warehouse.scan("flight").select(pl.col("vehicle_id").unique()).collect()["vehicle_id"].to_list())
    limit = now - timedelta(days=alerts.expires_days)
    return {
        vehicle: _fitness(
            warehouse,
            vehicle,
            trends.get(vehicle, nothing),
            latest.get(vehicle, nothing),
            units.get(vehicle, nothing),
            dated.get(vehicle, nothing),
            known.get(vehicle, nothing),
            limit,
            alerts,
        )
        for vehicle in every
        if vehicles is None or vehicle in vehicles
    }


def _by_vehicle(rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
    return {str(key[0]): part for key, part in rows.partition_by("vehicle_id", as_dict=True).items()}


def _fitness(
    warehouse: Warehouse,
    vehicle: str,
    trend: pl.DataFrame,
    flights: pl.DataFrame,
    units: pl.DataFrame,
    ages: pl.DataFrame,
    usable: pl.DataFrame,
    limit: datetime,
    alerts: Alerts,
) -> Fitness:
    last = None if flights.is_empty() else typed([flights.row(-1, named=True)], FlightRow)[0]
    if usable.is_empty():
        told = (
            "No flight counts." if last is None else f"No flight gave a constant. {_why_none(warehouse, last)}".strip()
        )
        return Fitness(vehicle, Standing.NOTHING, (told,))
    rows = typed(trend.iter_rows(named=True), DriftRow)
    reasons = [*_moving(rows), *_of_last(warehouse, last, usable), *_old(units, ages, limit, alerts)]
    if reasons:
        return Fitness(vehicle, Standing.LOOK, tuple(dict.fromkeys(reasons)))
    if not rows:
        return Fitness(vehicle, Standing.TOO_FEW, ("Trends are not analysed yet.",))
    if all(row["status"] == DriftStatus.INSUFFICIENT for row in rows):
        return Fitness(vehicle, Standing.TOO_FEW, tuple(sorted({str(r["reason"]) for r in rows if r["reason"]})[:1]))
    return Fitness(vehicle, Standing.FINE)


def _moving(rows: list[DriftRow]) -> Iterator[str]:
    """What drifts, stepped or stands out, an axis once, by the parameter that tells most; then flights off the line."""
    seen: set[tuple[str, str, str]] = set()
    for row in sorted(rows, key=_gravity):
        place = row["unit_id"], row["sensor"], row["axis"]
        about = f"{plain_name(row['sensor'])} {row['axis']} {row['parameter']}"
        if row["status"] not in (DriftStatus.STABLE, DriftStatus.INSUFFICIENT):
            if place not in seen:
                yield f"{about}: {row['status']}. {change_sentence(row, [])}"
        elif abs(row["last_z"] or 0.0) > UNCONFIRMED_SD:
            if place not in seen:
                yield f"{about}: the last flight lies {abs(row['last_z'] or 0.0):.1f} sd off the trend."
        else:
            continue
        seen.add(place)


def _gravity(row: DriftRow) -> tuple[int, str, int, str, str]:
    order = {str(status): i for i, status in enumerate(GRAVEST_FIRST)}
    telling = TELLING.index(row["parameter"]) if row["parameter"] in TELLING else len(TELLING)
    return order.get(row["status"], len(order)), row["sensor"], telling, row["axis"], row["method"]


def _of_last(warehouse: Warehouse, last: FlightRow | None, usable: pl.DataFrame) -> Iterator[str]:
    if last is None:
        return
    if last["verdict"] != Verdict.OK:
        yield f"Latest log {last['verdict']}: {last['reason'] or last['reason_code']}"
    elif last["flight_id"] not in usable["flight_id"].to_list():
        yield f"The latest flight gave no constant. {_why_none(warehouse, last)}".strip()


def _why_none(warehouse: Warehouse, flight: FlightRow) -> str:
    """What stopped the first stage of a flight that stopped by itself; nothing where nothing is known."""
    if flight["reason"]:
        return str(flight["reason"])
    ids = {"vehicle_id": flight["vehicle_id"], "flight_id": flight["flight_id"]}
    rows = warehouse.scan("run", **ids).filter("is_primary").collect()
    stopped = [
        row
        for row in typed(map(unfolded, rows.iter_rows(named=True)), UnfoldedRun)
        if row["status"] in (Status.REFUSED, Status.FAILED) and not is_consequence(row)
    ]
    order = {stage.name: i for i, stage in enumerate(PIPELINE)}
    first = min(stopped, key=lambda row: order.get(row["stage"], len(order)), default=None)
    return "" if first is None else str(first["measured"].get("reason") or first["reason_code"])


def _old(units: pl.DataFrame, ages: pl.DataFrame, limit: datetime, alerts: Alerts) -> Iterator[str]:
    at = {} if ages.is_empty() else dict(ages.group_by("sensor").agg(pl.col("last_at").max()).iter_rows())
    aboard = [] if units.is_empty() else units["sensor"].to_list()
    expired: dict[str, list[str]] = {}
    for sensor in (name for name in SENSORS if name in aboard):
        when = at.get(sensor)
        if when is not None and when < limit:
            expired.setdefault(f"{when:%Y-%m-%d}", []).append(Sensor(sensor).value)
    for when, sensors in expired.items():
        yield f"Expired: {', '.join(sensors)} last calibrated on {when}; that counts for {alerts.expires_days:g} days."


def remembered_alerts(root: Path) -> Alerts:
    """The limits of the last night; those by default where there was none."""
    from fieldcal.warehouse.sealed import BrokenSeal, unseal

    try:
        return Alerts.model_validate(unseal((root / "night" / "closing.json").read_bytes())["alerts"])
    except (OSError, BrokenSeal, KeyError, ValueError):
        return Alerts()
