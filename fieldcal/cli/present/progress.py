"""Progress of a night on the terminal. Imports little: Prefect's server starts while the rest is imported."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

from fieldcal.words.printable import printable
from fieldcal.words.talk import say

if TYPE_CHECKING:
    from rich.progress import Progress

    from fieldcal.batch.outcome import Outcome


class NightProgress:
    """Tells of each flight as it is done: a bar with the time remaining on a terminal, else a line a log, on stderr."""

    def __init__(self) -> None:
        self._bar: Progress | None = None
        self._total = 0
        self._done = 0

    def planned(self, flights: int, missing: int, done: int) -> None:
        """The night knows what it has to do; of `done` flights it hears nothing more."""
        self._total, self._done = flights, done
        say(f"{flights} logs, {missing} of them new or changed")
        if sys.stderr.isatty() and missing:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            name = TextColumn("{task.description}", markup=False)
            columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), name)
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.add_task("", total=flights, completed=done)
            self._bar.start()

    def done(self, outcome: Outcome) -> None:
        """A flight is done."""
        self._done += 1
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], advance=1, description=printable(outcome.job.log_uri))
        elif outcome.ran:
            from fieldcal.batch.outcome import cause

            facts = outcome.facts
            why = f" ({facts['reason_code']})" if facts["reason_code"] else ""
            reasons = cause({step: outcome.why.get(step) for step in outcome.ran})
            what = f"{facts['verdict']}{why}, {len(outcome.ran)} stages run ({reasons})"
            say(f"[{self._done}/{self._total}] {outcome.job.log_uri}: {what}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
