"""What a local copy of a warehouse knows: whose copy it is, and which heads it follows."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar, cast

from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.cache import WAREHOUSES, origin
from fieldcal.remote.objects import Objects
from fieldcal.remote.url import below
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.remote.heads import HEADS, Head, Kept, name_of
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

T = TypeVar("T")
AT_ONCE = 8
"""Requests under way together."""


class Gone(Exception):
    """An object that a head named is not there: what the head names now is."""

    def __init__(self, key: str) -> None:
        super().__init__(key)
        self.key = key


def objects_of(root: Path) -> Objects | None:
    """The object store of which a root is the copy; None of a warehouse on this machine."""
    found = origin(WAREHOUSES, root)
    return None if found is None or found[0] != root else Objects(found[1])


def known(root: Path, name: str) -> tuple[Head, str] | None:
    """The head that the copy follows, and its tag; None of a vehicle that it knows nothing of."""
    try:
        told = unseal(_place(root, name).read_bytes())
        return Head.of(cast(Mapping[str, Any], told["head"])), str(told["e_tag"])
    except (OSError, BrokenSeal, KeyError, TypeError, ValueError):
        return None


def known_head(root: Path, name: str) -> Head | None:
    """The head alone."""
    found = known(root, name)
    return None if found is None else found[0]


def known_names(root: Path) -> list[str]:
    """Vehicles of which the copy follows a head, by their names in paths."""
    return sorted(name_of(path.name) for path in (root / "remote" / HEADS).glob("*.json"))


def know_head(root: Path, name: str, head: Head, e_tag: str | None) -> None:
    """Remember the head that the copy follows; without a tag there is none."""
    if e_tag is None:
        _place(root, name).unlink(missing_ok=True)
    else:
        write_bytes(_place(root, name), seal({"e_tag": e_tag, "head": head.plain()}), durable=False)


def fetched(objects: Objects, one: Kept) -> bytes:
    """The content of an object, held against its sha256.

    Raises
    ------
    Gone
        It is not there.
    RemoteError, WarehouseError
        `damaged_file`, or the store's refusal.
    """
    found = objects.get(one.key)
    if found is None:
        raise Gone(one.key)
    if hashlib.sha256(found[0]).hexdigest() != one.sha256:
        told = f"{below(objects.url, one.key)} is damaged: its sha256 differs. Restore it, or a whole copy of it."
        raise WarehouseError(ReasonCode.DAMAGED_FILE, told)
    return found[0]


def in_threads(do: Callable[[T], object], over: Iterable[T]) -> None:
    """Some requests at a time; the first error is raised."""
    with ThreadPoolExecutor(AT_ONCE) as threads:
        for _ in threads.map(do, over):
            pass


def _place(root: Path, name: str) -> Path:
    return root / "remote" / HEADS / f"{name}.json"
