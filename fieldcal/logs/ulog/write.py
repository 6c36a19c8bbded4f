"""Writing ULog files from arrays, as PX4's logger lays them out.

    write_ulog(path, [Rows("sensor_combined", {"timestamp": t_us, "gyro_rad": rates, ...})],
               parameters={"CAL_GYRO0_XOFF": 0.01, "SENS_BOARD_ROT": 0}, infos={"ver_hw": "PX4_FMU_V6C"})

A column's numpy type is the field's type; (n,) is a single value, (n, k) an array. Every topic needs `timestamp`, µs
since boot. Data messages of all topics are written in order of time.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.ulog import records
from fieldcal.logs.ulog.file import Change

VERSION = 1
ALIGNMENT = 8
SYNC_EVERY = 512
_TYPE_NAMES = {np.dtype(code): name for name, code in records.BASIC_TYPES.items() if name not in ("bool", "char")}


@dataclass(frozen=True)
class Rows:
    """Messages of one instance of a topic."""

    topic: str
    columns: Mapping[str, NDArray[np.generic]]
    instance: int = 0


def write_ulog(
    path: Path,
    topics: Sequence[Rows],
    *,
    parameters: Mapping[str, int | float] | None = None,
    changes: Sequence[Change] = (),
    infos: Mapping[str, str | int] | None = None,
    dropouts_ms: Sequence[int] = (),
    start_us: int = 0,
) -> None:
    """Write a log.

    Parameters
    ----------
    path : Path
    topics : sequence of Rows
    parameters : mapping, optional
        Values at the start: int32 for an int, float otherwise.
    changes : sequence of Change, optional
        Parameters set later, each before the first data message of a later time.
    infos : mapping, optional
        Texts, and numbers of 32 or (`…_us`) 64 bits.
    dropouts_ms : sequence of int, optional
        Written at the end.
    start_us : int
        When the log began, µs since boot.
    """
    parts = encode(
        topics,
        parameters=parameters or {},
        changes=changes,
        infos=infos or {},
        dropouts_ms=dropouts_ms,
        start_us=start_us,
    )
    path.write_bytes(b"".join(parts))


def encode(
    topics: Sequence[Rows],
    *,
    parameters: Mapping[str, int | float],
    changes: Sequence[Change] = (),
    infos: Mapping[str, str | int],
    dropouts_ms: Sequence[int] = (),
    start_us: int = 0,
) -> list[bytes]:
    """The file's head and its messages one by one, as `write_ulog` writes them."""
    parts = [records.MAGIC + struct.pack("<BQ", VERSION, start_us), message(records.FLAGS, bytes(40))]
    for key, value in infos.items():
        parts.append(message(records.INFO, _info(key, value)))
    formats = {rows.topic: _format(rows) for rows in topics}
    parts += [message(records.FORMAT, text.encode()) for text in formats.values()]
    parts += [_parameter(name, value) for name, value in parameters.items()]
    for number, rows in enumerate(topics):
        head = struct.pack("<BH", rows.instance, number)
        parts.append(message(records.SUBSCRIPTION, head + rows.topic.encode()))
    parts += _data(topics, changes)
    parts += [message(records.DROPOUT, struct.pack("<H", duration)) for duration in dropouts_ms]
    return parts


def message(kind: int, payload: bytes) -> bytes:
    """One message with its head."""
    return struct.pack("<HB", len(payload), kind) + payload


def _data(topics: Sequence[Rows], changes: Sequence[Change]) -> Iterator[bytes]:
    payloads = [_payloads(number, rows) for number, rows in enumerate(topics)]
    lengths = [len(own) for own in payloads]
    owner = np.repeat(np.arange(len(topics)), lengths)
    place = np.concatenate([np.arange(n) for n in lengths] or [np.empty(0, np.int64)])
    t_us = np.concatenate(
        [np.asarray(rows.columns["timestamp"], np.uint64) for rows in topics] or [np.empty(0, np.uint64)]
    )
    waiting = sorted(changes, key=lambda change: change.t_us)
    for count, index in enumerate(np.argsort(t_us, kind="stable").tolist()):
        while waiting and waiting[0].t_us < int(t_us[index]):
            yield _parameter(waiting[0].name, waiting.pop(0).value)
        if count % SYNC_EVERY == SYNC_EVERY - 1:
            yield records.SYNC_MESSAGE
        yield message(records.DATA, payloads[owner[index]][place[index]])
    yield from (_parameter(change.name, change.value) for change in waiting)


def _payloads(number: int, rows: Rows) -> list[bytes]:
    columns = {name: np.asarray(values) for name, values in rows.columns.items()}
    kind = np.dtype(
        [
            ("message_id", "<u2"),
            *((name, values.dtype.newbyteorder("<"), values.shape[1:]) for name, values in columns.items()),
        ]
    )
    packed = np.zeros(len(columns["timestamp"]), kind)
    packed["message_id"] = number
    for name, values in columns.items():
        packed[name] = values
    content, size = packed.tobytes(), kind.itemsize
    return [content[start : start + size] for start in range(0, len(content), size)]


def _format(rows: Rows) -> str:
    """Its definition; the padding up to whole words at its end is defined, and as PX4 does it, not logged."""
    fields, size = [], 0
    for name, values in rows.columns.items():
        array = np.asarray(values)
        own = _TYPE_NAMES[array.dtype.newbyteorder("<")]
        count = f"[{array.shape[1]}]" if array.ndim == 2 else ""
        fields.append(f"{own}{count} {name};")
        size += array.dtype.itemsize * (array.shape[1] if array.ndim == 2 else 1)
    padding = -size % ALIGNMENT
    if padding:
        fields.append(f"uint8_t[{padding}] _padding0;")
    return f"{rows.topic}:{''.join(fields)}"


def _info(key: str, value: str | int) -> bytes:
    if isinstance(value, str):
        content = value.encode()
        named = f"char[{len(content)}] {key}".encode()
    elif key.endswith("_us"):
        content, named = struct.pack("<Q", value), f"uint64_t {key}".encode()
    else:
        content, named = struct.pack("<I", value), f"uint32_t {key}".encode()
    return bytes([len(named)]) + named + content


def _parameter(name: str, value: float) -> bytes:
    whole = isinstance(value, int)
    named = f"{'int32_t' if whole else 'float'} {name}".encode()
    content = struct.pack("<i", value) if whole else struct.pack("<f", value)
    return message(records.PARAMETER, bytes([len(named)]) + named + content)
