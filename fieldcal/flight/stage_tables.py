"""Tables of one unit of a flight by their `stage.table` names, wherever they are: in memory, read, or made again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import polars as pl

from fieldcal.config.stage_settings import from_json
from fieldcal.errors import FieldcalError
from fieldcal.flight.record import Record
from fieldcal.logs.on_board import PRIMARY, signals_of
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.pipeline import INGEST, PIPELINE
from fieldcal.stages.stage import Stage, step_of
from fieldcal.warehouse.rows_as_json import digest
from fieldcal.warehouse.signals import has_signal, read_signal
from fieldcal.warehouse.stage_store import StageStore, is_kept, outputs_of

STAGES: dict[str, Stage] = {stage.name: stage for stage in PIPELINE}


class StageTables:
    """What ingest and the stages of a unit wrote. What a stage only handed on is made again from what it read, by the
    settings in its record.

    Parameters
    ----------
    root : Path
        Data root.
    vehicle_id, flight_id : str
    records : mapping of str to Record
        Step → what it left behind; it may grow, and what it lists may change.
    table : str
        The unit, by the table of its readings.
    read_again : callable, optional
        Has the log read once more, for readings that were removed to make room. It holds nothing that holds these
        tables: they are given up with the last that asks, not some time later.
    """

    def __init__(
        self,
        root: Path,
        vehicle_id: str,
        flight_id: str,
        records: Mapping[str, Record],
        table: str = PRIMARY,
        read_again: Callable[[], object] | None = None,
    ) -> None:
        self._root, self._vehicle_id, self._flight_id = root, vehicle_id, flight_id
        self._records, self._unit, self._read_again = records, table, read_again
        self._store = StageStore(root)
        self._at_hand: dict[str, pl.DataFrame] = {}

    def keep(self, stage: str, tables: Mapping[str, pl.DataFrame]) -> None:
        """Have tables at hand that a stage just wrote."""
        self._at_hand |= {f"{stage}.{name}": frame for name, frame in tables.items()}

    def __getitem__(self, name: str) -> pl.DataFrame:
        """A table that was written.

        Raises
        ------
        KeyError
            It was not.
        FieldcalError
            `stage_incomplete`: it cannot be made again as it was.
        WarehouseError
            `stage_incomplete`: it was kept, and is not there; `damaged_file`.
        """
        if name not in self._at_hand:
            self._at_hand[name] = self._read(*name.split("."))
        return self._at_hand[name]

    def _read(self, stage: str, table: str) -> pl.DataFrame:
        if stage == INGEST:
            own = signals_of(self._unit, self._records[INGEST]["signals"])[table]
            there = has_signal(self._root, own, self._vehicle_id, self._flight_id)
            if not there and self._read_again is not None:
                self._read_again()
            return read_signal(self._root, own, self._vehicle_id, self._flight_id)
        step = step_of(stage, self._unit)
        record = self._records[step]
        if is_kept(outputs_of(record)[table]):
            return self._store.load(step, self._flight_id, str(record["run_key"]), [table])[table]
        self._make_again(STAGES[stage], record)
        return self._at_hand[f"{stage}.{table}"]

    def _make_again(self, stage: Stage, record: Record) -> None:
        inputs = {own: self[name] for own, name in stage.reads.items() if name in record["inputs"]}
        settings = from_json(record["params"], stage.takes)
        made = stage.function(inputs, settings).tables if settings is not None else {}
        for table, output in outputs_of(record).items():
            if is_kept(output):
                continue
            if table not in made or digest(made[table]) != output["sha256"]:
                step = step_of(stage.name, self._unit)
                self._store.forget(step, self._flight_id, str(record["run_key"]))
                what = f"{step} of flight {self._flight_id} does not give again what it gave; the next night runs it."
                raise FieldcalError(ReasonCode.STAGE_INCOMPLETE, what)
            self._at_hand[f"{stage.name}.{table}"] = made[table]
