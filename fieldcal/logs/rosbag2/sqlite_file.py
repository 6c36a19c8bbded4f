"""One `.db3` file of a ROS 2 bag: messages in a table of an SQLite database, their topics in another."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np

from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap.mapped import map_file
from fieldcal.logs.messages.container import Block
from fieldcal.logs.messages.definitions import Channel, Definitions, Schema
from fieldcal.logs.rosbag2.rows import Rows, open_read_only
from fieldcal.logs.unpacked import Unpacked, is_packed
from fieldcal.reason_codes import ReasonCode

SQLITE_MAGIC = b"SQLite format 3\0"
BLOCK_BYTES = 4 << 20
BLOCK_MESSAGES = 1 << 16
JOURNALS = ("-wal", "-journal")


class SqliteContainer:
    """The file as a `Container`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_readable`; `not_bag`: it is no SQLite database, or its tables are not those of a bag.
    """

    def __init__(self, path: Path) -> None:
        self._name = path.name
        self._unpacked = Unpacked(path) if is_packed(path) else None
        self._journals = [path.name + end for end in JOURNALS if _bytes_of(path.with_name(path.name + end))]
        database = self._unpacked.path if self._unpacked else path
        with map_file(database) as content:
            self._bytes = len(content)
            head = content[:100]
        if not head.startswith(SQLITE_MAGIC):
            raise UnreadableLog(
                ReasonCode.NOT_BAG, f"{self._name} does not begin like an SQLite database. Check what it is."
            )
        page_bytes = int.from_bytes(head[16:18], "big")
        self._declared_bytes = int.from_bytes(head[28:32], "big") * (65536 if page_bytes == 1 else page_bytes)
        self._malformed = 0
        self._unknown = 0
        self._rows: Rows | None = None
        try:
            self._connection = open_read_only(database)
            self.definitions = _definitions(self._connection)
        except sqlite3.Error as error:
            told = " Its journal lies beside it: open and close it once with sqlite3." if self._journals else ""
            raise UnreadableLog(
                ReasonCode.NOT_BAG,
                f"{self._name} cannot be read as a ROS 2 bag ({error}): it is damaged at its beginning, was never "
                f"closed, or is another database.{told} Copy it again from the recorder.",
            ) from error

    @property
    def counts(self) -> Mapping[int, int] | None:
        """See `Container`. The file does not say."""
        return None

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """See `Container`."""
        return {}

    def blocks(self, channels: Collection[int]) -> Iterator[Block]:
        """See `Container`."""
        wanted = ", ".join(str(int(channel_id)) for channel_id in sorted(channels))
        columns = f"topic_id, timestamp, CASE WHEN topic_id IN ({wanted}) THEN data END"
        self._rows = Rows(self._connection, "messages", columns)
        gathered: list[tuple[int, int, bytes]] = []
        size = 0
        for _, (channel_id, log_time_ns, payload) in self._rows:
            if channel_id not in channels:
                self._unknown += channel_id not in self.definitions.channels
                continue
            if not (isinstance(channel_id, int) and isinstance(log_time_ns, int) and isinstance(payload, bytes)):
                self._malformed += 1
                continue
            gathered.append((channel_id, log_time_ns, payload))
            size += len(payload)
            if size >= BLOCK_BYTES or len(gathered) == BLOCK_MESSAGES:
                yield _block(gathered)
                gathered, size = [], 0
        if gathered:
            yield _block(gathered)

    def report(self, summary: LogSummary) -> None:
        """See `Container`. Nothing in such a file is under a checksum."""
        if self._unpacked:
            self._unpacked.report(summary)
        if self._declared_bytes > self._bytes:
            summary.add(
                ReasonCode.TRUNCATED,
                1,
                f"{self._name} is cut short: it has {self._bytes} of {self._declared_bytes} bytes. What stands before "
                "the cut was read.",
                loses_data=True,
            )
        if self._journals:
            summary.add(
                ReasonCode.TRUNCATED,
                1,
                f"{self._name} was not closed: the messages recorded last are in {', '.join(self._journals)} beside it "
                "and are not read. Open and close it once with sqlite3, which moves them into it.",
                loses_data=True,
            )
        if self._malformed:
            summary.add(
                ReasonCode.MALFORMED_MESSAGE,
                self._malformed,
                f"{self._name}: {self._malformed} rows of table messages hold no bytes or no time and were left out.",
                loses_data=True,
            )
        if self._unknown:
            summary.add(
                ReasonCode.UNKNOWN_CHANNEL,
                self._unknown,
                f"{self._name}: {self._unknown} messages belong to topics that are defined nowhere in the file.",
                loses_data=True,
            )
        if self._rows and self._rows.gaps:
            _tell_of_gaps(self._name, self._rows, summary)


def _tell_of_gaps(name: str, rows: Rows, summary: LogSummary) -> None:
    first, last = rows.gaps[0]
    until = f"up to {last}" if len(rows.gaps) > 1 or last < 2**62 else "to the end"
    summary.add(
        ReasonCode.DAMAGED_RECORD,
        len(rows.gaps),
        f"{name} is damaged in {len(rows.gaps)} place(s) ({rows.damage}); the first: messages behind row "
        f"{max(first, 0)} {until} are lost. All that can be reached was read.",
        loses_data=True,
    )
    if rows.gave_up:
        summary.add(
            ReasonCode.SEARCH_CAP,
            1,
            f"{name}: searching behind the damage for whole rows was given up; the rest was not read.",
            loses_data=True,
        )


def _definitions(connection: sqlite3.Connection) -> Definitions:
    """Topics and types of the bag. Raises sqlite3.Error where its tables are not what they should be."""
    query = "SELECT name, sql FROM sqlite_master WHERE type = 'table'"
    tables = {str(name) for name, sql in connection.execute(query) if str(sql).upper().startswith("CREATE TABLE")}
    if not {"topics", "messages"} <= tables:
        raise sqlite3.DatabaseError("it has no tables topics and messages")
    connection.execute("SELECT rowid, topic_id, timestamp, data FROM messages LIMIT 0")
    texts: dict[str, tuple[str, bytes]] = {}
    if "message_definitions" in tables:
        rows = connection.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        texts = {str(name): (str(encoding), str(text).encode()) for name, encoding, text in rows}
    found = Definitions()
    topics = connection.execute("SELECT id, name, type, serialization_format FROM topics")
    for topic_id, topic, name, encoding in topics:
        if not isinstance(topic_id, int):
            continue
        found.add(Schema(topic_id, str(name), *texts.get(str(name), ("", b""))))
        found.add(Channel(topic_id, topic_id, str(topic), str(encoding), ()))
    return found


def _block(messages: list[tuple[int, int, bytes]]) -> Block:
    channels, log_times, payloads = zip(*messages, strict=True)
    sizes = np.array([len(payload) for payload in payloads], np.int64)
    data = np.frombuffer(b"".join(payloads), np.uint8)
    starts = np.cumsum(sizes) - sizes
    return Block(data, starts, sizes, np.array(channels, np.int64), np.array(log_times, np.int64))


def _bytes_of(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
