"""ArduPilot DataFlash logs: their messages as signal batches.

World north-east-down, body nose-starboard-underside, specific force; rad/s, m/s², gauss. ISBH and ISBD are not read:
the autopilot takes such batches of one sensor at a time, so that no gyroscope has its accelerometer beside it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.autopilot import tell_join, tell_sources
from fieldcal.logs.dataflash import report, signals, units
from fieldcal.logs.dataflash.clock import epoch, stamps_ns
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.dataflash.parameters import Parameters
from fieldcal.logs.dataflash.signals import ANGLES, Stream
from fieldcal.logs.interface import UNKNOWN, Batch, LogSummary, logged_units
from fieldcal.reason_codes import ReasonCode

UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "G"}
NEEDED = {
    "GPS": ("Status", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ"),
    "GPA": ("SAcc",),
    "VISP": ("PX", "PY", "PZ"),
    "BAT": ("Curr",),
    "CURR": ("Curr",),
}
ADVICE = (
    "Readings without the autopilot's low-pass are logged by the bit IMU_RAW of LOG_BITMASK (messages ACC and GYR), "
    "corrected as well."
)


class DataflashLog:
    """A DataFlash log (`fieldcal.logs.LogReader`). The further units' tables are "imu.1", "temperature.1", ….

    Parameters
    ----------
    path : Path
        The file.
    vehicle : Vehicle
        Its `units` and `simulated`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`, `not_an_autopilot_log`, `missing_sensor`.
    """

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        self.summary = LogSummary("dataflash", world="ned", body="frd", gravity_sign="specific_force")
        self._file = DataflashFile(path)
        self._file.locate(signals.LOCATED)
        malformed = self._file.unreadable()
        parameters = self._parameters()
        self._imus = units.imus(self._file, parameters, malformed)
        self._magnetometers = units.magnetometers(self._file, parameters, malformed)
        self._others = {name: self._first(name, malformed) for name in NEEDED}
        if not self._imus and not self._magnetometers:
            raise UnreadableLog(
                ReasonCode.MISSING_SENSOR,
                f"{path.name} holds no readings of an IMU or a magnetometer (messages IMU, MAG); it has "
                f"{', '.join(sorted(self._file.counts())) or 'none that is whole'}. Set LOG_BITMASK so that they are "
                "logged.",
            )
        gps = self._others["GPS"]
        dated = epoch(gps.rows if gps else None)
        self._shift_ns = dated.offset_ns if dated else 0
        self.summary.epoch_known = dated is not None
        report.report_damage(self._file, malformed, self.summary)
        report.report_dropouts(self._file, self.summary)
        texts = report.describe(self._file, dated, self.summary)
        report.report_simulation(self._file, texts, self.summary, expected=vehicle.simulated)
        self.summary.units = logged_units(self.summary, UNITS, vehicle.units, path.name)
        self._tell_units(parameters)

    def batches(self) -> Iterator[Batch]:
        """Signal batches, table by table, each in file order. May be iterated once."""
        for table, columns in self._tables():
            columns["t_ns"] = np.asarray(columns["t_ns"], np.int64) + self._shift_ns
            self.summary.count_rows(table, columns)
            yield table, columns

    def _tables(self) -> Iterator[Batch]:
        for number, unit in enumerate(self._imus):
            dot = f".{number}" if number else ""
            joined = unit.joined()
            if joined is not None:
                tell_join(
                    self.summary,
                    self._file.name,
                    unit.stream,
                    interpolated=joined.interpolated,
                    left_out=joined.left_out,
                    outside=joined.outside,
                )
                yield f"imu{dot}", joined.columns
            else:
                yield from ((f"imu{dot}", signals.imu(piece)) for piece in unit.slow.pieces())
            temperature = signals.temperature(unit.slow)
            if temperature is not None:
                yield f"temperature{dot}", temperature
        for number, stream in enumerate(self._magnetometers):
            table = f"magnetometer.{number}" if number else "magnetometer"
            yield from ((table, signals.magnetometer(piece)) for piece in stream.pieces())
        yield from self._rest()

    def _rest(self) -> Iterator[Batch]:
        """What is not of an IMU."""
        gps, battery = self._others["GPS"], self._others["BAT"] or self._others["CURR"]
        if gps is not None:
            fixed = signals.fixed(gps)
            if not fixed.all():
                self.summary.add(
                    ReasonCode.NO_GPS_FIX,
                    int(np.count_nonzero(~fixed)),
                    f"{self._file.name}: {np.count_nonzero(~fixed)} of {len(fixed)} GPS messages have no "
                    "three-dimensional fix; their position and velocity were left out.",
                )
            gps = Stream(gps.instance, gps.name, gps.rows.where(fixed), gps.t_ns[fixed])
            for piece in gps.pieces():
                yield "position", signals.position(piece)
                yield "gnss_velocity", signals.velocity(piece, self._others["GPA"])
        if (vision := self._others["VISP"]) is not None:
            yield from (("vps", signals.vps(piece)) for piece in vision.pieces())
        if battery is not None:
            yield from (("power", signals.power(piece)) for piece in battery.pieces())

    def _parameters(self) -> Parameters:
        rows = self._file.rows("PARM")
        t_ns = None if rows is None else stamps_ns(rows)
        if rows is not None and t_ns is None:  # before 3.3 without a stamp: each counts from the start
            t_ns = np.zeros(len(rows), np.int64)
        return Parameters(rows, [] if t_ns is None else t_ns.tolist())

    def _first(self, name: str, malformed: dict[str, int]) -> Stream | None:
        """The first instance of what a vehicle has one of."""
        needed = NEEDED[name]
        if name == "VISP":
            rows = self._file.rows(name)
            later = rows is not None and ANGLES[1][0] in rows
            needed = (*needed, *ANGLES[later])
        found = signals.streams(self._file, name, needed, malformed)
        return next(iter(found.values()), None)

    def _tell_units(self, parameters: Parameters) -> None:
        name, summary = self._file.name, self.summary
        summary.sources = [
            *units.imu_sources(self._imus, parameters, self._shift_ns, summary, name),
            *units.magnetometer_sources(self._magnetometers, parameters, self._shift_ns, summary, name),
        ]
        tell_sources(summary, name, self._advice(parameters))
        unsaid = [source for source in summary.sources if source.primary and not source.corrected]
        if unsaid:
            listed = " and ".join(str(source.sensor) for source in unsaid)
            summary.add(
                ReasonCode.ALREADY_CORRECTED,
                1,
                f"{name}: {listed} had been corrected by the autopilot, and the log lacks parameters that say how; "
                "constants found here come on top of those unknown ones. Keep the vehicle's parameter file.",
            )
        summary.sources = [one if one.corrected else replace(one, corrections=(UNKNOWN,)) for one in summary.sources]

    def _advice(self, parameters: Parameters) -> str:
        said = ADVICE
        if self._imus and self._imus[0].fast is None:
            limits = parameters.first("INS_GYRO_FILTER"), parameters.first("INS_ACCEL_FILTER")
            said = (
                f"IMU messages are low-passed too (gyroscope {limits[0]:g} Hz, accelerometer {limits[1]:g} Hz). {said}"
            )
        batches = self._file.counts().get("ISBH", 0)
        if batches:
            said += f" The {batches} ISBH batches are of one sensor at a time, so that they are no IMU record."
        compensated = sum(map(signals.motors, self._magnetometers))
        if compensated:
            said += f" In {compensated} MAG messages a part for the motors (MOX, MOY, MOZ) had been added."
        return said
