"""Decide that flights, or parts of them, count nowhere, or that they count: remembered with author, time and reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from fieldcal import schemas
from fieldcal.errors import FieldcalError
from fieldcal.names import Decision
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.frames import empty_frame
from fieldcal.schemas.rows import DecisionRow
from fieldcal.warehouse.decisions.withdrawn import PARTS
from fieldcal.warehouse.publish import append, settle
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.questions import existing, nearest

LEAST_PREFIX = 6
"""Characters of a flight's id by which it may be called, where no other begins so."""
NEAR = 5


def flights_meant(root: Path, target: str, session: str | None = None) -> pl.DataFrame:
    """vehicle_id, flight_id, session_id, log_uri of what a person calls by a vehicle's id, or a flight's id, its
    beginning, or its log; of a vehicle those in the history today, with `session` that session's alone.

    Raises
    ------
    FieldcalError
        `not_found`: no flight, or several, are called so.
    """
    flights = existing(root).scan("flight").sort("vehicle_id", *FLOWN_ORDER, nulls_last=False).collect()
    found = flights.filter((pl.col("flight_id") == target) | (pl.col("log_uri") == target))
    if found.is_empty():
        found = flights.filter(pl.col("vehicle_id") == target)
    if found.is_empty() and len(target) >= LEAST_PREFIX:
        found = flights.filter(pl.col("flight_id").str.starts_with(target))
        if found.height > 1:
            several = ", ".join(found["flight_id"].head(NEAR).to_list())
            raise FieldcalError(ReasonCode.NOT_FOUND, f"Several flights' ids begin with {target!r}: {several}.")
    if found.is_empty():
        known = {*flights["vehicle_id"], *flights["log_uri"], *flights["flight_id"]}
        told = f"No vehicle, flight or log {target!r} is known; {nearest(target, known)}."
        raise FieldcalError(ReasonCode.NOT_FOUND, told)
    of_session = found if session is None else found.filter(pl.col("session_id") == session)
    if of_session.is_empty():
        there = ", ".join(found["session_id"].unique(maintain_order=True).tail(NEAR).to_list())
        raise FieldcalError(ReasonCode.NOT_FOUND, f"{target} has no session {session!r}; the latest are: {there}.")
    return of_session.select("vehicle_id", "flight_id", "session_id", "log_uri")


def decide(
    root: Path,
    flights: pl.DataFrame,
    decision: Decision,
    *,
    reason: str,
    author: str,
    part: Mapping[str, str],
    now: datetime | None = None,
) -> int:
    """Remember a decision about each of `flights` (vehicle_id, flight_id), and let their rows follow; how many
    constants are counted now that were not before, or the other way round.

    Parameters
    ----------
    part : mapping of str to str
        What of each flight is meant, by unit_id, sensor, parameter, axis; empty: all of it.

    Raises
    ------
    FieldcalError
        `not_found`: no constant of the flights is of this part. `wrong_option`: there is no reason or no author.
    """
    if not reason.strip() or not author.strip():
        raise FieldcalError(
            ReasonCode.WRONG_OPTION, "A decision needs a reason and an author: who reads it later asks."
        )
    vehicles = flights["vehicle_id"].unique(maintain_order=True).to_list()
    before = _statuses(root, flights)
    if part:
        _some(before, part)
    moment = now or datetime.now(UTC)
    for vehicle_id in vehicles:
        own = flights.filter(pl.col("vehicle_id") == vehicle_id)["flight_id"].to_list()
        append(root, vehicle_id, "decision", _rows(vehicle_id, own, decision, moment, part, author, reason))
        settle(root, vehicle_id)
    after = _statuses(root, flights)
    return int((before["status"] != after["status"]).sum())


def _rows(
    vehicle_id: str,
    flight_ids: Sequence[str],
    decision: Decision,
    moment: datetime,
    part: Mapping[str, str],
    author: str,
    reason: str,
) -> pl.DataFrame:
    rows: list[DecisionRow] = [
        {
            "vehicle_id": vehicle_id,
            "flight_id": flight_id,
            "decided_at": moment,
            "decision": str(decision),
            "unit_id": part.get("unit_id"),
            "sensor": part.get("sensor"),
            "parameter": part.get("parameter"),
            "axis": part.get("axis"),
            "author": author.strip(),
            "reason": reason.strip(),
        }
        for flight_id in flight_ids
    ]
    return pl.DataFrame(rows, schema=empty_frame("decision").schema)


def _statuses(root: Path, flights: pl.DataFrame) -> pl.DataFrame:
    """Constants of flights with their status, in the order of their key."""
    key = list(schemas.table_key("calibration"))
    rows = Warehouse(root).scan("calibration").filter(pl.col("flight_id").is_in(flights["flight_id"].to_list()))
    return rows.select(*key, "status").sort(key).collect()


def _some(rows: pl.DataFrame, part: Mapping[str, str]) -> None:
    """Make sure that a part is one: what is misspelt would be remembered, and mean nothing."""
    for name in PARTS:
        if name not in part:
            continue
        own = rows.filter(pl.col(name) == part[name])
        if own.is_empty():
            there = ", ".join(rows[name].unique().sort().to_list()) or "none"
            what = f"{name.removesuffix('_id')} {part[name]!r}"
            raise FieldcalError(ReasonCode.NOT_FOUND, f"These flights have no constant of {what}; there is: {there}.")
        rows = own
