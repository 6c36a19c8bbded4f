"""The folder of a ROS 2 bag: its storage files in order, as one recording with channels of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap.reader import McapContainer
from fieldcal.logs.messages.container import Block, Container
from fieldcal.logs.messages.definitions import Definitions
from fieldcal.logs.rosbag2.metadata import read_metadata
from fieldcal.logs.rosbag2.parts import METADATA, stem, storage_files
from fieldcal.logs.rosbag2.sqlite_file import SqliteContainer
from fieldcal.reason_codes import ReasonCode


class FolderContainer:
    """The folder as a `Container`. Its files are opened one at a time: first for their topics, then for the messages.

    Raises
    ------
    UnreadableLog
        `not_bag`: it holds no storage file; else what the first file raises, where none can be read.
    """

    def __init__(self, folder: Path) -> None:
        self._name = folder.name
        self.metadata: dict[str, dict[str, str]] = {}
        self.definitions = Definitions()
        self._own = read_metadata(folder)
        self._findings = LogSummary("rosbag2", verifiable=True)
        self._read: Counter[str] = Counter()
        self._wanted: frozenset[str] = frozenset()
        self._parts: dict[Path, dict[int, int]] = {}
        errors: list[UnreadableLog] = []
        for path in self._files(folder):
            try:
                self._parts[path] = self._adopted(_open(path).definitions)
            except UnreadableLog as refusal:
                errors.append(refusal)
        if not self._parts:
            nothing = UnreadableLog(ReasonCode.NOT_BAG, f"{self._name} holds no .mcap or .db3 file.")
            raise errors[0] if errors else nothing
        for error in errors:
            self._leave_out(error)

    @property
    def counts(self) -> Mapping[int, int] | None:
        """See `Container`."""
        topics = self.definitions.by_topic()
        counts = {topics[name][0].channel_id: count for name, count in self._own.counts.items() if name in topics}
        return counts or None

    def blocks(self, channels: Collection[int]) -> Iterator[Block]:
        """See `Container`."""
        self._wanted = frozenset(self.definitions.channels[channel_id].topic for channel_id in channels)
        for path, ids in self._parts.items():
            try:
                part = _open(path)
            except UnreadableLog as error:  # it was readable a moment ago
                self._leave_out(error)
                continue
            own = [channel_id for channel_id, new_id in ids.items() if new_id in channels]
            for block in part.blocks(own):
                new_ids = np.full(len(block.channels), -1, np.int64)
                for channel_id in own:
                    which = block.channels == channel_id
                    new_ids[which] = ids[channel_id]
                    self._read[self.definitions.channels[ids[channel_id]].topic] += int(which.sum())
                yield replace(block, channels=new_ids)
            self._finish(path, part)

    def report(self, summary: LogSummary) -> None:
        """See `Container`."""
        if self._own.damage:
            summary.add(
                ReasonCode.DAMAGED_SUMMARY,
                1,
                f"{self._name}: {METADATA} is not used ({self._own.damage}); its files are read in the order of their "
                "numbers.",
            )
        lossy = any(finding.loses_data for finding in self._findings.findings)
        missing = {
            topic: count - self._read[topic]
            for topic, count in self._own.counts.items()
            if topic in self._wanted and count > self._read[topic]
        }
        if missing and not lossy:
            listed = ", ".join(f"{topic} {count}" for topic, count in sorted(missing.items()))
            summary.add(
                ReasonCode.COUNT_MISMATCH,
                sum(missing.values()),
                f"{self._name} holds fewer messages than its {METADATA} says. Lost: {listed}.",
                loses_data=True,
            )
        summary.findings += self._findings.findings
        summary.verifiable = self._findings.verifiable

    def _files(self, folder: Path) -> list[Path]:
        """Storage files: those that the metadata lists in its order, then the others by number."""
        there = {path.name: path for path in storage_files(folder)}
        names = list(dict.fromkeys(self._own.names))
        stems = {stem(name) for name in there}  # bags of the first versions name files as before they were packed
        gone = [name for name in names if name not in there and stem(name) not in stems]
        if gone:
            self._findings.add(
                ReasonCode.TRUNCATED,
                len(gone),
                f"{self._name} lacks {', '.join(gone[:5])}, which its {METADATA} names. Copy the bag again, whole.",
                loses_data=True,
            )
        order = [there[name] for name in names if name in there]
        return order + [path for path in there.values() if path not in order]

    def _adopted(self, definitions: Definitions) -> dict[int, int]:
        """A file's channels among the folder's own: its id → the folder's."""
        known = {
            (channel.topic, channel.message_encoding, self.definitions.schemas.get(channel.schema_id)): channel_id
            for channel_id, channel in self.definitions.channels.items()
        }
        schemas = {replace(schema, schema_id=0): schema for schema in self.definitions.schemas.values()}
        ids = {}
        for channel in definitions.channels.values():
            schema = definitions.schemas.get(channel.schema_id)
            if schema is not None:
                alike = schemas.setdefault(replace(schema, schema_id=0), replace(schema, schema_id=len(schemas) + 1))
                self.definitions.add(alike)
                schema = alike
            key = channel.topic, channel.message_encoding, schema
            if key not in known:
                known[key] = len(self.definitions.channels) + 1
                schema_id = 0 if schema is None else schema.schema_id
                self.definitions.add(replace(channel, channel_id=known[key], schema_id=schema_id))
            ids[channel.channel_id] = known[key]
        return ids

    def _finish(self, path: Path, part: Container) -> None:
        own = LogSummary("rosbag2")
        part.report(own)
        self._findings.findings += own.findings
        self._findings.verifiable &= own.verifiable
        for name, pairs in part.metadata.items():
            self.metadata.setdefault(name, {}).update(pairs)

    def _leave_out(self, error: UnreadableLog) -> None:
        sentence = f"{self._name}: a file of it is left out. {error.sentence}"
        self._findings.add(error.reason_code, 1, sentence, loses_data=True)


def _open(path: Path) -> Container:
    end = path.name.removeprefix(stem(path.name)).lower()
    return McapContainer(path) if ".mcap" in end else SqliteContainer(path)
