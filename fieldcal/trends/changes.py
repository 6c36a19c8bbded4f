"""What a night changed: new drift, steps, outliers, flights off the line, calibrations that expired, vehicles idle."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TypedDict

import polars as pl

from fieldcal.config.configuration import Alerts
from fieldcal.names import GRAVEST_FIRST, PREFERRED_METHODS, DriftStatus, Status
from fieldcal.schemas import table_key
from fieldcal.schemas.reference import UNCONFIRMED_SD
from fieldcal.trends.reasons import AGREEMENT
from fieldcal.warehouse import Warehouse

NORMAL = Alerts()
STATUSES = GRAVEST_FIRST[:3]
KINDS: tuple[str, ...] = (*STATUSES, "last_flight", "recovered", "expired", "idle")
TELLING = ("zero_bias", "zero", "scale", "bias")
"""Which parameter speaks for an axis first: the best conditioned."""
SERIES = list(table_key("drift"))


class PlainChange(TypedDict):
    """A `Change` as plain JSON."""

    kind: str
    vehicle_id: str
    imu_id: str | None
    unit_id: str | None
    sensor: str | None
    axis: str | None
    parameters: list[str]
    sentence: str


@dataclass(frozen=True)
class Change:
    """One change to report, `sentence` for people. `parameters` of an axis with the same change are reported
    together."""

    kind: str
    vehicle_id: str
    imu_id: str | None
    unit_id: str | None
    sensor: str | None
    axis: str | None
    parameters: tuple[str, ...]
    sentence: str

    def row(self) -> PlainChange:
        """As a JSON object."""
        return {
            "kind": self.kind,
            "vehicle_id": self.vehicle_id,
            "imu_id": self.imu_id,
            "unit_id": self.unit_id,
            "sensor": self.sensor,
            "axis": self.axis,
            "parameters": list(self.parameters),
            "sentence": self.sentence,
        }


def changes(
    former: pl.DataFrame,
    table: pl.DataFrame,
    latest: pl.DataFrame,
    *,
    now: datetime,
    since: datetime | None = None,
    alerts: Alerts = NORMAL,
) -> list[Change]:
    """What tonight reports and the night before did not, the gravest first.

    Parameters
    ----------
    former, table : DataFrame
        The table `drift` before the night and after it.
    latest : DataFrame
        `last_usable` of the warehouse.
    now, since : datetime
        Time of this night and of the one before. Without `since` every expired calibration and idle vehicle is
        reported.
    alerts : Alerts
        Age at which a sensor's latest calibration, a vehicle's latest usable flight, is to be reported.
    """
    both = table.join(former.select(*SERIES, "status", "last_z", "change_at"), on=SERIES, how="left", suffix="_before")
    found = [*_news(both), *_ages(latest, now, since, alerts)]
    return sorted(found, key=lambda c: (KINDS.index(c.kind), c.vehicle_id, c.sensor or "", c.axis or ""))


def last_usable(root: Path, warehouse: Warehouse | None = None) -> pl.DataFrame:
    """vehicle_id, imu_id, unit_id, sensor, last_at: latest flight with a time that calibrated each sensor."""
    return (
        (warehouse or Warehouse(root))
        .scan("calibration")
        .filter((pl.col("status") == Status.OK) & pl.col("started_at").is_not_null())
        .group_by("vehicle_id", "imu_id", "unit_id", "sensor")
        .agg(last_at=pl.col("started_at").max())
        .sort("vehicle_id", "imu_id", "unit_id", "sensor")
        .collect()
    )


def _news(both: pl.DataFrame) -> Iterable[Change]:
    """Rows whose status became worse or well again, whose step is another, or whose last flight is newly off."""
    status, before = pl.col("status"), pl.col("status_before")
    off, off_before = (pl.col(name).abs().fill_null(0.0) > UNCONFIRMED_SD for name in ("last_z", "last_z_before"))
    another = (status == DriftStatus.STEP) & (pl.col("change_at") != pl.col("change_at_before"))
    kind = (
        pl.when(status.is_in(STATUSES) & (status.ne_missing(before) | another.fill_null(False)))
        .then(status)
        .when((status == DriftStatus.STABLE) & off & ~off_before)
        .then(pl.lit("last_flight"))
        .when((status == DriftStatus.STABLE) & before.is_in(STATUSES))
        .then(pl.lit("recovered"))
    )
    ranked: tuple[tuple[str, tuple[str, ...]], ...] = (("parameter", TELLING), ("method", PREFERRED_METHODS))
    rank = [
        pl.col(name).replace_strict(
            {str(value): i for i, value in enumerate(order)}, default=len(order), return_dtype=pl.Int64
        )
        for name, order in ranked
    ]
    news = both.with_columns(kind=kind).filter(pl.col("kind").is_not_null())
    groups = ["kind", "unit_id", "sensor", "axis"]
    for (name, unit_id, sensor, axis), rows in news.sort(*groups, *rank).group_by(groups, maintain_order=True):
        first = rows.row(0, named=True)
        about = f"agreement with {axis}" if sensor == AGREEMENT else f"{sensor} {axis}".strip()
        what = first["reason"] or f"{first['status_before']} no more."
        yield Change(
            kind=str(name),
            vehicle_id=first["vehicle_id"],
            imu_id=first["imu_id"],
            unit_id=str(unit_id),
            sensor=str(sensor),
            axis=str(axis),
            parameters=tuple(dict.fromkeys(rows["parameter"].to_list())),
            sentence=f"{first['vehicle_id']}, {unit_id}, {about}, {first['parameter']}: {what}",
        )


def _ages(latest: pl.DataFrame, now: datetime, since: datetime | None, alerts: Alerts) -> Iterable[Change]:
    """Sensors and vehicles that passed the limit since the night before. A unit counts where it flew last."""
    current = latest.sort("last_at").unique(["unit_id", "sensor"], keep="last")
    current = current.sort("vehicle_id", "unit_id", "sensor")
    for row in current.iter_rows(named=True):
        if _passed(row["last_at"], now, since, alerts.expires_days):
            days = (now - row["last_at"]).days
            yield Change(
                kind="expired",
                vehicle_id=row["vehicle_id"],
                imu_id=row["imu_id"],
                unit_id=row["unit_id"],
                sensor=row["sensor"],
                axis=None,
                parameters=(),
                sentence=f"{row['vehicle_id']}, {row['unit_id']}, {row['sensor']}: last calibrated {days} days ago,"
                f" on {row['last_at']:%Y-%m-%d}; it counts for {alerts.expires_days:g} days.",
            )
    flown = latest.group_by("vehicle_id").agg(pl.col("last_at").max()).sort("vehicle_id")
    for vehicle_id, last_at in flown.iter_rows():
        if _passed(last_at, now, since, alerts.idle_days):
            yield Change(
                kind="idle",
                vehicle_id=vehicle_id,
                imu_id=None,
                unit_id=None,
                sensor=None,
                axis=None,
                parameters=(),
                sentence=f"{vehicle_id}: no usable flight for {(now - last_at).days} days, since {last_at:%Y-%m-%d}.",
            )


def _passed(last_at: datetime, now: datetime, since: datetime | None, days: float) -> bool:
    limit = last_at + timedelta(days=days)
    return limit < now and (since is None or limit >= since)
