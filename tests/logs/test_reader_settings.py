"""What readers see of the configuration enters the key of ingest: a map left out would find the former signals."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest
from bags import Truth, write_rosbag1, write_rosbag2
from dataflash_support import DataflashFlight

from fieldcal.config.configuration import Vehicle, load, parse
from fieldcal.config.reader_settings import READ, reader_settings
from fieldcal.logs import READERS, find_logs, read_log
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment


class Watched:
    """A vehicle that notes which of its keys are read."""

    def __init__(self, content: Vehicle) -> None:
        self.content = content
        self.asked: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        self.asked.add(name)
        return getattr(self.content, name)


def write_dataflash_flight(archive: Path) -> None:
    """What the simulation does not write."""
    (archive / "v" / "s").mkdir(parents=True)
    DataflashFlight(50).write(archive / "v" / "s" / "a.bin")
    (archive / "fieldcal.toml").write_text("")


def write_bag(archive: Path, log_format: str) -> None:
    truth = Truth(50, ros1=log_format == "rosbag1")
    (archive / "v" / "s").mkdir(parents=True)
    if log_format == "rosbag1":
        write_rosbag1(archive / "v" / "s" / "a.bag", truth.messages, truth.rows)
    else:
        write_rosbag2(archive / "v" / "s" / "a", truth.messages, truth.rows)
    (archive / "fieldcal.toml").write_text("")


@pytest.mark.parametrize("log_format", READERS)
def test_a_reader_reads_nothing_that_its_key_does_not_hold(tmp_path: Path, log_format: str) -> None:
    if log_format == "dataflash":
        write_dataflash_flight(tmp_path)
    elif log_format.startswith("rosbag"):
        write_bag(tmp_path, log_format)
    else:
        write_flights(tmp_path, Experiment(duration_s=5.0), log_format=log_format)
    (log,) = find_logs(tmp_path)
    watched = Watched(load(tmp_path / "fieldcal.toml").vehicle(log.vehicle_id))
    tables, _ = read_log(log.path, cast(Vehicle, watched))
    assert tables["imu"].height
    assert watched.asked
    assert watched.asked <= set(READ)


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        ("csv = { separator = ';' }", True),
        ("mcap = { imu = '/imu' }", True),
        ("units = { gyroscope = 'deg/s' }", True),
        ("simulated = true", True),
        ("polarity = { gyroscope = [1, 1, -1] }", False),
        ("parameters = { smoothing_cutoff_hz = 7.0 }", False),
        ("field = { north_east_down = [1.0, 0.0, 0.0], unit = 'norm' }", False),
        ("imu_id = 'other'", False),
    ],
)
def test_what_concerns_readers_alone_counts(text: str, counts: bool) -> None:
    plain, configured = (reader_settings(parse(t, None).vehicle("v")) for t in ("", f"[defaults]\n{text}"))
    assert (plain != configured) == counts
