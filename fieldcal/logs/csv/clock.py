"""The clock of one CSV file: its time column as nanoseconds that go on growing where a counter began again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fieldcal.logs.csv.time import NANOSECONDS_OF, nanoseconds, sample_numbers, sample_times
from fieldcal.logs.interface import Finding
from fieldcal.reason_codes import ReasonCode

COUNTER_BITS = range(8, 33)
DAY_NS = 86_400 * 1_000_000_000
WEEK_NS = 7 * DAY_NS
WRAP_PAUSE_NS = 10_000_000_000
"""Longest pause over which a clock may have begun again."""
CALENDAR_PAUSE_NS = 600_000_000_000
"""The same over midnight, or the end of the week, which a clock hardly ever meets by chance."""
WRAP_SHARE = 1e-3
"""Longest such pause as a share of the period: a clock that was reset hardly ever looks like a counter's end."""
WRAP_INTERVALS = 8
"""So many intervals may pass in any case."""
ROWS_BEHIND = 8
"""Most of so many rows behind the turn begin again with it."""
RESTART_NS = 1_000_000_000
"""Steps back that are longer are a clock that began again, shorter ones rows that came late."""

Stamps = NDArray[np.int64]


class FileClock:
    """Times of the rows of one CSV file. Feed blocks in the file's order.

    Parameters
    ----------
    unit : str or None
        Unit of the time column (`fieldcal.logs.csv.time`); None: it holds sample numbers at `rate_hz`.
    rate_hz : float or None
        Rate of the rows where there is no unit.
    period_s : float or None
        After which time the clock begins again, where that is known.
    """

    def __init__(self, unit: str | None, rate_hz: float | None, period_s: float | None) -> None:
        self._unit = unit
        self._rate_hz = rate_hz
        # Sample numbers are unwrapped as they are counted: their periods are whole numbers of samples.
        scale = 1e9 if unit else rate_hz or 1.0
        self._known = [round(period_s * scale)] if period_s else _known_periods(unit)
        self._pause = WRAP_PAUSE_NS * scale / 1e9
        self._restart = RESTART_NS * scale / 1e9
        self._second = scale
        self._declared = period_s is not None
        self._period = 0
        self._wraps = 0
        self._last: int | None = None
        self._first: int | None = None
        self._restarted_after: int | None = None
        self._bad_cell: str | None = None

    def times(self, cells: pl.Series) -> tuple[Stamps, NDArray[np.bool_]]:
        """Nanoseconds of each row's time cell, and where they are sound."""
        ticks = nanoseconds(cells, self._unit) if self._unit else sample_numbers(cells)
        sound = ticks.is_not_null().to_numpy()
        if self._bad_cell is None and not sound.all():
            self._bad_cell = cells[int(np.flatnonzero(~sound)[0])]
        t = ticks.fill_null(0).to_numpy().copy()
        if sound.any():
            t[sound] = self._unwrapped(t[sound])
        return (t if self._unit else sample_times(t, self._rate_hz or 1.0)), sound

    @property
    def bad_cell(self) -> str | None:
        """The first cell that is no time."""
        return self._bad_cell

    def findings(self, name: str) -> Iterator[Finding]:
        """What was met, of the file called `name`."""
        if self._wraps:
            yield Finding(
                ReasonCode.CLOCK_WRAPPED,
                self._wraps,
                f"{name}: its clock began again {self._wraps} time(s) after {self._period / self._second:.3f} s; "
                "that was added.",
            )
        elif self._restarted_after is not None and self._first is not None and (self._last or 0) < self._first:
            yield Finding(
                ReasonCode.CLOCK_RESET,
                1,
                f"{name}: its clock begins again near 0 after {self._restarted_after / self._second:.3f} s, which is "
                "the period of no known counter. Give csv.clock_period_s if it is one, else split the log there.",
                fatal=True,
            )

    def _unwrapped(self, t: Stamps) -> Stamps:
        previous = np.r_[t[0] if self._last is None else self._last, t[:-1]]
        self._first = int(t[0]) if self._first is None else self._first
        self._last = int(t[-1])
        step = t - previous
        if not self._period and (step < 0).any():
            self._period = self._found(t, previous, step)
        if not self._period:
            return t
        turns = (step < -self._period // 2).astype(np.int64)
        # A late row from before the turn, between two from behind it.
        turns -= (step > self._period // 2) & (self._wraps + np.cumsum(turns) > 0)
        total = self._wraps + np.cumsum(turns)
        self._wraps = int(total[-1])
        result: Stamps = t + total * self._period
        return result

    def _found(self, t: Stamps, previous: Stamps, step: Stamps) -> int:
        """The period of the counter that began again, 0 where none did."""
        growing = step[step > 0]
        interval = float(np.median(growing)) if growing.size else 0.0
        for period in self._known:
            pause = min(max(WRAP_SHARE * period, WRAP_INTERVALS * interval), self._pause)
            if period in (DAY_NS, WEEK_NS):
                pause = CALENDAR_PAUSE_NS
            slack = period if self._declared else pause
            inside = (previous < period) & (t >= 0) & (step < -period // 2)
            turns = np.flatnonzero(inside & (step + period <= slack))
            if not turns.size:
                continue
            # A row that came late is alone: what follows it goes on where the row before it stood.
            low = t[turns[0] : turns[0] + ROWS_BEHIND] < previous[turns[0]] - period // 2
            if low.mean() > 0.5:
                return period
        restart = np.flatnonzero((step < -self._restart) & (t >= 0) & (t <= WRAP_INTERVALS * interval))
        if restart.size:
            self._restarted_after = int(previous[restart[0]])
        return 0


def _known_periods(unit: str | None) -> list[int]:
    """Periods of counters in ticks of a unit of time (ns), or of sample numbers."""
    if unit is None:
        return [2**bits for bits in COUNTER_BITS]
    if unit == "iso8601":
        return []
    if unit == "time_of_day":
        return [DAY_NS]
    if unit == "s":
        return [
            *(tick * 2**bits for tick in (1000, 1_000_000) for bits in (24, 32)),
            2**16 * 1_000_000,
            DAY_NS,
            WEEK_NS,
        ]
    tick = 10 ** NANOSECONDS_OF[unit]
    return [*(tick * 2**bits for bits in COUNTER_BITS), DAY_NS, WEEK_NS]
