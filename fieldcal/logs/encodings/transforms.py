"""Transforms between frames (`tf2_msgs/TFMessage`, `tf/tfMessage`): those of one frame, among many in a message."""

from __future__ import annotations

import struct
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.encodings.decoded import NANOSECONDS, Decoded
from fieldcal.logs.encodings.ros2_cdr import ENCAPSULATION_BYTES, ENCAPSULATIONS

TRANSFORMS_CAP = 4096
"""Transforms in one message; more than a robot has."""
FRAMES_CAP = 1000
LOOKED_AT = 2000
"""Messages that are looked at where only the names of the frames are wanted."""
_Transform = tuple[str, str, int, tuple[float, ...]]


class TransformDecoder:
    """Reads `orientation` (x, y, z, w) and `position` of a frame from messages of many transforms.

    A transform turns coordinates of the child frame into those of its parent: it is the child's pose in the parent.

    Parameters
    ----------
    frame : str or None
        The child frame, with or without a slash before it. None: no pose is read, only `seen` filled.
    parent : str or None
        The parent frame; None: the first that `frame` is given in, and only that.
    ros1 : bool
        The messages are in ROS 1 serialisation.

    Attributes
    ----------
    seen : Counter
        (parent, child) → transforms met.
    parent : str or None
        The parent in use.
    """

    def __init__(self, frame: str | None, parent: str | None, *, ros1: bool = False) -> None:
        self.frame = frame.lstrip("/") if frame else None
        self.parent = parent.lstrip("/") if parent else None
        self.seen: Counter[tuple[str, str]] = Counter()
        self._ros1 = ros1

    def decode(self, data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Decoded:
        """See `Decoder.decode`. A message with several transforms of the frame gives as many rows."""
        stamps: list[int] = []
        numbers: list[tuple[float, ...]] = []
        kept: list[int] = []
        malformed = 0
        if self.frame is None:
            starts = starts[: max(LOOKED_AT - self.seen.total(), 0)]
            sizes = sizes[: len(starts)]
        for number, (start, size) in enumerate(zip(starts.tolist(), sizes.tolist(), strict=True)):
            try:
                transforms = self._read(data[start : start + size].tobytes())
            except (struct.error, ValueError):
                malformed += 1
                continue
            for parent, child, stamp_ns, values in transforms:
                if (parent, child) in self.seen or len(self.seen) < FRAMES_CAP:
                    self.seen[parent, child] += 1
                if child != self.frame:
                    continue
                self.parent = self.parent or parent
                if parent == self.parent:
                    stamps.append(stamp_ns)
                    numbers.append(values)
                    kept.append(number)
        table = np.array(numbers, np.float64).reshape(len(numbers), 7)
        poses = {"orientation": table[:, 3:], "position": table[:, :3]}
        return Decoded(poses, np.array(stamps, np.int64), np.array(kept, np.intp), malformed)

    def _read(self, payload: bytes) -> list[_Transform]:
        order, largest, head = "<", 1, 0
        if not self._ros1:
            kind = int.from_bytes(payload[:2], "little")
            if kind not in ENCAPSULATIONS:
                raise ValueError("no CDR")
            order, largest = ENCAPSULATIONS[kind]
            head = ENCAPSULATION_BYTES
        return _transforms(memoryview(payload)[head:], order, largest, self._ros1)


def _transforms(body: memoryview, order: str, largest_alignment: int, ros1: bool) -> list[_Transform]:
    """Layout of one: [seq,] stamp, frame_id, child_frame_id, translation, rotation. Raises where it ends before."""
    stamp, length, pose = struct.Struct(order + "iI"), struct.Struct(order + "I"), struct.Struct(order + "7d")
    four, eight = min(4, largest_alignment), min(8, largest_alignment)
    (count,) = length.unpack_from(body, 0)
    if count > TRANSFORMS_CAP:
        raise ValueError(f"{count} transforms")
    position = 4
    found = []
    for _ in range(count):
        position = -(-position // four) * four + (4 if ros1 else 0)
        seconds, nanoseconds = stamp.unpack_from(body, position)
        position += stamp.size
        frames = []
        for _ in range(2):
            position = -(-position // four) * four
            (size,) = length.unpack_from(body, position)
            position += 4
            frames.append(bytes(body[position : position + size]).rstrip(b"\0").decode("utf-8").lstrip("/"))
            position += size
        position = -(-position // eight) * eight
        values = pose.unpack_from(body, position)
        position += pose.size
        found.append((frames[0], frames[1], seconds * NANOSECONDS + nanoseconds, values))
    return found
