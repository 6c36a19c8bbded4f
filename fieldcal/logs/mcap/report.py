"""What a pass through an MCAP file met, and the findings that follow from it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap.records import Statistics
from fieldcal.logs.messages.definitions import Definitions
from fieldcal.reason_codes import ReasonCode


@dataclass
class Tally:
    """What was met on the way through a file."""

    messages: Counter[int] = field(default_factory=Counter)
    lost: Counter[int] = field(default_factory=Counter)
    unknown_channels: Counter[int] = field(default_factory=Counter)
    damaged_chunks: list[tuple[int, str]] = field(default_factory=list)
    damaged_records: list[tuple[int, str]] = field(default_factory=list)
    duplicate_chunks: int = 0
    chunks: int = 0
    unverifiable: int = 0
    summary_damage: str | None = None
    ended: bool = False
    stopped: str | None = None

    def forget_cut(self) -> None:
        """Drop the last damage met: it is the end of a file that was cut, told as such."""
        places = max(self.damaged_chunks, self.damaged_records, key=lambda damage: damage[-1][0] if damage else -1)
        places.pop()


def report(
    name: str, size: int, tally: Tally, definitions: Definitions, statistics: Statistics | None, summary: LogSummary
) -> None:
    """Turn what a finished pass through the file `name` of `size` bytes met into findings of `summary`."""
    topics = {channel_id: channel.topic for channel_id, channel in definitions.channels.items()}
    missing, surplus, complete = _balance(tally, statistics)
    lost = _listed(missing, topics) if missing else " are not counted in the file"
    if tally.damaged_chunks:
        byte, why = tally.damaged_chunks[0]
        summary.add(
            ReasonCode.DAMAGED_CHUNK,
            len(tally.damaged_chunks),
            f"{name}: {len(tally.damaged_chunks)} damaged chunk(s), the first at byte {byte} ({why}). All intact "
            f"chunks were read. Messages lost{lost}.",
            loses_data=not complete,
        )
    if tally.damaged_records:
        byte, why = tally.damaged_records[0]
        summary.add(
            ReasonCode.DAMAGED_RECORD,
            len(tally.damaged_records),
            f"{name}: {len(tally.damaged_records)} damaged record(s) outside chunks, the first at byte {byte} ({why}).",
            loses_data=not complete,
        )
    if tally.stopped:
        summary.add(ReasonCode.SEARCH_CAP, 1, f"{name}: {tally.stopped}; the rest was not read.", loses_data=True)
    elif not tally.ended and not complete:
        summary.add(
            ReasonCode.TRUNCATED,
            1,
            f"{name} is cut short: it has {size} bytes and no end. Everything whole before the cut was read.",
            loses_data=True,
        )
    if missing and not tally.damaged_chunks:
        summary.add(
            ReasonCode.COUNT_MISMATCH,
            sum(missing.values()),
            f"{name} holds fewer messages than it says itself. Lost{lost}.",
            loses_data=True,
        )
    if surplus:
        summary.add(
            ReasonCode.COUNT_MISMATCH,
            sum(surplus.values()),
            f"{name} holds more messages than its statistics say{_listed(surplus, topics)}.",
        )
    _report_contradictions(name, tally, definitions, summary)
    summary.verifiable = not tally.unverifiable


def _balance(tally: Tally, statistics: Statistics | None) -> tuple[dict[int, int], dict[int, int], bool]:
    """Messages missing and too many per channel, and whether the file's own count says that nothing is missing."""
    if statistics is None:
        return dict(tally.lost), {}, False
    said, met = statistics.channel_message_counts, tally.messages
    missing = {channel_id: count - met[channel_id] for channel_id, count in said.items() if count > met[channel_id]}
    surplus = {channel_id: count - said.get(channel_id, 0) for channel_id, count in met.items()}
    surplus = {channel_id: count for channel_id, count in surplus.items() if count > 0}
    return missing, surplus, not missing and sum(said.values()) == statistics.message_count


def _report_contradictions(name: str, tally: Tally, definitions: Definitions, summary: LogSummary) -> None:
    if tally.unknown_channels:
        count = sum(tally.unknown_channels.values())
        summary.add(
            ReasonCode.UNKNOWN_CHANNEL,
            count,
            f"{name}: {count} messages belong to channels that are defined nowhere in what is left of the file.",
            loses_data=True,
        )
    if tally.duplicate_chunks:
        summary.add(
            ReasonCode.DUPLICATE_CHUNK,
            tally.duplicate_chunks,
            f"{name}: {tally.duplicate_chunks} chunk(s) stand in the file twice and were read once.",
        )
    if tally.summary_damage:
        summary.add(ReasonCode.DAMAGED_SUMMARY, 1, f"{name}: its summary section is not used ({tally.summary_damage}).")
    if definitions.redefined:
        summary.add(
            ReasonCode.CHANNEL_REDEFINED,
            len(definitions.redefined),
            f"{name} defines {', '.join([*definitions.redefined][:5])} twice and differently: what its messages mean "
            "is uncertain. Record the log again, or split it where the definition changes.",
            fatal=True,
        )
    if tally.unverifiable:
        summary.add(
            ReasonCode.UNVERIFIABLE,
            tally.unverifiable,
            f"{name} carries no CRC for {tally.unverifiable} stretch(es) of messages: damage there would go unseen.",
        )


def _listed(counts: dict[int, int], topics: dict[int, str]) -> str:
    parts = [
        f"{topics.get(channel_id, f'channel {channel_id}')} {count}" for channel_id, count in sorted(counts.items())
    ]
    return ": " + ", ".join(parts[:8])
