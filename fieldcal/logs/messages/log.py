"""Messages of the chosen topics as signal batches, block by block, from whatever file they lie in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.encodings.decoded import COMPONENTS, Decoded
from fieldcal.logs.further_units import FurtherUnits
from fieldcal.logs.interface import Batch, Columns, LogSummary, logged_units, stamps_are_epoch
from fieldcal.logs.joining import INERTIAL, SensorJoin, triad
from fieldcal.logs.messages.container import Block, Container
from fieldcal.logs.messages.frames import STAMPED_TYPES, by_frame
from fieldcal.logs.messages.packed import PackedPayloads
from fieldcal.logs.messages.roles import METADATA_NAME, SI_TYPES, choose_sources
from fieldcal.logs.messages.source import Source
from fieldcal.logs.messages.transforms import tell_of_transforms
from fieldcal.names import SENSORS
from fieldcal.reason_codes import ReasonCode

SI_UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "T"}
CHANNELS_CAP = 4096
MESSAGES_AT_ONCE = 20_000
"""A chunk of 1 MiB holds some thousand; one that unpacks to far more is not to be decoded all at once."""


class MessageLog:
    """A log of messages (`fieldcal.logs.LogReader`).

    Parameters
    ----------
    container : Container
        The recording.
    summary : LogSummary
        Receives what the log says; it may hold findings already.
    name : str
        Of the log, for sentences.
    vehicle : Vehicle
        Its `mcap` (topics, fields, which clock) and `units`.

    Raises
    ------
    UnreadableLog
        `too_many_channels`, `missing_topic`, `missing_field`, `missing_sensor`, `unsupported_schema`; from `batches()`
        only `no_messages`, `several_units`.
    """

    def __init__(self, container: Container, summary: LogSummary, name: str, vehicle: Vehicle) -> None:
        self.summary = summary
        self._container = container
        self._name = name
        self._vehicle = vehicle
        self._by_log_time = vehicle.mcap.time == "log"
        definitions = container.definitions
        if len(definitions.channels) > CHANNELS_CAP:
            raise UnreadableLog(
                ReasonCode.TOO_MANY_CHANNELS,
                f"{name} defines {len(definitions.channels)} channels, {CHANNELS_CAP} at most are read: it is "
                "damaged, or no flight log. Check what it is.",
            )
        self._sources = choose_sources(definitions, vehicle.mcap, summary, name, container.counts)
        self._malformed: dict[str, int] = {}
        self._unstamped: dict[str, int] = {}
        self._packed = PackedPayloads()
        self._join = SensorJoin()
        self._further = FurtherUnits()

    def batches(self) -> Iterator[Batch]:
        """Signal batches in file order, one per topic and chunk. May be iterated once."""
        wanted = frozenset(channel_id for source in self._sources for channel_id in source.decoders)
        for block in _pieces(self._container.blocks(wanted)):
            for source in self._sources:
                for channel_id, decoder in source.decoders.items():
                    for frame, some in self._by_unit(source, _of_channel(block, channel_id)):
                        decoded = decoder.decode(some.data, some.starts, some.sizes)
                        lost = len(some.starts) - len(decoded.kept) if decoded.malformed is None else decoded.malformed
                        if lost:
                            self._malformed[source.topic] = self._malformed.get(source.topic, 0) + lost
                        for batch in self._tables(source, decoded, some.log_time_ns):
                            placed = self._further.placed(batch, *_named(source, frame))
                            if placed is not None:
                                self.summary.count_rows(*placed)
                                yield placed
        joined = self._join.joined(self._name)
        if joined is not None:
            columns, finding = joined
            self.summary.findings.append(finding)
            self.summary.count_rows("imu", columns)
            yield "imu", columns
        self._finish()

    def _by_unit(self, source: Source, block: Block) -> Iterator[tuple[str, Block]]:
        """(frame_id, messages) of each IMU on one topic, "" of the primary or only one; payloads unpacked that are
        packed."""
        if len(block.starts) and source.may_be_packed:
            block = self._packed.unpacked(block)
        if len(block.starts) and source.role == "imu" and source.type_name in STAMPED_TYPES:
            frame_id = None if source.further else self._vehicle.mcap.frame_id
            frames = by_frame(block.data, block.starts, block.sizes, frame_id, source, self._name)
            parts = [(frame, block.of(chosen)) for frame, chosen in frames.items()]
        else:
            parts = [("", block)]
        yield from ((frame, part) for frame, part in parts if len(part.starts))

    def _tables(self, source: Source, decoded: Decoded, log_time_ns: NDArray[np.int64]) -> Iterator[Batch]:
        t_ns = decoded.stamp_ns
        if t_ns is not None and len(t_ns) > 1 and not t_ns.any():
            t_ns = None  # a driver that never fills them in
        if t_ns is None or self._by_log_time:
            if t_ns is None and not self._by_log_time:
                self._unstamped[source.topic] = self._unstamped.get(source.topic, 0) + len(decoded.kept)
            t_ns = log_time_ns[decoded.kept]
        if not t_ns.size:
            return
        if not self.summary.epoch_known:
            self.summary.epoch_known = stamps_are_epoch(t_ns)
        values = decoded.values
        if source.role == "imu":
            sensors = [name for name in ("gyroscope", "accelerometer") if name in values]
            if sensors:
                yield "imu", _columns(t_ns, values, sensors)
            others = {other.role for other in self._sources if not (other.further or source.further)}
            if "magnetometer" in values and "magnetometer" not in others:
                yield from _finite("magnetometer", _columns(t_ns, values, ["magnetometer"]))
            if "temperature" in values and "temperature" not in others:
                yield from _finite("temperature", {"t_ns": t_ns, "temperature_degc": values["temperature"]})
        elif source.role in INERTIAL:
            self._join.add(source.role, t_ns, values[source.role])
        elif source.role == "magnetometer":
            yield "magnetometer", _columns(t_ns, values, ["magnetometer"])
        elif source.role == "temperature":
            yield from _finite("temperature", {"t_ns": t_ns, "temperature_degc": values["temperature"]})
        elif source.role == "power":
            # ROS: negative while discharging, NaN where it is not measured.
            yield from _finite("power", {"t_ns": t_ns, "current_a": np.abs(values["current"])})
        elif source.role == "vps":
            columns: Columns = {"t_ns": t_ns}
            for number, component in enumerate(COMPONENTS[4]):
                columns[f"q{component}"] = values["orientation"][:, number].copy()
            for number, component in enumerate(COMPONENTS[3]):
                columns[f"p{component}_m"] = values["position"][:, number].copy()
            yield "vps", columns
        elif source.role == "gnss_velocity":
            yield "gnss_velocity", _velocity(t_ns, values)
        else:
            yield "position", {"t_ns": t_ns, **values}

    def _settle_conventions(self) -> None:
        """Units, frames and gravity sign: what ROS types imply, overruled by the file's own metadata."""
        declared: dict[str, str] = {}
        for source in self._sources:
            if source.type_name in SI_TYPES:
                declared |= {sensor: SI_UNITS[sensor] for sensor in source.values if sensor in SENSORS}
        own = self._container.metadata.get(METADATA_NAME, {})
        declared |= {sensor: own[f"unit_{sensor}"] for sensor in SENSORS if own.get(f"unit_{sensor}")}
        ros = any(source.type_name in SI_TYPES for source in self._sources)
        self.summary.world = own.get("world") or ("enu" if ros else None)
        self.summary.body = own.get("body") or ("flu" if ros else None)
        self.summary.gravity_sign = own.get("gravity_sign") or ("specific_force" if ros else None)
        self.summary.units = logged_units(self.summary, declared, self._vehicle.units, self._name)

    def _finish(self) -> None:
        self._settle_conventions()
        self._further.tell(self.summary, self._name)
        self._container.report(self.summary)
        for topic, count in self._malformed.items():
            self.summary.add(
                ReasonCode.MALFORMED_MESSAGE,
                count,
                f"{self._name}: {count} messages on {topic} do not have the layout of their schema and were left out.",
                loses_data=True,
            )
        for topic, count in self._unstamped.items():
            self.summary.add(
                ReasonCode.NO_HEADER_STAMP,
                count,
                f"{self._name}: messages on {topic} carry no stamp of their own; the time of recording is used.",
            )
        self._packed.report(self.summary, self._name)
        tell_of_transforms(self._sources, self.summary, self._name)
        for name, pairs in self._container.metadata.items():
            prefix = "" if name == METADATA_NAME else f"{name}."
            self.summary.metadata |= {prefix + key: value for key, value in pairs.items()}
        if not {"imu", "magnetometer"} & self.summary.counts.keys():
            packed = [finding for finding in self.summary.findings if finding.code == ReasonCode.PACKED_MESSAGES]
            told = packed or self.summary.findings
            raise UnreadableLog(
                ReasonCode.NO_MESSAGES,
                f"{self._name}: not one message of {', '.join(source.topic for source in self._sources)} could be read"
                + (f" ({told[0].sentence})" if told else "."),
            )


def _named(source: Source, frame: str) -> tuple[str, str]:
    """(stream, id) of a unit: by topic, and by frame_id where that tells several on one topic apart."""
    if frame:
        return f"{source.topic} ({frame})", f"{source.topic}:{frame}"
    return source.topic, source.topic if source.further else ""


def _pieces(blocks: Iterator[Block]) -> Iterator[Block]:
    """The same messages, at most `MESSAGES_AT_ONCE` in a block."""
    for block in blocks:
        if len(block.starts) <= MESSAGES_AT_ONCE:
            yield block
            continue
        places = np.arange(len(block.starts))
        for first in range(0, len(places), MESSAGES_AT_ONCE):
            yield block.of((places >= first) & (places < first + MESSAGES_AT_ONCE))


def _of_channel(block: Block, channel_id: int) -> Block:
    return block.of(block.channels == channel_id)


def _columns(t_ns: NDArray[np.int64], values: dict[str, NDArray[np.float64]], sensors: Sequence[str]) -> Columns:
    columns: Columns = {"t_ns": t_ns}
    for sensor in sensors:
        columns |= triad(sensor, values[sensor])
    return columns


def _velocity(t_ns: NDArray[np.int64], values: dict[str, NDArray[np.float64]]) -> Columns:
    """Of a receiver, which has it east, north and up; its sd is the mean of the axes', where the message tells."""
    east, north, up = values["velocity"].T
    columns: Columns = {"t_ns": t_ns, "velocity_north_mps": north.copy(), "velocity_east_mps": east.copy()}
    columns["velocity_down_mps"] = -up
    if "covariance" in values:
        variance = values["covariance"][:, [0, 7, 14]].mean(axis=1)
        columns["velocity_sd_mps"] = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    return columns


def _finite(table: str, columns: Columns) -> Iterator[Batch]:
    """Rows in which every number is there: slower sensors share messages with faster ones and leave gaps."""
    whole = np.logical_and.reduce([np.isfinite(values) for name, values in columns.items() if name != "t_ns"])
    if whole.all():
        yield table, columns
    elif whole.any():
        yield table, {name: values[whole] for name, values in columns.items()}
