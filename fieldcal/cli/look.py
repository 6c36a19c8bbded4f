"""Before the first night: `fieldcal inspect`, what is in a log, and `fieldcal init`, a first fieldcal.toml."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from fieldcal.cli.options import AsJson, Config, Place, UnusedConfig, UnusedRoot
from fieldcal.words.printable import printable

if TYPE_CHECKING:
    from fieldcal.flight.inspection import Inspection, UnitOnBoard

OK, LOSSES = 0, 3
WIDTH = 80
LABEL = 10


def inspect(log: Place, /, *, as_json: AsJson = False, config: Config = None, warehouse: UnusedRoot = None) -> int:
    """Show what is in a log, and what is unknown or assumed of it. Nothing is calibrated, nothing written.

    Parameters
    ----------
    log
        A log as `calibrate` takes it.
    """
    from dataclasses import asdict

    from fieldcal.cli.show import print_json
    from fieldcal.flight.inspection import inspect_log
    from fieldcal.names import Verdict
    from fieldcal.remote.places import log_at

    found = inspect_log(log_at(log), config)
    if as_json:
        print_json(asdict(found))
    else:
        print("\n".join(map(printable, screen(found))))
    return OK if found.verdict == Verdict.OK else LOSSES


def init(
    archive: Place, /, *, as_json: AsJson = False, config: UnusedConfig = None, warehouse: UnusedRoot = None
) -> int:
    """Write a commented fieldcal.toml for an archive from what lies in it; one that is there is left as it is.

    Parameters
    ----------
    archive
        Folder of logs.
    """
    import shlex

    from fieldcal.cli.show import print_json
    from fieldcal.flight.first_configuration import first_configuration, write_first_configuration
    from fieldcal.remote.places import folder_at
    from fieldcal.words.talk import say

    first = first_configuration(folder_at(archive, "init"))
    if first.logs:
        write_first_configuration(first)
    if as_json:
        told = {"logs": first.logs, "vehicles": first.vehicles}
        print_json({"file": str(first.path) if first.logs else None, **told, "text": first.text})
    elif first.logs:
        print(first.text, end="")
    if not first.logs:
        say(
            f"fieldcal: {archive} holds nothing that is a log by its name (.mcap, .bag, .db3, .ulg, .bin, .csv); "
            f"nothing was written. fieldcal doctor --archive {shlex.quote(str(archive))} names what lies there."
        )
        return LOSSES
    say(
        f"Wrote {first.path}: logs found: {first.logs}, vehicles: {first.vehicles}. Fill in what stands in comments, "
        f"then: fieldcal nightly {shlex.quote(str(archive))} --dry-run"
    )
    return OK


def screen(found: Inspection) -> Iterator[str]:
    """The lines for people, at most 80 wide unless a single word is wider."""
    name = Path(found.path).name
    yield from _told("log", f"{name} ({found.log_format}, {_size(found.size_bytes)}), vehicle {found.vehicle_id}")
    if found.configuration is not None:
        yield f"{'by':{LABEL}}{_that_fits(found.configuration)}"  # in one piece, as it can be copied
    yield from _told("verdict", found.verdict + (f": {found.reason}" if found.reason else ""))
    for finding in found.findings:
        if finding["sentence"] != found.reason:
            yield from _told("finding", finding["sentence"])
    if not found.streams:
        return
    start = "no date" if found.started_at is None else f"{found.started_at[:19].replace('T', ' ')} UTC"
    yield from _told("start", f"{start}; duration {found.duration_s or 0.0:.1f} s")
    yield from _told("clock", str(found.clock))
    yield ""
    yield f"{'signal':14}{'rows':>9}{'rate Hz':>11}{'first s':>12}{'last s':>12}{'longest gap s':>15}"
    for stream in found.streams:
        times = f"{stream.first_s:12.3f}{stream.last_s:12.3f}{_number(stream.longest_gap_s, 15)}"
        yield f"{stream.table:14}{stream.rows:9}{_number(stream.rate_hz, 11)}{times}"
    yield ""
    yield f"{'sensor':14}{'rows':>9}  {'unit':10}{'unit from':15}median length"
    for one in found.sensors:
        if one.rows:
            length = _number(one.median_length, 0)
            yield f"{one.sensor:14}{one.rows:9}  {one.unit:10}{one.unit_from:15}{length}"
        else:
            yield f"{one.sensor:14}{'none':>9}"
    yield ""
    for unit in found.units_on_board:
        rate = _number(unit.rate_hz, 0)
        kind = "primary" if unit.primary else "further unit"
        filtered = ", filtered" if unit.filtered else ""
        corrected = ", corrected by the autopilot" if unit.corrected else ""
        yield from _told(
            "on board", f"{unit.sensor} {unit.unit_id} ({unit.stream}, {rate} Hz): {kind}{filtered}{corrected}"
        )
    for unit in found.units_on_board:
        if unit.primary and unit.corrected:
            yield from _told("applied", _applied(unit))
    frames = ", ".join(f"{one.key} {one.value} ({one.value_from})" for one in found.conventions)
    yield from _told("frames", frames)
    if (field := found.field_used) is not None:
        vector = "" if field.north_east_down is None else " ".join(f"{value:.4g}" for value in field.north_east_down)
        yield from _told("field", f"{field.source}" + (f": {vector} {field.unit}, north east down" if vector else ""))
    for sentence in found.would_do:
        yield from _told("would", sentence)
    if found.settings:
        from fieldcal.flight.first_configuration import vehicle_header

        yield ""
        yield "Unknown or assumed; to settle it, put into fieldcal.toml and correct:"
        yield ""
        yield vehicle_header(found.vehicle_id)
        yield from found.settings


def _that_fits(path: str) -> str:
    """A path; where that is too long for a line, the same from the current directory."""
    return path if LABEL + len(path) <= WIDTH else min(path, os.path.relpath(path), key=len)


def _applied(unit: UnitOnBoard) -> str:
    values = ", ".join(
        f"{name} {value:.0f}" if value.is_integer() else f"{name} {value:.6g}"
        for name, value in unit.parameters.items()
        if not name.endswith("_ID")
    )
    changed = f"; changed {unit.changes} time(s) in the log" if unit.changes else ""
    return f"{unit.sensor} {unit.unit_id}: {values or 'no parameter but such that are 0'}{changed}"


def _told(label: str, text: str) -> list[str]:
    rest = " " * LABEL
    return textwrap.wrap(text, WIDTH, initial_indent=f"{label:{LABEL}}", subsequent_indent=rest, break_long_words=False)


def _number(value: float | None, width: int) -> str:
    return f"{'–' if value is None else f'{value:.4g}':>{width}}"


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f} MB" if size_bytes >= 100_000 else f"{size_bytes / 1e3:.1f} kB"
