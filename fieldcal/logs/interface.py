"""What every log reader hands over: signal batches, and a summary of what the log says of itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fieldcal.config.loaded import Autopilot
from fieldcal.config.values import UNITS
from fieldcal.names import SENSORS, Sensor
from fieldcal.reason_codes import ReasonCode

Columns = dict[str, NDArray[np.int64 | np.float64]]
Batch = tuple[str, Columns]

UNKNOWN_UNIT = "unknown"

SIGNAL_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "imu": (
        "t_ns",
        "gyroscope_x",
        "gyroscope_y",
        "gyroscope_z",
        "accelerometer_x",
        "accelerometer_y",
        "accelerometer_z",
    ),
    "magnetometer": ("t_ns", "magnetometer_x", "magnetometer_y", "magnetometer_z"),
    "temperature": ("t_ns", "temperature_degc"),
    "vps": ("t_ns", "qx", "qy", "qz", "qw", "px_m", "py_m", "pz_m"),
    "position": ("t_ns", "latitude_deg", "longitude_deg", "altitude_m"),
    "power": ("t_ns", "current_a", "throttle"),
    "gnss_velocity": (
        "t_ns",
        "velocity_north_mps",
        "velocity_east_mps",
        "velocity_down_mps",
        "velocity_sd_mps",
    ),
}

EPOCH_KNOWN_AFTER_NS = 1_000_000_000 * 1_000_000_000
"""Stamps beyond 2001-09-09 are taken for Unix time, smaller ones for a clock with an unknown zero."""


@dataclass(frozen=True)
class Finding:
    """One thing worth knowing about a log.

    `loses_data`: samples of the original recording are missing from what was delivered.
    `fatal`: the log contradicts itself; nothing of it should be published.
    """

    code: ReasonCode
    count: int
    sentence: str
    loses_data: bool = False
    fatal: bool = False


@dataclass(frozen=True)
class Correction:
    """What an autopilot had done to a sensor's readings before it logged them: logged = matrix · raw + offset.

    `matrix` (3, 3) and `offset` (3,), logged unit and axes on the left, nominal unit and the sensor's own axes as the
    driver gives them on the right. Holds from `from_ns` (the log's clock) until the next of the same sensor. Where it
    depends on temperature, `offset` is that at `temperature_degc`, and `offset_per_degc` its slope there.
    `parameters`: those that say so, as they stand in the log.
    """

    from_ns: int
    matrix: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    offset: tuple[float, float, float]
    parameters: Mapping[str, float]
    temperature_degc: float | None = None
    offset_per_degc: tuple[float, float, float] = (0.0, 0.0, 0.0)


UNKNOWN = Correction(0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0), {})
"""Something was done, and the log does not say what."""


@dataclass(frozen=True)
class SensorSource:
    """One sensor of one unit on board: what it is, and where in the log its readings are.

    `table`: the signal table that they come in: "imu" and "magnetometer" of the primary unit, "imu.1", "imu.2",
    "magnetometer.1", … of the further ones. `unit_id` names the unit within the vehicle: by device id, else by topic
    and frame, else by instance; empty where it is the vehicle's `imu_id`. `stream`: message or topic, with its
    instance. `filtered`: low-passed, or averaged over intervals, by the autopilot. `corrections`: in order of
    `from_ns`; empty where the readings are raw. `autopilot`: which one wrote the log; `parameters`: its own that
    concern the sensor, as they stood at the end of the log.
    """

    sensor: Sensor
    table: str
    unit_id: str
    stream: str
    rate_hz: float
    primary: bool
    filtered: bool = False
    device_id: int | None = None
    corrections: tuple[Correction, ...] = ()
    autopilot: Autopilot | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def corrected(self) -> bool:
        """Whether the autopilot had corrected the readings."""
        return bool(self.corrections)


@dataclass
class LogSummary:
    """What a log says of itself. Complete once the reader's `batches()` is exhausted.

    `units`: sensor -> unit of the delivered numbers, "unknown" when neither log nor configuration says.
    `world`, `body`, `gravity_sign`: the log's own declaration, None when it makes none.
    `epoch_known`: stamps are Unix time. `verifiable`: every delivered sample was under a checksum that held.
    `counts`: signal table -> delivered rows. `metadata`: text pairs found in the log (of an autopilot: hardware,
    firmware, board id). `sources`: where each sensor's readings came from, where one log may hold several units.
    `board_id`: serial number of the autopilot's board.
    """

    log_format: str
    units: dict[str, str] = field(default_factory=lambda: dict.fromkeys(SENSORS, UNKNOWN_UNIT))
    world: str | None = None
    body: str | None = None
    gravity_sign: str | None = None
    epoch_known: bool = False
    verifiable: bool = False
    findings: list[Finding] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    sources: list[SensorSource] = field(default_factory=list)
    board_id: str | None = None

    def add(
        self, code: ReasonCode, count: int, sentence: str, *, loses_data: bool = False, fatal: bool = False
    ) -> None:
        """Record one finding."""
        self.findings.append(Finding(code, count, sentence, loses_data, fatal))

    def count_rows(self, table: str, columns: Columns) -> None:
        """Account for a delivered batch."""
        self.counts[table] = self.counts.get(table, 0) + len(columns["t_ns"])


class LogReader(Protocol):
    """A log being read. `batches()` yields (signal table, columns) in file order and may be called once.

    Columns are named as in the signal tables: `t_ns` int64, the rest float64. Columns that the log does not have (a
    gyroscope in an accelerometer log, the position of an attitude-only VPS) are absent from the mapping;
    `fieldcal.logs.batch_frame` adds them as nulls.
    """

    summary: LogSummary

    def batches(self) -> Iterator[Batch]: ...


@dataclass(frozen=True)
class LogFile:
    """A log found in an archive. `log_uri` is relative to the archive, with forward slashes."""

    path: Path
    log_uri: str
    vehicle_id: str
    session_id: str
    log_format: str


def stamps_are_epoch(t_ns: NDArray[np.int64]) -> bool:
    """Whether stamps (nanoseconds) look like Unix time rather than time since some start."""
    return bool(t_ns.size) and int(np.median(t_ns)) > EPOCH_KNOWN_AFTER_NS


def logged_units(
    summary: LogSummary, declared: Mapping[str, str], configured: Mapping[Sensor, str], log_name: str
) -> dict[str, str]:
    """Unit per sensor: the configured one, else the log's own, else "unknown". A contradiction is a finding."""
    units: dict[str, str] = {}
    for sensor in SENSORS:
        own, wanted = declared.get(sensor), configured.get(sensor)
        if own and own not in UNITS[sensor]:
            if not wanted:
                summary.add(
                    ReasonCode.UNIT_NOT_SUPPORTED,
                    1,
                    f"{log_name}: the log gives its {sensor} in {own!r}, which is none of "
                    f"{', '.join(UNITS[sensor])}. Set units.{sensor} if it is one of them, else convert the log.",
                )
            own = None
        if own and wanted and own != wanted:
            summary.add(
                ReasonCode.UNIT_CONFLICT,
                1,
                f"{log_name}: the log gives its {sensor} in {own}, the configuration says {wanted}; the configuration "
                f"is followed. Correct units.{sensor} if the log is right.",
            )
        units[sensor] = wanted or own or UNKNOWN_UNIT
    return units
