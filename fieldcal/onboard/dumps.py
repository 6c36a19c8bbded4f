"""Dumps: the sums as the C writes them, little-endian, with a checksum; a file holds one after the other."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from fieldcal.errors import UnreadableLog
from fieldcal.names import SENSORS, Sensor
from fieldcal.onboard import rates
from fieldcal.onboard.moments import AXIS_ALIGNED, FULL
from fieldcal.onboard.streams import Moments, RateEquations
from fieldcal.reason_codes import ReasonCode

MAGIC = b"FCM1"
HEAD = struct.Struct("<4sBBHII3f6f")
"""magic; sensor, sums, samples of a block; samples; differences; centre; noise as pairs."""
State = Moments | RateEquations


def dump(sensor: Sensor | str, state: State) -> bytes:
    """What a stream has collected of a sensor, as `fieldcal_moments_dump` and `fieldcal_rates_dump` write it.

    Raises
    ------
    ValueError
        Something was forgotten: it could not be merged.

    Examples
    --------
    >>> from fieldcal.onboard import Moments, dump, read_dumps
    >>> moments = Moments()
    >>> moments.feed([[1.0, 2.0, 3.0], [1.5, 2.5, 2.0]])
    >>> [(sensor, state)] = read_dumps(dump("magnetometer", moments))
    >>> str(sensor), state.n_samples
    ('magnetometer', 2)
    """
    if isinstance(state, RateEquations):
        if state.forgetting < 1.0:
            raise ValueError("what was forgotten cannot be merged, so it is not dumped")
        sums, block = state.values, state.block_samples
    else:
        sums, block = state.values[1 : 1 + state.sums], 0
    centre = np.full(3, np.nan) if state.centre is None else state.centre
    head = HEAD.pack(
        MAGIC,
        SENSORS.index(Sensor(sensor)),
        len(sums),
        block,
        state.n_samples,
        state.noise.n_differences,
        *(float(v) for v in centre),
        *_pairs(state.noise.squares),
    )
    body = head + struct.pack(f"<{2 * len(sums)}f", *_pairs(sums))
    return body + struct.pack("<I", zlib.crc32(body))


def read_dumps(source: Path | str | bytes) -> list[tuple[Sensor, State]]:
    """What the dumps in a file (or bytes) hold, in its order.

    Raises
    ------
    UnreadableLog
        `bad_dump`: it is no dump, is cut off, or its checksum is wrong.
    """
    name = "the dump" if isinstance(source, bytes) else str(source)
    data = source if isinstance(source, bytes) else Path(source).read_bytes()
    found: list[tuple[Sensor, State]] = []
    at = 0
    while at < len(data):
        size = _size(data, at)
        whole = data[at : at + size]
        if size == 0 or len(whole) < size or zlib.crc32(whole[:-4]) != struct.unpack("<I", whole[-4:])[0]:
            raise UnreadableLog(
                ReasonCode.BAD_DUMP,
                f"{name}: what begins at byte {at} is no whole dump of fieldcal's; have the vehicle write it again.",
            )
        found.append(_state(whole))
        at += size
    if not found:
        raise UnreadableLog(ReasonCode.BAD_DUMP, f"{name} is empty; have the vehicle write it again.")
    return found


def _size(data: bytes, at: int) -> int:
    """Bytes of the dump that begins at `at`, 0 where none does."""
    if len(data) - at < HEAD.size or data[at : at + 4] != MAGIC:
        return 0
    sensor, sums = data[at + 4], data[at + 5]
    known = sums == rates.SUMS if sensor == SENSORS.index(Sensor.GYROSCOPE) else sums in (AXIS_ALIGNED, FULL)
    return HEAD.size + 8 * sums + 4 if known and sensor < len(SENSORS) else 0


def _state(data: bytes) -> tuple[Sensor, State]:
    _, number, n_sums, block, samples, differences, *rest = HEAD.unpack_from(data)
    sensor = SENSORS[number]
    pairs = np.frombuffer(data, dtype="<f4", count=2 * n_sums, offset=HEAD.size).astype(float)
    sums = pairs[::2] + pairs[1::2]
    centre = np.array(rest[:3])
    state: State
    if sensor == Sensor.GYROSCOPE:
        if not 3 <= block <= 256:
            raise UnreadableLog(ReasonCode.BAD_DUMP, f"The dump's blocks are of {block} samples, not of 3 to 256.")
        state = RateEquations(block)
        state.values[:] = sums
        state.n_samples = samples
    else:
        state = Moments(sums=n_sums)
        state.values[0] = samples
        state.values[1 : 1 + n_sums] = sums
    state.noise.squares = np.add(rest[3::2], rest[4::2])
    state.noise.n_differences = differences
    state.centre = None if not np.isfinite(centre).all() else centre
    return sensor, state


def _pairs(values: np.ndarray) -> list[float]:
    """Each value as a float and the rest that it leaves."""
    high = values.astype(np.float32)
    low = (values - high.astype(float)).astype(np.float32)
    return [float(v) for v in np.column_stack([high, low]).ravel()]
