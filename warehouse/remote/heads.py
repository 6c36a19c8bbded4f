"""The one object of a vehicle that changes: which immutable objects are its history now."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import uuid4

from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.objects import Objects, Tag
from fieldcal.remote.url import below
from fieldcal.schemas import HISTORY_TABLES
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.sealed import BrokenSeal, unseal

HEADS, OBJECTS, LIVE, HANDED_OVER = "heads", "objects", "tables", "handed-over"
PLACE = re.compile(r"[a-z_]+(\.[0-9]+)?/[A-Za-z0-9%~-][A-Za-z0-9%~._-]*")
"""Of readings: "<table>/<flight>"."""
GRACE = timedelta(days=7)
"""How long what no head names stays: for readers that still read it, and writers that have yet to name it."""


@dataclass(frozen=True)
class Kept:
    """A file as an object."""

    key: str
    sha256: str
    size: int

    @classmethod
    def new(cls, sha256: str, size: int) -> Kept:
        """One that is to be uploaded: under a key that nobody has used, so that no removal of garbage can meet it."""
        return cls(f"{OBJECTS}/{sha256}-{uuid4().hex[:12]}", sha256, size)


@dataclass(frozen=True)
class Head:
    """What a vehicle's history is. `files`: by table; `signals`: the list of its readings; `former`: objects that were
    replaced, and when; `written`: names the very write of this head."""

    vehicle_id: str
    generation: int = 0
    written: str = ""
    files: Mapping[str, Kept] = field(default_factory=dict)
    signals: Kept | None = None
    former: Mapping[str, str] = field(default_factory=dict)

    def next(self, files: Mapping[str, Kept], signals: Kept | None) -> Head:
        """The head that follows this one."""
        now = datetime.now(UTC)
        kept = {one.key for one in (*files.values(), *((signals,) if signals else ()))}
        replaced = {one.key for one in self.all_files()} - kept
        young = {key: at for key, at in self.former.items() if now - datetime.fromisoformat(at) < GRACE}
        former = young | dict.fromkeys(sorted(replaced), now.isoformat())
        return Head(self.vehicle_id, self.generation + 1, uuid4().hex, files, signals, former)

    def all_files(self) -> list[Kept]:
        """Every object that is live."""
        return [*self.files.values(), *((self.signals,) if self.signals else ())]

    def plain(self) -> dict[str, Json]:
        """As plain JSON; `Head.of` is the head again."""
        return {
            "vehicle_id": self.vehicle_id,
            "generation": self.generation,
            "written": self.written,
            "files": {table: [*astuple(one)] for table, one in self.files.items()},
            "signals": None if self.signals is None else [*astuple(self.signals)],
            "former": dict(self.former),
        }

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Head:
        """From plain JSON; tables that a newer release has are passed over."""
        files = {table: Kept(*one) for table, one in plain["files"].items() if table in HISTORY_TABLES}
        signals = None if plain["signals"] is None else Kept(*plain["signals"])
        return cls(plain["vehicle_id"], plain["generation"], plain["written"], files, signals, dict(plain["former"]))


def head_key(name: str) -> str:
    """Key of the head of a vehicle, whose id has this name in paths."""
    return f"{HEADS}/{name}.json"


def live_key(name: str, table: str) -> str:
    """Key of the live copy of a vehicle's table: where a local warehouse has it too."""
    return f"{LIVE}/{table}/vehicle={name}/part.parquet"


def name_of(key: str) -> str:
    """The vehicle's name in a head's key."""
    return key.rpartition("/")[2].removesuffix(".json")


def read_head(objects: Objects, name: str, vehicle_id: str = "") -> tuple[Head, Tag | None]:
    """The head as it is now and its tag; an empty one and None where there is none yet.

    Raises
    ------
    RemoteError, WarehouseError
        `damaged_file`: it is not what was written.
    """
    found = objects.get(head_key(name))
    if found is None:
        return Head(vehicle_id), None
    try:
        return Head.of(unseal(found[0])), found[1]
    except (BrokenSeal, KeyError, TypeError, ValueError, AttributeError) as error:
        told = f"{below(objects.url, head_key(name))} is damaged ({error}); restore an older version of that object."
        raise WarehouseError(ReasonCode.DAMAGED_FILE, told) from error
