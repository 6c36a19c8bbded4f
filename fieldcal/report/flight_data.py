"""All that a flight's page is made of: rows of the history, readings, and what is left of its stages' tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import polars as pl

from fieldcal.config.stage_settings import Axes, Differentiation, Gravity, LocalField, as_json, from_json, taken_from
from fieldcal.errors import FieldcalError
from fieldcal.flight.calibrate import CalibratedLog
from fieldcal.flight.record import Record
from fieldcal.flight.rows import rows_frame
from fieldcal.flight.stage_tables import StageTables
from fieldcal.names import InitialAttitude, Json, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import SIGNAL_TABLES, SchemaMismatch
from fieldcal.schemas.rows import DecisionRow, FitRow, SyncRow, UnfoldedFlight, UnfoldedRun
from fieldcal.stages.composition import in_log
from fieldcal.stages.pipeline import INGEST, PIPELINE
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import decisions
from fieldcal.warehouse.questions import existing
from fieldcal.warehouse.stage_store import StageStore
from fieldcal.words.rows import rows_of, typed, unfolded

STAGE_TABLES = (
    "manoeuvre.segments",
    "smoothing.samples",
    "attitude_pass2.attitude",
    "joint.trajectory",
    "vps_sync.vps_aligned",
)


@dataclass(frozen=True, kw_only=True)
class FigureSettings(Axes, LocalField, Gravity, Differentiation):
    """What the figures take of the stages' settings; `gate_norm` None: the second pass of the accelerometer is gone."""

    initial_attitude: InitialAttitude
    gate_norm: float | None = None


@dataclass(frozen=True)
class FlightData:
    """One flight. `tables` are named `stage.table` as in the pipeline, `parameters` are the stages' settings as plain
    JSON, `settings` what the figures need of them, None where they do not say.

    `gone` names stages whose tables should be there and are not. `further`: rows of `calibration` of further units.
    `decisions`: what people decided about it, the first first.
    """

    flight: UnfoldedFlight
    calibration: pl.DataFrame
    fit: Sequence[FitRow]
    sync: SyncRow | None
    run: Sequence[UnfoldedRun]
    tables: Mapping[str, pl.DataFrame]
    parameters: Mapping[str, Json]
    settings: FigureSettings | None
    gone: tuple[str, ...] = field(default=())
    further: pl.DataFrame = field(default_factory=lambda: rows_frame("calibration", ()))
    decisions: Sequence[DecisionRow] = field(default=())

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of each sensor's logged readings."""
        ingest = next((row for row in self.run if row["stage"] == "ingest"), None)
        units = None if ingest is None else (ingest["measured"] or {}).get("units")
        return {sensor: str(unit) for sensor, unit in units.items()} if isinstance(units, Mapping) else {}


def read_flight(
    root: Path,
    flight_id: str,
    warehouse: Warehouse | None = None,
    wanted: Sequence[str] = STAGE_TABLES,
    signals: Sequence[str] = SIGNAL_TABLES,
) -> FlightData:
    """A flight from the warehouse at `root`, or what of it is at hand; of the stages' tables those `wanted`.

    Raises
    ------
    FieldcalError
        `no_warehouse`; `not_found`: no flight, or more than one, has this id, this start of an id, or this `log_uri`.
    """
    warehouse = warehouse or existing(root)
    flight = typed(map(unfolded, rows_of(_one_flight(warehouse, flight_id))), UnfoldedFlight)[0]
    ids = {"vehicle_id": flight["vehicle_id"], "flight_id": flight["flight_id"]}
    every = {name: warehouse.scan(name, **ids).collect() for name in ("calibration", "fit", "sync", "run")}
    history = {name: rows if rows["is_primary"].all() else rows.filter("is_primary") for name, rows in every.items()}
    order = {stage: i for i, stage in enumerate(("ingest", *(stage.name for stage in PIPELINE)))}
    run = typed(map(unfolded, rows_of(history["run"])), UnfoldedRun)
    run.sort(key=lambda row: order.get(row["stage"], len(order)))
    tables: dict[str, pl.DataFrame] = {}
    for name in signals:
        signal = _signal(warehouse, name, ids)
        if not signal.is_empty():
            tables[f"ingest.{name}"] = signal.drop("vehicle_id", "flight_id")
    stages, parameters, gone = _stages(root, flight, run, wanted)
    sync = typed(rows_of(history["sync"]), SyncRow)
    return FlightData(
        flight,
        in_log(history["calibration"]),
        typed(rows_of(history["fit"]), FitRow),
        sync[0] if sync else None,
        run,
        tables | stages,
        parameters,
        from_json(parameters, FigureSettings),
        gone,
        every["calibration"].filter(~pl.col("is_primary")),
        typed(decisions(root).filter(flight_id=flight["flight_id"]).iter_rows(named=True), DecisionRow),
    )


def of_log(log: CalibratedLog) -> FlightData:
    """A flight calibrated in memory, without a warehouse."""
    document = log.document
    parameters: dict[str, Json] = {}
    if log.settings is not None:
        for stage in PIPELINE:
            parameters |= as_json(taken_from(log.settings, stage.takes))
    return FlightData(
        document["flight"],
        in_log(rows_frame("calibration", document["calibration"])),
        document["fit"],
        document["sync"],
        document["run"],
        log.tables,
        parameters,
        from_json(parameters, FigureSettings),
    )


def _one_flight(warehouse: Warehouse, wanted: str) -> pl.DataFrame:
    flights = warehouse.scan("flight")
    for same in (
        pl.col("flight_id") == wanted,
        pl.col("log_uri") == wanted,
        pl.col("flight_id").str.starts_with(wanted) if wanted else pl.lit(False),
    ):
        found = flights.filter(same).collect()
        if found.height == 1:
            return found
        if found.height > 1:
            several = ", ".join(found["flight_id"].head(3).to_list())
            raise FieldcalError(
                ReasonCode.NOT_FOUND, f'"{wanted}" is the start of {found.height} flight ids: {several}, …'
            )
    raise FieldcalError(
        ReasonCode.NOT_FOUND, f'No flight "{wanted}" is in the history; fieldcal history --json lists flight ids.'
    )


def _signal(warehouse: Warehouse, name: str, ids: Mapping[str, str]) -> pl.DataFrame:
    """Readings of the flight; none where they were removed or are damaged (`fieldcal verify` tells which)."""
    try:
        return warehouse.scan(name, **ids).collect()
    except (OSError, FieldcalError, pl.exceptions.PolarsError):
        return pl.DataFrame()


def _stages(
    root: Path, flight: UnfoldedFlight, run: Sequence[UnfoldedRun], wanted: Sequence[str]
) -> tuple[dict[str, pl.DataFrame], dict[str, Json], tuple[str, ...]]:
    """Tables that are there or can be made again, the parameters of their stages, and the stages that should be there
    and are not."""
    store = StageStore(root)
    parameters: dict[str, Json] = {}
    records: dict[str, Record] = {}
    gone = []
    for row in run:
        stage = row["stage"]
        if row["status"] == Status.FAILED:
            continue
        record = store.record(stage, flight["flight_id"], str(row["run_key"]))
        if record is not None:
            records[stage] = cast(Record, record)
            parameters |= records[stage]["params"] if stage != INGEST else {}
        elif stage != INGEST:
            gone.append(stage)
    written = StageTables(root, flight["vehicle_id"], flight["flight_id"], records)
    tables: dict[str, pl.DataFrame] = {}
    for name in wanted:
        stage, table = name.split(".")
        if stage not in records or table not in records[stage]["outputs"]:
            continue
        try:
            tables[name] = written[name]
        except (FieldcalError, SchemaMismatch, KeyError, OSError, pl.exceptions.PolarsError):
            gone.append(stage)
    return tables, parameters, tuple(gone)
