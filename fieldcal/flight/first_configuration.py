"""A first `fieldcal.toml` from what lies in an archive.

All that it says of vehicles stands in comments: a unit that one log declares must not be laid over the others. In force
are only the globs of logs that would not be found otherwise.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from glob import escape
from pathlib import Path, PurePosixPath

from fieldcal.config.configuration import Configuration, LogsMap, parse
from fieldcal.config.find import CONFIG_NAME
from fieldcal.errors import FieldcalError
from fieldcal.flight.inspection import FROM_LOG, Inspection, inspect_as
from fieldcal.logs.discovery import LOG_FORMATS, find_logs, inside, log_format
from fieldcal.logs.interface import LogFile
from fieldcal.names import Verdict
from fieldcal.reason_codes import ReasonCode

MOST_LOGS_TRIED = 3
"""Logs of a vehicle that are opened until one can be read."""

HEAD = f"""\
# {CONFIG_NAME}: what the logs cannot say. A line that begins with # holds nothing.
# Check it: fieldcal config check. All keys of a vehicle: fieldcal config show.
"""


@dataclass(frozen=True)
class FirstConfiguration:
    """The file's text, and how many logs of how many vehicles are found with it."""

    path: Path
    text: str
    logs: int
    vehicles: int


def first_configuration(archive: Path) -> FirstConfiguration:
    """What would be written; nothing is.

    Raises
    ------
    FieldcalError
        `no_archive`: there is no such folder. `wrong_option`: it has its fieldcal.toml already.
    """
    if not archive.is_dir():
        raise FieldcalError(ReasonCode.NO_ARCHIVE, f"There is no archive at {archive}.")
    path = archive / CONFIG_NAME
    if os.path.lexists(path):
        raise _there_already(path)
    globs = "\n".join(_archive_table(archive))
    own = parse(globs, path)
    logs = find_logs(archive, own.logs)
    of: dict[str, list[LogFile]] = {}
    for log in logs:
        of.setdefault(log.vehicle_id, []).append(log)
    tables = ["\n".join(_vehicle_table(vehicle, found, own)) for vehicle, found in sorted(of.items())]
    return FirstConfiguration(path, "\n".join([HEAD, *([globs] if globs else []), *tables]), len(logs), len(of))


def write_first_configuration(first: FirstConfiguration) -> None:
    """Write it. Raises FieldcalError (`wrong_option`) where a file has come to be there: it is never overwritten."""
    try:
        with first.path.open("x", encoding="utf-8") as stream:
            stream.write(first.text)
    except FileExistsError as error:
        raise _there_already(first.path) from error


def vehicle_header(vehicle_id: str) -> str:
    """The head of a vehicle's table, whatever its name."""
    return f"[vehicles.{_quoted(vehicle_id)}]"


def _there_already(path: Path) -> FieldcalError:
    return FieldcalError(
        ReasonCode.WRONG_OPTION,
        f"{path} is there already and stays as it is. Check it with fieldcal config check, or move it away.",
    )


def _vehicle_table(vehicle_id: str, logs: list[LogFile], configuration: Configuration) -> Iterator[str]:
    formats = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(log.log_format for log in logs).items()))
    header = f"{vehicle_header(vehicle_id)}  # logs: {formats}"
    yield header
    tried = logs[:MOST_LOGS_TRIED]
    for log in tried:
        found = _looked_at(log, configuration)
        if found is not None:
            yield f"# As {_quoted(log.log_uri)} has it:"
            yield from _as_comments(found)
            break
    else:
        first = _quoted(tried[0].log_uri)
        yield f"# No log can be read of the {len(tried)} that were tried; fieldcal inspect {first} says why."
    yield ""


def _looked_at(log: LogFile, configuration: Configuration) -> Inspection | None:
    try:
        found = inspect_as(log.path, configuration.vehicle(log.vehicle_id))
    except OSError:  # may not be opened
        return None
    return None if found.verdict == Verdict.REJECTED else found


def _as_comments(found: Inspection) -> Iterator[str]:
    for sensor in found.sensors:
        if sensor.unit_from == FROM_LOG:
            yield f'# units.{sensor.sensor} = "{sensor.unit}"  # the log says so'
    for line in found.settings:
        yield line if line.startswith("#") else f"# {line}"
    if found.field_used is not None and not any("field = " in line for line in found.settings):
        yield "# field = { latitude_deg = ?, longitude_deg = ?, altitude_m = 0.0 }  # else where the log was flown"


def _archive_table(archive: Path) -> Iterator[str]:
    """Entries for logs that lie deeper or flatter than `<vehicle>/<session>/<log>`."""
    usual = {log.log_uri for log in find_logs(archive)}
    elsewhere = [uri for uri in _log_uris(archive) if uri not in usual]
    named = [PurePosixPath(uri) for uri in elsewhere if _is_text(uri)]
    if lost := len(elsewhere) - len(named):
        yield f"# Not found by the night, as folder or name is no UTF-8; rename them: {lost} logs.\n"
    entries = list(dict.fromkeys(_entries(archive, named)))
    if not entries:
        return
    yield "[archive]  # logs that do not lie as <vehicle>/<session>/<log>; first match counts"
    yield "# vehicle, session: the outermost and the innermost folder unless given"
    yield "logs = ["
    yield from (f"  {{ {entry} }}," for entry in entries)
    yield "]\n"


def _entries(archive: Path, uris: list[PurePosixPath]) -> Iterator[str]:
    parents_of: dict[tuple[str, str], set[PurePosixPath]] = {}
    for uri in uris:
        parents_of.setdefault((uri.parts[0], uri.parent.name), set()).add(uri.parent)
    known = set(_log_uris(archive))
    for uri in uris:
        last = f"*{_end(archive, uri)}"
        folders = uri.parts[:-1]
        if not folders:
            yield f"glob = {_quoted(last)}, vehicle = {_quoted(archive.resolve().name or 'vehicle')}"
            continue
        if len(folders) == 1 and last == "*":  # the session's folder is its one log
            yield f"glob = {_quoted(escape(str(uri)))}, session = {_quoted(uri.name)}"
            continue
        own = "/".join([*map(escape, folders), last])
        if len(parents_of[uri.parts[0], uri.parent.name]) > 1:  # 2026/05/11 and 2026/06/11 are two sessions
            yield f"glob = {_quoted(own)}, session = {_quoted('-'.join(folders[1:]) or folders[0])}"
            continue
        wide = "/".join([escape(folders[0]), *("*" for _ in folders[1:]), last])
        yield f"glob = {_quoted(wide if _matched(archive, wide) <= known else own)}"


def _matched(archive: Path, glob: str) -> set[str]:
    """The logs that a glob takes: those within a folder that is a log itself would be taken for flights."""
    return {log.log_uri for log in find_logs(archive, [LogsMap(glob=glob)])} & {
        path.relative_to(archive).as_posix() for path in archive.glob(glob)
    }


def _log_uris(archive: Path) -> Iterator[str]:
    """Everything that is a log by its name, at any depth; a folder that is one is not entered."""
    root = archive.resolve()
    for at, folders, files in os.walk(archive):
        folder = Path(at)
        logs = [name for name in sorted(folders) if not name.startswith(".") and _is_log_folder(folder / name)]
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name not in logs)
        named = [name for name in sorted(files) if not name.startswith(".") and _end_of_name(name)]
        for name in (*logs, *named):
            if inside(folder / name, root):
                yield (folder / name).relative_to(archive).as_posix()


def _is_log_folder(path: Path) -> bool:
    try:
        return log_format(path) is not None
    except OSError:  # may not be entered
        return False


def _end(archive: Path, uri: PurePosixPath) -> str:
    """The end of the names that a glob should match; none of a folder."""
    return "" if (archive / uri).is_dir() else _end_of_name(uri.name)


def _end_of_name(name: str) -> str:
    end = next((end for end in LOG_FORMATS if name.lower().endswith(end)), "")
    return name[len(name) - len(end) :]


def _quoted(text: str) -> str:
    """As a TOML string, or for a comment: nothing in it ends the line, and what is no UTF-8 is told by its bytes."""
    text = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _is_text(name: str) -> bool:
    """Whether a name can stand in a UTF-8 file."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
