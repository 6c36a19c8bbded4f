"""The readings' own noise, while the vehicle moves: third differences of means over a few neighbouring readings.

Motion is smooth and drops out of them; of noise 20 times its variance is left. Means over some 20 ms stand for the
noise at the frequencies that averaging leaves, whatever filter the sensor has behind it.
"""

from __future__ import annotations

import numpy as np

from fieldcal.geometry.rotation import Array

THIRD_DIFFERENCE = 20.0
"""1 + 9 + 9 + 1: variance of third differences over that of the noise."""
FEWEST = 50
"""Differences that make a variance."""
SPAN_S = 0.02
"""Over so long readings are averaged: motion of 1 Hz is still smooth over three of them."""
MOST_IN_MEAN = 16


def readings_in_mean(rate_hz: float) -> int:
    """Readings that are averaged at a rate."""
    return int(np.clip(round(rate_hz * SPAN_S), 1, MOST_IN_MEAN))


class NoiseStream:
    """Sums (3,) of the squared third differences, times the readings in a mean, and their number."""

    def __init__(self, in_mean: int, dtype: np.dtype) -> None:
        if not 1 <= in_mean <= MOST_IN_MEAN:
            raise ValueError(f"1 to {MOST_IN_MEAN} readings are averaged, not {in_mean}")
        self.in_mean = in_mean
        self.dtype = dtype
        self.squares: Array = np.zeros(3)
        self.n_differences = 0
        self.gap()

    def gap(self) -> None:
        """The next reading does not follow on the last."""
        self._pending: Array = np.empty((0, 3), dtype=self.dtype)
        self._last: Array = np.empty((0, 3), dtype=self.dtype)

    def feed(self, x: Array) -> None:
        """Readings (n, 3) that follow on those before."""
        run = np.concatenate([self._pending, x])
        whole = len(run) // self.in_mean
        self._pending = run[whole * self.in_mean :]
        means = run[: whole * self.in_mean].reshape(whole, self.in_mean, 3).mean(axis=1, dtype=self.dtype)
        means = np.concatenate([self._last, means])
        self._last = means[-3:]
        d = (means[3:] - means[:-3]) - self.dtype.type(3.0) * (means[2:-1] - means[1:-2])
        self.squares = self.squares + self.in_mean * np.sum(d * d, axis=0, dtype=np.float64)
        self.n_differences += len(d)

    def merge(self, other: NoiseStream) -> None:
        """Add what another has seen."""
        self.squares = self.squares + other.squares
        self.n_differences += other.n_differences
        self.gap()


def variance_of(squares: Array, differences: int) -> Array | None:
    """Variance (3,) of a reading as averaging sees it; None where there are too few differences."""
    return squares / (THIRD_DIFFERENCE * differences) if differences >= FEWEST else None
