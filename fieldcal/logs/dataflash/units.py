"""Which IMUs and magnetometers a log holds, which are the primary ones, and what was done to their readings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldcal.logs.autopilot import Joined, join_on_gyroscope, unit_ids
from fieldcal.logs.dataflash import signals
from fieldcal.logs.dataflash.applied import Temperatures, inertial_corrections, magnetometer_corrections
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.dataflash.parameters import AUTOPILOT, Parameters, compass_names, inertial_names
from fieldcal.logs.dataflash.signals import ACCELEROMETER, GYROSCOPE, MAGNETOMETER, OFFSETS, Stream
from fieldcal.logs.interface import LogSummary, SensorSource
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode

LEAST_COVER = 0.9
"""ACC and GYR are taken instead of IMU where they span so much of its time."""
FASTER = 1.5
"""And where they come at so many times its rate."""
POST_FILTER, PRE_AND_POST_FILTER = 1 << 2, 1 << 3
"""Bits of INS_RAW_LOG_OPT. With the latter, filtered readings are logged as instances beyond the real ones."""
PARTS = (("GYR", Sensor.GYROSCOPE), ("ACC", Sensor.ACCELEROMETER))


@dataclass(frozen=True)
class Unit:
    """One IMU: its messages IMU, and where they are taken instead, its faster GYR and ACC. `filtered`: these."""

    slow: Stream
    fast: tuple[Stream, Stream] | None = None
    filtered: bool = True

    @property
    def stream(self) -> str:
        """How its messages are called."""
        return f"{self.fast[0].name} and {self.fast[1].name}" if self.fast else self.slow.name

    def joined(self) -> Joined | None:
        """Rows of GYR and ACC at the gyroscope's stamps; None where IMU is taken."""
        if self.fast is None:
            return None
        gyroscope, accelerometer = self.fast
        return join_on_gyroscope(
            gyroscope.t_ns,
            gyroscope.vectors(GYROSCOPE),
            accelerometer.t_ns,
            accelerometer.vectors(ACCELEROMETER),
        )


def imus(file: DataflashFile, parameters: Parameters, malformed: dict[str, int]) -> list[Unit]:
    """The IMUs, the primary one first: the first that the autopilot may use, then by instance."""
    slow = signals.streams(file, "IMU", (*GYROSCOPE, *ACCELEROMETER), malformed)
    gyroscopes = signals.streams(file, "GYR", GYROSCOPE, malformed)
    accelerometers = signals.streams(file, "ACC", ACCELEROMETER, malformed)
    options = int(parameters.first("INS_RAW_LOG_OPT"))
    filtered = bool(options & POST_FILTER) and not options & PRE_AND_POST_FILTER
    units = []
    for instance, stream in slow.items():
        unit = Unit(stream)
        if instance in gyroscopes and instance in accelerometers:
            fast = signals.by_sample(gyroscopes[instance]), signals.by_sample(accelerometers[instance])
            if all(_better(other, stream) for other in fast):
                unit = Unit(stream, fast, filtered)
        units.append(unit)
    return sorted(
        units, key=lambda unit: not parameters.first(inertial_names("GYR", unit.slow.instance).use, default=True)
    )


def magnetometers(file: DataflashFile, parameters: Parameters, malformed: dict[str, int]) -> list[Stream]:
    """The magnetometers at the times of their samples, the primary one first."""
    found = signals.streams(file, "MAG", MAGNETOMETER, malformed).values()
    return sorted(
        (signals.by_sample(stream) for stream in found),
        key=lambda stream: not parameters.first(compass_names(stream.instance).use, default=True),
    )


def imu_sources(
    units: list[Unit], parameters: Parameters, shift_ns: int, summary: LogSummary, log_name: str
) -> list[SensorSource]:
    """What is known of gyroscope and accelerometer of each IMU. `shift_ns`: from time since boot to the log's clock."""
    slots = [unit.slow.instance for unit in units]
    ids = {kind: [_identity(parameters, inertial_names(kind, slot).device_id) for slot in slots] for kind, _ in PARTS}
    names = unit_ids(ids["GYR"], "IMU", summary, log_name)
    if units:
        _tell_changed(units[0], parameters, summary, log_name)
    found = []
    for number, unit in enumerate(units):
        temperature = signals.temperature(unit.slow)
        degc = np.empty(0) if temperature is None else np.asarray(temperature["temperature_degc"], float)
        temperatures = Temperatures(unit.slow.t_ns[: len(degc)], degc)
        for part, (kind, sensor) in enumerate(PARTS):
            stream = unit.fast[part] if unit.fast else unit.slow
            corrections = inertial_corrections(
                kind,
                unit.slow.instance,
                parameters,
                int(stream.t_ns.min()),
                temperatures,
                before_3_3="TimeMS" in stream.rows,
            )
            found.append(
                SensorSource(
                    sensor,
                    _table("imu", number),
                    names[number],
                    unit.stream,
                    stream.rate_hz,
                    number == 0,
                    unit.filtered,
                    ids[kind][number],
                    tuple(replace(one, from_ns=one.from_ns + shift_ns) for one in corrections),
                    AUTOPILOT,
                    parameters.last(_of_both(unit.slow.instance)),
                )
            )
    return found


def magnetometer_sources(
    found: list[Stream], parameters: Parameters, shift_ns: int, summary: LogSummary, log_name: str
) -> list[SensorSource]:
    """What is known of each magnetometer."""
    ids = [_identity(parameters, compass_names(stream.instance).device_id) for stream in found]
    names = unit_ids(ids, "magnetometer", summary, log_name)
    sources = []
    for number, stream in enumerate(found):
        offsets = None
        if all(name in stream.rows for name in OFFSETS):
            offsets = np.stack([stream.rows.numbers(name) for name in OFFSETS], axis=1)  # milligauss, as the parameters
        order = np.argsort(stream.t_ns, kind="stable")
        corrections = magnetometer_corrections(
            stream.instance, parameters, stream.t_ns[order], None if offsets is None else offsets[order]
        )
        sources.append(
            SensorSource(
                Sensor.MAGNETOMETER,
                _table("magnetometer", number),
                names[number],
                stream.name,
                stream.rate_hz,
                number == 0,
                False,
                ids[number],
                tuple(replace(one, from_ns=one.from_ns + shift_ns) for one in corrections),
                AUTOPILOT,
                parameters.last(compass_names(stream.instance).loaded()),
            )
        )
    return sources


def _of_both(slot: int) -> list[str]:
    """Parameters of gyroscope and accelerometer: a thermal compensation is enabled for both."""
    return [name for kind, _ in PARTS for name in inertial_names(kind, slot).loaded()]


def _better(fast: Stream, slow: Stream) -> bool:
    spans = [int(stream.t_ns.max() - stream.t_ns.min()) for stream in (fast, slow)]
    return fast.rate_hz > FASTER * slow.rate_hz and spans[0] >= LEAST_COVER * spans[1]


def _tell_changed(unit: Unit, parameters: Parameters, summary: LogSummary, log_name: str) -> None:
    """Finding on a primary IMU whose device id becomes another one while it is recorded."""
    name = inertial_names("GYR", unit.slow.instance).device_id
    changes = [at_ns for at_ns in parameters.changes_ns([name]) if at_ns > int(unit.slow.t_ns.min())]
    if changes and parameters.first(name):
        summary.add(
            ReasonCode.UNIT_CHANGED,
            len(changes),
            f"{log_name}: {name} becomes {parameters.value(name, changes[-1]):.0f} within the recording, and was "
            f"{parameters.first(name):.0f}: the log is of two IMUs. Split it there.",
        )


def _identity(parameters: Parameters, name: str) -> int | None:
    return int(parameters.first(name)) or None


def _table(stem: str, number: int) -> str:
    return stem if number == 0 else f"{stem}.{number}"
