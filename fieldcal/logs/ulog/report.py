"""Findings on a ULog file: what was lost, by damage and by the logger itself."""

from __future__ import annotations

from fieldcal.logs.interface import LogSummary
from fieldcal.logs.ulog.file import UlogFile
from fieldcal.reason_codes import ReasonCode


def report(file: UlogFile, summary: LogSummary) -> None:
    """Tell what the file lost."""
    losses, name = file.losses, file.name
    if losses.places:
        summary.add(
            ReasonCode.DAMAGED_RECORD,
            losses.places,
            f"{name}: {losses.lost_bytes} bytes at {losses.places} place(s) are damaged and were left out"
            + (
                f", and with them {losses.messages} data message(s) whose end they may hold. "
                if losses.messages
                else ". "
            )
            + "ULog has no checksums: damage within a reading cannot be seen. Copy the log again if there is another.",
            loses_data=True,
        )
    if losses.cut_bytes:
        summary.add(
            ReasonCode.TRUNCATED,
            1,
            f"{name} ends within a message; its last {losses.cut_bytes} bytes were left out: power was lost, or the "
            "copy is not whole. What came later is missing.",
            loses_data=True,
        )
    if file.dropouts_ms:
        total = sum(file.dropouts_ms)
        summary.add(
            ReasonCode.DROPOUTS_LOGGED,
            len(file.dropouts_ms),
            f"{name}: the logger could not keep up {len(file.dropouts_ms)} time(s), for {total} ms in all; what came "
            "then is missing. Use a faster card, or log less.",
            loses_data=True,
        )
    if file.unknown_messages:
        summary.add(
            ReasonCode.UNKNOWN_CHANNEL,
            file.unknown_messages,
            f"{name}: {file.unknown_messages} data messages are of topics that the log does not define; they were left "
            "out.",
            loses_data=True,
        )


def tell_selection(summary: LogSummary, log_name: str, stream: str, device_id: int, left_out: int) -> None:
    """Finding on rows of another unit than the one that a stream had for most of the time."""
    summary.add(
        ReasonCode.UNIT_CHANGED,
        left_out,
        f"{log_name}: {stream} is not of one unit throughout; the {left_out} rows that are not of device {device_id} "
        "were left out.",
        loses_data=True,
    )
