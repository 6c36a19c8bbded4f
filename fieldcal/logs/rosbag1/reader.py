"""ROS 1 bags."""

from __future__ import annotations

from pathlib import Path

from fieldcal.config.configuration import Vehicle
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.log import MessageLog
from fieldcal.logs.rosbag1.file import BagContainer


class Rosbag1Log(MessageLog):
    """A ROS 1 bag (`fieldcal.logs.LogReader`).

    Parameters
    ----------
    path : Path
        The file.
    vehicle : Vehicle
        Its `mcap` (topics, fields, which clock) and `units`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`, `not_bag`, `no_messages`, and what `MessageLog` raises.
    """

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        super().__init__(BagContainer(path), LogSummary("rosbag1"), path.name, vehicle)
