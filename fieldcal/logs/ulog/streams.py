"""Readings in the rows of PX4's topics: times, vectors, and samples that one message holds many of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.autopilot import Joined, join_on_gyroscope
from fieldcal.logs.ulog.file import ROWS_AT_ONCE, Rows, UlogFile
from fieldcal.logs.ulog.records import Topic

Stamps = NDArray[np.int64]
Values = NDArray[np.float64]

FIFO_GYROSCOPE, FIFO_ACCELEROMETER = "sensor_gyro_fifo", "sensor_accel_fifo"
LATEST_US = 4 * 10**15
"""Later stamps are none; cut here they stay far from all others and do not overflow."""
INVALID_RELATIVE = 2**31 - 1
"""What sensor_combined has for a sensor that it has no reading of."""
ROWS_FOR_A_RATE = 1 << 16
_SAMPLES_A_MESSAGE = 32


@dataclass(frozen=True)
class Clock:
    """The log's clock: µs since boot, `offset_ns` later in the stamps that are delivered."""

    offset_ns: int = 0

    def ns(self, t_us: NDArray[np.integer]) -> Stamps:
        """Delivered stamps."""
        return np.clip(t_us, 0, LATEST_US).astype(np.int64) * 1000 + self.offset_ns


def has(topic: Topic, *names: str, shape: tuple[int, ...] = ()) -> bool:
    """Whether a topic has these fields as numbers of this shape."""
    known = topic.kind.names or ()
    kinds = [topic.kind[name] for name in names if name in known]
    return len(kinds) == len(names) and all(kind.shape == shape and kind.base.kind in "fiu" for kind in kinds)


def stamps_us(rows: Rows) -> NDArray[np.uint64]:
    """When each row was sampled: its timestamp_sample, or where it has none its timestamp."""
    names = rows.dtype.names or ()
    logged = rows["timestamp"].astype(np.uint64)
    if "timestamp_sample" not in names or rows["timestamp_sample"].dtype.kind not in "iu":
        return logged
    sampled = rows["timestamp_sample"].astype(np.uint64)
    return np.where(sampled > 0, sampled, logged)


def vector(rows: Rows, *names: str) -> Values:
    """Readings (n, 3) from one field of three numbers, or from three fields."""
    return np.column_stack([rows[name] for name in names]).astype(np.float64)


def rate_hz(file: UlogFile, topic: Topic) -> float:
    """Median rate of a topic's samples; 0 below two."""
    rows = file.rows(topic, 0, ROWS_FOR_A_RATE)
    intervals = np.diff(np.clip(stamps_us(rows), 0, LATEST_US).astype(np.int64))
    usual = float(np.median(intervals)) if len(intervals) else 0.0
    samples = float(np.median(rows["samples"])) if is_fifo(topic) else 1.0
    return 1e6 * samples / usual if usual > 0 else 0.0


def is_fifo(topic: Topic) -> bool:
    """Whether a message of the topic holds many samples."""
    return topic.name in (FIFO_GYROSCOPE, FIFO_ACCELEROMETER)


def readings(rows: Rows, topic: Topic, clock: Clock) -> tuple[Stamps, Values]:
    """Times and readings of sensor_gyro, sensor_accel, their FIFO topics or sensor_mag."""
    if not is_fifo(topic):
        return clock.ns(stamps_us(rows)), vector(rows, "x", "y", "z")
    held = min(rows[axis].shape[1] for axis in "xyz")
    counts = np.minimum(rows["samples"].astype(np.int64), held)
    number = np.arange(held)
    there = number < counts[:, None]
    # The stamp is that of the last sample; the others lie before it, `dt` apart.
    back_us = (counts[:, None] - 1 - number) * np.nan_to_num(rows["dt"].astype(np.float64))[:, None]
    t_ns = clock.ns(stamps_us(rows))[:, None] - np.rint(np.clip(back_us, 0, 1e7) * 1e3).astype(np.int64)
    scale = rows["scale"].astype(np.float64)[:, None]
    values = np.stack([rows[axis][:, :held].astype(np.float64) * scale for axis in "xyz"], axis=2)
    return t_ns[there], values[there]


def joined(file: UlogFile, gyroscope: Topic, accelerometer: Topic, clock: Clock) -> Iterator[Joined]:
    """The two sensors of a unit as rows at the gyroscope's times, chunk by chunk."""
    t_accelerometer = np.concatenate(
        [clock.ns(stamps_us(rows)) for rows in file.chunks(accelerometer)] or [np.empty(0, np.int64)]
    )
    whole = bool((np.diff(t_accelerometer) < 0).any())  # out of order: neighbours may lie anywhere
    at_once = ROWS_AT_ONCE // (_SAMPLES_A_MESSAGE if is_fifo(gyroscope) else 1)
    for first in range(0, file.count(gyroscope), at_once):
        t_ns, values = readings(file.rows(gyroscope, first, first + at_once), gyroscope, clock)
        low, high = 0, len(t_accelerometer)
        if len(t_ns) and not whole:
            low = max(int(np.searchsorted(t_accelerometer, t_ns.min())) - 2, 0)
            high = int(np.searchsorted(t_accelerometer, t_ns.max(), "right")) + 3
        other = readings(file.rows(accelerometer, low, high), accelerometer, clock)
        yield join_on_gyroscope(t_ns, values, *other)


def combined(rows: Rows, clock: Clock) -> Joined:
    """Rows of sensor_combined. The accelerometer's time is told relative to the gyroscope's, and nearly always the
    same."""
    t_us = np.clip(rows["timestamp"], 0, LATEST_US).astype(np.int64)
    gyroscope, accelerometer = vector(rows, "gyro_rad"), vector(rows, "accelerometer_m_s2")
    relative = rows["accelerometer_timestamp_relative"].astype(np.int64)
    valid = relative != INVALID_RELATIVE
    accelerometer[~valid] = np.nan
    relative = np.where(valid, relative, 0)
    return join_on_gyroscope(clock.ns(t_us), gyroscope, clock.ns(t_us + relative), accelerometer)


def combined_magnetometer(rows: Rows, clock: Clock, last_us: int) -> tuple[Stamps, Values, int]:
    """Magnetometer in old rows of sensor_combined, held there until the next reading: each once. `last_us`: time of
    the last one delivered before; returned anew."""
    relative = rows["magnetometer_timestamp_relative"].astype(np.int64)
    t_us = np.clip(rows["timestamp"], 0, LATEST_US).astype(np.int64) + relative
    new = (np.diff(t_us, prepend=last_us) != 0) & (relative != INVALID_RELATIVE)
    last_us = int(t_us[new][-1]) if new.any() else last_us
    return clock.ns(t_us[new]), vector(rows, "magnetometer_ga")[new], last_us


def averaged(rows: Rows, clock: Clock) -> tuple[Stamps, Values, Values]:
    """Rows of vehicle_imu: mean rate and acceleration over its intervals, whose ends the stamps are."""
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = vector(rows, "delta_angle") / (rows["delta_angle_dt"].astype(np.float64) * 1e-6)[:, None]
        force = vector(rows, "delta_velocity") / (rows["delta_velocity_dt"].astype(np.float64) * 1e-6)[:, None]
    return clock.ns(stamps_us(rows)), rate, force
