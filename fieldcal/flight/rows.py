"""Rows of the history tables from what the steps recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
import polars as pl

from fieldcal import schemas
from fieldcal.flight.job import Job
from fieldcal.flight.record import Refusal, StepRecord
from fieldcal.flight.units import Unit
from fieldcal.flight.when import when
from fieldcal.logs.facts import Facts, FindingFacts
from fieldcal.logs.on_board import PRIMARY
from fieldcal.names import Json, Sensor, Status, Verdict
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.frames import empty_frame
from fieldcal.schemas.rows import FlightLead, FlightRow, RunRow, UnitLead
from fieldcal.stages.composition import PUBLISHED_ROWS
from fieldcal.stages.pipeline import PUBLISHED
from fieldcal.stages.preparation import TURNED_DEG
from fieldcal.stages.stage import stage_and_unit
from fieldcal.words.flights import is_consequence, no_result

COMPOSITION, MANOEUVRE = "composition", "manoeuvre"
LEAD_SCHEMA = pl.Schema(
    {
        "flight_id": pl.String(),
        "vehicle_id": pl.String(),
        "imu_id": pl.String(),
        "session_id": pl.String(),
        "started_at": pl.Datetime("us", "UTC"),
        "dated_by": pl.String(),
        "sequence": pl.String(),
        "unit_id": pl.String(),
        "is_primary": pl.Boolean(),
        "run_key": pl.String(),
    }
)
BY_SENSOR = ("calibration", "moments")
"""Tables that a stage writes a sensor's rows in: of a board whose sensors are units of their own, each by its unit."""
StageTables = Mapping[str, tuple[pl.DataFrame, str | None]]
"""`stage.table` → its rows and the run_key that made them."""


def lead(job: Job, imu_id: str, facts: Facts) -> FlightLead:
    """What leads every row of the history."""
    return {
        "flight_id": job.flight_id,
        "vehicle_id": job.vehicle_id,
        "imu_id": imu_id,
        "session_id": job.session_id,
        **when(job, facts),
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


def run_rows(leading: FlightLead, units: Sequence[Unit], records: Mapping[str, StepRecord]) -> list[RunRow]:
    """Rows of `run`, one a step. The sentence of a refusal stands among the measured numbers, as `reason`."""
    by_table = {unit.table: unit for unit in units}
    placed = [(*stage_and_unit(step), record) for step, record in records.items()]
    return [
        {
            **unit_lead(leading, by_table[table]),
            "stage": stage,
            "status": record["status"],
            "reason_code": record["reason_code"],
            "measured": _json({**record["measured"], **({"reason": record["reason"]} if record["reason"] else {})}),
            "run_key": record["run_key"],
            "versions": _json(record["versions"]),
        }
        for stage, table, record in placed
        if table in by_table
    ]


def judged(facts: Facts, records: Mapping[str, StepRecord]) -> Facts:
    """The facts with what the stages found: a stage that failed makes an `ok` log `partial`, faults are findings; of a
    log that gave no constant the verdict is `no_result`, with the reason and what would help."""
    faults = [fault for step, record in records.items() for fault in _faults(step, record["measured"])]
    facts = {**facts, "findings": [*facts["findings"], *faults]}
    failed = [record for record in records.values() if record["status"] == Status.FAILED]
    if facts["verdict"] == Verdict.OK and failed:
        return {
            **facts,
            "verdict": Verdict.PARTIAL,
            "reason_code": failed[0]["reason_code"],
            "reason": failed[0]["reason"],
        }
    if Verdict(facts["verdict"]).usable and not failed and _published(records) == 0:
        causes = [refusal for refusal in refusals(records) if not is_consequence(refusal)]
        causes = [refusal for refusal in causes if refusal["reason_code"] != ReasonCode.NOTHING_CALIBRATED]
        reasons = [refusal["reason"] for refusal in causes if refusal["reason"]]
        code = causes[0]["reason_code"] if causes else ReasonCode.NOTHING_CALIBRATED
        return {
            **facts,
            "verdict": Verdict.NO_RESULT,
            "reason_code": code,
            "reason": no_result(reasons, _turned(records)),
        }
    return facts


def _published(records: Mapping[str, StepRecord]) -> int | None:
    """How many constants were not refused; None while the stages have not run."""
    found = [record for step, record in records.items() if stage_and_unit(step)[0] == COMPOSITION]
    return sum(cast(int, record["measured"].get(PUBLISHED_ROWS, 0)) for record in found) if found else None


def _turned(records: Mapping[str, StepRecord]) -> Sequence[float] | None:
    """By how much the vehicle turned about each axis, degrees; None where that is not known."""
    return cast("Sequence[float] | None", records.get(MANOEUVRE, {"measured": {}})["measured"].get(TURNED_DEG))


def refusals(records: Mapping[str, StepRecord]) -> list[Refusal]:
    """Stages that refused or failed, with code and sentence."""
    return [
        {"stage": step, "status": record["status"], "reason_code": record["reason_code"], "reason": record["reason"]}
        for step, record in records.items()
        if record["status"] in (Status.REFUSED, Status.FAILED)
    ]


def published_tables(units: Sequence[tuple[FlightLead, Unit, StageTables]]) -> dict[str, pl.DataFrame]:
    """Published tables but `flight` and `run` of units of flights, each its flight's `lead` and its stages' tables."""
    result = {}
    for table, sources in PUBLISHED.items():
        parts = [
            ({**unit_lead(leading, unit), "unit_id": unit_id, "run_key": run_key}, own)
            for leading, unit, tables in units
            if publishes(table, unit)
            for frame, run_key in (tables[name] for name in sources if name in tables)
            for unit_id, own in _by_unit_id(table, unit, frame)
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


def publishes(table: str, unit: Unit) -> bool:
    """Whether a unit has rows in a table: how attitudes agree, and what the VPS's clock is against the IMU's, tells of
    IMUs; a further magnetometer has constants only."""
    return table in (*BY_SENSOR, "information") or Sensor.GYROSCOPE in unit.ids


def _by_unit_id(table: str, unit: Unit, frame: pl.DataFrame) -> list[tuple[str, pl.DataFrame]]:
    """(unit_id, rows) of what a stage found of a unit: of its sensors each by its own id, information of all."""
    if table == "information":
        own_ids = {str(sensor): unit_id for sensor, unit_id in unit.ids.items()}
        return [(unit.unit_id, frame.with_columns(sensor_unit_id=pl.col("sensor").replace_strict(own_ids)))]
    if table not in BY_SENSOR:
        return [(unit.unit_id, frame)]
    sensors = {unit_id: [s for s in unit.ids if unit.ids[s] == unit_id] for unit_id in unit.ids.values()}
    return [(unit_id, frame.filter(pl.col("sensor").is_in(own))) for unit_id, own in sensors.items()]


def unit_lead(leading: FlightLead, unit: Unit) -> UnitLead:
    """What leads every row of the history that speaks of a unit."""
    return {**leading, "unit_id": unit.unit_id, "is_primary": unit.is_primary}


def rows_frame(table: str, rows: Sequence[Mapping[str, object]]) -> pl.DataFrame:
    """Rows as a typed frame of `table`."""
    empty = empty_frame(table)
    return pl.DataFrame(rows, schema=empty.schema, strict=False) if rows else empty


def _faults(step: str, measured: Mapping[str, Json]) -> list[FindingFacts]:
    """The faults that a stage found, as findings of the log."""
    listed = measured.get("faults")
    _, table = stage_and_unit(step)
    of_unit = "" if table == PRIMARY else f"{table}: "
    return [
        {"code": str(fault["code"]), "count": 1, "sentence": f"{of_unit}{fault['sentence']}"}
        for fault in (listed if isinstance(listed, Sequence) else ())
        if isinstance(fault, Mapping)
    ]


def _json(value: object) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False, allow_nan=False)
