"""A ULog file: its definitions, and the rows of its topics as views into the mapped file."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldcal.errors import UnreadableLog
from fieldcal.logs.mcap.mapped import map_file
from fieldcal.logs.ulog import records
from fieldcal.logs.ulog.records import FILE_HEAD_BYTES, HEAD_BYTES, MESSAGE_ID_BYTES, Topic
from fieldcal.logs.ulog.scan import IDS, Found, Losses, Scan, Sizes
from fieldcal.reason_codes import ReasonCode

Rows = NDArray[np.void]

ROWS_AT_ONCE = 1 << 16
_TIMESTAMP = "timestamp"


@dataclass(frozen=True)
class Change:
    """A parameter that was set while the log was written: when, by the latest data message before it, in µs."""

    t_us: int
    name: str
    value: float


class UlogFile:
    """A ULog file that was walked through once; its rows are read when they are asked for.

    Attributes
    ----------
    start_us : int
        When the log was begun, µs since boot.
    topics : list of Topic
        As subscribed, in file order.
    infos, parameters, defaults
        By key: text; value at the start; the firmware's own value.
    changes : list of Change
        Parameters set later, in file order.
    dropouts_ms : list of int
        Times for which the logger says that it wrote nothing.
    unknown_messages : int
        Data messages of what is not subscribed, or has no usable format.
    losses : Losses
        Bytes and messages that could not be read.

    Parameters
    ----------
    path : Path
    wanted : callable, optional
        Which topics will be asked for, by name; all. Memory is 8 bytes a message of those.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`, `not_an_autopilot_log`, `format_not_supported`.
    """

    def __init__(self, path: Path, wanted: Callable[[str], bool] = lambda name: True) -> None:
        self._data = map_file(path)
        self.name, self.size = path.name, len(self._data)
        head = self._data[:FILE_HEAD_BYTES]
        if len(head) < FILE_HEAD_BYTES or not head.startswith(records.MAGIC):
            raise UnreadableLog(
                ReasonCode.NOT_AN_AUTOPILOT_LOG,
                f"{self.name} does not begin as a ULog file does: it is no log of PX4, or was damaged at its first "
                "bytes. Check what it is, or copy it again.",
            )
        self.start_us = int(struct.unpack_from("<Q", head, len(records.MAGIC) + 1)[0])
        self.topics: list[Topic] = []
        self.infos: dict[str, str] = {}
        self.parameters: dict[str, float] = {}
        self.defaults: dict[str, float] = {}
        self.changes: list[Change] = []
        self.dropouts_ms: list[int] = []
        self.unknown_messages = 0
        self.losses = Losses()
        self._wanted = wanted
        self._formats: dict[str, str] = {}
        self._sizes = Sizes()
        self._is_wanted = np.zeros(IDS, bool)
        self._stamp_at = np.full(IDS, -1, np.int64)
        self._counts = np.zeros(IDS, np.int64)
        self._last_us: int | None = None
        self._parts: dict[int, list[NDArray[np.int64]]] = {}
        for start, end in self._stretches():
            for found in Scan(self._data, self._sizes, self._subscriptions, self.losses).messages(start, end):
                self._take(found)
        self._offsets = {number: np.concatenate(parts) for number, parts in self._parts.items()}
        del self._parts

    def instances(self, name: str) -> list[Topic]:
        """Instances of a topic that have messages, in order of their number."""
        found = [topic for topic in self.topics if topic.name == name and self.count(topic)]
        return sorted(found, key=lambda topic: topic.instance)

    def count(self, topic: Topic) -> int:
        """Messages of a topic."""
        return int(self._counts[topic.message_id])

    def rows(self, topic: Topic, first: int = 0, last: int | None = None) -> Rows:
        """Messages `first` to `last` of a topic, fields as its format has them; a copy."""
        offsets = self._offsets.get(topic.message_id, np.empty(0, np.int64))[first:last]
        size = topic.kind.itemsize
        if not len(offsets):
            return np.empty(0, topic.kind)
        windows: Rows = np.ndarray((self.size - size + 1,), topic.kind, self._data, strides=(1,))
        return windows[offsets + HEAD_BYTES + MESSAGE_ID_BYTES]

    def chunks(self, topic: Topic) -> Iterator[Rows]:
        """All messages of a topic, `ROWS_AT_ONCE` at a time."""
        for first in range(0, self.count(topic), ROWS_AT_ONCE):
            yield self.rows(topic, first, first + ROWS_AT_ONCE)

    def _stretches(self) -> list[tuple[int, int]]:
        """From where to where messages are: what was appended after a crash follows whatever the crash cut."""
        begins = [FILE_HEAD_BYTES]
        head = self._data[FILE_HEAD_BYTES : FILE_HEAD_BYTES + HEAD_BYTES + records.FLAG_BITS_BYTES]
        whole = len(head) == HEAD_BYTES + records.FLAG_BITS_BYTES
        if whole and head[2] == records.FLAGS and head[0] | head[1] << 8 >= records.FLAG_BITS_BYTES:
            incompatible, *appended = struct.unpack_from("<8s3Q", head, HEAD_BYTES + 8)
            if any(incompatible[1:]) or incompatible[0] & ~records.DATA_APPENDED:
                raise UnreadableLog(
                    ReasonCode.FORMAT_NOT_SUPPORTED,
                    f"{self.name} says that it uses something of ULog that is not known here (flags "
                    f"{incompatible.hex()}). Update fieldcal, or convert the log to MCAP or CSV.",
                )
            if incompatible[0] & records.DATA_APPENDED:
                begins += sorted({offset for offset in appended if FILE_HEAD_BYTES < offset < self.size})
        return list(zip(begins, [*begins[1:], self.size], strict=True))

    def _subscriptions(self, messages: list[tuple[int, bytes]]) -> list[Topic]:
        """Topics that some formats and subscriptions define, with the formats that are known."""
        formats, topics = dict(self._formats), []
        for kind, payload in messages:
            if kind == records.FORMAT:
                name, fields = records.read_format(payload)
                formats.setdefault(name, fields)
            elif (topic := _topic(payload, formats)) is not None:
                topics.append(topic)
        return [topic for topic in topics if not self._sizes.least[topic.message_id]]

    def _take(self, found: Found) -> None:
        for index in np.flatnonzero(found.kinds != records.DATA).tolist():
            self._take_one(int(found.kinds[index]), found.payload(index), found, index)
        at = np.flatnonzero(found.kinds == records.DATA)
        if not len(at):
            return
        ids = found.ids[at]
        self._last_us = self._stamp(found, at) or self._last_us
        counts = np.bincount(ids, minlength=IDS)
        self._counts += counts
        self.unknown_messages += int(counts[self._sizes.least == 0].sum())
        at = at[self._is_wanted[ids]]
        order = at[np.argsort(found.ids[at], kind="stable")]
        ids = found.ids[order]
        borders = np.flatnonzero(np.diff(ids)) + 1
        for part in np.split(found.starts[order], borders) if len(order) else []:
            number = int(found.ids[np.searchsorted(found.starts, part[0])])
            self._parts.setdefault(number, []).append(part)

    def _take_one(self, kind: int, payload: bytes, found: Found, index: int) -> None:
        if kind == records.FORMAT:
            name, fields = records.read_format(payload)
            self._formats.setdefault(name, fields)
        elif kind == records.SUBSCRIPTION:
            for topic in self._subscriptions([(kind, payload)]):
                self._sizes.learn(topic)
                self.topics.append(topic)
                self._is_wanted[topic.message_id] = self._wanted(topic.name)
                if topic.kind.fields and _TIMESTAMP in topic.kind.fields:
                    self._stamp_at[topic.message_id] = topic.kind.fields[_TIMESTAMP][1]
        elif kind == records.INFO:
            type_name, key, value = records.read_keyed(payload)
            self.infos.setdefault(key, records.text_of(type_name, value))
        elif kind == records.PARAMETER:
            self._take_parameter(payload, found, index)
        elif kind == records.PARAMETER_DEFAULT:
            type_name, key, value = records.read_keyed(payload, 1)
            self.defaults.setdefault(key, records.number_of(type_name, value) or 0.0)
        elif kind == records.DROPOUT:
            self.dropouts_ms.append(payload[0] | payload[1] << 8)

    def _take_parameter(self, payload: bytes, found: Found, index: int) -> None:
        type_name, key, value = records.read_keyed(payload)
        number = records.number_of(type_name, value)
        if number is None:
            return
        if not self.topics:  # definitions come before the first subscription
            self.parameters[key] = number
            return
        before = np.flatnonzero(found.kinds[:index] == records.DATA)
        t_us = self._stamp(found, before) or self._last_us
        self.changes.append(Change(self.start_us if t_us is None else t_us, key, number))

    def _stamp(self, found: Found, at: NDArray[np.intp]) -> int | None:
        """Time stamp of the last data message among these that has one."""
        stamped = at[self._stamp_at[found.ids[at]] >= 0]
        if not len(stamped):
            return None
        index = int(stamped[-1])
        place = MESSAGE_ID_BYTES + int(self._stamp_at[found.ids[index]])
        return int(struct.unpack_from("<Q", found.payload(index), place)[0])


def _topic(payload: bytes, formats: dict[str, str]) -> Topic | None:
    name = payload[3:].decode("ascii")
    try:
        kind, padding = records.row_kind(name, formats)
    except ValueError:
        return None
    return Topic(name, payload[0], payload[1] | payload[2] << 8, kind, padding)
