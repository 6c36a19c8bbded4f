"""One CSV file as signal batches: its columns, its clock, its units, and every row that was left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fieldcal.config.configuration import CsvTimeUnit, Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv import columns as columns_of
from fieldcal.logs.csv import conversion, instances
from fieldcal.logs.csv.clock import FileClock
from fieldcal.logs.csv.dialect import cells_of, comment_lines, find_dialect
from fieldcal.logs.csv.losses import Losses
from fieldcal.logs.csv.presets.choice import only_by_name, read_as
from fieldcal.logs.csv.presets.layout import ATTITUDES, layout_of
from fieldcal.logs.csv.rows import numbers_of, other_header, read_rows
from fieldcal.logs.csv.text import LineBlocks
from fieldcal.logs.csv.time import looks_iso8601, looks_time_of_day, sample_times
from fieldcal.logs.csv.units import time_unit
from fieldcal.logs.further_units import FurtherUnits
from fieldcal.logs.interface import Batch, LogSummary, stamps_are_epoch
from fieldcal.logs.interface import Columns as BatchColumns
from fieldcal.logs.joining import INERTIAL, SensorJoin, stand_apart
from fieldcal.reason_codes import ReasonCode

_HEAD_CAP_BYTES = 64 << 20
_LINES_LOOKED_AT, _ROWS_LOOKED_AT = 50, 5000


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
    join : SensorJoin, optional
        Takes the readings of gyroscope and accelerometer, where they stand in files of their own.
    """

    def __init__(
        self,
        path: Path,
        name: str,
        vehicle: Vehicle,
        tables: tuple[str, ...],
        summary: LogSummary,
        join: SensorJoin | None = None,
    ) -> None:
        self._name = name
        self._summary = summary
        self._csv = vehicle.csv
        self._blocks = LineBlocks(path)
        first = self._head()
        self.dialect = find_dialect(first, self._name, self._csv.separator, self._csv.decimal)
        self._first_cells = self._cells_of_first_row(first)
        layout = layout_of(first, self.dialect, self._first_cells)
        self._as = read_as(self._csv, layout, tables, columns_of.known_by_names(self.dialect, self._csv), name)
        if self._as.meaning.names:
            self.dialect = replace(self.dialect, names=self._as.meaning.names)
        self._rate_hz = self._as.rate_hz(self._csv)
        self._only_by_name = only_by_name(layout) if self._as.preset is None and self._csv.preset is None else ""
        self._clocks: dict[int, FileClock] = {}
        self._to_rad = 1.0
        self._to_degc = 1.0, 0.0
        self.imu = self._imu_columns() if "imu" in tables else None
        self.vps = self._vps_columns(alone="imu" not in tables) if "vps" in tables else None
        self.units: dict[str, str] = {}
        self._factors: dict[str, float] = {}
        if self.imu is not None:
            own = self._as.units(self.imu.values, self._csv.imu)
            others = {key: places for key, places in self.imu.values.items() if key not in own}
            by_names = columns_of.declared_units(self.dialect, replace(self.imu, values=others), summary, name)
            self.units, self._factors = conversion.sensor_factors({**by_names, **own}, vehicle.units, summary, name)
            for sensor in own.keys() - vehicle.units.keys():
                self._factors[sensor] = self._factors.get(sensor, 1.0) * self._as.meaning.factors.get(sensor, 1.0)
            if "temperature" in self.imu.values:
                self._to_degc = conversion.temperature_scale(self.dialect, self.imu, summary, name)
        self._as.tell(summary, name)
        if self.dialect.preamble and self._as.preset is None:
            summary.add(
                ReasonCode.PREAMBLE,
                self.dialect.preamble,
                f"{name}: line {self.dialect.header_line} is taken for the header; the {self.dialect.preamble} line(s) "
                "above it were passed over.",
            )
        self._instance_place = self._instances(first)
        self._further = FurtherUnits()
        self._joins_itself = join is None
        self._join = SensorJoin() if join is None and self._sensors_stand_apart(first) else join

    def _head(self) -> bytes:
        """The file's first block, with those behind it for as long as they hold nothing but comments."""
        head = b""
        for block in self._blocks:
            head += block
            if comment_lines(head) < head.count(b"\n") or len(head) > _HEAD_CAP_BYTES:
                break
        return head

    def batches(self) -> Iterator[Batch]:
        """Signal batches, block by block."""
        losses = Losses()
        line, row = 1, 0
        skip = self.dialect.first_row
        for block in self._blocks:
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
            if row == 0 and losses.counts.get(ReasonCode.RAGGED_ROW, 0) > len(numbers):
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
        yield from self._joined()
        self._report(losses)

    def _wanted(self) -> list[int]:
        wanted = {self._instance_place} if self._instance_place is not None else set()
        for table in (self.imu, self.vps):
            if table is not None:
                wanted |= {place for places in table.values.values() for place in places}
                wanted |= {table.time} if table.time is not None else set()
        return sorted(wanted)

    def _imu_columns(self) -> columns_of.Columns:
        configured = columns_of.without_absent(self.dialect, self._csv.imu, "imu", self._summary, self._name)
        wanted = self._as.columns("imu", configured)
        found = columns_of.find_columns(self.dialect, wanted, columns_of.IMU_DEFAULTS, "imu", self._name)
        if found.values:
            self._set_clock(found.time, self._csv.time_unit or self._as.time_unit("imu", configured))
        return found

    def _vps_columns(self, *, alone: bool) -> columns_of.Columns | None:
        """Columns of the VPS. In a file that is the IMU's too, what is wrong with them is told and nothing else."""
        try:
            configured = columns_of.without_absent(self.dialect, self._csv.vps, "vps", self._summary, self._name)
            wanted = self._as.columns("vps", configured)
            if not wanted and self._as.has("imu"):  # what looks like an attitude there is the IMU's own estimate
                return None
            found = columns_of.find_columns(self.dialect, wanted, columns_of.VPS_DEFAULTS, "vps", self._name)
            found = columns_of.attitude_columns(self.dialect, found)
            if "roll_pitch_yaw" in found.values:
                self._to_rad = conversion.radians(self._csv, self.dialect, found, self._name)
            elif not set(ATTITUDES) & found.values.keys():
                if alone:
                    raise columns_of.no_attitude(self.dialect, self._name, self._only_by_name)
                return None
            unit = self._csv.vps_time_unit or self._as.time_unit("vps", configured)
            self._set_clock(found.time, unit, otherwise=self._csv.time_unit)
        except UnreadableLog as error:
            if alone:
                raise
            self._summary.add(error.reason_code, 1, f"{error.sentence} The VPS is not read.", loses_data=True)
            return None
        return found

    def _instances(self, first: bytes) -> int | None:
        """Position of the column that tells several IMUs apart, where one of them is chosen; refused where none is."""
        if self.imu is None:
            return None
        named = {"instance": self._csv.imu["instance"]} if "instance" in self._csv.imu else {}
        found = columns_of.find_columns(self.dialect, named, {"instance": ()}, "imu", self._name).values
        taken = {place for table in (self.imu, self.vps) if table for at in table.values.values() for place in at}
        taken |= set(self._clocks)
        place = found["instance"][0] if found else instances.instance_column(self.dialect.names, taken)
        if place is None:
            return None
        cells = self._first_rows(first, [place])[str(place)]
        values = instances.interleaved(cells)
        if self._csv.instance is None:
            if values:
                raise instances.several_units(self._name, self.dialect.names[place], values)
            return None
        if not found and not values:
            return None
        if not instances.rows_of(cells, self._csv.instance).any():
            raise instances.absent_unit(self._name, self.dialect.names[place], cells, self._csv.instance)
        return place

    def _sensors_stand_apart(self, first: bytes) -> bool:
        if self.imu is None or not set(INERTIAL) <= self.imu.values.keys():
            return False
        frame = self._first_rows(first, self._wanted())
        places = [self.imu.values[key] for key in INERTIAL]
        readings = np.stack([[numbers_of(frame[str(place)])[0] for place in axes] for axes in places])
        whole = np.isfinite(readings)
        return stand_apart(whole[0].all(axis=0), whole[1].all(axis=0))

    def _first_rows(self, first: bytes, columns: list[int]) -> pl.DataFrame:
        skip = self.dialect.first_row
        lines = first.split(b"\n", skip + _ROWS_LOOKED_AT)[skip:-1]
        if not lines:
            return pl.DataFrame(schema={str(column): pl.String for column in columns})
        return read_rows(b"\n".join(lines) + b"\n", self.dialect, 1, columns, Losses())[0]

    def _cells_of_first_row(self, block: bytes) -> list[str]:
        for line in block.split(b"\n", self.dialect.first_row + _LINES_LOOKED_AT)[self.dialect.first_row : -1]:
            text = line.decode("utf-8", "replace")
            if text.strip() and not text.startswith("#"):
                return cells_of(text, self.dialect.separator)
        return []

    def _set_clock(self, place: int | None, unit: str | None, otherwise: CsvTimeUnit | None = None) -> None:
        """The clock of a time column: its unit is the known one, else what the column says, else `otherwise`.

        A clock that is set already stays: the IMU's, where the VPS has the same column.
        """
        if place is None:
            if not self._rate_hz:
                raise UnreadableLog(
                    ReasonCode.MISSING_TIME,
                    f"{self._name} has no time column among {', '.join(self.dialect.names[:20])}. Name it as csv.imu.t "
                    "or csv.vps.t, or give csv.rate_hz if the rows come at a fixed rate.",
                )
            return
        if place in self._clocks:
            return
        row = self.dialect.unit_row
        own = time_unit(self.dialect.names[place], row[place] if row else None)
        cell = self._first_cells[place] if place < len(self._first_cells) else ""
        seen = "iso8601" if looks_iso8601(cell) else "time_of_day" if looks_time_of_day(cell) else None
        default = None if self._rate_hz else "s"
        # A column's name gives the unit of numbers; its cells may yet be times of day.
        found = unit or (seen if own == "s" else None) or own or seen or otherwise or default
        self._clocks[place] = FileClock(found, self._rate_hz, self._csv.clock_period_s)

    def _block(
        self, frame: pl.DataFrame, numbers: NDArray[np.int64], places: NDArray[np.int64], losses: Losses
    ) -> Iterator[Batch]:
        cells = {name: numbers_of(frame[name]) for name in self._numeric()}
        times = {place: clock.times(frame[str(place)]) for place, clock in self._clocks.items()}
        units = self._units(frame)
        everything = {"": np.ones(len(numbers), bool)}
        for table, groups in columns_of.signal_groups(self.imu, self.vps, apart=self._join is not None):
            columns = self.imu if table != "vps" else self.vps
            if columns is None or not groups:
                continue
            if columns.time is None:
                t_ns, sound = sample_times(places, self._rate_hz or 1.0), np.ones(len(places), bool)
            else:
                t_ns, sound = times[columns.time]
            values = {
                out: cells[str(place)][0]
                for key, outs in groups
                for place, out in zip(columns.values[key], outs, strict=True)
            }
            bad = np.zeros(len(numbers), bool)
            for key, _ in groups:
                for place in columns.values[key]:
                    bad |= cells[str(place)][1]
            required = [out for key, outs in groups for out in outs if key not in ("position", "gnss_velocity_sd")]
            there = np.stack([np.isfinite(values[out]) for out in required])
            if table == "power":
                there = np.stack([there.any(axis=0)])  # one of the two will do
            whole = there.all(axis=0)
            for unit_id, of_unit in (everything if table == "vps" else units).items():
                losses.add(ReasonCode.BAD_NUMBER, numbers[bad & of_unit])
                losses.add(ReasonCode.INCOMPLETE_ROW, numbers[~whole & there.any(axis=0) & of_unit & ~bad])
                losses.add(ReasonCode.BAD_TIME, numbers[~sound & whole & ~bad & of_unit])
                kept = sound & whole & ~bad & of_unit
                if not kept.any():
                    continue
                batch = self._batch(table, t_ns[kept], {out: column[kept] for out, column in values.items()})
                self._summary.epoch_known |= columns.time is not None and stamps_are_epoch(t_ns[kept])
                if self._join is not None and table in INERTIAL:
                    if not unit_id:
                        self._join.add(table, t_ns[kept], np.column_stack([batch[out] for out in required]))
                    continue
                placed = self._further.placed((table, batch), unit_id or self._name, unit_id)
                if placed is not None:
                    self._summary.count_rows(*placed)
                    yield placed

    def _units(self, frame: pl.DataFrame) -> dict[str, NDArray[np.bool_]]:
        """Which rows are of which IMU: those of the chosen one under "", others under their names."""
        if self._instance_place is None or self._csv.instance is None:
            return {"": np.ones(frame.height, bool)}
        cells = frame[str(self._instance_place)]
        others = [name for name in instances.names_in(cells) if name != self._csv.instance]
        return {"": instances.rows_of(cells, self._csv.instance), **{n: instances.rows_of(cells, n) for n in others}}

    def _batch(self, table: str, t_ns: NDArray[np.int64], values: dict[str, NDArray[np.float64]]) -> BatchColumns:
        """Rows of one table in the units that are delivered."""
        for sensor, factor in self._factors.items():
            values |= {out: values[out] * factor for out in columns_of.AXES[sensor] if out in values}
        if "temperature_degc" in values and self._to_degc != (1.0, 0.0):
            values["temperature_degc"] = values["temperature_degc"] * self._to_degc[0] + self._to_degc[1]
        if table == "vps":
            values = conversion.with_quaternion(values, self._to_rad)
            if self._as.has("vps"):
                values = conversion.in_world(values, self._as.meaning.world_from_logged, self._as.meaning.metre)
        return {"t_ns": t_ns, **values}

    def _joined(self) -> Iterator[Batch]:
        """Rows of sensors that stand in rows of their own."""
        found = self._join.joined(self._name) if self._join is not None and self._joins_itself else None
        if found is not None:
            batch, finding = found
            self._summary.findings.append(finding)
            self._summary.count_rows("imu", batch)
            yield "imu", batch

    def _numeric(self) -> list[str]:
        tables = [table for table in (self.imu, self.vps) if table is not None]
        return sorted({str(place) for table in tables for places in table.values.values() for place in places})

    def _report(self, losses: Losses) -> None:
        self._further.tell(self._summary, self._name)
        bad_times = [clock.bad_cell for clock in self._clocks.values() if clock.bad_cell is not None]
        self._summary.findings += losses.findings(self._name, bad_times[0] if bad_times else None)
        for clock in self._clocks.values():
            self._summary.findings += clock.findings(self._name)
        if self._blocks.unterminated:
            self._summary.add(
                ReasonCode.UNTERMINATED_ROW,
                1,
                f"{self._name} ends inside a row: the last row has no line end, its last number may be cut, and it was "
                "left out.",
                loses_data=True,
            )
