"""`metadata.yaml` of a ROS 2 bag: which files in which order, how many messages on each topic.

Two lists of it are looked for, in the block style that recorders write; a YAML library would do much more with a file
that nobody vouches for.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from fieldcal.logs.rosbag2.parts import METADATA

CAP_BYTES = 2 << 20
"""Largest `metadata.yaml` that is read; recorders write some kilobytes."""

_NAME = re.compile(r"^[ \-]*name:[ ]+(\S.*?)[ ]*$", re.MULTILINE)
_COUNT = re.compile(r"^[ \-]*message_count:[ ]+(\d{1,18})[ ]*$", re.MULTILINE)
_QUOTED = re.compile(r"(['\"])(.*)\1")


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
        lines = path.read_bytes().decode("utf-8", "replace").splitlines()
    except OSError as error:
        return BagMetadata(damage=error.strerror or str(error))
    # Bags of the first versions name files with their folder.
    names = [Path(_plain(item)).name for item in _items(lines, "relative_file_paths")]
    counts = {}
    for item in _items(lines, "topics_with_message_count"):
        name, count = _NAME.search(item), _COUNT.search(item)
        if name and count:
            counts[_plain(name[1])] = int(count[1])
    return BagMetadata(names, counts)


def _items(lines: list[str], key: str) -> list[str]:
    """The items of the block list under a key: the lines of each, without its dash."""
    found: list[list[str]] = []
    start = next((number for number, line in enumerate(lines) if line.strip() == f"{key}:"), None)
    if start is None:
        return []
    outer, inner = _indent(lines[start]), -1
    for line in lines[start + 1 :]:
        if not line.strip():
            continue
        dashed, indent = line.lstrip().startswith("- "), _indent(line)
        if indent < outer or (indent == outer and not dashed):
            break
        if dashed and inner in (-1, indent):
            inner = indent
            found.append([line.lstrip()[2:]])
        elif found:
            found[-1].append(line)
    return ["\n".join(item) for item in found]


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _plain(text: str) -> str:
    """A scalar without its quotes."""
    quoted = _QUOTED.fullmatch(text.strip())
    return quoted[2] if quoted else text.strip()
