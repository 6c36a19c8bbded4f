"""Reading flight logs: one interface, one registry of formats.

`find_logs` lists an archive, `open_log` streams one log as batches of signal tables, `read_log` loads one whole.
Whatever is wrong with a file, reading it raises only `fieldcal.errors.UnreadableLog` or returns with findings.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv.reader import CsvLog
from fieldcal.logs.dataflash.reader import DataflashLog
from fieldcal.logs.discovery import find_logs, flight_id, is_stored, log_format, log_sha256
from fieldcal.logs.interface import (
    SIGNAL_COLUMNS,
    UNKNOWN_UNIT,
    Batch,
    Columns,
    Finding,
    LogFile,
    LogReader,
    LogSummary,
)
from fieldcal.logs.mcap.reader import McapLog
from fieldcal.logs.rosbag1.reader import Rosbag1Log
from fieldcal.logs.rosbag2.reader import Rosbag2Log
from fieldcal.logs.ulog.reader import UlogLog
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import signal_kind

READERS: dict[str, Callable[[Path, Vehicle], LogReader]] = {
    "mcap": McapLog,
    "csv": CsvLog,
    "ulog": UlogLog,
    "dataflash": DataflashLog,
    "rosbag1": Rosbag1Log,
    "rosbag2": Rosbag2Log,
}
"""Log format (as `discovery.log_format` names it) -> reader."""


def open_log(path: Path, vehicle: Vehicle) -> LogReader:
    """Open a log for streaming.

    Parameters
    ----------
    path : Path
        An `.mcap`, `.mcap.zstd`, `.bag`, `.db3`, `.ulg`, `.bin` (ArduPilot) or `.csv` file, a rosbag2 folder, or a
        folder with `imu.csv` or a known exporter's files.
    vehicle : Vehicle
        Configuration of its vehicle: topics, columns, units.

    Raises
    ------
    UnreadableLog
        With a reason code and a sentence. Iterating `batches()` may raise it too.
    """
    if not path.exists():
        raise UnreadableLog(ReasonCode.NOT_FOUND, f"{path.name} does not exist. Check the path.")
    if not is_stored(path):
        raise UnreadableLog(
            ReasonCode.NOT_READABLE, f"{path.name} is a pipe, socket or device. Save its content to a file."
        )
    kind = log_format(path)
    if kind not in READERS:
        what = "a folder that is neither a ROS 2 bag nor has imu.csv" if path.is_dir() else f"a {path.suffix or 'file'}"
        raise UnreadableLog(
            ReasonCode.FORMAT_NOT_SUPPORTED,
            f"{path.name} is {what}, which cannot be read. Convert it to MCAP or CSV.",
        )
    return READERS[kind](path, vehicle)


def read_log(path: Path, vehicle: Vehicle) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    """A whole log in memory: signal table -> frame sorted by time, and the summary. Raises as `open_log`."""
    reader = open_log(path, vehicle)
    frames: dict[str, list[pl.DataFrame]] = {}
    for table, columns in reader.batches():
        frames.setdefault(table, []).append(batch_frame(table, columns))
    whole = {table: pl.concat(parts).sort("t_ns", maintain_order=True) for table, parts in frames.items()}
    return whole, reader.summary


def batch_frame(table: str, columns: Columns) -> pl.DataFrame:
    """A batch as a frame with every column of its signal table; those the log lacks are null. Tables of further units,
    "imu.1", have the columns of their kind."""
    rows = len(columns["t_ns"])
    series = []
    for name in SIGNAL_COLUMNS[signal_kind(table)]:
        dtype = pl.Int64 if name == "t_ns" else pl.Float64
        if name in columns:
            series.append(pl.Series(name, np.ascontiguousarray(columns[name]), dtype))
        else:
            series.append(pl.Series(name, [None], dtype).new_from_index(0, rows))
    return pl.DataFrame(series)


__all__ = [
    "READERS",
    "SIGNAL_COLUMNS",
    "UNKNOWN_UNIT",
    "Batch",
    "Columns",
    "CsvLog",
    "DataflashLog",
    "Finding",
    "LogFile",
    "LogReader",
    "LogSummary",
    "McapLog",
    "Rosbag1Log",
    "Rosbag2Log",
    "UlogLog",
    "batch_frame",
    "find_logs",
    "flight_id",
    "log_format",
    "log_sha256",
    "open_log",
    "read_log",
]
