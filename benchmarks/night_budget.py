"""Where a flight's processor time goes in a night, beside what it was at the last release.

    python benchmarks/night_budget.py [--flights 20] [--no-vps] [--keep]

Simulated flights of 40 s at 185 Hz, with a VPS or without, through all steps in this process, without Prefect, then
the night's own work on them: planning it when everything is new and when nothing is, publishing, closing. Seconds of
the processor a flight, the share of all, and the ratio to `night_budget.json`, which `--keep` writes anew. Machines
differ, and one does from hour to hour: a ratio is of both in units of what a plain loop takes on the machine.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fieldcal.batch import steps
from fieldcal.batch.closing import close_night
from fieldcal.batch.flights import one_flight
from fieldcal.batch.night import plan_night, publishings
from fieldcal.flight.threads import one_thread
from fieldcal.report.fitness import Criteria
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.stage_store import StageStore

KEPT = Path(__file__).with_suffix(".json")
LOOP = "a plain loop (not in a night)"
ROUNDS = 5_000_000


class Budget:
    """Seconds of the processor by what they were spent on; what runs inside something else counts there alone."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self._inside: list[float] = []

    @contextmanager
    def on(self, what: str) -> Iterator[None]:
        """Count what the block takes."""
        began = time.process_time()
        self._inside.append(0.0)
        try:
            yield
        finally:
            took = time.process_time() - began
            self.spent[what] += took - self._inside.pop()
            if self._inside:
                self._inside[-1] += took

    def watch(self, holder: Any, name: str, what: Callable[..., str]) -> None:
        """Count what a function takes, under the name that its arguments give."""
        function = getattr(holder, name)

        def counted(*args: Any, **kwargs: Any) -> Any:
            with self.on(what(*args, **kwargs)):
                return function(*args, **kwargs)

        setattr(holder, name, counted)


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--flights", type=int, default=20)
    arguments.add_argument("--no-vps", action="store_true")
    arguments.add_argument("--keep", action="store_true")
    given = arguments.parse_args()
    budget = Budget()
    budget.watch(steps, "run_stage", lambda stage, *_: f"mathematics: {stage.name}")
    budget.watch(steps, "read_log", lambda *_, **__: "read the log, write readings")
    for name in ("save", "load", "complete", "latest"):
        budget.watch(StageStore, name, lambda *_, **__: "cache of stages")
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        loop_s = _loop()
        archive, root = Path(folder) / "archive", Path(folder) / "data"
        with budget.on("simulate (not in a night)"):
            flown = Experiment(seed=1, dip_rad=np.radians(60.0), translation_rms_mps2=0.1, vps=not given.no_vps)
            write_flights(archive, flown, sessions=given.flights)
        plan_night(archive, root)  # parses the source, once a process
        with budget.on("plan, everything new"):
            night = plan_night(archive, root)
        with budget.on("keys and all else of the steps"):
            outcomes = [one_flight(root, job, night.configuration) for job in night.missing()]
        with budget.on("publish"):
            for publishing in publishings(night, outcomes):
                publishing.publish()
            night.remember(outcomes)
        with budget.on("trends, report"):
            close_night(root, Criteria.of(night.configuration))
        with budget.on("plan, nothing new"):
            again = plan_night(archive, root)
        assert len(again.plan.done) == given.flights
        loop_s += _loop()
        logs = sum(path.stat().st_size for path in archive.rglob("*.mcap"))
        kept = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
    kind = "without a VPS" if given.no_vps else "with a VPS"
    every: dict[str, dict[str, float]] = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    each, before = {what: spent / given.flights for what, spent in budget.spent.items()}, every.get(kind, {})
    slower = loop_s / before[LOOP] if before else 1.0
    print(f"{'ms a flight':>12} {'share':>6} {'÷ before':>9}")
    for what, spent in sorted(each.items(), key=lambda item: -item[1]):
        ratio = f"{spent / before[what] / slower:9.2f}" if before.get(what) else " " * 9
        print(f"{1e3 * spent:12.2f} {100 * spent / _whole(each):5.1f}% {ratio}  {what}")
    ratio = f"{_whole(each) / _whole(before) / slower:9.2f}" if before else " " * 9
    print(f"{1e3 * _whole(each):12.2f}        {ratio}  all of a night but Prefect and the start of its processes")
    print(f"warehouse {kept / given.flights / 1e6:.2f} MB a flight, {100 * kept / logs:.0f} % of its log")
    if given.keep:
        every[kind] = {what: round(spent, 6) for what, spent in each.items()} | {LOOP: loop_s}
        KEPT.write_text(json.dumps(every, indent=1) + "\n")


def _loop() -> float:
    """Seconds of a plain loop: how fast the machine is just now."""
    began, total = time.process_time(), 0
    for i in range(ROUNDS):
        total += i
    return time.process_time() - began


def _whole(each: Mapping[str, float]) -> float:
    return sum(spent for what, spent in each.items() if "not in" not in what)


if __name__ == "__main__":
    main()
