"""A table that a stage only handed on is made again as it was; only what is missing runs."""

from __future__ import annotations

import gc
import json
import weakref
from pathlib import Path

import numpy as np
import pytest

from fieldcal.batch.jobs import find_jobs
from fieldcal.batch.steps import FlightWork
from fieldcal.config.find import configuration_of, find_source
from fieldcal.flight.stage_tables import STAGES, StageTables
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.rows_as_json import digest
from fieldcal.warehouse.sealed import seal, unseal
from fieldcal.warehouse.stage_store import is_kept, outputs_of

HANDED_ON = [(name, table) for name, stage in STAGES.items() for table in stage.hands_on]


class Archive:
    """One simulated flight."""

    def __init__(self, folder: Path) -> None:
        self.archive, self.root = folder / "archive", folder / "data"
        write_flights(self.archive, Experiment(seed=3, duration_s=20.0, dip_rad=np.radians(60.0)))
        self.configuration = configuration_of(find_source(None, self.archive))
        (self.job,) = find_jobs(self.archive, self.configuration)

    def done(self) -> FlightWork:
        work = FlightWork(self.root, self.job, self.configuration.vehicle(self.job.vehicle_id))
        work.do("ingest")
        for step in work.steps():
            work.do(step)
        return work


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Archive:
    return Archive(tmp_path_factory.mktemp("flown"))


def test_it_is_made_again_as_it_was(flown: Archive) -> None:
    records = flown.done().records
    tables = StageTables(flown.root, flown.job.vehicle_id, flown.job.flight_id, records)
    assert {stage for stage, _ in HANDED_ON} == {"smoothing", "attitude", "attitude_pass2", "vps_sync"}
    for stage, table in HANDED_ON:
        output = outputs_of(records[stage])[table]
        assert not is_kept(output)
        assert not list((flown.root / "stages").rglob(f"{table}.parquet"))
        assert digest(tables[f"{stage}.{table}"]) == output["sha256"]
    with pytest.raises(KeyError):
        tables["smoothing.nothing"]


def test_a_flight_s_tables_are_given_up_with_it(flown: Archive) -> None:
    """Not when garbage is next looked for: by then a process would hold many flights."""
    work = flown.done()
    there = weakref.ref(work)
    gc.disable()
    try:
        del work
        assert there() is None
    finally:
        gc.enable()


def test_what_is_missing_runs_alone_on_tables_that_are_made_again(flown: Archive) -> None:
    whole = flown.done().records
    for stage in ("verify", "gyro_output"):
        for record in (flown.root / "stages" / stage).rglob("run.json"):
            record.unlink()
    again = flown.done()
    assert set(again.why) == {"verify", "gyro_output"}
    for stage in ("verify", "gyro_output"):
        assert again.records[stage]["outputs"] == whole[stage]["outputs"]
    assert not flown.done().why


def test_where_it_comes_out_otherwise_the_stage_runs_again(flown: Archive) -> None:
    """As on another machine: nothing is taken for the result of what it is not."""
    flown.done()
    (place,) = (flown.root / "stages" / "smoothing").rglob("run.json")
    record = unseal(place.read_bytes())
    outputs = json.loads(json.dumps(record["outputs"]))
    outputs["samples"]["sha256"] = "0" * 64
    place.write_bytes(seal({**record, "outputs": outputs}))
    (verify,) = (flown.root / "stages" / "verify").rglob("run.json")
    verify.unlink()
    failed = flown.done().records["verify"]
    assert failed["status"] == "failed"
    assert "does not give again what it gave; the next night runs it" in str(failed["reason"])
    assert set(flown.done().why) == {"smoothing", "verify"}
    assert not flown.done().why
