"""Exports remembered, and what became of them: whether the next log's parameters are those that were handed out.

A number that was exported went through a ground station's text and an autopilot's float32: `SAME_VALUE`. Flights are
known by the values alone, so that no clock has to be right; where a log tells of some of a sensor's parameters only,
these decide.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

import polars as pl

from fieldcal.exports import AUTOPILOTS
from fieldcal.exports.calibration import Constants, Export
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.frames import empty_frame
from fieldcal.schemas.reference import SAME_VALUE
from fieldcal.schemas.rows import ExportRow
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import append
from fieldcal.warehouse.questions import existing


class Fate(StrEnum):
    """What became of an export."""

    FLIES = "flies"
    """The latest flight had it loaded."""
    REPLACED = "replaced"
    """A flight had it loaded, the latest has not."""
    NOT_LOADED = "not_loaded"
    """There are flights since, none had it loaded."""
    NOT_KNOWN = "not_known"
    """No log since then tells."""


@dataclass(frozen=True)
class HandedOut:
    """The latest export of a unit's sensor to an autopilot, and what became of it.

    Attributes
    ----------
    vehicle_id, unit_id, sensor, format, author : str
    exported_at : datetime
        UTC.
    fate : Fate
    since, until : str or None
        flight_id of the first and of the last flight, one after the other, that had it loaded.
    since_at, until_at : datetime or None
        When these started; None where their clock is not known.
    differs : str
        The first parameter of the latest flight that has another value, and both; empty where none has.

    Examples
    --------
    >>> moment = datetime(2026, 5, 4, tzinfo=UTC)
    >>> known = "quad-1", "b/1", "gyroscope", "px4", "ann", moment
    >>> HandedOut(*known, Fate.NOT_KNOWN, None, None, None, None, "").sentence
    'gyroscope: exported for px4 on 2026-05-04; no log since then tells whether it was loaded.'
    """

    vehicle_id: str
    unit_id: str
    sensor: str
    format: str
    author: str
    exported_at: datetime
    fate: Fate
    since: str | None
    until: str | None
    since_at: datetime | None
    until_at: datetime | None
    differs: str

    @property
    def sentence(self) -> str:
        """For people."""
        first, last = _flight(self.since, self.since_at), _flight(self.until, self.until_at)
        flew = f"flew in {first}" if self.since == self.until else f"flew from {first} to {last}"
        told = {
            Fate.FLIES: f"loaded since {first}, and still flies",
            Fate.REPLACED: f"{flew}, and was replaced: {self.differs}",
            Fate.NOT_LOADED: f"not loaded: {self.differs}",
            Fate.NOT_KNOWN: "no log since then tells whether it was loaded",
        }[self.fate]
        return f"{self.sensor}: exported for {self.format} on {self.exported_at:%Y-%m-%d}; {told}."


def record_export(
    root: Path,
    constants: Constants,
    to: str,
    export: Export,
    *,
    author: str,
    at_degc: float,
    now: datetime | None = None,
) -> bool:
    """Remember an export; False where the vehicle's last one in this format has the same text.

    Raises
    ------
    WarehouseError
        As `fieldcal.warehouse.publish.append`.
    """
    digest = hashlib.sha256(export.text.encode()).hexdigest()
    former = Warehouse(root).scan("export", vehicle_id=constants.vehicle_id).filter(format=to).collect()
    if former.height and former.sort("exported_at")["text_sha256"][-1] == digest:
        return False
    moment = now or datetime.now(UTC)
    rows: list[ExportRow] = [
        {
            "vehicle_id": constants.vehicle_id,
            "exported_at": moment,
            "latest_flight_id": _latest_flight(root, constants.vehicle_id),
            "format": to,
            "unit_id": one.unit_id,
            "sensor": one.sensor,
            "name": one.name,
            "set_to": one.value,
            "at_degc": at_degc,
            "author": author,
            "text_sha256": digest,
        }
        for one in export.written
    ]
    append(root, constants.vehicle_id, "export", pl.DataFrame(rows, schema=empty_frame("export").schema))
    return True


def _latest_flight(root: Path, vehicle_id: str) -> str | None:
    flights = Warehouse(root).scan("flight", vehicle_id=vehicle_id).sort(FLOWN_ORDER, nulls_last=False)
    latest = flights.select(pl.col("flight_id").last()).collect()
    return None if latest.is_empty() else latest.item()


def handed_out(root: Path, vehicle_id: str) -> list[HandedOut]:
    """The latest export of each sensor of a vehicle to an autopilot, and what became of it."""
    warehouse = existing(root)
    exports = warehouse.scan("export", vehicle_id=vehicle_id).filter(pl.col("format").is_in(list(AUTOPILOTS))).collect()
    if exports.is_empty():
        return []
    columns = [*FLOWN_ORDER, "sensor", "name", "set_to"]
    flown = warehouse.sql("SELECT * FROM active WHERE vehicle_id = ?", [vehicle_id]).select(columns)
    latest = exports.filter(pl.col("exported_at") == pl.col("exported_at").max().over("unit_id", "sensor"))
    return [
        _became(own, flown.filter(sensor=own["sensor"][0]))
        for _, own in latest.sort("sensor", "unit_id", "name").group_by("sensor", "unit_id", maintain_order=True)
    ]


def _became(own: pl.DataFrame, flown: pl.DataFrame) -> HandedOut:
    """What became of one sensor's export: `flown`, its parameters flight by flight."""
    first = own.row(0, named=True)
    exported = own.select("name", exported="set_to")
    both = flown.join(exported, on="name", how="inner").with_columns(
        same=(pl.col("set_to") - pl.col("exported")).abs()
        <= SAME_VALUE * pl.max_horizontal(pl.col("exported").abs(), SAME_VALUE)
    )
    flights = (
        both.group_by(FLOWN_ORDER)
        .agg(
            pl.col("name", "set_to", "exported").filter(~pl.col("same")).first(),
            same=pl.col("same").all(),
        )
        .sort(FLOWN_ORDER, nulls_last=False)
    )
    known = (
        first["vehicle_id"],
        first["unit_id"],
        first["sensor"],
        first["format"],
        first["author"],
        first["exported_at"],
    )
    had_it = flights["same"].to_list()
    if not any(had_it):
        ids = flights["flight_id"].to_list()
        later = flights.slice(ids.index(first["latest_flight_id"]) + 1 if first["latest_flight_id"] in ids else 0)
        later = later.filter(pl.col("started_at").is_null() | (pl.col("started_at") > first["exported_at"]))
        if later.is_empty():
            return HandedOut(*known, Fate.NOT_KNOWN, None, None, None, None, "")
        return HandedOut(*known, Fate.NOT_LOADED, None, None, None, None, _difference(later))
    end = begin = max(i for i, same in enumerate(had_it) if same)
    while begin > 0 and had_it[begin - 1]:
        begin -= 1
    since, until = flights.row(begin, named=True), flights.row(end, named=True)
    flies = end == flights.height - 1
    return HandedOut(
        *known,
        Fate.FLIES if flies else Fate.REPLACED,
        since["flight_id"],
        until["flight_id"],
        since["started_at"],
        until["started_at"],
        "" if flies else _difference(flights),
    )


def _difference(flights: pl.DataFrame) -> str:
    """The first parameter of the last flight that is not as exported."""
    row = flights.row(-1, named=True)
    return f"{row['name']} is {row['set_to']:.6g}, not {row['exported']:.6g}"


def _flight(flight_id: str | None, started_at: datetime | None) -> str:
    return f"flight {flight_id}" if started_at is None else f"flight {flight_id} of {started_at:%Y-%m-%d}"
