"""A stage: what it is, and how one runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import polars as pl

from fieldcal.config.flight_settings import FlightSettings
from fieldcal.config.stage_settings import StageSettings, names_of, taken_from
from fieldcal.logs.on_board import PRIMARY
from fieldcal.names import VECTOR_SENSORS, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import SchemaMismatch, conform, fits
from fieldcal.stages.inputs import Tables
from fieldcal.stages.results import StageResult, fatal_fault

AT = "@"
"""Between a stage and the further unit on board that it ran for."""


@dataclass(frozen=True)
class Stage:
    """One stage: `takes` is its part of the flight's settings, `reads` maps the function's own names to `stage.table`,
    `needs` are those it cannot do without, `trusts` the sensors that must be free of fatal faults. Of what it writes
    all is kept but what it `hands_on`: tables that it makes again in less time than their files would take."""

    name: str
    function: Callable[[Tables, Any], StageResult]  # Any: settings of class `takes`, as `pipeline` checks
    takes: type[StageSettings]
    reads: Mapping[str, str]
    needs: tuple[str, ...]
    writes: tuple[str, ...]
    trusts: tuple[Sensor, ...]
    hands_on: tuple[str, ...] = ()

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the settings that enter its run key."""
        return names_of(self.takes)


def step_of(stage: str, table: str) -> str:
    """Name of a stage's step of the unit whose readings are in `table`."""
    return stage if table == PRIMARY else f"{stage}{AT}{table}"


def stage_and_unit(step: str) -> tuple[str, str]:
    """(stage, table of the unit) of a step."""
    stage, _, table = step.partition(AT)
    return stage, table or PRIMARY


def run_stage(stage: Stage, tables: Mapping[str, pl.DataFrame], settings: FlightSettings) -> StageResult:
    """Run one stage on `stage.table` tables; missing needs end as a refusal that names them."""
    inputs = {own: tables[name] for own, name in stage.reads.items() if name in tables}
    result = refused_beforehand(stage, inputs)
    if result is None:
        result = stage.function(inputs, taken_from(settings, stage.takes))
        _check_written(stage, result)
    return result


def refused_beforehand(stage: Stage, inputs: Mapping[str, pl.DataFrame]) -> StageResult | None:
    """The refusal of a stage that is not to run on these inputs: a sensor is faulty, or something needed is missing."""
    # A fault of the vectors is one of the attitude that was made of them.
    for faults, sensors in (("faults", stage.trusts), ("attitude_faults", VECTOR_SENSORS)):
        fault = fatal_fault(inputs[faults], sensors) if faults in inputs else None
        if fault is not None:
            return StageResult(
                status=Status.REFUSED,
                reason_code=ReasonCode(fault["reason_code"]),
                reason=str(fault["reason"]),
                measured={"number": fault["number"], "limit": fault["limit"]},
            )
    for need in stage.needs:
        if need not in inputs:
            source = stage.reads[need].split(".")[0]
            return StageResult(
                status=Status.REFUSED,
                reason_code=ReasonCode(f"no_{need}"),
                reason=f"{stage.name} needs {stage.reads[need]}, which {source} could not give.",
            )
    return None


def _check_written(stage: Stage, result: StageResult) -> None:
    """Raise `SchemaMismatch` unless what a stage wrote is what it declares, by the tables' schemas."""
    if undeclared := sorted(set(result.tables) - set(stage.writes)):
        raise SchemaMismatch(f"stage {stage.name} wrote {', '.join(undeclared)}, which it does not declare")
    for name, frame in result.tables.items():
        if not fits(frame, name, stage=True):
            conform(frame.to_arrow(), name, stage=True)
