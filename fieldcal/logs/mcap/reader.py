"""MCAP logs, also such as were compressed as a whole (`.mcap.zstd`)."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from fieldcal.config.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap.file import McapFile
from fieldcal.logs.mcap.report import report
from fieldcal.logs.messages.container import Block
from fieldcal.logs.messages.definitions import Definitions
from fieldcal.logs.messages.log import MessageLog
from fieldcal.logs.unpacked import Unpacked, is_packed
from fieldcal.reason_codes import ReasonCode


class McapLog(MessageLog):
    """An MCAP log (`fieldcal.logs.LogReader`).

    Parameters
    ----------
    path : Path
        The file.
    vehicle : Vehicle
        Its `mcap` (topics, fields, which clock) and `units`.

    Raises
    ------
    UnreadableLog
        `empty_file`, `not_mcap`, `not_readable`, `no_messages`, and what `MessageLog` raises.
    """

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        super().__init__(McapContainer(path), LogSummary("mcap"), path.name, vehicle)


class McapContainer:
    """The file as a `Container`. Raises UnreadableLog: `empty_file`, `not_mcap`, `not_readable`, `no_messages`."""

    def __init__(self, path: Path) -> None:
        self._unpacked = Unpacked(path) if is_packed(path) else None
        buffer = self._unpacked.map() if self._unpacked else None
        self._file = McapFile(path, buffer)
        if not self._file.has_summary or not self._file.definitions.channels:
            first_pass = McapFile(path, self._file.buffer)
            for _ in first_pass.blocks():
                pass
            self._file.definitions = first_pass.definitions
        if not self._file.definitions.channels:
            raise UnreadableLog(
                ReasonCode.NO_MESSAGES,
                f"{path.name} holds no whole chunk and no definition of any topic: it was cut or damaged before the "
                "first messages were safe. Nothing of it can be used.",
            )

    @property
    def definitions(self) -> Definitions:
        """See `Container`."""
        return self._file.definitions

    @property
    def counts(self) -> Mapping[int, int] | None:
        """See `Container`."""
        return self._file.statistics.channel_message_counts if self._file.statistics else None

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """See `Container`."""
        return self._file.metadata

    def blocks(self, channels: Collection[int]) -> Iterator[Block]:
        """See `Container`. Chunks are read whole: of every channel."""
        return self._file.blocks()

    def report(self, summary: LogSummary) -> None:
        """See `Container`."""
        if self._unpacked:
            self._unpacked.report(summary)
        file = self._file
        report(file.name, file.size, file.tally, file.definitions, file.statistics, summary)
