"""Which vehicles are fine to fly with their constants, which are not, and why: said once, for whoever tells it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Self

import polars as pl

from fieldcal.config.configuration import Alerts, Configuration, Tolerances
from fieldcal.errors import FieldcalError
from fieldcal.exports.autopilots.comparison import compared
from fieldcal.exports.calibration_at import what_flies
from fieldcal.names import GRAVEST_FIRST, SENSORS, DriftStatus, Sensor, Standing, Status, Verdict
from fieldcal.report.history import last_usable, usable_flights
from fieldcal.report.standing.due import ZERO, Due, Flown, due_of, next_sentence
from fieldcal.report.standing.reason import EXPIRED, FEW, IDLE, LAST_FLIGHT, LATEST_LOG, LIMIT, Reason
from fieldcal.report.trend import change_sentence
from fieldcal.report.words import plain_name
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.reference import UNCONFIRMED_SD
from fieldcal.schemas.rows import DriftRow, FlightRow, UnfoldedRun
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.trends.reasons import AGREEMENT, VPS, status_words
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting
from fieldcal.warehouse.questions import units_flown
from fieldcal.words.flights import is_consequence
from fieldcal.words.rows import typed, unfolded

TELLING = ("zero_bias", "zero", "scale", "bias")
"""Which parameter speaks for an axis first: the best conditioned."""


@dataclass(frozen=True)
class Criteria:
    """By what vehicles are judged: the ages of `[alerts]` and the limits of `[limits]`."""

    alerts: Alerts = field(default_factory=Alerts)
    tolerances: Tolerances = field(default_factory=Tolerances)

    @classmethod
    def of(cls, configuration: Configuration) -> Self:
        """What fieldcal.toml says."""
        return cls(configuration.alerts, configuration.tolerances)


@dataclass(frozen=True)
class Fitness:
    """A vehicle's standing. `told`: why it needs a look, the gravest first; none where it is fine. `notes`: what else
    there is to say, which keeps nobody from flying; `next`: when to calibrate again, "" without limits."""

    vehicle_id: str
    standing: Standing
    told: tuple[Reason, ...] = ()
    notes: tuple[Reason, ...] = ()
    next: str = ""

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences of `told`, each once."""
        return tuple(dict.fromkeys(reason.sentence for reason in self.told))

    def why(self, most: int) -> str:
        """The gravest reasons, and how many others there are; "" where it is fine."""
        more = len(self.reasons) - most
        return " ".join(self.reasons[:most]) + (f" (and {more} more)" if more > 0 else "")


def ranked(fleet: Mapping[str, Fitness]) -> list[Fitness]:
    """What needs a look first."""
    order = list(Standing)
    return sorted(fleet.values(), key=lambda one: (order.index(one.standing), one.vehicle_id))


def fleet_fitness(
    warehouse: Warehouse, criteria: Criteria, now: datetime, vehicles: Collection[str] | None = None
) -> dict[str, Fitness]:
    """Each vehicle's standing, by its id. A calibration that is older than `alerts.expires_days` at `now` has expired.

    What counts: trends of the units that it flew with last, by how much its constants may be off by now, what its
    latest log is good for, and how old the constants of each sensor are.
    """
    flights = warehouse.scan("flight").filter(counting(warehouse.root)).sort(FLOWN_ORDER, nulls_last=False).collect()
    flown, drift = units_flown(warehouse), warehouse.scan("drift").collect()
    usable = usable_flights(warehouse)
    ages = last_usable(warehouse)
    on_board = flown.select("vehicle_id", "imu_id", "unit_id").unique(maintain_order=True)
    carried = drift.drop("vehicle_id", "imu_id")
    trends = flown.join(carried, on=["unit_id", "sensor"], maintain_order="left_right")
    beside = on_board.join(carried.filter(pl.col("sensor").is_in([VPS, AGREEMENT])), on="unit_id")
    parts = {
        "trends": trends,
        "beside": beside,
        "flights": flights,
        "units": flown,
        "ages": ages.join(flown, on=["vehicle_id", "unit_id", "sensor"], how="semi"),
        "usable": usable,
    }
    by_vehicle = {name: _by_vehicle(rows) for name, rows in parts.items()}
    every = sorted(warehouse.scan("flight").select(pl.col("vehicle_id").unique()).collect()["vehicle_id"].to_list())
    nothing = pl.DataFrame()
    return {
        vehicle: _fitness(
            warehouse, vehicle, {name: rows.get(vehicle, nothing) for name, rows in by_vehicle.items()}, criteria, now
        )
        for vehicle in every
        if vehicles is None or vehicle in vehicles
    }


def _by_vehicle(rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
    return {str(key[0]): part for key, part in rows.partition_by("vehicle_id", as_dict=True).items()}


def _fitness(
    warehouse: Warehouse, vehicle: str, of: Mapping[str, pl.DataFrame], criteria: Criteria, now: datetime
) -> Fitness:
    flights, usable, alerts = of["flights"], of["usable"], criteria.alerts
    last = None if flights.is_empty() else typed([flights.row(-1, named=True)], FlightRow)[0]
    notes = (*_moving(typed(of["beside"].iter_rows(named=True), DriftRow)), *_idle(of["ages"], alerts, now))
    if usable.is_empty():
        told = (
            "No flight counts." if last is None else f"No flight gave a constant. {_why_none(warehouse, last)}".strip()
        )
        return Fitness(vehicle, Standing.NOTHING, (Reason(LATEST_LOG, told),), notes)
    rows = typed(of["trends"].iter_rows(named=True), DriftRow)
    due: list[Due] = []
    if criteria.tolerances.given:
        due = due_of(rows, criteria.tolerances, _flown(warehouse, vehicle), now)
    following = next_sentence(due)
    reasons = [
        *_moving(rows),
        *(Reason(LIMIT, d.sentence, d.imu_id, d.unit_id, d.sensor, d.axis, (ZERO,)) for d in due if d.passed),
        *_of_last(warehouse, last, usable),
        *_old(of["units"], of["ages"], alerts, now),
    ]
    if reasons:
        return Fitness(vehicle, Standing.LOOK, tuple(reasons), notes, following)
    few = all(row["status"] == DriftStatus.INSUFFICIENT for row in rows)
    if few:
        why = sorted({str(row["reason"]) for row in rows if row["reason"]})[:1] or ["Trends are not analysed yet."]
        return Fitness(vehicle, Standing.TOO_FEW, (Reason(FEW, why[0]),), notes, following)
    return Fitness(vehicle, Standing.FINE, (), notes, following)


def _flown(warehouse: Warehouse, vehicle: str) -> Flown:
    """What is known of the constants that it flies with."""
    exports = (
        warehouse.scan("export", vehicle_id=vehicle).group_by("unit_id", "sensor").agg(pl.col("exported_at").max())
    )
    exported = {(unit_id, sensor): at for unit_id, sensor, at in exports.collect().iter_rows()}
    try:
        constants = what_flies(warehouse.root, vehicle, warehouse=warehouse)
    except FieldcalError:
        return Flown(exported, (), None)
    origin = constants.origins.get(Sensor.MAGNETOMETER)
    field = (None, None) if origin is None else (origin.horizontal_field_g, origin.horizontal_share)
    try:
        return Flown(exported, compared(constants)[0], *field)
    except FieldcalError:  # no autopilot's
        return Flown(exported, (), *field)


def _moving(rows: list[DriftRow]) -> Iterator[Reason]:
    """What drifts, stepped or stands out, an axis once, by the parameter that tells most; then flights off the line."""
    seen: set[tuple[str, str, str]] = set()
    for row in sorted(rows, key=_gravity):
        place = row["unit_id"], row["sensor"], row["axis"]
        is_steady = row["status"] in (DriftStatus.STABLE, DriftStatus.INSUFFICIENT)
        if place in seen or (is_steady and abs(row["last_z"] or 0.0) <= UNCONFIRMED_SD):
            continue
        seen.add(place)
        about = " ".join(filter(None, (plain_name(row["sensor"]), row["axis"], row["parameter"])))
        alike = [other["parameter"] for other in rows if _place(other) == place and other["status"] == row["status"]]
        told = (
            f"{about}: the last flight lies {abs(row['last_z'] or 0.0):.1f} sd off the trend."
            if is_steady
            else f"{about}: {status_words(row)}. {change_sentence(row, [])}"
        )
        yield Reason(
            LAST_FLIGHT if is_steady else row["status"],
            told,
            row["imu_id"],
            *place,
            (row["parameter"],) if is_steady else tuple(dict.fromkeys([row["parameter"], *alike])),
            "" if row["change_at"] is None or is_steady else row["change_at"].isoformat(),
        )


def _place(row: DriftRow) -> tuple[str, str, str]:
    return row["unit_id"], row["sensor"], row["axis"]


def _gravity(row: DriftRow) -> tuple[int, str, int, str, str]:
    order = {str(status): i for i, status in enumerate(GRAVEST_FIRST)}
    telling = TELLING.index(row["parameter"]) if row["parameter"] in TELLING else len(TELLING)
    return order.get(row["status"], len(order)), row["sensor"], telling, row["axis"], row["method"]


def _of_last(warehouse: Warehouse, last: FlightRow | None, usable: pl.DataFrame) -> Iterator[Reason]:
    if last is None:
        return
    if last["verdict"] != Verdict.OK:
        yield Reason(LATEST_LOG, f"Latest log {last['verdict']}: {last['reason'] or last['reason_code']}")
    elif last["flight_id"] not in usable["flight_id"].to_list():
        yield Reason(LATEST_LOG, f"The latest flight gave no constant. {_why_none(warehouse, last)}".strip())


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


def _old(units: pl.DataFrame, ages: pl.DataFrame, alerts: Alerts, now: datetime) -> Iterator[Reason]:
    at = {} if ages.is_empty() else dict(ages.group_by("sensor").agg(pl.col("last_at").max()).iter_rows())
    aboard = [] if units.is_empty() else units["sensor"].to_list()
    expired: dict[str, list[str]] = {}
    for sensor in (name for name in SENSORS if name in aboard):
        when = at.get(sensor)
        if when is not None and when < now - timedelta(days=alerts.expires_days):
            expired.setdefault(f"{when:%Y-%m-%d}", []).append(Sensor(sensor).value)
    for when, sensors in expired.items():
        told = f"Expired: {', '.join(sensors)} last calibrated on {when}; that counts for {alerts.expires_days:g} days."
        yield Reason(
            EXPIRED, told, sensor=sensors[0] if len(sensors) == 1 else None, mark=f"{', '.join(sensors)} {when}"
        )


def _idle(ages: pl.DataFrame, alerts: Alerts, now: datetime) -> Iterator[Reason]:
    last = None if ages.is_empty() else ages["last_at"].max()
    if isinstance(last, datetime) and last < now - timedelta(days=alerts.idle_days):
        told = f"No usable flight for {(now - last).days} days, since {last:%Y-%m-%d}."
        yield Reason(IDLE, told, mark=f"{last:%Y-%m-%d}")
