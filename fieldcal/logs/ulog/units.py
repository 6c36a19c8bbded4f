"""Which inertial units and magnetometers a log knows, which are the primary ones, and which topic serves each best."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from fieldcal.logs.ulog.file import Rows, UlogFile
from fieldcal.logs.ulog.records import Topic
from fieldcal.logs.ulog.streams import (
    FIFO_ACCELEROMETER,
    FIFO_GYROSCOPE,
    LATEST_US,
    ROWS_FOR_A_RATE,
    Clock,
    combined_magnetometer,
    has,
    rate_hz,
    stamps_us,
)

LEAST_IMU_HZ, LEAST_MAGNETOMETER_HZ = 50.0, 5.0
"""Rawer readings are preferred down to these rates, below them faster ones."""

_TRIPLE = (3,)


@dataclass(frozen=True)
class Stream:
    """Topics that give a unit's readings. `accelerometer`: where it has a topic of its own."""

    topic: Topic
    rate_hz: float
    accelerometer: Topic | None = None

    @property
    def name(self) -> str:
        """Topic and instance."""
        own = f"{self.topic.name}.{self.topic.instance}"
        other = self.accelerometer
        return own if other is None else f"{own} and {other.name}.{other.instance}"


@dataclass(frozen=True)
class Unit:
    """A unit on board. `device_id` and `accelerometer_id`: 0 where the log tells none (of a magnetometer the latter
    too). `stream`: the topic that its readings are taken from."""

    device_id: int
    accelerometer_id: int
    stream: Stream
    primary: bool


@dataclass(frozen=True)
class Selection:
    """Which unit the autopilot flew by, from `from_us` on."""

    from_us: int
    device_id: int
    accelerometer_id: int


def selections(file: UlogFile) -> list[Selection]:
    """The autopilot's choices of an IMU, in order of time, repetitions left out."""
    found: list[Selection] = []
    for topic in file.instances("sensor_selection")[:1]:
        if not has(topic, "timestamp", "gyro_device_id", "accel_device_id"):
            continue
        for row in file.rows(topic):
            one = Selection(
                min(int(row["timestamp"]), LATEST_US), int(row["gyro_device_id"]), int(row["accel_device_id"])
            )
            if not found or (found[-1].device_id, found[-1].accelerometer_id) != (one.device_id, one.accelerometer_id):
                found.append(one)
    return found


def longest(chosen: list[Selection], end_us: int) -> Selection | None:
    """The unit that was chosen for the longest time."""
    if not chosen:
        return None
    spans: dict[tuple[int, int], int] = {}
    for one, until in zip(chosen, [*(later.from_us for later in chosen[1:]), end_us], strict=True):
        key = one.device_id, one.accelerometer_id
        spans[key] = spans.get(key, 0) + max(until - one.from_us, 0)
    key = max(spans, key=lambda pair: spans[pair])
    return next(one for one in chosen if (one.device_id, one.accelerometer_id) == key)


def imus(file: UlogFile) -> list[Unit]:
    """Inertial units, the primary one first, each with the topic that serves it best."""
    combined = [topic for topic in _instances(file, "sensor_combined", "timestamp") if _is_combined(topic)][:1]
    averaged = [topic for topic in _instances(file, "vehicle_imu", "timestamp") if _is_averaged(topic)]
    end_us = _last_us(file, combined[0]) if combined else LATEST_US
    chosen = longest(selections(file), end_us)
    pairs = [_pair(file, topic) for topic in averaged]
    gyroscopes, accelerometers = _separate(file, FIFO_GYROSCOPE), _separate(file, FIFO_ACCELEROMETER)
    for slow, kept in (("sensor_gyro", gyroscopes), ("sensor_accel", accelerometers)):
        kept += _separate(file, slow)
    for gyroscope in gyroscopes:
        one, like = first_id(file, gyroscope), gyroscope.name.replace("gyro", "accel")
        mates = [topic for topic in accelerometers if (topic.name, topic.instance) == (like, gyroscope.instance)]
        if mates and one not in [pair[0] for pair in pairs]:
            pairs.append((one, first_id(file, mates[0])))
    primary = (chosen.device_id, chosen.accelerometer_id) if chosen else (pairs[0] if pairs else (0, 0))
    if combined and primary not in pairs:
        pairs = [primary, *(pair for pair in pairs if pair[0] != primary[0] or not primary[0])]
    units = []
    for pair in sorted(pairs, key=lambda pair: pair != primary):
        streams = list(_apart(file, pair, gyroscopes, accelerometers))
        streams += [Stream(topic, rate_hz(file, topic)) for topic in averaged if _pair(file, topic) == pair]
        if pair == primary:
            streams += [Stream(topic, rate_hz(file, topic)) for topic in combined]
        if streams:
            units.append(Unit(*pair, _best(streams, LEAST_IMU_HZ), pair == primary))
    return units


def magnetometers(file: UlogFile, parameters: Mapping[str, float]) -> list[Unit]:
    """Magnetometers, the primary one first, each with the topic that serves it best."""
    raw = [topic for topic in _instances(file, "sensor_mag", "timestamp") if has(topic, "x", "y", "z")]
    calibrated = [
        topic
        for topic in _instances(file, "vehicle_magnetometer", "timestamp")
        if has(topic, "magnetometer_ga", shape=_TRIPLE)
    ]
    streams: dict[int, list[Stream]] = {}
    for topic in (*calibrated[:1], *raw, *calibrated[1:]):
        number = usual_id(file, topic)
        # Of two that have one id, or none, each is a unit of its own.
        twin = number in streams and topic.name in [stream.topic.name for stream in streams[number]]
        key = -1 - len(streams) if twin else number
        streams.setdefault(key, []).append(Stream(topic, rate_hz(file, topic)))
    held = [topic for topic in _instances(file, "sensor_combined", "timestamp") if _holds_magnetometer(topic)][:1]
    if held and not streams:
        streams[0] = [Stream(held[0], _held_rate_hz(file, held[0]))]
    if not streams:
        return []
    first = next(iter(streams))
    if not calibrated:
        first = max(streams, key=lambda key: (_priority(key, parameters), -list(streams).index(key)))
    return [
        Unit(
            usual_id(file, streams[key][0].topic),
            0,
            _best(sorted(streams[key], key=lambda stream: stream.topic.name != "sensor_mag"), LEAST_MAGNETOMETER_HZ),
            key == first,
        )
        for key in sorted(streams, key=lambda key: key != first)
    ]


def first_id(file: UlogFile, topic: Topic, name: str = "device_id") -> int:
    """A device id in the first row of a topic; 0 where it has none."""
    if not has(topic, name):
        return 0
    rows = file.rows(topic, 0, 1)
    return int(rows[name][0]) if len(rows) else 0


def usual_id(file: UlogFile, topic: Topic) -> int:
    """The device id of most rows of a topic; 0 where it has none."""
    if not has(topic, "device_id"):
        return 0
    ids, counts = np.unique(_column(file, topic, "device_id"), return_counts=True)
    return int(ids[np.argmax(counts)]) if len(ids) else 0


def corrected_by_driver(topic: Topic) -> bool:
    """Whether a sensor's own topic is of the time when drivers applied the calibration: raw counts stand beside it."""
    return "x_raw" in (topic.kind.names or ())


def _pair(file: UlogFile, topic: Topic) -> tuple[int, int]:
    return first_id(file, topic, "gyro_device_id"), first_id(file, topic, "accel_device_id")


def _best(streams: list[Stream], least_hz: float) -> Stream:
    """The first that is fast enough, else the fastest."""
    return next((one for one in streams if one.rate_hz >= least_hz), max(streams, key=lambda one: one.rate_hz))


def _apart(
    file: UlogFile, pair: tuple[int, int], gyroscopes: Iterable[Topic], accelerometers: Iterable[Topic]
) -> Iterable[Stream]:
    """Streams of two topics, one a sensor, the rawest first."""
    for gyroscope in gyroscopes:
        if first_id(file, gyroscope) != pair[0]:
            continue
        like = gyroscope.name.replace("gyro", "accel")
        for accelerometer in accelerometers:
            if accelerometer.name == like and first_id(file, accelerometer) == pair[1]:
                if not pair[0] and accelerometer.instance != gyroscope.instance:
                    continue
                slower = min(rate_hz(file, gyroscope), rate_hz(file, accelerometer))
                yield Stream(gyroscope, slower, accelerometer)
                break


def _separate(file: UlogFile, name: str) -> list[Topic]:
    found = _instances(file, name, "timestamp")
    if name not in (FIFO_GYROSCOPE, FIFO_ACCELEROMETER):
        return [topic for topic in found if has(topic, "x", "y", "z")]
    return [topic for topic in found if has(topic, "samples", "dt", "scale") and _holds_samples(topic)]


def _holds_samples(topic: Topic) -> bool:
    kinds = [topic.kind[axis] for axis in "xyz" if axis in (topic.kind.names or ())]
    return len(kinds) == 3 and all(len(kind.shape) == 1 and kind.base.kind == "i" for kind in kinds)


def _is_combined(topic: Topic) -> bool:
    return has(topic, "gyro_rad", "accelerometer_m_s2", shape=_TRIPLE) and has(
        topic, "accelerometer_timestamp_relative"
    )


def _holds_magnetometer(topic: Topic) -> bool:
    return has(topic, "magnetometer_ga", shape=_TRIPLE) and has(topic, "magnetometer_timestamp_relative")


def _held_rate_hz(file: UlogFile, topic: Topic) -> float:
    """Rate of a magnetometer whose readings are repeated until the next one."""
    rows = file.rows(topic, 0, ROWS_FOR_A_RATE)
    t_ns = combined_magnetometer(rows, Clock(), -1)[0]
    return float(1e9 / np.median(np.diff(t_ns))) if len(t_ns) > 1 and np.median(np.diff(t_ns)) > 0 else 0.0


def _is_averaged(topic: Topic) -> bool:
    return has(topic, "delta_angle", "delta_velocity", shape=_TRIPLE) and has(
        topic, "delta_angle_dt", "delta_velocity_dt"
    )


def _instances(file: UlogFile, name: str, *fields: str) -> list[Topic]:
    return [topic for topic in file.instances(name) if has(topic, *fields)]


def _priority(device_id: int, parameters: Mapping[str, float]) -> float:
    """CAL_MAGn_PRIO of the slot with this device id."""
    for slot in range(4):
        number = parameters.get(f"CAL_MAG{slot}_ID")
        if number is not None and device_id > 0 and int(number) & 0xFFFFFFFF == device_id:
            return parameters.get(f"CAL_MAG{slot}_PRIO", 0.0)
    return 0.0


def _last_us(file: UlogFile, topic: Topic) -> int:
    rows: Rows = file.rows(topic, file.count(topic) - 1)
    return int(np.clip(stamps_us(rows), 0, LATEST_US)[-1]) if len(rows) else LATEST_US


def _column(file: UlogFile, topic: Topic, name: str) -> np.ndarray:
    return np.concatenate([rows[name] for rows in file.chunks(topic)] or [np.empty(0)])
