"""CSV logs: one file, or a folder with `imu.csv` and, where there is a VPS, `vps.csv`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv.table import CsvTable
from fieldcal.logs.interface import Batch, LogSummary, logged_units
from fieldcal.names import SENSORS
from fieldcal.reason_codes import ReasonCode


class CsvLog:
    """A CSV log (`fieldcal.logs.LogReader`).

    Parameters
    ----------
    path : Path
        A file with inertial columns, and perhaps those of a VPS; or a folder with `imu.csv` and perhaps `vps.csv`.
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
        self._parts = [*self._opened(path, vehicle)]
        values = [value for part in self._parts if part.imu is not None for value in part.imu.values]
        if not set(SENSORS) & set(values):
            listed = ", ".join(self._parts[0].dialect.names[:20])
            raise UnreadableLog(
                ReasonCode.MISSING_SENSOR,
                f"{self._name} has no known columns of gyroscope, accelerometer or magnetometer; it has {listed}. "
                "Name them under csv.imu in the configuration.",
            )
        self.summary.units = logged_units(self.summary, self._parts[0].units, vehicle.units, self._name)

    def batches(self) -> Iterator[Batch]:
        """Signal batches in file order (of a folder: `imu.csv`, then `vps.csv`). May be iterated once."""
        first, *others = self._parts
        yield from first.batches()
        for part in others:
            try:
                yield from part.batches()
            except UnreadableLog as error:
                self._without_vps(error)
        if not {"imu", "magnetometer"} & self.summary.counts.keys():
            told = self.summary.findings[0].sentence if self.summary.findings else "It holds a header only."
            raise UnreadableLog(ReasonCode.NO_ROWS, f"{self._name} holds not one usable row. {told}")

    def _opened(self, path: Path, vehicle: Vehicle) -> Iterator[CsvTable]:
        if not path.is_dir():
            yield CsvTable(path, path.name, vehicle, ("imu", "vps"), self.summary)
            return
        has_vps = (path / "vps.csv").is_file()
        tables = ("imu",) if has_vps else ("imu", "vps")
        yield CsvTable(path / "imu.csv", f"{path.name}/imu.csv", vehicle, tables, self.summary)
        if has_vps:
            try:
                yield CsvTable(path / "vps.csv", f"{path.name}/vps.csv", vehicle, ("vps",), self.summary)
            except UnreadableLog as error:
                self._without_vps(error)

    def _without_vps(self, error: UnreadableLog) -> None:
        self.summary.add(ReasonCode.VPS_UNREADABLE, 1, f"The VPS is not read whole: {error.sentence}", loses_data=True)
