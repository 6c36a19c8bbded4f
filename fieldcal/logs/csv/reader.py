"""CSV logs: one file, or a folder with `imu.csv` and, where there is a VPS, `vps.csv`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv import columns as columns_of
from fieldcal.logs.csv.dialect import cells_of, find_dialect
from fieldcal.logs.csv.rows import Losses, numbers_of, other_header, read_rows
from fieldcal.logs.csv.text import LineBlocks
from fieldcal.logs.csv.time import looks_iso8601, nanoseconds, sample_numbers, sample_times
from fieldcal.logs.csv.units import time_unit
from fieldcal.logs.interface import Batch, LogSummary, logged_units, stamps_are_epoch
from fieldcal.logs.interface import Columns as BatchColumns
from fieldcal.names import SENSORS
from fieldcal.reason_codes import ReasonCode

VPS_COLUMNS = {"quaternion_xyzw": ("qx", "qy", "qz", "qw"), "position": ("px_m", "py_m", "pz_m")}
POWER_COLUMNS = {"current": ("current_a",), "throttle": ("throttle",)}
_LINES_LOOKED_AT = 50
_LOSS_SENTENCES = {
    ReasonCode.RAGGED_ROW: ("have more or fewer fields than the header and were left out", True),
    ReasonCode.NUL_BYTES: ("contain NUL bytes and were left out", True),
    ReasonCode.BAD_TIME: ("have a time that is none and were left out", True),
    ReasonCode.BAD_NUMBER: ("have a cell that is no number and were left out", True),
    ReasonCode.INCOMPLETE_ROW: ("have only part of a sensor's cells and were left out", True),
    ReasonCode.HEADER_CHANGED: (
        "name the columns anew and differently; nothing behind them was read: split the file",
        True,
    ),
    ReasonCode.REPEATED_HEADER: ("repeat the header; several recordings may stand in one file", False),
}


class CsvTable:
    """One CSV file being read.

    Parameters
    ----------
    path, name : Path, str
        The file, and what sentences call it.
    vehicle : Vehicle
        Its `csv` and `units`.
    tables : tuple of str
        Which of "imu" and "vps" to look for in it.
    summary : LogSummary
        Receives findings and counts.
    """

    def __init__(self, path: Path, name: str, vehicle: Vehicle, tables: tuple[str, ...], summary: LogSummary) -> None:
        self._name = name
        self._summary = summary
        self._csv = vehicle.csv
        self._blocks = LineBlocks(path)
        first = next(iter(self._blocks), b"")
        self.dialect = find_dialect(first, self._name, self._csv.separator, self._csv.decimal)
        self.imu = self._columns("imu", columns_of.IMU_DEFAULTS) if "imu" in tables else None
        self.vps = self._columns("vps", columns_of.VPS_DEFAULTS) if "vps" in tables else None
        if self.vps is not None and "quaternion_xyzw" not in self.vps.values:
            self.vps = None
        self.units = (
            columns_of.declared_units(self.dialect, self.imu, summary, self._name) if self.imu is not None else {}
        )
        self._first_cells = self._cells_of_first_row(first)
        for table in (self.imu, self.vps):
            if table is not None and table.values:
                self._require_time(table)

    def batches(self) -> Iterator[Batch]:
        """Signal batches, block by block."""
        losses = Losses()
        line, row = 1, 0
        skip = self.dialect.first_row
        for number, block in enumerate(self._blocks):
            lines = block.count(b"\n")
            if skip:
                passed = min(skip, lines)
                block = block.split(b"\n", passed)[passed]
                skip -= passed
                line += passed
                lines -= passed
            if not block:
                continue
            losses.next_block()
            frame, numbers = read_rows(block, self.dialect, line, self._wanted(), losses)
            if number == 0 and losses.counts.get(ReasonCode.RAGGED_ROW, 0) > len(numbers):
                raise UnreadableLog(
                    ReasonCode.RAGGED_ROWS,
                    f"{self._name}: most rows have not the {self.dialect.fields} fields of the header (first at line "
                    f"{losses.first_lines[ReasonCode.RAGGED_ROW]}), read with separator {self.dialect.separator!r}. "
                    "Correct csv.separator and csv.decimal, or the file.",
                )
            changed = other_header(frame, self.dialect)
            if changed is not None:
                losses.add(ReasonCode.HEADER_CHANGED, numbers[changed : changed + 1])
                frame, numbers = frame[:changed], numbers[:changed]
            places = row + (numbers - line)
            yield from self._block(frame, numbers, places, losses)
            if changed is not None:
                break
            line, row = line + lines, row + lines
        self._report(losses)

    def _wanted(self) -> list[int]:
        wanted: set[int] = set()
        for table in (self.imu, self.vps):
            if table is not None:
                wanted |= {place for places in table.values.values() for place in places}
                wanted |= {table.time} if table.time is not None else set()
        return sorted(wanted)

    def _columns(self, table: str, defaults: dict[str, tuple[str, ...]]) -> columns_of.Columns:
        configured = self._csv.imu if table == "imu" else self._csv.vps
        return columns_of.find_columns(self.dialect, configured, defaults, table, self._name)

    def _cells_of_first_row(self, block: bytes) -> list[str]:
        for line in block.split(b"\n", self.dialect.first_row + _LINES_LOOKED_AT)[self.dialect.first_row : -1]:
            text = line.decode("utf-8", "replace")
            if text.strip() and not text.startswith("#"):
                return cells_of(text, self.dialect.separator)
        return []

    def _require_time(self, table: columns_of.Columns) -> None:
        if table.time is None and not self._csv.rate_hz:
            raise UnreadableLog(
                ReasonCode.MISSING_TIME,
                f"{self._name} has no time column among {', '.join(self.dialect.names[:20])}. Name it as csv.imu.t, or "
                "give csv.rate_hz if the rows come at a fixed rate.",
            )

    def _time_unit(self, place: int) -> str | None:
        """Unit of a time column; None: it holds sample numbers."""
        row = self.dialect.unit_row
        own = time_unit(self.dialect.names[place], row[place] if row else None)
        if self._csv.time_unit or own:
            return self._csv.time_unit or own
        if place < len(self._first_cells) and looks_iso8601(self._first_cells[place]):
            return "iso8601"
        return None if self._csv.rate_hz else "s"

    def _rate_hz(self) -> float:
        """The configured rate of the rows, which `_require_time` asked for."""
        assert self._csv.rate_hz is not None
        return self._csv.rate_hz

    def _times(
        self, frame: pl.DataFrame, place: int | None, places: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Nanoseconds of each row, and where they are sound."""
        if place is None:
            return sample_times(places, self._rate_hz()), np.ones(len(places), bool)
        unit = self._time_unit(place)
        cells = frame[str(place)]
        times = nanoseconds(cells, unit) if unit else sample_numbers(cells)
        sound = times.is_not_null().to_numpy()
        t_ns = times.fill_null(0).to_numpy()
        return (t_ns if unit else sample_times(t_ns, self._rate_hz())), sound

    def _block(
        self, frame: pl.DataFrame, numbers: NDArray[np.int64], places: NDArray[np.int64], losses: Losses
    ) -> Iterator[Batch]:
        cells = {name: numbers_of(frame[name]) for name in self._numeric()}
        for table, groups in self._tables():
            columns = self.imu if table != "vps" else self.vps
            if columns is None or not groups:
                continue
            t_ns, sound = self._times(frame, columns.time, places)
            values = {
                out: cells[str(place)][0]
                for key, outs in groups
                for place, out in zip(columns.values[key], outs, strict=True)
            }
            bad = np.zeros(len(numbers), bool)
            for key, _ in groups:
                for place in columns.values[key]:
                    bad |= cells[str(place)][1]
            required = [out for key, outs in groups for out in outs if key != "position"]
            there = np.stack([np.isfinite(values[out]) for out in required])
            if table == "power":
                there = np.stack([there.any(axis=0)])  # one of the two will do
            absent = ~there.any(axis=0) & ~bad
            losses.add(ReasonCode.BAD_NUMBER, numbers[bad])
            losses.add(ReasonCode.INCOMPLETE_ROW, numbers[~there.all(axis=0) & ~absent & ~bad])
            losses.add(ReasonCode.BAD_TIME, numbers[~sound & there.all(axis=0) & ~bad])
            kept = sound & there.all(axis=0) & ~bad
            if not kept.any():
                continue
            batch: BatchColumns = {"t_ns": t_ns[kept], **{out: column[kept] for out, column in values.items()}}
            self._summary.count_rows(table, batch)
            self._summary.epoch_known |= columns.time is not None and stamps_are_epoch(t_ns[kept])
            yield table, batch

    def _numeric(self) -> list[str]:
        tables = [table for table in (self.imu, self.vps) if table is not None]
        return sorted({str(place) for table in tables for places in table.values.values() for place in places})

    def _tables(self) -> list[tuple[str, list[tuple[str, tuple[str, ...]]]]]:
        """Signal table -> (key of the column map, output columns)."""
        imu = self.imu.values if self.imu is not None else {}
        vps = self.vps.values if self.vps is not None else {}
        inertial = [key for key in ("gyroscope", "accelerometer") if key in imu]
        axes: dict[str, tuple[str, ...]] = {key: tuple(f"{key}_{axis}" for axis in "xyz") for key in SENSORS}
        return [
            ("imu", [(key, axes[key]) for key in inertial]),
            ("magnetometer", [("magnetometer", axes["magnetometer"])] if "magnetometer" in imu else []),
            ("temperature", [("temperature", ("temperature_degc",))] if "temperature" in imu else []),
            ("power", [(key, outs) for key, outs in POWER_COLUMNS.items() if key in imu]),
            ("vps", [(key, outs) for key, outs in VPS_COLUMNS.items() if key in vps]),
        ]

    def _report(self, losses: Losses) -> None:
        for reason, count in losses.counts.items():
            words, loses_data = _LOSS_SENTENCES[reason]
            self._summary.add(
                reason,
                count,
                f"{self._name}: {count} row(s) {words}; the first is line {losses.first_lines[reason]}.",
                loses_data=loses_data,
            )
        if self._blocks.unterminated:
            self._summary.add(
                ReasonCode.UNTERMINATED_ROW,
                1,
                f"{self._name} ends inside a row: the last row has no line end, its last number may be cut, and it was "
                "left out.",
                loses_data=True,
            )


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
        `missing_time`, `missing_sensor`; from `batches()` also `ragged_rows`.
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
