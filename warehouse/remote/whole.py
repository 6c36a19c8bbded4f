"""Whether everything that a warehouse by URL holds is what was written there."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from fieldcal.remote.objects import Objects
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.remote.heads import Head, Kept, live_key
from fieldcal.warehouse.remote.known import Gone, fetched, known_head, known_names, objects_of
from fieldcal.warehouse.remote.live import behind_head
from fieldcal.warehouse.remote.signals import listed
from fieldcal.warehouse.sealed import BrokenSeal

Problem = tuple[str, str | None]


def remote_files(root: Path) -> Iterator[Problem]:
    """Every object that a head names, by name, with what is wrong with it, and the live copies; each is read whole.
    Nothing of a warehouse on this machine."""
    objects = objects_of(root)
    if objects is None:
        return
    behind = behind_head(objects)
    for name in known_names(root):
        head = known_head(root, name)
        if head is None:
            continue
        try:
            readings = listed(root, objects, head)
        except (Gone, WarehouseError, BrokenSeal, KeyError, TypeError) as error:
            yield f"readings of {name}", f"their list is damaged ({error})"
            readings = {}
        for one in (*head.files.values(), *readings.values()):
            yield one.key, _wrong(objects, one)
        yield from _live(objects, name, head, name in behind)


def _wrong(objects: Objects, one: Kept) -> str | None:
    try:
        fetched(objects, one)
    except Gone:
        return "it is missing"
    except WarehouseError:
        return "its content is not what was written: the sha256 differs"
    return None


def _live(objects: Objects, name: str, head: Head, behind: bool) -> Iterator[Problem]:
    for table, one in head.files.items():
        key = live_key(name, table)
        found = objects.get(key)
        same = found is not None and hashlib.sha256(found[0]).hexdigest() == one.sha256
        when = "the next night brings it up" if behind else "`fieldcal prune --yes` copies it anew"
        yield key, None if same else f"the live copy is not what the head names; {when}"
