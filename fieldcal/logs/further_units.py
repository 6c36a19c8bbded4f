"""Further IMUs and magnetometers of a log without device ids: which tables they come in, what they are called."""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldcal.logs.interface import Batch, Columns, LogSummary, SensorSource
from fieldcal.logs.on_board import tell_further_units
from fieldcal.names import SENSORS, Sensor
from fieldcal.schemas import signal_kind


@dataclass
class _Seen:
    """What was delivered of a unit's table."""

    stream: str
    unit_id: str
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

    _numbers: dict[tuple[str, str], int] = field(default_factory=dict)
    _seen: dict[str, _Seen] = field(default_factory=dict)

    def placed(self, batch: Batch, stream: str, unit_id: str) -> Batch | None:
        """A batch in the table of its unit; None where a further unit has no such signal.

        `stream`: where its readings are. `unit_id`: what tells the unit from others; empty of the primary one.
        """
        name, columns = batch
        kind = {"magnetometer": "magnetometer", "imu": "imu", "temperature": "imu"}.get(name)
        if unit_id and kind is None:
            return None
        if unit_id:
            known = [number for (of, _), number in self._numbers.items() if of == kind]
            name = f"{name}.{self._numbers.setdefault((str(kind), unit_id), len(known) + 1)}"
        if signal_kind(name) == kind:
            sensors = tuple(sensor for sensor in SENSORS if f"{sensor}_x" in columns)
            self._seen.setdefault(name, _Seen(stream, unit_id, sensors)).add(columns)
        return name, columns

    def tell(self, summary: LogSummary, log_name: str) -> None:
        """Where each unit's readings were, where there are several. The primary one is the vehicle's `imu_id`."""
        if not self._numbers:
            return
        for table, seen in sorted(self._seen.items()):
            summary.sources += [
                SensorSource(sensor, table, seen.unit_id, seen.stream, seen.rate_hz, not seen.unit_id)
                for sensor in seen.sensors
            ]
        tell_further_units(summary, log_name)
