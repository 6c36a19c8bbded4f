"""What a pass through a DataFlash file met, and what the log says of itself, as findings and metadata."""

from __future__ import annotations

import re
from collections.abc import Mapping

from fieldcal.logs.autopilot import tell_simulated
from fieldcal.logs.dataflash.clock import Epoch
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.interface import LogSummary
from fieldcal.reason_codes import ReasonCode

WHOLE_BLOCK_BYTES = 512
"""ArduPilot writes logs in whole blocks: one that ends with a block within a message was cut by nobody."""
FIRMWARE = re.compile(r"(APM:)?\s*(Ardu\w+|Copter|Plane|Rover|Sub|Blimp|AntennaTracker)\b.*\bV\d")
BOARD = re.compile(r"(?P<board>\S.*?) (?P<id>[0-9A-F]{8} [0-9A-F]{8} [0-9A-F]{8})$")
OPERATING_SYSTEM = re.compile(r"(ChibiOS|PX4|NuttX|Linux)\b")


def report_damage(file: DataflashFile, malformed: Mapping[str, int], summary: LogSummary) -> None:
    """Findings on what of the file could not be read. `malformed`: name → messages without the fields they need."""
    name, tally = file.name, file.tally
    if tally.stretches:
        summary.add(
            ReasonCode.DAMAGED_RECORD,
            tally.stretches,
            f"{name}: {tally.damaged_bytes} bytes in {tally.stretches} place(s), the first at byte {tally.damaged_at}, "
            "are no message and were left out; reading went on behind them. Copy the log again if the original is "
            "whole.",
            loses_data=True,
        )
    if tally.undefined:
        types = ", ".join(map(str, sorted(tally.undefined)))
        summary.add(
            ReasonCode.UNKNOWN_CHANNEL,
            len(tally.undefined),
            f"{name}: {sum(tally.undefined.values())} bytes are messages of type {types}, which the log does not "
            "define (FMT); they were left out.",
            loses_data=True,
        )
    for message, count in tally.redefined.items():
        summary.add(
            ReasonCode.CHANNEL_REDEFINED,
            count,
            f"{name}: message {message} is defined a second time and differently; its {count} messages behind that "
            "were left out. Split the log there.",
            loses_data=True,
        )
    if tally.cut:
        whole = file.size % WHOLE_BLOCK_BYTES == 0
        why = (
            "as ArduPilot leaves it when power is cut"
            if whole
            else "the end is missing. Copy the log again if the original is whole"
        )
        summary.add(
            ReasonCode.TRUNCATED,
            1,
            f"{name} ends within a message, of which {tally.cut} bytes are there: {why}.",
            loses_data=not whole,
        )
    for message, count in malformed.items():
        summary.add(
            ReasonCode.MALFORMED_MESSAGE,
            count,
            f"{name}: the {count} messages {message} lack fields that ArduPilot has in them and were left out.",
            loses_data=True,
        )


def report_dropouts(file: DataflashFile, summary: LogSummary) -> None:
    """Finding on messages that the logger dropped by its own count (DSF.Dp)."""
    rows = file.rows("DSF")
    if rows is None or "Dp" not in rows:
        return
    dropped = int(rows.integers("Dp").max())
    if dropped:
        summary.add(
            ReasonCode.DROPOUTS_LOGGED,
            dropped,
            f"{file.name}: by the logger's own count (DSF.Dp) {dropped} messages could not be written. Log less, or "
            "use a faster card.",
            loses_data=True,
        )


def describe(file: DataflashFile, epoch: Epoch | None, summary: LogSummary) -> list[str]:
    """Firmware, board and date as metadata. Returns the different texts of the log's MSG messages."""
    rows = file.rows("MSG")
    texts = list(dict.fromkeys(rows.texts("Message"))) if rows is not None and rows.has_text("Message") else []
    for text in texts:
        board = BOARD.match(text)
        if FIRMWARE.match(text):
            summary.metadata.setdefault("firmware", text)
        elif board:
            summary.metadata.setdefault("hardware", board["board"])
            summary.metadata.setdefault("board_id", board["id"])
            summary.board_id = summary.metadata["board_id"]
        elif OPERATING_SYSTEM.match(text):
            summary.metadata.setdefault("operating_system", text)
    versions = file.rows("VER")
    if versions is not None and versions.has_text("FWS"):
        summary.metadata.setdefault("firmware", versions.texts("FWS")[0])
    if epoch is not None:
        summary.metadata["epoch"] = (
            f"GPS time less {epoch.leap_s} leap seconds, one offset for the whole log, median of {epoch.fixes} fixes"
        )
    return texts


def report_simulation(file: DataflashFile, texts: list[str], summary: LogSummary, *, expected: bool) -> None:
    """Finding on a log of a simulation (SITL), which says so by its messages or texts."""
    simulated = file.counts().get("SIM", 0)
    named = next((text for text in texts if re.search(r"\bSITL\b", text)), None)
    if simulated:
        tell_simulated(summary, file.name, f"it holds {simulated} messages SIM", expected=expected)
    elif named is not None:
        tell_simulated(summary, file.name, f'its firmware says "{named}"', expected=expected)
