"""Further IMUs and magnetometers of a log of messages: which tables they come in, and what they are called."""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldcal.logs.interface import Batch, Columns, LogSummary, SensorSource
from fieldcal.logs.messages.source import Source
from fieldcal.names import SENSORS, Sensor
from fieldcal.schemas import signal_kind

Place = tuple[str, str]
"""Topic, and frame_id where that tells units apart; "" else."""


@dataclass
class _Seen:
    """What was delivered of a table."""

    sensors: tuple[Sensor, ...]
    rows: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def add(self, columns: Columns) -> None:
        first_ns, last_ns = int(columns["t_ns"].min()), int(columns["t_ns"].max())
        self.first_ns = min(self.first_ns, first_ns) if self.rows else first_ns
        self.last_ns = max(self.last_ns, last_ns) if self.rows else last_ns
        self.rows += len(columns["t_ns"])

    @property
    def rate_hz(self) -> float:
        span_s = (self.last_ns - self.first_ns) * 1e-9
        return (self.rows - 1) / span_s if span_s > 0.0 else 0.0


@dataclass
class FurtherUnits:
    """Numbers further units in the order in which they are met, IMUs and magnetometers each from 1."""

    _numbers: dict[tuple[str, Place], int] = field(default_factory=dict)
    _seen: dict[str, _Seen] = field(default_factory=dict)
    _places: dict[str, Place] = field(default_factory=dict)

    def table(self, batch: Batch, source: Source, frame: str) -> Batch | None:
        """A batch in the table of its unit; None where a unit of that kind has no such signal."""
        name, columns = batch
        place = (source.topic, frame)
        if source.further or frame:
            kind = "magnetometer" if name == "magnetometer" else "imu"
            if name not in ("imu", "magnetometer", "temperature"):
                return None
            known = [number for (of, _), number in self._numbers.items() if of == kind]
            name = f"{name}.{self._numbers.setdefault((kind, place), len(known) + 1)}"
        if signal_kind(name) in ("imu", "magnetometer"):
            sensors = tuple(sensor for sensor in SENSORS if f"{sensor}_x" in columns)
            self._seen.setdefault(name, _Seen(sensors)).add(columns)
            self._places[name] = place
        return name, columns

    def tell(self, summary: LogSummary) -> None:
        """Where each unit's readings were, where there are several. The primary one is the vehicle's `imu_id`."""
        if not self._numbers:
            return
        for table, seen in sorted(self._seen.items()):
            topic, frame = self._places[table]
            primary = table == signal_kind(table)
            stream = f"{topic} ({frame})" if frame else topic
            unit_id = "" if primary else f"{topic}:{frame}" if frame else topic
            summary.sources += [
                SensorSource(sensor, table, unit_id, stream, seen.rate_hz, primary) for sensor in seen.sensors
            ]
