"""PX4 ULog logs: the rawest readings of every unit on board as signal batches, and what the autopilot had done to
them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.autopilot import Joined, tell_join, tell_simulated, tell_sources, unit_ids
from fieldcal.logs.interface import Batch, Columns, Correction, LogSummary, SensorSource, logged_units
from fieldcal.logs.joining import imu_columns, triad
from fieldcal.logs.ulog import aids
from fieldcal.logs.ulog.file import UlogFile
from fieldcal.logs.ulog.parameters import AUTOPILOT, BOARD, History, corrections, parameters_of
from fieldcal.logs.ulog.report import report, tell_selection
from fieldcal.logs.ulog.streams import (
    Clock,
    averaged,
    combined,
    combined_magnetometer,
    has,
    joined,
    readings,
    stamps_us,
    vector,
)
from fieldcal.logs.ulog.units import Unit, corrected_by_driver, imus, magnetometers, selections
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode

UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "G"}
READ_TOPICS = frozenset(
    (
        *("sensor_gyro_fifo", "sensor_accel_fifo", "sensor_gyro", "sensor_accel", "sensor_mag", "sensor_combined"),
        *("vehicle_imu", "vehicle_imu_status", "vehicle_magnetometer", "sensor_selection", "battery_status"),
        *aids.GNSS,
        *aids.POSES,
    )
)
RAWER = "For raw readings let PX4 log its FIFO topics (SDLOG_PROFILE)."
LONGEST_INFO = 200
_RAW = ("sensor_gyro_fifo", "sensor_accel_fifo", "sensor_gyro", "sensor_accel", "sensor_mag")


class UlogLog:
    """A PX4 log (`fieldcal.logs.LogReader`).

    Readings are in rad/s, m/s² and gauss; the world is NED, the body FRD, the accelerometer reads specific force. Raw
    streams are in the sensor's own axes, corrected ones in the body's (`summary.sources`).

    Parameters
    ----------
    path : Path
        The file.
    vehicle : Vehicle
        Its `simulated` and `units`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`, `not_an_autopilot_log`, `format_not_supported`, `missing_sensor`.
    """

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        self.summary = LogSummary("ulog", world="ned", body="frd", gravity_sign="specific_force")
        self._file = UlogFile(path, READ_TOPICS.__contains__)
        self._name = self._file.name
        self._vehicle = vehicle
        self._imus = imus(self._file)
        self._magnetometers = magnetometers(self._file, self._file.parameters)
        if not self._imus and not self._magnetometers:
            raise UnreadableLog(
                ReasonCode.MISSING_SENSOR,
                f"{self._name} holds no readings of a gyroscope, accelerometer or magnetometer that are known; its "
                f"topics are {self._topics()}. Let PX4 log sensor_combined, or the sensors' own topics.",
            )
        epoch = aids.epoch(self._file)
        self._clock = Clock(epoch.offset_ns if epoch else 0)
        self.summary.epoch_known = epoch is not None
        self.summary.metadata |= {key: text for key, text in self._file.infos.items() if len(text) <= LONGEST_INFO}
        self.summary.board_id = self._file.infos.get("sys_uuid")
        if epoch:
            self.summary.metadata["utc_minus_boot_s"] = f"{epoch.offset_ns * 1e-9:.6f}"
            self.summary.metadata["utc_from"] = epoch.source
        release = self._file.infos.get("ver_sw_release", "")
        self._history = History(
            self._file.parameters,
            sorted(self._file.changes, key=lambda change: change.t_us),
            self._file.start_us,
            int(release) if release.isdigit() else None,
        )

    def batches(self) -> Iterator[Batch]:
        """Signal batches, one signal after the other. May be iterated once."""
        for table, columns in self._signals():
            if len(columns["t_ns"]):
                self.summary.count_rows(table, columns)
                yield table, columns
        self.summary.units = logged_units(self.summary, UNITS, self._vehicle.units, self._name)
        if why := self._simulation():
            tell_simulated(self.summary, self._name, why, expected=self._vehicle.simulated)
        tell_sources(self.summary, self._name, RAWER)
        report(self._file, self.summary)

    def _signals(self) -> Iterator[Batch]:
        ids = unit_ids([unit.device_id for unit in self._imus], "IMU", self.summary, self._name)
        for number, (unit, unit_id) in enumerate(zip(self._imus, ids, strict=True)):
            table = f"imu.{number}" if number else "imu"
            warmth = aids.temperature(self._file, unit, self._clock)
            self._note_imu(unit, table, unit_id, warmth)
            yield from ((table, columns) for columns in self._imu(unit))
            if warmth is not None:
                yield table.replace("imu", "temperature"), warmth
        ids = unit_ids([unit.device_id for unit in self._magnetometers], "magnetometer", self.summary, self._name)
        for number, (unit, unit_id) in enumerate(zip(self._magnetometers, ids, strict=True)):
            table = f"magnetometer.{number}" if number else "magnetometer"
            self._note(Sensor.MAGNETOMETER, unit, unit.device_id, table, unit_id, None)
            yield from ((table, columns) for columns in self._magnetometer(unit))
        yield from aids.gnss_batches(self._file, self._clock)
        yield from self._poses()
        power = aids.current(self._file, self._clock)
        if power is not None:
            yield "power", power

    def _note_imu(self, unit: Unit, table: str, unit_id: str, warmth: Columns | None) -> None:
        usual = None if warmth is None else float(np.median(warmth["temperature_degc"]))
        self._note(Sensor.GYROSCOPE, unit, unit.device_id, table, unit_id, usual)
        self._note(Sensor.ACCELEROMETER, unit, unit.accelerometer_id, table, unit_id, usual)

    def _note(
        self, sensor: Sensor, unit: Unit, device_id: int, table: str, unit_id: str, temperature_degc: float | None
    ) -> None:
        topic = unit.stream.topic
        done: tuple[Correction, ...] = ()
        if topic.name not in _RAW or corrected_by_driver(topic):
            history = self._history if topic.name not in _RAW else _before_mounting(self._history)
            done = corrections(sensor, device_id or None, history, temperature_degc, self._clock.offset_ns)
        averages = topic.name in ("sensor_combined", "vehicle_imu") and sensor != Sensor.MAGNETOMETER
        self.summary.sources.append(
            SensorSource(
                sensor,
                table,
                unit_id,
                unit.stream.name,
                unit.stream.rate_hz,
                unit.primary,
                averages,
                device_id or None,
                done,
                AUTOPILOT,
                parameters_of(sensor, device_id or None, self._history.last),
            )
        )

    def _imu(self, unit: Unit) -> Iterator[Columns]:
        stream, clock = unit.stream, self._clock
        if stream.topic.name == "vehicle_imu":
            for rows in self._file.chunks(stream.topic):
                yield imu_columns(*averaged(rows, clock))
            return
        if stream.accelerometer is not None:
            parts = joined(self._file, stream.topic, stream.accelerometer, clock)
        else:
            parts = (combined(rows, clock) for rows in self._file.chunks(stream.topic))
        total, left_out = Joined({}), 0
        for part in parts:
            total = replace(
                total,
                interpolated=total.interpolated + part.interpolated,
                left_out=total.left_out + part.left_out,
                outside=total.outside + part.outside,
            )
            columns = part.columns
            if stream.topic.name == "sensor_combined":
                chosen = self._chosen(unit, columns["t_ns"])
                left_out += int(np.count_nonzero(~chosen))
                columns = {name: values[chosen] for name, values in columns.items()}
            yield columns
        tell_join(
            self.summary,
            self._name,
            stream.name,
            interpolated=total.interpolated,
            left_out=total.left_out,
            outside=total.outside,
        )
        if left_out:
            tell_selection(self.summary, self._name, stream.name, unit.device_id, left_out)

    def _chosen(self, unit: Unit, t_ns: NDArray[np.int64 | np.float64]) -> NDArray[np.bool_]:
        """Which rows of sensor_combined are of this unit: the autopilot may change to another in flight."""
        chosen = selections(self._file)
        if len(chosen) < 2:
            return np.ones(len(t_ns), bool)
        from_ns = self._clock.ns(np.array([one.from_us for one in chosen]))
        which = np.clip(np.searchsorted(from_ns, t_ns, "right") - 1, 0, None)
        own = [(one.device_id, one.accelerometer_id) == (unit.device_id, unit.accelerometer_id) for one in chosen]
        return np.array(own)[which]

    def _magnetometer(self, unit: Unit) -> Iterator[Columns]:
        topic, last_us, left_out = unit.stream.topic, -1, 0
        for rows in self._file.chunks(topic):
            if topic.name == "sensor_combined":
                t_ns, values, last_us = combined_magnetometer(rows, self._clock, last_us)
                yield {"t_ns": t_ns, **triad("magnetometer", values)}
                continue
            if has(topic, "device_id"):
                own = rows["device_id"] == unit.device_id
                left_out += int(np.count_nonzero(~own))
                rows = rows[own]
            if topic.name == "sensor_mag":
                t_ns, values = readings(rows, topic, self._clock)
            else:
                t_ns, values = self._clock.ns(stamps_us(rows)), vector(rows, "magnetometer_ga")
            yield {"t_ns": t_ns, **triad("magnetometer", values)}
        if left_out:
            tell_selection(self.summary, self._name, unit.stream.name, unit.device_id, left_out)

    def _poses(self) -> Iterator[Batch]:
        topic = aids.pose_topic(self._file)
        if topic is None:
            return
        total = 0
        for rows in self._file.chunks(topic):
            columns, unusable = aids.pose_columns(topic, rows, self._clock)
            total += unusable
            yield "vps", columns
        if total:
            self.summary.add(
                ReasonCode.UNSUPPORTED_SCHEMA,
                total,
                f"{self._name}: {total} poses of {topic.name} are in a frame whose vertical is not known, and were "
                "left out. Let the source of the poses give them north-east-down or forward-right-down.",
                loses_data=True,
            )

    def _simulation(self) -> str:
        """What shows that the sensors are not real; empty where nothing does."""
        infos, hardware = self._file.infos, self._file.infos.get("ver_hw", "")
        if "SITL" in hardware:
            return f"hardware {hardware}"
        if self._file.parameters.get("SYS_HITL", 0.0) > 0:
            return f"SYS_HITL = {self._file.parameters['SYS_HITL']:.0f}"
        return f"replay of {infos['replay']}" if "replay" in infos else ""

    def _topics(self) -> str:
        named = sorted({topic.name for topic in self._file.topics if self._file.count(topic)})
        return ", ".join(named[:20]) + (", …" if len(named) > 20 else "") if named else "none"


def _before_mounting(history: History) -> History:
    """Parameters without the rotations: drivers of old calibrated before the readings were turned."""
    kept = {name: value for name, value in history.initial.items() if not _turns(name)}
    return replace(history, initial=kept, changes=[one for one in history.changes if not _turns(one.name)])


def _turns(name: str) -> bool:
    return name.startswith(BOARD) or (name.startswith("CAL_") and name.endswith("_ROT"))
