"""Objects that no head names: former versions, and what writers left that died. They go after a grace time."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fieldcal.remote.objects import Objects
from fieldcal.warehouse.remote.heads import GRACE, HANDED_OVER, HEADS, LIVE, OBJECTS, head_key, name_of, read_head
from fieldcal.warehouse.remote.known import objects_of
from fieldcal.warehouse.remote.live import bring_up
from fieldcal.warehouse.remote.signals import listed


@dataclass(frozen=True)
class Garbage:
    """What may go of a warehouse by URL; `files` are keys. Told as what `upkeep.prune` finds."""

    objects: Objects
    files: tuple[str, ...]
    size_bytes: int
    what: str = f"former versions by URL, older than {GRACE.days} days"
    lost: str = "nothing that the history has"

    def remove(self) -> None:
        """Remove them, and make the live copies anew."""
        self.objects.delete(self.files)
        self.objects.delete([one.key for one in self.objects.listed(LIVE)])
        bring_up(self.objects)


def garbage(root: Path, now: datetime | None = None) -> Garbage | None:
    """What may go by `now`; None of a warehouse on this machine.

    Every object was uploaded under a key of its own, so that one which no head names by now is named by none later,
    but for those of writers at work; these are young. Objects are listed before heads are read.
    """
    objects = objects_of(root)
    if objects is None:
        return None
    before = (now or datetime.now(UTC)) - GRACE
    old = [one for prefix in (OBJECTS, HANDED_OVER) for one in objects.listed(prefix) if one.modified < before]
    named: set[str] = set()
    for one in objects.listed(HEADS):
        if one.key == head_key(name := name_of(one.key)):
            head, _ = read_head(objects, name)
            named |= {kept.key for kept in (*head.all_files(), *listed(root, objects, head).values())}
            named |= {key for key, at in head.former.items() if datetime.fromisoformat(at) >= before}
    gone = [one for one in old if one.key not in named]
    return Garbage(objects, tuple(one.key for one in gone), sum(one.size for one in gone))
