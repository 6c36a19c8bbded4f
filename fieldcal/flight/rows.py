"""Rows of the history tables from what the steps recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl

from fieldcal import schemas
from fieldcal.flight.job import Job
from fieldcal.flight.record import Refusal, StepRecord
from fieldcal.logs import ingest
from fieldcal.logs.facts import Facts, FindingFacts
from fieldcal.names import Json, Status, Verdict
from fieldcal.schemas.rows import FlightLead, FlightRow, RunRow
from fieldcal.stages.pipeline import PUBLISHED
from fieldcal.warehouse.store import empty_frame, frame

LEAD_SCHEMA = pl.Schema(
    {
        "flight_id": pl.String(),
        "vehicle_id": pl.String(),
        "imu_id": pl.String(),
        "session_id": pl.String(),
        "started_at": pl.Datetime("us", "UTC"),
        "run_key": pl.String(),
    }
)
StageTables = Mapping[str, tuple[pl.DataFrame, str | None]]
"""`stage.table` → its rows and the run_key that made them."""


def lead(job: Job, imu_id: str, facts: Facts) -> FlightLead:
    """What leads every row of the history."""
    return {
        "flight_id": job.flight_id,
        "vehicle_id": job.vehicle_id,
        "imu_id": imu_id,
        "session_id": job.session_id,
        "started_at": ingest.started_at(facts),
    }


def flight_row(job: Job, leading: FlightLead, facts: Facts) -> FlightRow:
    """The row of `flight`."""
    return {
        **leading,
        "log_uri": job.log_uri,
        "log_sha256": job.sha256,
        "log_format": job.log_format,
        "duration_s": facts["duration_s"],
        "imu_rate_hz": facts["imu_rate_hz"],
        "vps_rate_hz": facts["vps_rate_hz"],
        "n_samples": facts["n_samples"],
        "temperature_min_degc": facts["temperature_min_degc"],
        "temperature_mean_degc": facts["temperature_mean_degc"],
        "temperature_max_degc": facts["temperature_max_degc"],
        "verdict": facts["verdict"],
        "reason_code": facts["reason_code"],
        "reason": facts["reason"],
        "verifiable": facts["verifiable"],
        "findings": _json(facts["findings"]),
    }


def run_rows(leading: FlightLead, records: Mapping[str, StepRecord]) -> list[RunRow]:
    """Rows of `run`, one a step. The sentence of a refusal stands among the measured numbers, as `reason`."""
    return [
        {
            **leading,
            "stage": step,
            "status": record["status"],
            "reason_code": record["reason_code"],
            "measured": _json({**record["measured"], **({"reason": record["reason"]} if record["reason"] else {})}),
            "run_key": record["run_key"],
            "versions": _json(record["versions"]),
        }
        for step, record in records.items()
    ]


def judged(facts: Facts, records: Mapping[str, StepRecord]) -> Facts:
    """The facts with what the stages found: a stage that failed makes an `ok` log `partial`, faults are findings."""
    faults = [fault for record in records.values() for fault in _faults(record["measured"])]
    facts = {**facts, "findings": [*facts["findings"], *faults]}
    failed = [record for record in records.values() if record["status"] == Status.FAILED]
    if facts["verdict"] == Verdict.OK and failed:
        return {
            **facts,
            "verdict": Verdict.PARTIAL,
            "reason_code": failed[0]["reason_code"],
            "reason": failed[0]["reason"],
        }
    return facts


def refusals(records: Mapping[str, StepRecord]) -> list[Refusal]:
    """Stages that refused or failed, with code and sentence."""
    return [
        {"stage": step, "status": record["status"], "reason_code": record["reason_code"], "reason": record["reason"]}
        for step, record in records.items()
        if record["status"] in (Status.REFUSED, Status.FAILED)
    ]


def published_tables(flights: Sequence[tuple[FlightLead, StageTables]]) -> dict[str, pl.DataFrame]:
    """`calibration`, `fit` and `sync` of flights, each its `lead` and its stages' tables."""
    result = {}
    for table, sources in PUBLISHED.items():
        parts = [
            ({**leading, "run_key": run_key}, frame)
            for leading, tables in flights
            for frame, run_key in (tables[name] for name in sources if name in tables)
        ]
        if not parts:
            result[table] = empty_frame(table)
            continue
        leads = pl.DataFrame([leading for leading, _ in parts], schema=LEAD_SCHEMA)
        columns = [column.name for column in schemas.table_columns(table)]
        own = pl.concat([frame.select([name for name in columns if name not in LEAD_SCHEMA]) for _, frame in parts])
        of_row = np.repeat(np.arange(len(parts)), [frame.height for _, frame in parts])
        result[table] = pl.concat([leads[of_row], own], how="horizontal").select(columns)
    return result


def rows_frame(table: str, rows: Sequence[Mapping[str, object]]) -> pl.DataFrame:
    """Rows as a typed frame of `table`."""
    empty = frame(schemas.arrow_schema(table).empty_table())
    return pl.DataFrame(rows, schema=empty.schema, strict=False) if rows else empty


def _faults(measured: Mapping[str, Json]) -> list[FindingFacts]:
    """The faults that a stage found, as findings of the log."""
    listed = measured.get("faults")
    return [
        {"code": str(fault["code"]), "count": 1, "sentence": str(fault["sentence"])}
        for fault in (listed if isinstance(listed, Sequence) else ())
        if isinstance(fault, Mapping)
    ]


def _json(value: object) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False, allow_nan=False)
