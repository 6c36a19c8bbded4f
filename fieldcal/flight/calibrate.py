"""`fieldcal calibrate`: one log through the whole pipeline in memory. No warehouse, no Prefect."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import polars as pl

from fieldcal.config.configuration import Vehicle
from fieldcal.config.find import configuration_of, find_near, find_source, with_parameters
from fieldcal.config.flight_settings import FlightSettings
from fieldcal.errors import FieldcalError, unforeseen
from fieldcal.flight.job import Job
from fieldcal.flight.record import StepRecord
from fieldcal.flight.rows import flight_row, judged, lead, published_tables, rows_frame, run_rows
from fieldcal.flight.threads import one_thread
from fieldcal.flight.units import Unit, units_of
from fieldcal.flight.versions import versions
from fieldcal.flight.when import when
from fieldcal.logs import flight_id, ingest, log_format, log_sha256
from fieldcal.logs.facts import Facts
from fieldcal.logs.on_board import PRIMARY, signals_of
from fieldcal.names import SENSORS, Approach, Json, Status, Verdict
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.rows import CalibrationRow, FitRow, FlightDocument, SyncRow, UnfoldedFlight, UnfoldedRun
from fieldcal.stages.pipeline import INGEST, PIPELINE
from fieldcal.stages.results import StageResult, plain
from fieldcal.stages.stage import run_stage
from fieldcal.words.rows import rows_of, typed, unfolded


@dataclass(frozen=True)
class CalibratedLog:
    """One log's results: `document` is what `fieldcal calibrate --json` prints; every `stage.table`; the flight's
    settings, None of a log that is not usable."""

    document: FlightDocument
    tables: dict[str, pl.DataFrame]
    settings: FlightSettings | None


@dataclass(frozen=True)
class LogRead:
    """A log in memory before any stage: what it is, its vehicle's configuration, signal table → frame, and the facts
    (`ingest.TidyLog.facts`)."""

    job: Job
    vehicle: Vehicle
    signals: dict[str, pl.DataFrame]
    facts: Facts


def configuration_file(log: Path, config: Path | None = None) -> Path | None:
    """The named `fieldcal.toml`, else the one at the archive's root, beside the log or in the current directory."""
    log = log.absolute()
    return config or find_near(log, log.parent.parent.parent)


def identify(
    log: Path, config: Path | None = None, *, vehicle_id: str | None = None, session_id: str | None = None
) -> tuple[Job, Vehicle]:
    """What a log is and how its vehicle is configured.

    Vehicle and session are taken from the folders the log lies in, `<vehicle>/<session>/<log>`, unless given; the
    configuration from the file that `configuration_file` names.

    Raises
    ------
    ConfigurationError
        The configuration is wrong.
    FieldcalError
        `not_found`, `not_readable`: there is no such log.
    """
    log = log.absolute()
    archive = log.parent.parent.parent
    configuration = configuration_of(find_source(configuration_file(log, config), None))
    vehicle_id = vehicle_id or log.parent.parent.name
    job = _job(log, vehicle_id, session_id or log.parent.name, archive)
    return job, configuration.vehicle(vehicle_id)


def overruled(
    vehicle: Vehicle, *, profile: str | None = None, method: str | None = None, changes: dict[str, str] | None = None
) -> Vehicle:
    """The vehicle with other presets, another method, other stage parameters (name → text).

    Raises
    ------
    ConfigurationError
        An override is wrong.
    """
    vehicle = with_parameters(vehicle, profile, changes or {})
    if method is None:
        return vehicle
    return vehicle.model_copy(update={"method": dict.fromkeys(SENSORS, Approach(method))})


def read(job: Job, vehicle: Vehicle) -> LogRead:
    """A whole log in memory; what cannot be read has verdict `rejected` and no signals.

    Nothing of it enters a history, so that a simulation is as welcome as a flight; that it is one is told.
    """
    reading = vehicle.model_copy(update={"simulated": True})
    return LogRead(job, vehicle, *ingest.read_flight(Path(job.path), reading))


def run_stages(log: LogRead, table: str = PRIMARY) -> CalibratedLog:
    """Every stage on a log that was read, for the unit whose readings are in `table`.

    Raises
    ------
    FieldcalError
        `wrong_option`: there is no such unit on board.
    """
    job, vehicle, facts = log.job, log.vehicle, log.facts
    imu_id = vehicle.imu_at(when(job, facts)["started_at"])
    unit = _unit_of(log, table, imu_id)
    records: dict[str, StepRecord] = {INGEST: _record(_ingest_result(facts))}
    settings: FlightSettings | None = None
    seen = signals_of(table, log.signals.keys() - set(facts["left_out"]))
    tables: dict[str, pl.DataFrame] = {f"{INGEST}.{name}": log.signals[place] for name, place in seen.items()}
    if Verdict(facts["verdict"]).usable:
        settings = ingest.settings_of(facts, vehicle, table)
        for stage in PIPELINE:
            try:
                with one_thread():
                    result = run_stage(stage, tables, settings)
            except Exception as error:
                why = f"{stage.name}: {unforeseen(job.log_uri, error)}"
                result = StageResult(status=Status.FAILED, reason_code=ReasonCode.STAGE_FAILED, reason=why)
            records[stage.name] = _record(result)
            tables |= {f"{stage.name}.{name}": frame for name, frame in result.tables.items()}
    facts = judged(facts, records)
    leading = lead(job, imu_id, facts)
    published = published_tables([(leading, unit, {name: (frame, None) for name, frame in tables.items()})])
    sync = typed(rows_of(published["sync"]), SyncRow)
    flight = rows_frame("flight", [flight_row(job, leading, facts)])
    runs = rows_frame("run", run_rows(leading, [unit], {unit.step(stage): one for stage, one in records.items()}))
    document: FlightDocument = {
        "flight": typed(map(unfolded, rows_of(flight)), UnfoldedFlight)[0],
        "calibration": typed(rows_of(published["calibration"]), CalibrationRow),
        "fit": typed(rows_of(published["fit"]), FitRow),
        "sync": sync[0] if sync else None,
        "run": typed(map(unfolded, rows_of(runs)), UnfoldedRun),
    }
    return CalibratedLog(document, tables, settings)


def _unit_of(log: LogRead, table: str, imu_id: str) -> Unit:
    units = {unit.table: unit for unit in units_of(log.facts, log.vehicle, imu_id)}
    if table not in units:
        raise FieldcalError(
            ReasonCode.WRONG_OPTION, f"{log.job.log_uri} has no unit {table!r}; there is {', '.join(units)}."
        )
    return units[table]


def _job(log: Path, vehicle_id: str, session_id: str, archive: Path) -> Job:
    if not log.exists():
        raise FieldcalError(ReasonCode.NOT_FOUND, f"There is no log at {log}.")
    try:
        sha256 = log_sha256(log)
    except OSError as error:
        raise FieldcalError(ReasonCode.NOT_READABLE, f"{log} cannot be read ({error.strerror}).") from error
    kind = log_format(log) or log.suffix.lstrip(".") or "unknown"
    return Job(str(log), log.relative_to(archive).as_posix(), vehicle_id, session_id, kind, sha256, flight_id(sha256))


def _ingest_result(facts: Facts) -> StageResult:
    status = Status.OK if Verdict(facts["verdict"]).usable else Status.REFUSED
    measured: dict[str, Json] = {"rows": facts["rows"], "units": facts["units"], "verdict": facts["verdict"]}
    code = None if facts["reason_code"] is None else ReasonCode(facts["reason_code"])
    return StageResult(status=status, reason_code=code, reason=facts["reason"], measured=measured)


def _record(result: StageResult) -> StepRecord:
    return {
        "status": result.status,
        "reason_code": result.reason_code,
        "reason": result.reason,
        "measured": plain(result.measured),
        "versions": versions(),
        "run_key": None,
    }
