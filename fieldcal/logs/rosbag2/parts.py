"""What makes a folder a ROS 2 bag: its storage files, and `metadata.yaml`, which names them."""

from __future__ import annotations

import re
from pathlib import Path

METADATA = "metadata.yaml"
STORAGE_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd", ".mcap.zst", ".db3.zst")
_MARK = b"rosbag2_bagfile_information"
_MARK_BYTES = 4096


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder holds storage files and a `metadata.yaml` of rosbag2; or storage files named after the folder
    and no others, where the recorder died before it wrote one."""
    names = [path.name for path in storage_files(folder)]
    if not names:
        return False
    metadata = folder / METADATA
    if metadata.is_file():
        with metadata.open("rb") as stream:
            return _MARK in stream.read(_MARK_BYTES)
    return all(re.fullmatch(re.escape(folder.name) + r"_\d+", stem(name)) for name in names)


def stem(name: str) -> str:
    """The name of a storage file without what says its format."""
    lower = name.lower()
    return next((name[: -len(end)] for end in STORAGE_SUFFIXES if lower.endswith(end)), name)


def storage_files(folder: Path) -> list[Path]:
    """The files of messages in a folder, in the order of their numbers."""
    files = (path for path in folder.iterdir() if path.name.lower().endswith(STORAGE_SUFFIXES) and path.is_file())
    return sorted(files, key=lambda path: _by_number(path.name))


def bag_files(folder: Path) -> list[Path]:
    """All files of a bag: its content."""
    metadata = folder / METADATA
    return [*storage_files(folder), *([metadata] if metadata.is_file() else [])]


def _by_number(name: str) -> tuple[list[tuple[int, str]], str]:
    """Order in which `bag_2` stands before `bag_10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)], name
