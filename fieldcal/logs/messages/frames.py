"""Several IMUs on one topic, their messages' frame_id telling them apart: one is chosen as the primary one, or the
file is refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldcal.errors import UnreadableLog
from fieldcal.logs.encodings.gather import gather
from fieldcal.logs.encodings.ros2_cdr import CdrDecoder
from fieldcal.logs.messages.source import Source
from fieldcal.reason_codes import ReasonCode

STAMPED_TYPES = ("sensor_msgs/Imu",)
"""Types that begin with a std_msgs/Header."""
FRAME_PLACE = 12
"""Bytes before the length of frame_id: encapsulation and stamp in CDR; number and stamp in ROS 1."""
LONGEST_FRAME = 64
INTERLEAVED_SHARE = 0.2
"""Where the frame changes from message to message so often, two IMUs publish; a frame that is renamed changes once."""


def by_frame(
    data: NDArray[np.uint8],
    starts: NDArray[np.int64],
    sizes: NDArray[np.int64],
    frame_id: str | None,
    source: Source,
    log_name: str,
) -> dict[str, NDArray[np.bool_]]:
    """Which messages, whose payloads begin at byte `starts` of `data` and are `sizes` long, are of which IMU.

    The chosen IMU's are under "", others' under their frame_id; all are under "" where none is chosen.

    Raises
    ------
    UnreadableLog
        `several_units`: messages of several alternate and none is chosen.
    """
    everything = {"": np.ones(len(starts), dtype=bool)}
    if not all(isinstance(decoder, CdrDecoder) for decoder in source.decoders.values()):
        return everything
    frames = frame_ids(data, starts, sizes)
    names = np.unique(frames[frames != b""]).tolist()
    if frame_id is not None:
        others = {name.decode("utf-8", "replace"): frames == name for name in names if name != frame_id.encode()}
        return {"": frames == frame_id.encode(), **others}
    if len(names) > 1 and np.mean(frames[1:] != frames[:-1]) > INTERLEAVED_SHARE:
        listed = [name.decode("utf-8", "replace") for name in names]
        raise UnreadableLog(
            ReasonCode.SEVERAL_UNITS,
            f"{log_name}: messages of several IMUs alternate on {source.topic}, told apart by frame_id: "
            f"{', '.join(listed)}. Choose the primary one: set mcap.frame_id to "
            f"{' or '.join(repr(name) for name in listed)}; the others are calibrated as further units.",
        )
    return everything


def frame_ids(data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.bytes_]:
    """The frame_id of each message; empty where a message is too short, its first bytes of names that are longer."""
    frames = np.zeros(len(starts), dtype=f"S{LONGEST_FRAME}")
    first = FRAME_PLACE + 4
    whole = np.flatnonzero(sizes >= first)
    lengths = gather(data, starts[whole] + FRAME_PLACE, np.dtype("<u4")).astype(np.int64)
    for length in np.unique(lengths).tolist():
        same = whole[(lengths == length) & (sizes[whole] >= first + length)]
        taken = min(length, LONGEST_FRAME)
        if same.size and taken:
            text = gather(data, starts[same] + first, np.dtype("u1"), taken).reshape(len(same), taken)
            frames[same] = np.ascontiguousarray(text).view(f"S{taken}").ravel()
    return frames
