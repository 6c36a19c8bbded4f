"""What stamps say of the clock that made them: wrapped counters, stretches of one clock, stray stamps, pauses.

Stamps are int64 nanoseconds in the order in which they were recorded. A clock is believed where stamps grow. Where
they do not, order alone tells a message that came late (it fills a hole) from a stamp that is wrong (it does not), and
parts of a log that were written in another order (their times do not overlap) from a clock that was set back (they do).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldcal.estimation.segments import run_starts
from fieldcal.geometry.intervals import interval_of

Stamps = NDArray[np.int64]

COUNTER_PERIODS_NS = (2**32 * 1000, 2**32 * 1_000_000)
"""Where 32-bit counters of µs and ms begin again."""

WRAP_PAUSE_NS = 10_000_000_000
"""Longest pause over which a counter may have wrapped."""

FAR_NS = 86_400 * 1_000_000_000
"""A pause of over a day inside a recording is a clock that was set."""

NEAR_NS = 1_000_000_000
"""Stamps this close to those recorded beside them may be those of late messages."""

PAUSE = 10
"""So many intervals without a stamp end a run of recording."""

LONG_RUN = 10
"""So many stamps that grow are a run of recording, fewer are strays."""

INTERLEAVED = 5
"""Runs whose stamps alternate so often in order of time claim the same time."""

HOLE = 1.5
"""Intervals without a stamp that make a hole which a late message can fill."""


AT_ONCE = 1 << 17


class Unwrapper:
    """Adds a counter's period wherever it began again. Feed batches in the order of recording.

    Attributes
    ----------
    wraps : int
        How often the counter began again.
    period_ns : int
        Its period.
    """

    def __init__(self) -> None:
        self.wraps = 0
        self.period_ns = 0
        self._previous: int | None = None

    def __call__(self, t_ns: Stamps) -> Stamps:
        """Stamps that go on growing where the counter began again."""
        if not t_ns.size:
            return t_ns
        previous = np.r_[t_ns[0] if self._previous is None else self._previous, t_ns[:-1]]
        self._previous = int(t_ns[-1])
        step = t_ns - previous
        turns = np.zeros(len(t_ns), dtype=np.int64)
        for period in COUNTER_PERIODS_NS if not self.period_ns else (self.period_ns,):
            inside = (previous >= 0) & (previous < period) & (t_ns >= 0) & (t_ns < period)
            forward = inside & (step < 0) & (step + period <= WRAP_PAUSE_NS)
            # A late message from before the wrap, between two from behind it.
            back = inside & (step > 0) & (period - step <= WRAP_PAUSE_NS) & bool(self.wraps or forward.any())
            turns = forward.astype(np.int64) - back
            if forward.any():
                self.period_ns = period
                break
        total = self.wraps + np.cumsum(turns)
        self.wraps = int(total[-1])
        return t_ns + total * self.period_ns


@dataclass(frozen=True)
class Order:
    """What became of n stamps in the order of recording.

    `wild` (n,): stamps far from those recorded beside them that fill no hole. `stretch` (n,): number of the stretch of
    one clock that a stamp belongs to. `back_ns`: by how much the clock was set back at most, 0 where it was not.
    `far`: how often the stamps jump by over a day.
    """

    wild: NDArray[np.bool_]
    stretch: Stamps
    back_ns: int
    far: int


def suspicious(t_ns: Stamps, previous: int | None, behind: Stamps, n_late: int) -> tuple[bool, int]:
    """Whether a batch of stamps (n,) needs `judge`, and how many at its end grow but lie behind earlier ones.

    `previous`: last stamp of the batch before. `behind` (n,): how far each lies behind the latest before it.
    `n_late`: as returned for the batch before.
    """
    step = np.diff(np.r_[t_ns[0] if previous is None else previous, t_ns])
    ends = np.flatnonzero((behind <= 0) | (step < 0))
    lengths = np.diff(np.r_[-1 - n_late, ends, len(behind)]) - 1
    jumps = bool(step.min() < -NEAR_NS or step.max() > FAR_NS)
    return jumps or int(lengths.max()) >= LONG_RUN, int(lengths[-1])


def judge(t_ns: Stamps, repeated: NDArray[np.bool_]) -> Order:
    """Wild stamps and stretches of one clock among stamps in the order of recording.

    Parameters
    ----------
    t_ns : (n,) int64 array
        Stamps, ns.
    repeated : (n,) bool array
        Rows that repeat an earlier one in every value: a copy says nothing of the clock.
    """
    step = np.diff(t_ns)
    interval = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    run = np.r_[0, np.cumsum((step < 0) | (step > PAUSE * interval))]
    long = np.bincount(run, weights=~repeated) >= LONG_RUN
    if not long.any():
        return Order(np.zeros(len(t_ns), bool), np.zeros(len(t_ns), np.int64), 0, 0)
    sound = long[run] & ~repeated
    breaks, overlap_ns = _set_back(t_ns[sound], run[sound])
    back_ns = overlap_ns + round(interval) if len(breaks) else 0
    runs, start = np.unique(run[sound], return_index=True)
    t = t_ns[sound]
    jumps = t[start[1:]] - t[start[1:] - 1]
    far = runs[1:][np.abs(jumps) > FAR_NS]
    new = np.zeros(len(long), np.int64)
    new[np.r_[breaks, far]] = 1
    wild = _wild(t_ns, ~long[run] & ~repeated)
    return Order(wild, np.cumsum(new)[run], back_ns, len(far))


def _set_back(t_ns: Stamps, run: Stamps) -> tuple[Stamps, int]:
    """Runs before which the clock was set back, and the longest overlap, from stamps (n,) in runs of recording."""
    order = np.argsort(t_ns, kind="stable")
    label = run[order]
    switch = run_starts(label)[1:]
    pair = np.sort(np.stack([label[switch - 1], label[switch]]), axis=0)
    pairs, counts = np.unique(pair, axis=1, return_counts=True)
    pairs = pairs[:, counts >= INTERLEAVED]
    if not pairs.size:
        return np.empty(0, np.int64), 0
    first, last = np.full(int(run.max()) + 1, t_ns.max()), np.full(int(run.max()) + 1, t_ns.min())
    np.minimum.at(first, run, t_ns)
    np.maximum.at(last, run, t_ns)
    overlap = np.minimum(*last[pairs]) - np.maximum(*first[pairs])
    return np.unique(pairs[1]), int(overlap.max())


def _wild(t_ns: Stamps, stray: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Strays among stamps (n,) far from those recorded beside them that neither find a hole nor join an end."""
    wild = np.zeros(len(t_ns), bool)
    rows = np.flatnonzero(stray)
    for some in np.array_split(rows, len(rows) // AT_ONCE + 1):
        beside = t_ns[np.clip(some[:, None] + np.arange(-LONG_RUN, LONG_RUN + 1), 0, len(t_ns) - 1)]
        wild[some] = np.abs(t_ns[some] - np.median(beside, axis=1)) > NEAR_NS
    if not wild.any():
        return wild
    others = np.sort(t_ns[~wild])
    interval = float(np.median(np.diff(others)))
    t = t_ns[wild]
    i = interval_of(others, t, on_stamp="ends")
    inside = (others[0] < t) & (t < others[-1])
    hole = others[i + 1] - others[i] >= HOLE * interval
    beyond = np.maximum(others[0] - t, t - others[-1])
    wild[wild] = np.where(inside, ~hole, beyond > NEAR_NS)
    return wild
