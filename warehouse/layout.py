"""Where things lie below the data root, and how ids become names of files that cannot leave it.

An id (of a vehicle, a flight, a stage) may be any text. In a path every byte outside `A-Z a-z 0-9 . _ -` is
percent-encoded, and so is a leading dot or underscore (engines skip such files). The empty id has Hive's name for it.
A name beyond 150 bytes is cut and ends in `~` and a digest; the exact id is then in the table's column only.
"""

from __future__ import annotations

import hashlib
import os
import re
import string
from pathlib import Path

from fieldcal.schemas import HISTORY_TABLES, SIGNAL_TABLES, signal_kind
from fieldcal.warehouse.errors import disk

_PLAIN = frozenset(f"{string.ascii_letters}{string.digits}._-".encode())
_AS_IT_IS = re.compile(r"[A-Za-z0-9-][A-Za-z0-9._-]{0,149}")
_EMPTY = "__HIVE_DEFAULT_PARTITION__"
_LONGEST = 150
_CUT = 100
SIGNAL_PARTITION = "vehicle_id="
"""Of files that do not hold the id."""
PARTITION, FORMER_PARTITION = "vehicle=", "vehicle_id="
"""Of the history, whose files have the column vehicle_id: engines that take a folder's name for a column guess its
type, and fail where the file has a column of that name and another type. `fieldcal upgrade` renames former folders."""
LOCK = ".lock-"
SITE = "site"
"""Folder of the pages below the data root; `night/site` remembers what they were made from."""


def encode_id(text: str) -> str:
    """Name of a file or folder for an id: one path component, never `.` or `..`, at most 150 bytes."""
    if _AS_IT_IS.fullmatch(text):
        return text
    raw = text.encode("utf-8", "surrogatepass")
    if not raw:
        return _EMPTY
    parts = [chr(byte) if byte in _PLAIN else f"%{byte:02X}" for byte in raw]
    if raw[:1] in (b".", b"_"):
        parts[0] = f"%{raw[0]:02X}"
    name = "".join(parts)
    if len(name) <= _LONGEST:
        return name
    kept = ""
    for part in parts:
        if len(kept) + len(part) > _CUT:
            break
        kept += part
    return f"{kept}~{hashlib.sha256(raw).hexdigest()[:32]}"


def decode_id(name: str) -> str | None:
    """The id that `encode_id` turned into `name`; None when the name is a shortened one."""
    if name == _EMPTY:
        return ""
    if "~" in name:
        return None
    raw = bytearray()
    position = 0
    while position < len(name):
        if name[position] == "%":
            raw += bytes.fromhex(name[position + 1 : position + 3])
            position += 3
        else:
            raw += name[position].encode()
            position += 1
    return raw.decode("utf-8", "surrogatepass")


def signal_path(root: Path, table: str, vehicle_id: str, flight_id: str) -> Path:
    """File of one flight's readings."""
    _known(signal_kind(table), SIGNAL_TABLES)
    return root / "signals" / table / f"{SIGNAL_PARTITION}{encode_id(vehicle_id)}" / f"{encode_id(flight_id)}.parquet"


def history_path(root: Path, table: str, vehicle_id: str) -> Path:
    """File of one vehicle's history: where it lies, or will."""
    _known(table, HISTORY_TABLES)
    name = encode_id(vehicle_id)
    path, former = (
        root / "tables" / table / f"{prefix}{name}" / "part.parquet" for prefix in (PARTITION, FORMER_PARTITION)
    )
    return former if former.exists() and not path.exists() else path


def stage_folder(root: Path, stage: str, flight_id: str, run_key: str) -> Path:
    """Folder of one execution of one stage."""
    return root / "stages" / encode_id(stage) / encode_id(flight_id) / encode_id(run_key)


def history_files(root: Path, table: str) -> list[Path]:
    """Files of a history table, one a vehicle, in a fixed order."""
    _known(table, HISTORY_TABLES)
    found = {
        (vehicle_name(path), path.name): path
        for prefix in (FORMER_PARTITION, PARTITION)
        for path in (root / "tables" / table).glob(f"{prefix}*/*.parquet")
    }
    return [found[place] for place in sorted(found)]


def signal_files(root: Path, table: str) -> list[Path]:
    """Files of a signal table, one a flight, in a fixed order."""
    _known(signal_kind(table), SIGNAL_TABLES)
    return sorted((root / "signals" / table).glob(f"{SIGNAL_PARTITION}*/*.parquet"))


def vehicle_of(path: Path) -> str | None:
    """Vehicle whose folder `path` lies in; None where the name is shortened."""
    return decode_id(vehicle_name(path))


def under(prefix: str, path: Path) -> Path:
    """Where a file of the history lies whose folders are named by `prefix`."""
    return path.parent.with_name(prefix + vehicle_name(path)) / path.name


def vehicle_name(path: Path) -> str:
    """The vehicle's id as it stands in the name of the folder that a file lies in."""
    return path.parent.name.partition("=")[2]


def checksum_path(root: Path, path: Path) -> Path:
    """Where the recorded sha256 of `path` (below `root`) is kept: a tree of its own, so data folders hold data only."""
    return root / "checksums" / path.relative_to(root).with_name(path.name + ".json")


def lock_path(root: Path, vehicle_id: str) -> Path:
    """Lock that guards the publishing of a vehicle."""
    return root / f"{LOCK}{encode_id(vehicle_id)}"


def prepare(root: Path) -> None:
    """Make the data root: ignored by git, its cache of stages readable by its owner only."""
    with disk(root, "prepared"):
        if not root.is_dir():
            root.mkdir(parents=True, exist_ok=True)
        ignore = root / ".gitignore"
        if not ignore.exists():
            ignore.write_text("*\n", encoding="ascii")
        stages = root / "stages"
        if not stages.is_dir():
            stages.mkdir(mode=0o700, exist_ok=True)
        if stages.stat().st_mode & 0o077:
            os.chmod(stages, 0o700)


def _known(table: str, tables: tuple[str, ...]) -> None:
    if table not in tables:
        raise ValueError(f"there is no table {table!r} here; there are {', '.join(tables)}")
