"""Bring the history up to what the night found: one vehicle at a time, only flights whose rows differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from fieldcal.config.configuration import Configuration, Vehicle
from fieldcal.flight.job import Job
from fieldcal.flight.record import Record
from fieldcal.flight.rows import (
    StageTables,
    flight_row,
    judged,
    lead,
    published_tables,
    publishes,
    rows_frame,
    run_rows,
)
from fieldcal.flight.units import Unit, units_of
from fieldcal.flight.when import when
from fieldcal.schemas.rows import FlightRow, RunRow
from fieldcal.stages.pipeline import INGEST, PUBLISHED
from fieldcal.warehouse.publish import publish, read_history
from fieldcal.warehouse.stage_store import StageStore


def publish_vehicle(
    root: Path, vehicle_id: str, flights: Sequence[tuple[Job, Mapping[str, Record]]], configuration: Configuration
) -> tuple[str, ...]:
    """Publish the flights of one vehicle whose rows are not there yet or differ; the tables that changed.

    A flight that has another content now than when it was published under the same place replaces its former self; one
    that moved to this vehicle leaves the one it was published under.
    """
    vehicle = configuration.vehicle(vehicle_id)
    former = read_history(root, "flight", vehicle_id)
    imu_ids = _imu_ids(flights, vehicle, former)
    fresh = _rows(flights, vehicle, imu_ids)
    stale = _differing(root, vehicle, former, fresh, {job.flight_id: records for job, records in flights})
    places, ids = {job.log_uri for job, _ in flights}, [job.flight_id for job, _ in flights]
    gone = former.filter(pl.col("log_uri").is_in(list(places)) & ~pl.col("flight_id").is_in(ids))
    leaving = set(gone["flight_id"].to_list())
    if not stale and not leaving:
        return ()
    own = {table: frame.filter(pl.col("flight_id").is_in(list(stale))) for table, frame in fresh.items()}
    made = [
        (lead(job, imu_id, records[INGEST]["facts"]), unit, _tables(root, job, unit, records))
        for job, records in flights
        if job.flight_id in stale
        for imu_id in (imu_ids[job.flight_id],)
        for unit in units_of(records[INGEST]["facts"], vehicle, imu_id)
    ]
    return publish(root, vehicle_id, {**own, **published_tables(made)} if stale else {}, stale | leaving)


def take_out(root: Path, vehicle_id: str, flights: set[str]) -> None:
    """Take flights that moved elsewhere out of a vehicle's history."""
    publish(root, vehicle_id, {}, flights)


def _imu_ids(
    flights: Sequence[tuple[Job, Mapping[str, Record]]], vehicle: Vehicle, former: pl.DataFrame
) -> dict[str, str]:
    """flight_id → the IMU that was on board. An `imu_id` without dates says what is on board now: it holds for flights
    that are new, and those that are in the history keep theirs."""
    known = {} if vehicle.dated else dict(former.select("flight_id", "imu_id").iter_rows())
    return {
        job.flight_id: known.get(job.flight_id) or vehicle.imu_at(when(job, records[INGEST]["facts"])["started_at"])
        for job, records in flights
    }


def _rows(
    flights: Sequence[tuple[Job, Mapping[str, Record]]], vehicle: Vehicle, imu_ids: Mapping[str, str]
) -> dict[str, pl.DataFrame]:
    """`flight` and `run` as they should be."""
    flight_rows: list[FlightRow] = []
    step_rows: list[RunRow] = []
    for job, records in flights:
        facts = judged(records[INGEST]["facts"], records)
        imu_id = imu_ids[job.flight_id]
        leading = lead(job, imu_id, facts)
        flight_rows.append(flight_row(job, leading, facts))
        step_rows += run_rows(leading, units_of(facts, vehicle, imu_id), records)
    return {"flight": rows_frame("flight", flight_rows), "run": rows_frame("run", step_rows)}


def _differing(
    root: Path,
    vehicle: Vehicle,
    former: pl.DataFrame,
    fresh: Mapping[str, pl.DataFrame],
    records: Mapping[str, Mapping[str, Record]],
) -> set[str]:
    """Flights whose rows in `flight` and `run`, or whose numbers of rows elsewhere, are not what they should be."""
    there = {"flight": former, "run": read_history(root, "run", vehicle.vehicle_id)}
    stale = set()
    for table, held in there.items():
        both = _counted(fresh[table], held, list(held.columns))
        stale |= set(both.filter(pl.col("new") != pl.col("held"))["flight_id"].to_list())
    for table in PUBLISHED:
        wanted = {flight_id: _row_count(table, own, vehicle) for flight_id, own in records.items()}
        held = read_history(root, table, vehicle.vehicle_id)
        counts = dict(held.group_by("flight_id").len().iter_rows())
        stale |= {flight_id for flight_id, count in wanted.items() if counts.get(flight_id, 0) != count}
    return stale & set(records)


def _counted(new: pl.DataFrame, held: pl.DataFrame, columns: list[str]) -> pl.DataFrame:
    """Every distinct row of either, with how often each has it."""
    marked = pl.concat([new.with_columns(new=1, held=0), held.select(columns).with_columns(new=0, held=1)])
    return marked.group_by(columns).agg(pl.col("new").sum(), pl.col("held").sum())


def _row_count(table: str, records: Mapping[str, Record], vehicle: Vehicle) -> int:
    """How many rows a flight has in a table of the history."""
    outputs = [
        records[unit.step(stage)]["outputs"].get(name)
        for unit in units_of(records[INGEST]["facts"], vehicle, vehicle.vehicle_id)
        if publishes(table, unit)
        for stage, name in (source.split(".") for source in PUBLISHED[table])
        if unit.step(stage) in records
    ]
    return sum(output["rows"] for output in outputs if output is not None)


def _tables(root: Path, job: Job, unit: Unit, records: Mapping[str, Record]) -> StageTables:
    """What the stages made of one unit of a flight for the history."""
    store = StageStore(root)
    tables = {}
    for source in (name for sources in PUBLISHED.values() for name in sources):
        stage, table = source.split(".")
        step = unit.step(stage)
        if step in records and table in records[step]["outputs"]:
            run_key = str(records[step]["run_key"])
            tables[source] = (store.load(step, job.flight_id, run_key, [table])[table], run_key)
    return tables
