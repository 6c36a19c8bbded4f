"""One flight's steps through the cache: which key, is its result there and whole, else run it. Nothing of Prefect here.

A step is "ingest" or a stage of `fieldcal.stages.pipeline.PIPELINE`. Its record (`run.json`) is all that later steps
and the history need to know: status, reason, measured numbers, versions, and the sha256 of every output.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import cast

import polars as pl

from fieldcal.batch.limits import why_ended
from fieldcal.batch.reading import read_log
from fieldcal.batch.reasons import NO_RESULT, why_it_runs
from fieldcal.batch.sources import sources
from fieldcal.config.configuration import Limits, Vehicle
from fieldcal.config.flight_settings import FlightSettings
from fieldcal.config.reader_settings import reader_settings
from fieldcal.config.stage_settings import as_json, taken_from
from fieldcal.errors import unforeseen
from fieldcal.flight.job import Job, file_stamp
from fieldcal.flight.record import Causes, Output, Record
from fieldcal.flight.stage_tables import STAGES, StageTables
from fieldcal.flight.units import units_of
from fieldcal.flight.versions import versions
from fieldcal.logs import ingest
from fieldcal.logs.facts import Facts
from fieldcal.logs.on_board import PRIMARY, signals_of
from fieldcal.names import Json, Status, Verdict
from fieldcal.provenance.run_key import run_key
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.url import RemoteError
from fieldcal.stages.pipeline import INGEST, PIPELINE
from fieldcal.stages.results import StageResult, plain
from fieldcal.stages.stage import Stage, run_stage, stage_and_unit, step_of
from fieldcal.warehouse.checksums import problem
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.files import file_sha256
from fieldcal.warehouse.layout import checksum_path, signal_path
from fieldcal.warehouse.stage_store import StageStore, outputs_of

STEPS = (INGEST, *(stage.name for stage in PIPELINE))
"""Of the primary unit."""


class FlightWork:
    """The steps of one unit of a flight, in order: "ingest" and the stages of the primary unit, and of each of the
    `further` ones its stages ("joint@imu.1"). Tables stay in memory while they are needed, else they are read from
    disk.

    Parameters
    ----------
    root : Path
        Data root of the warehouse.
    job : Job
        The log.
    vehicle : Vehicle
        Its vehicle's configuration.
    limits : Limits
        What the log may take: one that was ended for taking more is rejected without another try.
    table : str
        The unit, by the table of its readings.
    """

    def __init__(
        self, root: Path, job: Job, vehicle: Vehicle, limits: Limits | None = None, table: str = PRIMARY
    ) -> None:
        self.job = job
        self.limits = limits or Limits()
        self.table = table
        self.records: dict[str, Record] = {}
        self.why: dict[str, str] = {}
        """Why each step had to run, of those that `find` did not."""
        self.work_s = 0.0
        """Time that the steps' own work took: reading their input, computing, writing their output."""
        self._root = root
        self._store = StageStore(root)
        self._vehicle = vehicle
        self._settings: FlightSettings | None = None
        self._inputs: dict[str, str] = {}
        self._made_of: dict[str, Causes] = {}
        read_again = partial(read_log, root, job, vehicle)
        self._tables = StageTables(root, job.vehicle_id, job.flight_id, self.records, table, read_again)

    def usable(self) -> bool:
        """Whether ingest left anything to calibrate on; known once its record is."""
        return Verdict(self.records[INGEST]["facts"]["verdict"]).usable

    def steps(self) -> tuple[str, ...]:
        """The unit's steps after ingest, known once ingest's record is: none of a log that is rejected or
        quarantined."""
        return tuple(step_of(stage, self.table) for stage in STEPS[1:]) if self.usable() else ()

    def further(self) -> Iterator[FlightWork]:
        """The work on each further unit on board that is to be calibrated."""
        facts = self.records[INGEST]["facts"]
        for unit in units_of(facts, self._vehicle, self.job.vehicle_id)[1:] if self.usable() else ():
            other = FlightWork(self._root, self.job, self._vehicle, self.limits, unit.table)
            other._take(INGEST, self.records[INGEST])
            yield other

    def key(self, step: str) -> str:
        """run_key of a step; the records of the steps before it must be known."""
        return self._causes(step)["run_key"]

    def do(self, step: str) -> None:
        """Take a step's result from the cache, or run it."""
        if self.find(step) is None:
            self.run(step)

    def find(self, step: str) -> Record | None:
        """The record of a step whose result is there and whole, taken as the step's; else None, and `why` says why."""
        if step == INGEST and (ended := why_ended(self._root, self.job, self._vehicle, self.limits)):
            refused = self._ingest_record(
                ingest.rejected(ReasonCode.OVER_LIMITS, ended), {}, self.key(INGEST), keep=False
            )
            self._take(INGEST, refused)
            return refused
        stored = self._store.complete(step, self.job.flight_id, self.key(step))
        record = None if stored is None else _of_store(stored)
        if record is None or (step == INGEST and not self._signals_whole(record)):
            former = self._store.latest(step, self.job.flight_id)
            self.why[step] = NO_RESULT if former is None else why_it_runs(_of_store(former), self._causes(step))
            return None
        self._take(step, record)
        return record

    def run(self, step: str) -> Record:
        """Run a step, whatever the cache says, and keep its result; its record.

        An error of the step itself becomes the status `failed` and is not kept: the next night tries again.

        Raises
        ------
        WarehouseError
            The warehouse cannot be written: this concerns every log.
        """
        began = time.perf_counter()
        record = self._ingest() if step == INGEST else self._stage(step)
        self.work_s += time.perf_counter() - began
        self._take(step, record)
        return record

    def pending(self) -> dict[str, str]:
        """Steps whose result is missing, and those that read from them, each with why; nothing is run or changed."""
        if INGEST not in self.records and self.find(INGEST) is None:
            new_input = f"new input: {INGEST}"
            return {INGEST: self.why[INGEST], **dict.fromkeys(STEPS[1:], new_input)}
        missing: dict[str, str] = {}
        for step in self.steps():
            read = {name.split(".")[0] for name in _stage_of(step).reads.values()} - {INGEST}
            if above := sorted({step_of(stage, self.table) for stage in read} & set(missing)):
                missing[step] = f"new input: {', '.join(above)}"
            elif self.find(step) is None:
                missing[step] = self.why[step]
        if self.table == PRIMARY:
            for other in self.further():
                missing |= other.pending()
                self.records |= other.records
        return missing

    def _take(self, step: str, record: Record) -> None:
        self.records[step] = record
        self._made_of.clear()  # what follows may read from it
        stage, _ = stage_and_unit(step)
        if step != INGEST:
            self._inputs |= {f"{stage}.{table}": output["sha256"] for table, output in record["outputs"].items()}
        else:
            seen = signals_of(self.table, record["signals"].keys() - set(record["facts"]["left_out"]))
            self._inputs |= {f"{INGEST}.{name}": record["signals"][table]["sha256"] for name, table in seen.items()}
            self._settings = ingest.settings_of(record["facts"], self._vehicle, self.table) if self.usable() else None

    def _params(self, step: str) -> Mapping[str, Json]:
        if step != INGEST:
            return as_json(taken_from(self._known(), _stage_of(step).takes))
        named = {"vehicle_id": self.job.vehicle_id, "name": Path(self.job.path).name}
        return {**reader_settings(self._vehicle), **named}

    def _known(self) -> FlightSettings:
        """The flight's settings; there are some once its log was found usable, and no stage runs before."""
        assert self._settings is not None
        return self._settings

    def _hashes(self, step: str) -> dict[str, str]:
        if step == INGEST:
            return {"log": self.job.sha256 or ""}
        sources = sorted(set(_stage_of(step).reads.values()))
        return {name: self._inputs[name] for name in sources if name in self._inputs}

    def _causes(self, step: str) -> Causes:
        """What the key of a step is made of, as its record keeps it."""
        if step not in self._made_of:
            stage, params, inputs = stage_and_unit(step)[0], self._params(step), self._hashes(step)
            source = sources()[stage]
            self._made_of[step] = {
                "run_key": run_key(stage, source, params, inputs),
                "params": plain(params),
                "inputs": inputs,
                "source": source,
                "versions": versions(),
            }
        return self._made_of[step]

    # --- ingest

    def _ingest(self) -> Record:
        key = self.key(INGEST)
        if self.job.problem is not None:
            return self._ingest_record(ingest.rejected(ReasonCode.NOT_READABLE, self.job.problem), {}, key, keep=False)
        try:
            facts, signals = read_log(self._root, self.job, self._vehicle)
        except RemoteError as error:
            return self._ingest_record(ingest.rejected(error.reason_code, error.sentence), {}, key, keep=False)
        except WarehouseError:
            raise
        except Exception as error:
            return self._ingest_record(
                ingest.rejected(ReasonCode.INGEST_FAILED, unforeseen(self.job.log_uri, error)), {}, key, keep=False
            )
        if facts["verdict"] != Verdict.REJECTED and file_stamp(Path(self.job.path)) != tuple(self.job.stamp):
            why = f"{self.job.log_uri} changed while it was read; the next night takes it when it is complete."
            return self._ingest_record(ingest.rejected(ReasonCode.CHANGED_WHILE_READ, why), {}, key, keep=False)
        return self._ingest_record(facts, signals, key, keep=facts["reason_code"] != ingest.TOO_SLOW)

    def _ingest_record(self, facts: Facts, signals: dict[str, Output], key: str, *, keep: bool) -> Record:
        status = Status.OK if Verdict(facts["verdict"]).usable else Status.REFUSED
        if facts["reason_code"] == ReasonCode.INGEST_FAILED:
            status = Status.FAILED
        measured = {"rows": facts["rows"], "units": facts["units"], "verdict": facts["verdict"]}
        record = _record(status, facts["reason_code"], facts["reason"], measured, self._causes(INGEST))
        record["facts"], record["signals"] = cast(Facts, plain(facts)), signals
        return self._kept(INGEST, key, {}, record) if keep else _unkept(record, key)

    def _signals_whole(self, record: Record) -> bool:
        """Whether the readings are what ingest wrote, and what everybody else holds them against says so too; or were
        removed, all of them, and nothing needs them."""
        paths = self._signal_paths(record)
        if paths and not any(path.exists() for path in paths.values()):
            return not any(checksum_path(self._root, path).exists() for path in paths.values())
        return all(self._whole(path, record["signals"][table]["sha256"]) for table, path in paths.items())

    def _whole(self, path: Path, sha256: str) -> bool:
        return path.exists() and file_sha256(path) == sha256 and problem(self._root, path, sha256) is None

    def _signal_paths(self, record: Record) -> dict[str, Path]:
        return {t: signal_path(self._root, t, self.job.vehicle_id, self.job.flight_id) for t in record["signals"]}

    # --- stages

    def _stage(self, step: str) -> Record:
        stage, key = _stage_of(step), self.key(step)
        try:
            tables = {name: self._tables[name] for name in set(stage.reads.values()) if name in self._inputs}
            result = run_stage(stage, tables, self._known())
        except WarehouseError:
            raise
        except Exception as error:
            why = f"{stage.name}: {unforeseen(self.job.log_uri, error)}"
            result = StageResult(status=Status.FAILED, reason_code=ReasonCode.STAGE_FAILED, reason=why)
        causes = self._causes(step)
        record = _record(result.status, result.reason_code, result.reason, result.measured, causes)
        if result.status == Status.FAILED:
            return _unkept(record, key)
        self._tables.keep(stage.name, result.tables)
        return self._kept(step, key, result.tables, record)

    def _kept(self, step: str, key: str, tables: Mapping[str, pl.DataFrame], record: Record) -> Record:
        hands_on = () if step == INGEST else _stage_of(step).hands_on
        return _of_store(self._store.save(step, self.job.flight_id, key, tables, record, handed_on=hands_on))


def _stage_of(step: str) -> Stage:
    return STAGES[stage_and_unit(step)[0]]


def _record(
    status: Status, reason_code: str | None, reason: str | None, measured: Mapping[str, object], causes: Causes
) -> Record:
    """The record of a step that has ended, without what it wrote."""
    return {
        "status": status,
        "reason_code": reason_code,
        "reason": reason,
        "measured": plain(measured),
        "run_key": causes["run_key"],
        "params": causes["params"],
        "inputs": causes["inputs"],
        "source": causes["source"],
        "versions": causes["versions"],
    }


def _of_store(stored: dict[str, Json]) -> Record:
    """A record as the warehouse gives it back: what was handed to it, with the outputs, of which those that lie in it
    stay there: a night passes its records on."""
    outputs = {name: {k: v for k, v in output.items() if k != "columns"} for name, output in outputs_of(stored).items()}
    return cast(Record, {**stored, "outputs": outputs})


def _unkept(record: Record, key: str) -> Record:
    return {**record, "run_key": key, "outputs": {}, "unkept": True}
