"""A log read into the signal tables of the warehouse: all of it, or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.flight.job import Job
from fieldcal.flight.record import Output
from fieldcal.logs import ingest
from fieldcal.logs.facts import Facts
from fieldcal.logs.tidy import Disordered
from fieldcal.names import Verdict
from fieldcal.remote.content import here
from fieldcal.warehouse.signals import signal_writer
from fieldcal.warehouse.store import TableWriter


def read_log(root: Path, job: Job, vehicle: Vehicle) -> tuple[Facts, dict[str, Output]]:
    """Read the log into the signal tables; what it is, and what was written.

    Raises
    ------
    RemoteError
        It lies elsewhere and cannot be fetched.
    WarehouseError
        The warehouse cannot be written.
    """
    with here(Path(job.path)):
        try:
            return _streamed(root, job, vehicle, whole=False)
        except Disordered:
            return _streamed(root, job, vehicle, whole=True)


def _streamed(root: Path, job: Job, vehicle: Vehicle, *, whole: bool) -> tuple[Facts, dict[str, Output]]:
    """Nothing appears unless the whole log came through."""

    def writer(table: str, units: Mapping[str, str]) -> TableWriter:
        return signal_writer(root, table, job.vehicle_id, job.flight_id, units=units)

    writers: dict[str, TableWriter] = {}
    try:
        with ExitStack() as stack:
            path, units = Path(job.path), None
            log = ingest.tidy_log(path, vehicle, whole=whole)
            for table, frame in log.tables():
                if table not in writers:
                    units = units or log.units() or ingest.logged_units(path, vehicle)
                    writers[table] = stack.enter_context(writer(table, units))
                writers[table].write(frame)
            facts = log.facts()
            if facts["verdict"] == Verdict.QUARANTINED:
                raise _Quarantined(facts)
    except _Quarantined as stop:
        return stop.facts, {}
    except UnreadableLog as error:
        return ingest.rejected(error.reason_code, error.sentence), {}
    return facts, {name: {"sha256": w.sha256, "rows": w.n_rows} for name, w in sorted(writers.items())}


class _Quarantined(Exception):
    def __init__(self, facts: Facts) -> None:
        super().__init__(facts["reason"])
        self.facts = facts
