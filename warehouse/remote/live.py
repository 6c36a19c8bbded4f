"""Live copies: one Parquet file a vehicle and table under a fixed key, for engines that know nothing of heads.

Each is replaced in one request, so that whoever reads all of them counts no row twice. They follow the heads when a
writer has done its work; where it died before, the next one's work includes its.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from functools import partial

from fieldcal.remote.objects import Listed, Objects
from fieldcal.warehouse.remote.heads import HEADS, LIVE, head_key, live_key, name_of, read_head
from fieldcal.warehouse.remote.known import in_threads

_MOST_ROUNDS = 10
"""Others may publish all the time; they bring up what they do."""


def bring_up(objects: Objects) -> None:
    """Copy the files of every head that is younger than its copies, until none is."""
    done: dict[str, str] = {}
    for _ in range(_MOST_ROUNDS):
        behind = behind_head(objects, done)
        if not behind:
            return
        in_threads(partial(_copy, objects), list(behind.items()))
        done |= {name: tag for name, (tag, _) in behind.items()}


def behind_head(objects: Objects, done: Mapping[str, str] | None = None) -> dict[str, tuple[str, list[str]]]:
    """Vehicles whose copies may be older than their head, by name: the head's tag, and the copies' keys. Of those that
    were `done`, by their tag, only where it is another by now.

    Listings tell whole seconds: what is of the same one is copied once more.
    """
    done = done or {}
    copies: dict[str, list[Listed]] = defaultdict(list)
    for one in objects.listed(LIVE):
        copies[one.key.split("/")[-2].partition("=")[2]].append(one)
    found = {}
    for head in objects.listed(HEADS):
        name = name_of(head.key)
        oldest = min((one.modified for one in copies[name]), default=None)
        older = done[name] != head.e_tag if name in done else oldest is None or oldest <= head.modified
        if older and head.key == head_key(name):
            found[name] = head.e_tag, [one.key for one in copies[name]]
    return found


def _copy(objects: Objects, one: tuple[str, tuple[str, Collection[str]]]) -> None:
    name, (_, copies) = one
    head, _ = read_head(objects, name)
    for table, kept in head.files.items():
        objects.copy(kept.key, live_key(name, table))
    objects.delete(sorted(set(copies) - {live_key(name, table) for table in head.files}))
