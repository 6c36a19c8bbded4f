"""MCAP logs: the messages of the chosen topics as signal batches, chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.encodings.decoded import COMPONENTS, Decoded
from fieldcal.logs.interface import Batch, Columns, LogSummary, logged_units, stamps_are_epoch
from fieldcal.logs.joining import INERTIAL, SensorJoin
from fieldcal.logs.mcap.file import Block, McapFile
from fieldcal.logs.mcap.frames import STAMPED_TYPES, of_frame
from fieldcal.logs.mcap.records import HEAD_BYTES, MESSAGE_HEAD_BYTES, gather
from fieldcal.logs.mcap.report import Definitions, report
from fieldcal.logs.mcap.roles import METADATA_NAME, SI_TYPES, Source, choose_sources
from fieldcal.names import SENSORS
from fieldcal.reason_codes import ReasonCode

SI_UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "T"}
CHANNELS_CAP = 4096
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_U2, _U4, _U8 = np.dtype("<u2"), np.dtype("<u4"), np.dtype("<u8")


class McapLog:
    """An MCAP log (`fieldcal.logs.LogReader`).

    Parameters
    ----------
    path : Path
        The file.
    vehicle : Vehicle
        Its `mcap` (topics, fields, which clock) and `units`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_mcap`, `not_readable`, `no_messages`, `too_many_channels`, `missing_topic`,
        `missing_field`, `missing_sensor`, `unsupported_schema`; from `batches()` only `no_messages`, `several_units`.
    """

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        self.summary = LogSummary("mcap")
        self._name = path.name
        self._vehicle = vehicle
        self._by_log_time = vehicle.mcap.time == "log"
        self._file = McapFile(path)
        definitions = self._file.definitions
        if not self._file.has_summary or not definitions.channels:
            definitions = _collected(path)
        if not definitions.channels:
            raise UnreadableLog(
                ReasonCode.NO_MESSAGES,
                f"{self._name} holds no whole chunk and no definition of any topic: it was cut or damaged before the "
                "first messages were safe. Nothing of it can be used.",
            )
        if len(definitions.channels) > CHANNELS_CAP:
            raise UnreadableLog(
                ReasonCode.TOO_MANY_CHANNELS,
                f"{self._name} defines {len(definitions.channels)} channels, {CHANNELS_CAP} at most are read: it is "
                "damaged, or no flight log. Check what it is.",
            )
        self._file.definitions = definitions
        counts = self._file.statistics.channel_message_counts if self._file.statistics else None
        self._sources = choose_sources(definitions, vehicle.mcap, self.summary, self._name, counts)
        self._malformed: dict[str, int] = {}
        self._unstamped: dict[str, int] = {}
        self._packed = 0
        self._join = SensorJoin()

    def batches(self) -> Iterator[Batch]:
        """Signal batches in file order, one per topic and chunk. May be iterated once."""
        for block in self._file.blocks():
            channels = gather(block.data, block.starts + HEAD_BYTES, _U2)
            for source in self._sources:
                for channel_id, decoder in source.decoders.items():
                    starts = block.starts[channels == channel_id]
                    if not starts.size:
                        continue
                    payloads, sizes = _payloads(block, starts)
                    if source.role == "imu" and source.type_name in STAMPED_TYPES:
                        chosen = of_frame(block.data, payloads, sizes, self._vehicle.mcap.frame_id, source, self._name)
                        starts, payloads, sizes = starts[chosen], payloads[chosen], sizes[chosen]
                        if not starts.size:
                            continue
                    decoded = decoder.decode(block.data, payloads, sizes)
                    if len(decoded.kept) < len(starts):
                        lost = len(starts) - len(decoded.kept)
                        self._packed += int(_packed(block.data, payloads, sizes).sum())
                        self._malformed[source.topic] = self._malformed.get(source.topic, 0) + lost
                    for table, columns in self._tables(source, decoded, block, starts):
                        self.summary.count_rows(table, columns)
                        yield table, columns
        joined = self._join.joined(self._name)
        if joined is not None:
            columns, finding = joined
            self.summary.findings.append(finding)
            self.summary.count_rows("imu", columns)
            yield "imu", columns
        self._finish()

    def _tables(self, source: Source, decoded: Decoded, block: Block, starts: NDArray[np.int64]) -> Iterator[Batch]:
        t_ns = decoded.stamp_ns
        if t_ns is not None and len(t_ns) > 1 and not t_ns.any():
            t_ns = None  # a driver that never fills them in
        if t_ns is None or self._by_log_time:
            if t_ns is None and not self._by_log_time:
                self._unstamped[source.topic] = self._unstamped.get(source.topic, 0) + len(decoded.kept)
            t_ns = gather(block.data, starts[decoded.kept] + HEAD_BYTES + 6, _U8).view(np.int64)
        if not t_ns.size:
            return
        if not self.summary.epoch_known:
            self.summary.epoch_known = stamps_are_epoch(t_ns)
        values = decoded.values
        if source.role == "imu":
            sensors = [name for name in ("gyroscope", "accelerometer") if name in values]
            if sensors:
                yield "imu", _columns(t_ns, values, sensors)
            others = {other.role for other in self._sources}
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
        else:
            yield "position", {"t_ns": t_ns, **values}

    def _settle_conventions(self) -> None:
        """Units, frames and gravity sign: what ROS types imply, overruled by the file's own metadata."""
        declared: dict[str, str] = {}
        for source in self._sources:
            if source.type_name in SI_TYPES:
                declared |= {sensor: SI_UNITS[sensor] for sensor in source.values if sensor in SENSORS}
        own = self._file.metadata.get(METADATA_NAME, {})
        declared |= {sensor: own[f"unit_{sensor}"] for sensor in SENSORS if own.get(f"unit_{sensor}")}
        ros = any(source.type_name in SI_TYPES for source in self._sources)
        self.summary.world = own.get("world") or ("enu" if ros else None)
        self.summary.body = own.get("body") or ("flu" if ros else None)
        self.summary.gravity_sign = own.get("gravity_sign") or ("specific_force" if ros else None)
        self.summary.units = logged_units(self.summary, declared, self._vehicle.units, self._name)

    def _finish(self) -> None:
        file = self._file
        self._settle_conventions()
        report(file.name, file.size, file.tally, file.definitions, file.statistics, self.summary)
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
        if self._packed:
            self.summary.add(
                ReasonCode.PACKED_MESSAGES,
                self._packed,
                f"{self._name}: the payloads of {self._packed} messages are zstd-compressed one by one (rosbag2's "
                'compression mode "message"), which is not read. Convert the log: ros2 bag convert, compression mode '
                "none or file.",
                loses_data=True,
            )
        for name, pairs in file.metadata.items():
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


def _collected(path: Path) -> Definitions:
    """Definitions of a file without a usable summary: from a pass through its records."""
    file = McapFile(path)
    for _ in file.blocks():
        pass
    return file.definitions


def _payloads(block: Block, starts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    sizes = gather(block.data, starts + 1, _U8).view(np.int64) - MESSAGE_HEAD_BYTES
    return starts + HEAD_BYTES + MESSAGE_HEAD_BYTES, sizes


def _packed(data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which payloads begin as a zstd frame does."""
    packed = sizes >= len(ZSTD_MAGIC)
    packed[packed] = gather(data, starts[packed], _U4) == int.from_bytes(ZSTD_MAGIC, "little")
    return packed


def _columns(t_ns: NDArray[np.int64], values: dict[str, NDArray[np.float64]], sensors: Sequence[str]) -> Columns:
    columns: Columns = {"t_ns": t_ns}
    for sensor in sensors:
        for number, component in enumerate(COMPONENTS[3]):
            columns[f"{sensor}_{component}"] = values[sensor][:, number].copy()
    return columns


def _finite(table: str, columns: Columns) -> Iterator[Batch]:
    """Rows in which every number is there: slower sensors share messages with faster ones and leave gaps."""
    whole = np.logical_and.reduce([np.isfinite(values) for name, values in columns.items() if name != "t_ns"])
    if whole.all():
        yield table, columns
    elif whole.any():
        yield table, {name: values[whole] for name, values in columns.items()}
