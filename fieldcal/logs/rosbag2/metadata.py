"""`metadata.yaml` of a ROS 2 bag: which files in which order, how many messages on each topic."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from fieldcal.logs.rosbag2.parts import METADATA

CAP_BYTES = 2 << 20
"""Largest `metadata.yaml` that is read; recorders write some kilobytes."""


@dataclass
class BagMetadata:
    """What the file says. `names` of files in order; `counts`: topic → messages. `damage`: why it is not used."""

    names: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    damage: str | None = None


def read_metadata(folder: Path) -> BagMetadata:
    """The folder's metadata; empty where it has none. Never raises for what the file holds."""
    path = folder / METADATA
    if not path.is_file():
        return BagMetadata(damage="the recorder did not write it")
    try:
        if path.stat().st_size > CAP_BYTES:
            return BagMetadata(damage=f"it is larger than {CAP_BYTES} bytes")
        document: object = yaml.load(path.read_bytes(), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (OSError, yaml.YAMLError, UnicodeError, ValueError, RecursionError, OverflowError) as error:
        return BagMetadata(damage=" ".join(str(error).split()))
    information = _table(_table(document).get("rosbag2_bagfile_information"))
    names = information.get("relative_file_paths")
    counts = dict(_counts(information.get("topics_with_message_count")))
    # Bags of the first versions name files with their folder.
    listed = [Path(name).name for name in names if isinstance(name, str)] if isinstance(names, list) else []
    return BagMetadata(listed, counts)


def _counts(topics: object) -> Iterator[tuple[str, int]]:
    for entry in topics if isinstance(topics, list) else []:
        name = _table(_table(entry).get("topic_metadata")).get("name")
        count = _table(entry).get("message_count")
        if isinstance(name, str) and isinstance(count, int):
            yield name, count


def _table(value: object) -> dict[object, object]:
    return value if isinstance(value, dict) else {}
