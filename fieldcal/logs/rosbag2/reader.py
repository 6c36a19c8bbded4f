"""ROS 2 bags: a folder with files in MCAP or SQLite, read one after the other as one log; or one SQLite file."""

from __future__ import annotations

from pathlib import Path

from fieldcal.config.configuration import Vehicle
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.log import MessageLog
from fieldcal.logs.rosbag2.folder import FolderContainer
from fieldcal.logs.rosbag2.sqlite_file import SqliteContainer


class Rosbag2Log(MessageLog):
    """A ROS 2 bag (`fieldcal.logs.LogReader`).

    Parameters
    ----------
    path : Path
        The folder, or a `.db3` file, which may be compressed as a whole.
    vehicle : Vehicle
        Its `mcap` (topics, fields, which clock) and `units`.

    Raises
    ------
    UnreadableLog
        `not_bag`, `empty_file`, `not_readable`, of a storage file in MCAP what `McapLog` raises, and what `MessageLog`
        raises.
    """

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        container = FolderContainer(path) if path.is_dir() else SqliteContainer(path)
        super().__init__(container, LogSummary("rosbag2"), path.name, vehicle)
