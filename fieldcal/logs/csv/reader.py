"""CSV logs: one file, or a folder with `imu.csv` or a known exporter's files and, where there is a VPS, `vps.csv`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv.folder import folder_layout, optional_files
from fieldcal.logs.csv.table import CsvTable
from fieldcal.logs.interface import Batch, LogSummary, logged_units
from fieldcal.logs.joining import SensorJoin
from fieldcal.names import SENSORS
from fieldcal.reason_codes import ReasonCode


class CsvLog:
    """A CSV log (`fieldcal.logs.LogReader`).

    Parameters
    ----------
    path : Path
        A file with inertial columns, and perhaps those of a VPS; or a folder of a known layout (`csv.folder`) with
        `imu.csv` or the like, and perhaps `vps.csv`.
    vehicle : Vehicle
        Its `csv` (columns, units of time, rate) and `units`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`, `not_text`, `no_rows`, `missing_header`, `missing_column`, `duplicate_column`,
        `missing_time`, `missing_sensor`, `several_units`; from `batches()` also `ragged_rows`.
    """

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        self.summary = LogSummary("csv")
        self._name = path.name
        self._needed = 1
        self._join: SensorJoin | None = None
        self._parts = [*self._opened(path, vehicle)]
        values = [value for part in self._parts if part.imu is not None for value in part.imu.values]
        if not set(SENSORS) & set(values):
            raise _no_sensor(self._name, self._parts[0])
        declared = {sensor: unit for part in self._parts for sensor, unit in part.units.items()}
        self.summary.units = logged_units(self.summary, declared, vehicle.units, self._name)

    def batches(self) -> Iterator[Batch]:
        """Signal batches in file order (of a folder: the IMU's, then `vps.csv`). May be iterated once."""
        for number, part in enumerate(self._parts):
            try:
                yield from part.batches()
            except UnreadableLog as error:
                if number < self._needed:
                    raise
                self._without(part.imu is None, error)
        found = self._join.joined(self._name) if self._join is not None else None
        if found is not None:
            batch, finding = found
            self.summary.findings.append(finding)
            self.summary.count_rows("imu", batch)
            yield "imu", batch
        if not {"imu", "magnetometer"} & self.summary.counts.keys():
            told = self.summary.findings[0].sentence if self.summary.findings else "It holds a header only."
            raise UnreadableLog(ReasonCode.NO_ROWS, f"{self._name} holds not one usable row. {told}")

    def _opened(self, path: Path, vehicle: Vehicle) -> Iterator[CsvTable]:
        layout = folder_layout(path) if path.is_dir() else None
        if layout is None:
            yield CsvTable(path, path.name, vehicle, ("imu", "vps"), self.summary)
            return
        self._needed = len(layout.needed)
        self._join = SensorJoin() if layout.apart else None
        others = [*optional_files(path, layout)]
        has_vps = any(table == "vps" for _, table in others)
        tables = ("imu",) if has_vps or layout.apart else ("imu", "vps")
        for name in layout.needed:
            yield CsvTable(path / name, f"{path.name}/{name}", vehicle, tables, self.summary, self._join)
        for name, table in others:
            full = f"{path.name}/{name}"
            try:
                part = CsvTable(path / name, full, vehicle, (table,), self.summary)
                if part.imu is not None and not part.imu.values:
                    raise _no_sensor(full, part)
                yield part
            except UnreadableLog as error:
                self._without(table == "vps", error)

    def _without(self, vps: bool, error: UnreadableLog) -> None:
        """Tell of a file beside the needed ones that is not read whole."""
        if vps:
            sentence = f"The VPS is not read whole: {error.sentence}"
            self.summary.add(ReasonCode.VPS_UNREADABLE, 1, sentence, loses_data=True)
        else:
            self.summary.add(error.reason_code, 1, error.sentence, loses_data=True)


def _no_sensor(name: str, part: CsvTable) -> UnreadableLog:
    """The refusal of a file without readings."""
    listed = ", ".join(part.dialect.names[:20])
    return UnreadableLog(
        ReasonCode.MISSING_SENSOR,
        f"{name} has no known columns of gyroscope, accelerometer or magnetometer; it has {listed}. "
        "Name them under csv.imu in the configuration.",
    )
