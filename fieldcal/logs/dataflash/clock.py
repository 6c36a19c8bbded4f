"""Stamps of DataFlash messages, and the date of a log by its GPS."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.dataflash.records import Rows

GPS_EPOCH_S = int(datetime(1980, 1, 6, tzinfo=UTC).timestamp())
WEEK_S = 604_800
LEAP_SECONDS = (
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
    (datetime(2006, 1, 1, tzinfo=UTC), 14),
)
"""How far GPS time is ahead of UTC from when on, the latest first. None has been announced since 2017."""
BEFORE_THOSE_S = 13
NO_LATER_US = 4 * 10**15
"""A boot clock beyond 126 years is damage: it is cut to this, which is far from all others and fits int64 ns."""
LATEST_SAMPLE_NS = 1_000_000_000
"""A message is written at most so long after its sample; an older time of sampling is taken for none."""
LEAST_FIX = 3


@dataclass(frozen=True)
class Epoch:
    """Unix time minus the boot clock, ns: the median over `fixes` GPS messages. `leap_s`: taken off GPS time."""

    offset_ns: int
    fixes: int
    leap_s: int


def stamps_ns(rows: Rows) -> NDArray[np.int64] | None:
    """Time since boot of each message, (n,) ns; None where the messages carry none. Logs before 3.3 have ms."""
    if "TimeUS" in rows:
        stored = rows.stored("TimeUS")
        if stored.dtype.kind == "u":
            return np.minimum(stored.astype(np.uint64), np.uint64(NO_LATER_US)).astype(np.int64) * 1000
        return np.clip(rows.integers("TimeUS"), 0, NO_LATER_US) * 1000
    if rows.layout.name == "GPS" and "T" in rows:  # before 3.3 TimeMS of GPS is GPS time
        return rows.integers("T") * 1_000_000
    return rows.integers("TimeMS") * 1_000_000 if "TimeMS" in rows else None


def sampled_ns(t_ns: NDArray[np.int64], sample_us: NDArray[np.int64], bits: int) -> NDArray[np.int64]:
    """When messages stamped `t_ns` (n,) were sampled, by a counter of µs of so many bits, 32 or 64; where it does not
    say, or says too long ago, the stamp."""
    behind_us = t_ns // 1000 - sample_us
    if bits < 64:
        behind_us = (behind_us + (1 << (bits - 1))) % (1 << bits) - (1 << (bits - 1))
    behind_us = np.clip(behind_us, -LATEST_SAMPLE_NS, LATEST_SAMPLE_NS)  # keeps products within int64
    plausible = (np.abs(behind_us) * 1000 <= LATEST_SAMPLE_NS) & (sample_us > 0)
    return np.where(plausible, t_ns - t_ns % 1000 - behind_us * 1000, t_ns)


def epoch(gps: Rows | None) -> Epoch | None:
    """What the log's GPS says of the date; None without a fix that does."""
    if gps is None:
        return None
    t_ns = stamps_ns(gps)
    week, milliseconds = ("GWk", "GMS") if "GWk" in gps else ("Week", "TimeMS")
    if t_ns is None or not all(name in gps for name in (week, milliseconds, "Status")):
        return None
    weeks, ms = gps.integers(week), gps.integers(milliseconds)
    dated = (gps.integers("Status") >= LEAST_FIX) & (weeks > 0) & (ms < WEEK_S * 1000)
    if not dated.any():
        return None
    gps_ns = (GPS_EPOCH_S + weeks[dated] * WEEK_S) * 10**9 + ms[dated] * 10**6
    leap_s = leap_seconds(int(np.median(gps_ns)))
    ahead = gps_ns - t_ns[dated]
    first = int(ahead[0])  # the median of differences: float64 would round the whole numbers
    return Epoch(first + int(np.median(ahead - first)) - leap_s * 10**9, int(dated.sum()), leap_s)


def leap_seconds(unix_ns: int) -> int:
    """Seconds that GPS time is ahead of UTC at a time; those of 1999 to 2005 at any earlier one too."""
    return next((s for since, s in LEAP_SECONDS if unix_ns >= since.timestamp() * 1e9), BEFORE_THOSE_S)
