"""One signal made tidy: sorted by stamp, one clock, no row twice, one row a stamp, finite readings.

Whatever is left out is counted and told.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from fieldcal.errors import UnreadableLog
from fieldcal.estimation.segments import begins_run
from fieldcal.logs import SIGNAL_COLUMNS, Columns, Finding, batch_frame, stamps
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import signal_kind

SENSOR_TABLES = ("imu", "magnetometer", "vps")
MAY_BE_UNKNOWN = ("px_m", "py_m", "pz_m", "altitude_m", "current_a", "throttle", "velocity_sd_mps")
HELD_ROWS = 1 << 17
WHOLE_ROWS_CAP = 6_000_000
CLOCK_RESET_NS = 1_000_000_000
GAP_NS = 1_000_000_000
MOST_REPEATED = 0.5
PLAUSIBLE_RATE_HZ = (1.0, 50_000.0)
"""At the lower one lie 1 kHz whose milliseconds are read as seconds."""
USUAL_RATE_HZ = (10.0, 10_000.0)
MOST_INTERVALS = 1 << 20
ROUNDED_SHARE, SAME_SIZE_SHARE = 0.1, 0.95
"""Where more rows than the first share repeat a stamp, by groups of which fewer than the second are of one size, stamps
were rounded: two sensors in one table make groups of one size."""


class Disordered(Exception):
    """A row belongs before rows that were handed on already: the log must be tidied as a whole."""


class TidySignal:
    """One signal being tidied. Rows are held back so that small disorder is sorted while streaming.

    Parameters
    ----------
    table : str
        Signal table.
    held_rows : int or None
        How many of the latest rows are held back; None holds all until the end.
    """

    def __init__(self, table: str, held_rows: int | None = HELD_ROWS) -> None:
        self.table = table
        self.rows = self.not_finite = self.duplicates = self.conflicts = self.disordered = 0
        self.wild = self.masked = self.far = self.back_ns = self.gaps = self.longest_gap_ns = 0
        self.rounded = False
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._unwrap = stamps.Unwrapper()
        self._held_rows = held_rows
        self._held: list[pl.DataFrame] = []
        self._n_held = 0
        self._suspicious = False
        self._latest_ns: int | None = None
        self._previous_ns: int | None = None
        self._n_late = 0
        self._intervals = np.empty(0, np.int64)
        self._keep_every = 1

    def add(self, columns: Columns) -> Iterator[pl.DataFrame]:
        """Take a batch; rows that no later one can come before.

        Raises
        ------
        Disordered
            Rows were yielded already that this batch puts in question.
        UnreadableLog
            `too_disordered`: so many rows would have to be held to put them in order.
        """
        frame = self._finite(
            batch_frame(self.table, {**columns, "t_ns": self._unwrap(np.asarray(columns["t_ns"], np.int64))})
        )
        if frame.is_empty():
            return
        t = frame["t_ns"].to_numpy()
        latest = np.maximum.accumulate(t if self._latest_ns is None else np.r_[self._latest_ns, t])
        before = latest[:-1] if self._latest_ns is not None else np.r_[t[0], latest[:-1]]
        behind = np.maximum(before - t, 0)
        self.disordered += int(np.count_nonzero(behind))
        odd, self._n_late = stamps.suspicious(t, self._previous_ns, behind, self._n_late)
        self._suspicious |= odd
        self._latest_ns, self._previous_ns = int(latest[-1]), int(t[-1])
        if self.last_ns is not None and (self._suspicious or int(t.min()) <= self.last_ns):
            raise Disordered(self.table)
        self._held.append(frame)
        self._n_held += len(frame)
        if self._n_held > WHOLE_ROWS_CAP:
            raise UnreadableLog(
                ReasonCode.TOO_DISORDERED,
                f"The stamps of {self.table} are so out of order that more than {WHOLE_ROWS_CAP} rows would have to be "
                "held to sort them. Sort the log, or split it.",
            )
        if self._held_rows is not None and not self._suspicious and self._n_held > 2 * self._held_rows:
            held = pl.concat(self._held).sort("t_ns", maintain_order=True)
            t_ns = held["t_ns"].to_numpy()
            cut = int(np.searchsorted(t_ns, t_ns[-self._held_rows]))
            self._held, self._n_held = [held[cut:]], len(held) - cut
            if cut:
                yield self._one_a_stamp(held[:cut])

    def finish(self) -> Iterator[pl.DataFrame]:
        """The rows still held."""
        if self._n_held:
            held = pl.concat(self._held)
            self._held, self._n_held = [], 0
            if self._suspicious or (self.disordered and self.last_ns is None):
                held = self._of_one_clock(held)
            yield self._one_a_stamp(held.sort("t_ns", maintain_order=True))

    def rate_hz(self) -> float | None:
        """Median rate; None below two samples."""
        if self._intervals.size == 0:
            return None
        return float(1e9 / np.median(self._intervals))

    def _finite(self, frame: pl.DataFrame) -> pl.DataFrame:
        names = [n for n in SIGNAL_COLUMNS[signal_kind(self.table)] if n != "t_ns" and n not in MAY_BE_UNKNOWN]
        whole = frame.filter(pl.all_horizontal(pl.col(names).is_finite().fill_null(True)))
        self.not_finite += len(frame) - len(whole)
        return whole

    def _of_one_clock(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Of all rows, in the order of recording, those of the longest stretch of one clock, without wild stamps."""
        t = frame["t_ns"].to_numpy()
        order = np.argsort(t, kind="stable")
        copy = np.zeros(len(t), dtype=bool)
        copy[order] = self._copies(frame[order])[1]
        judged = stamps.judge(t, copy)
        counts = np.bincount(judged.stretch, weights=~judged.wild & ~copy)
        longest = judged.stretch == int(np.argmax(counts))
        self.wild, self.masked = int(judged.wild.sum()), int((~longest & ~judged.wild & ~copy).sum())
        self.back_ns, self.far = judged.back_ns, judged.far
        kept = longest & ~judged.wild
        self.disordered = int(np.count_nonzero(np.maximum.accumulate(t[kept]) > t[kept]))
        return frame.filter(pl.Series(kept))

    def _copies(self, frame: pl.DataFrame) -> tuple[np.ndarray, np.ndarray]:
        """Of sorted rows: which are the first of their stamp, and which of the others repeat it in every value."""
        t = frame["t_ns"].to_numpy()
        first = begins_run(t)
        copy = np.zeros(len(t), dtype=bool)
        if not first.all():
            leaders = np.flatnonzero(first)[np.cumsum(first) - 1]
            others = np.flatnonzero(~first)
            one, other = frame[leaders[others]], frame[others]
            same = [other[n].eq_missing(one[n]).to_numpy() for n in SIGNAL_COLUMNS[signal_kind(self.table)]]
            copy[others] = np.logical_and.reduce(same)
        return first, copy

    def _one_a_stamp(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Of the sorted rows one of every stamp; the others are counted as copies or contradictions.

        It is the first, but where stamps were rounded: the first of many was read before its stamp, so that all would
        be delayed. There the middle one is kept; of two in the middle, by turns the older and the younger.
        """
        first, copy = self._copies(frame)
        if not first.all():
            conflicts = int(np.count_nonzero(~first & ~copy))
            self.duplicates += int(np.count_nonzero(copy))
            self.conflicts += conflicts
            kept = first
            starts = np.flatnonzero(first)
            sizes = np.diff(np.r_[starts, len(frame)])
            same = np.bincount(sizes).max() / len(sizes)
            if conflicts > ROUNDED_SHARE * len(frame) and same < SAME_SIZE_SHARE and not copy.any():
                kept = np.zeros(len(frame), dtype=bool)
                even = sizes % 2 == 0
                kept[starts + (sizes - 1) // 2 + (even & (np.cumsum(even) % 2 == 0))] = True
                self.rounded = True
            frame = frame.filter(pl.Series(kept))
        self._account(frame["t_ns"].to_numpy())
        return frame

    def _account(self, t: np.ndarray) -> None:
        intervals = np.diff(t if self.last_ns is None else np.r_[self.last_ns, t])
        self.gaps += int(np.count_nonzero(intervals > GAP_NS))
        self.longest_gap_ns = max(self.longest_gap_ns, int(intervals.max(initial=0)))
        self._intervals = np.concatenate([self._intervals, intervals[:: self._keep_every]])
        while self._intervals.size > MOST_INTERVALS:
            self._intervals, self._keep_every = self._intervals[::2], self._keep_every * 2
        self.first_ns = int(t[0]) if self.first_ns is None else self.first_ns
        self.last_ns = int(t[-1])
        self.rows += len(t)

    def findings(self, name: str) -> Iterator[Finding]:
        """What was met, as findings on the log called `name`."""
        table, sensors = self.table, signal_kind(self.table) in SENSOR_TABLES
        yield from self._clock_findings(name)
        if self.not_finite:
            yield Finding(
                ReasonCode.NOT_FINITE,
                self.not_finite,
                f"{name}: {self.not_finite} rows of {table} hold NaN or infinity and were left out.",
                loses_data=sensors,
            )
        if self.conflicts > MOST_REPEATED * (self.rows + self.conflicts):
            yield Finding(
                ReasonCode.CLOCK_STANDS,
                self.conflicts,
                f"{name}: {self.conflicts} of {self.rows + self.conflicts} rows of {table} carry the same time as "
                "another row with other values: the clock stands, or the times were rounded. Export the log again.",
                fatal=sensors,
            )
        elif self.conflicts:
            yield Finding(
                ReasonCode.REPEATED_STAMPS,
                self.conflicts,
                f"{name}: {self.conflicts} rows of {table} repeat a time stamp with other values; "
                + ("the stamps were rounded: the middle one" if self.rounded else "the first")
                + " of each stamp was kept.",
                loses_data=sensors,
            )
        if self.duplicates:
            yield Finding(
                ReasonCode.DUPLICATE_ROWS,
                self.duplicates,
                f"{name}: {self.duplicates} rows of {table} stand in the log twice and were taken once.",
            )

    def _clock_findings(self, name: str) -> Iterator[Finding]:
        table, sensors = self.table, signal_kind(self.table) in SENSOR_TABLES
        if self._unwrap.wraps:
            yield Finding(
                ReasonCode.CLOCK_WRAPPED,
                self._unwrap.wraps,
                f"{name}: the counter behind the stamps of {table} began again {self._unwrap.wraps} time(s) after "
                f"{self._unwrap.period_ns * 1e-9:.3f} s; its period was added.",
            )
        if self.back_ns > CLOCK_RESET_NS:
            yield Finding(
                ReasonCode.CLOCK_RESET,
                self.masked,
                f"{name}: the stamps of {table} step back by {self.back_ns * 1e-9:.3f} s into time "
                f"that is recorded already ({self.masked} rows): the clock was reset. Split the log where it was.",
                fatal=sensors,
            )
        elif self.masked:
            what = f"set back by {self.back_ns * 1e-9:.3f} s" if self.back_ns else "set by more than a day"
            yield Finding(
                ReasonCode.CLOCK_SET,
                self.masked,
                f"{name}: the clock of {table} was {what} during the recording; its longest stretch was kept, "
                f"{self.masked} rows beside it were left out.",
                loses_data=sensors,
            )
        elif self.disordered:
            yield Finding(
                ReasonCode.OUT_OF_ORDER,
                self.disordered,
                f"{name}: {self.disordered} rows of {table} came after later ones and were sorted in.",
            )
        if self.wild:
            yield Finding(
                ReasonCode.WILD_STAMPS,
                self.wild,
                f"{name}: {self.wild} rows of {table} carry times far from those recorded beside them and were left "
                "out.",
                loses_data=sensors,
            )
        rate = self.rate_hz()
        if table == "imu" and rate is not None and not PLAUSIBLE_RATE_HZ[0] < rate <= PLAUSIBLE_RATE_HZ[1]:
            yield Finding(
                ReasonCode.IMPLAUSIBLE_RATE,
                self.rows,
                f"{name}: read as they are, the stamps make the IMU sample at {rate:.4g} Hz{_other_unit(rate)}. "
                "Correct the unit of time (csv.time_unit) or the log.",
                fatal=True,
            )
        elif sensors and self.gaps and rate is not None and rate * GAP_NS * 1e-9 > stamps.PAUSE:
            yield Finding(
                ReasonCode.GAPS,
                self.gaps,
                f"{name}: {table} pauses {self.gaps} time(s) for over {GAP_NS * 1e-9:.0f} s, at the longest for "
                f"{self.longest_gap_ns * 1e-9:.3f} s; nothing is interpolated across.",
            )


def _other_unit(rate_hz: float) -> str:
    """Words on the rate of another unit of time that an IMU may well have."""
    for factor, words in ((1e3, "1000 times finer (ms instead of s)"), (1e6, "10⁶ times finer (us instead of s)")):
        if USUAL_RATE_HZ[0] <= rate_hz * factor <= USUAL_RATE_HZ[1]:
            return f"; were their unit {words}, it would be {rate_hz * factor:.4g} Hz"
    return ""
