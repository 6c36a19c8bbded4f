"""Processes that stay for the next night of a test session: to start one takes longer than most tests' flights."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import ClassVar

import pytest

from fieldcal.flows import processes

Surroundings = tuple[frozenset[tuple[str, str]], str]


class KeptProcesses(processes.Processes):
    """Those of a former night, where one ran in the same environment and folder; else new ones."""

    idle: ClassVar[list[ProcessPoolExecutor]] = []
    started_in: ClassVar[Surroundings | None] = None

    def __init__(self, number: int) -> None:
        if KeptProcesses.started_in != surroundings():
            end()
            KeptProcesses.started_in = surroundings()
        super().__init__(0)
        while self.idle and len(self.free) < number:
            self.free.append(self.idle.pop())
        while len(self.free) < number:
            self.add()

    def release(self) -> None:
        if KeptProcesses.started_in == surroundings():
            self.idle.extend(self.free)
            self.free.clear()
        super().release()


def surroundings() -> Surroundings:
    """What a process takes from the one that starts it."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    return frozenset(environment.items()), os.getcwd()


def end() -> None:
    """No process waits any more."""
    while KeptProcesses.idle:
        KeptProcesses.idle.pop().shutdown(wait=False, cancel_futures=True)


@contextmanager
def kept() -> Iterator[None]:
    """Nights of this process keep their processes for the next."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "Processes", KeptProcesses)
        yield
    end()
