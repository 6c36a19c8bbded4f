"""What the tests of log reading share: a vehicle, readings with a known truth, an independent MCAP reader."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from fieldcal.config.configuration import CsvMap, McapMap, Vehicle, load
from fieldcal.logs.mcap import write as mcap_writer

EPOCH_NS = 1_700_000_000_000_000_000


def vehicle(*, csv: CsvMap | None = None, mcap: McapMap | None = None, units: dict[str, str] | None = None) -> Vehicle:
    """A vehicle of which nothing is configured but what is given."""
    given = {"csv": csv or CsvMap(), "mcap": mcap or McapMap(), "units": units or {}}
    return load(None).vehicle("any").model_copy(update=given)


class Flight:
    """Seeded readings at irregular nanosecond stamps."""

    def __init__(self, samples: int = 500, seed: int = 0) -> None:
        generator = np.random.default_rng(seed)
        self.t_ns = EPOCH_NS + np.arange(samples) * 5_000_000 + generator.integers(0, 1000, samples)
        self.gyroscope, self.accelerometer, self.magnetometer = generator.normal(size=(3, samples, 3))
        self.counts = generator.integers(0, 65536, (3, samples, 3)).astype(np.uint16)
        self.temperature = generator.normal(25.0, 5.0, samples)
        self.quaternion = generator.normal(size=(samples, 4))
        self.position = generator.normal(size=(samples, 3))

    def channels(self) -> list[mcap_writer.MessageChannel]:
        """The flight in ROS messages."""
        return [
            mcap_writer.imu_channel(self.t_ns, self.t_ns + 450_000, self.gyroscope, self.accelerometer),
            mcap_writer.magnetic_field_channel(self.t_ns, self.t_ns + 450_001, self.magnetometer),
            mcap_writer.temperature_channel(self.t_ns, self.t_ns + 450_002, self.temperature),
            mcap_writer.pose_channel(self.t_ns + 7, self.t_ns + 4_800_000, self.quaternion, self.position),
        ]

    def write(self, path: Path, **options: Any) -> Path:
        """The flight as an MCAP file."""
        mcap_writer.write_mcap(path, self.channels(), **options)
        return path


def messages_by_mcap_ros2(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """(log time, decoded message) of a topic, read by the mcap and mcap_ros2 packages."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, _, message, decoded in reader.iter_decoded_messages(topics=[topic]):
            yield message.log_time, decoded


def stamp_ns(message: Any) -> int:
    """Header stamp in nanoseconds."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)
