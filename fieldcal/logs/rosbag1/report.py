"""What a pass through a ROS 1 bag met, and the findings that follow from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from fieldcal.logs.interface import LogSummary
from fieldcal.logs.messages.definitions import Definitions
from fieldcal.reason_codes import ReasonCode

TOPICS_TOLD = 8


@dataclass
class Tally:
    """`messages`: connection → messages met; `damaged`: byte and what is wrong there."""

    messages: Counter[int] = field(default_factory=Counter)
    damaged: list[tuple[int, str]] = field(default_factory=list)


def report(
    name: str,
    size: int,
    closed: bool,
    tally: Tally,
    definitions: Definitions,
    said: Mapping[int, int] | None,
    summary: LogSummary,
) -> None:
    """Turn what a finished pass through the bag `name` of `size` bytes met into findings of `summary`.

    `closed`: its head says that the recorder closed it; `said`: messages by connection as its index says.
    """
    missing = {key: count - tally.messages[key] for key, count in (said or {}).items() if count > tally.messages[key]}
    topics = {channel_id: channel.topic for channel_id, channel in definitions.channels.items()}
    parts = [f"{topics.get(key, f'connection {key}')} {count}" for key, count in sorted(missing.items())]
    lost = ": " + (", ".join(parts[:TOPICS_TOLD]) or "none") if said is not None else " are not counted in the file"
    if tally.damaged:
        byte, why = tally.damaged[0]
        summary.add(
            ReasonCode.DAMAGED_CHUNK,
            len(tally.damaged),
            f"{name} is damaged in {len(tally.damaged)} place(s), the first at byte {byte} ({why}). All whole chunks "
            f"were read. Messages lost{lost}.",
            loses_data=said is None or bool(missing),
        )
    elif missing:
        summary.add(
            ReasonCode.COUNT_MISMATCH,
            sum(missing.values()),
            f"{name} holds fewer messages than its index says. Lost{lost}.",
            loses_data=True,
        )
    if said is None:
        why = "its index is damaged or cut off" if closed else "the recorder did not close it"
        summary.add(
            ReasonCode.TRUNCATED,
            1,
            f"{name} has {size} bytes and no index: {why}. Every whole chunk was read; what came last may be missing.",
            loses_data=True,
        )
    unknown = sum(count for key, count in tally.messages.items() if key not in definitions.channels)
    if unknown:
        summary.add(
            ReasonCode.UNKNOWN_CHANNEL,
            unknown,
            f"{name}: {unknown} messages belong to connections that are defined nowhere in what is left of the file.",
            loses_data=True,
        )
    if definitions.redefined:
        summary.add(
            ReasonCode.CHANNEL_REDEFINED,
            len(definitions.redefined),
            f"{name} defines {', '.join([*definitions.redefined][:5])} twice and differently: what its messages mean "
            "is uncertain. Record the log again.",
            fatal=True,
        )
