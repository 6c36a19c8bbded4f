"""No log takes more time or memory than it may: a process of its own sees to it, and what it ended is not tried again.

A log whose process was ended leaves a note in the warehouse (`night/ended/`), by which whoever takes up its batch, and
every later night, rejects it unseen: until its limits, its vehicle's configuration, its content or the code change.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from fieldcal.batch.limits import watchdog
from fieldcal.config.configuration import Limits, Vehicle
from fieldcal.flight.job import Job
from fieldcal.provenance.run_key import code_digest
from fieldcal.warehouse.layout import encode_id
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal

UNITS = {"seconds": "s", "cpu_seconds": "s of the processor", "memory_mb": "MB of memory"}
"""Of each limit."""


def why_ended(root: Path, job: Job, vehicle: Vehicle, limits: Limits) -> str | None:
    """Why a log is not to be tried: a try under these very circumstances was ended. None: nothing of the kind."""
    try:
        note = unseal(_place(root, job.flight_id).read_bytes())
    except (OSError, BrokenSeal):
        return None
    return str(note["why"]) if note.get("of") == _circumstances(job, vehicle, limits) else None


def notes(root: Path, flight_ids: Iterable[str]) -> frozenset[tuple[str, int]]:
    """The notes about these flights, with when they were written: more than before means that one was ended since."""
    found = set()
    for flight_id in flight_ids:
        try:
            found.add((flight_id, _place(root, flight_id).stat().st_mtime_ns))
        except OSError:
            continue
    return frozenset(found)


class Watch:
    """Has this process ended when a log takes more than its limits; for a process that can be spared.

    Logs of several threads come one after another: what they take could not be told apart.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._dog: subprocess.Popen[bytes] | None = None
        self._work = 0

    @contextmanager
    def over(
        self, root: Path, job: Job, vehicle: Vehicle, limits: Limits, spent: Mapping[str, float]
    ) -> Iterator[Callable[[str], None]]:
        """Watch the work on a log within the block; call what it gives with the name of each step that begins. What was
        `spent` on the log before, by the name of its limit, counts."""
        with self._lock:
            self._work += 1
            circumstances = _circumstances(job, vehicle, limits)

            def begins(step: str) -> None:
                told = {
                    name: (
                        most - spent.get(name, 0.0),
                        seal({"of": circumstances, "why": _sentence(job, name, most, step)}).decode(),
                    )
                    for name, most in limits.model_dump().items()
                }
                self._tell({"work": self._work, "place": str(_place(root, job.flight_id)), "limits": told})

            try:
                yield begins
            finally:
                self._tell({})

    def _tell(self, what: dict[str, object]) -> None:
        line = json.dumps(what).encode() + b"\n"
        for _ in range(2):
            if self._dog is None or self._dog.poll() is not None:
                program = [sys.executable, "-I", "-S", watchdog.__file__, str(os.getpid())]
                self._dog = subprocess.Popen(program, stdin=subprocess.PIPE, bufsize=0)
            assert self._dog.stdin is not None
            try:
                self._dog.stdin.write(line)
                return
            except BrokenPipeError:  # somebody killed it
                self._dog.wait()


WATCH = Watch()
"""Of this process."""


def _place(root: Path, flight_id: str) -> Path:
    return root / "night" / "ended" / f"{encode_id(flight_id)}.json"


def _circumstances(job: Job, vehicle: Vehicle, limits: Limits) -> str:
    """Digest of all that may make another try end otherwise."""
    parts = (job.log_uri, job.sha256, code_digest(), vehicle.model_dump_json(), limits.model_dump_json())
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _sentence(job: Job, limit: str, most: float, step: str) -> str:
    return (
        f"{job.log_uri} took more than the {most:g} {UNITS[limit]} that a log may take (limits.{limit}) and was ended "
        f"in step {step}. It is tried again when the limits, its vehicle's configuration or fieldcal change: raise "
        f"limits.{limit} if the log is sound, else take it out of the archive."
    )
