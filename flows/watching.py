"""Who hears of the night's progress, in the process of the flow.

A module of its own, because what a flow's function names is pickled for other processes, and a progress bar cannot be.
"""

from __future__ import annotations

from typing import Protocol

from fieldcal.batch.outcome import Outcome


class Watcher(Protocol):
    """Hears of the night's progress."""

    def planned(self, flights: int, missing: int) -> None: ...
    def done(self, outcome: Outcome) -> None: ...


_watchers: list[Watcher] = []


def watch(watcher: Watcher | None) -> None:
    """Tell this one from now on, and no other."""
    _watchers[:] = [watcher] if watcher is not None else []


def tell_plan(flights: int, missing: int) -> None:
    """The night knows what it has to do."""
    for watcher in _watchers:
        watcher.planned(flights, missing)


def tell_done(outcome: Outcome) -> None:
    """A flight is done."""
    for watcher in _watchers:
        watcher.done(outcome)
