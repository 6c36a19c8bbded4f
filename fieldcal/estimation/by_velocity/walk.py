"""The walk that a triad's noise makes of its integral."""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.joint.problem import Readings
from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.smoothing import fill, lattice
from fieldcal.estimation.statistics import power_density
from fieldcal.geometry.rotation import Array

# Band in which readings are noise, not motion, Hz, and parts whose spectra are averaged, s.
NOISE_HZ, SPECTRUM_S = (10.0, 40.0), 4.0
SHORTEST = 16
"""Of a stretch, in readings."""


def walk_density(readings: Readings, logged: Array, scale: Array) -> float:
    """Density of the random walk, (unit · s)²/s, that a triad's noise makes of its integral, mean of the axes: that of
    its spectrum above the motion, by the longest stretch. 0 of a stretch that is too short."""
    a, b = max(run_bounds(readings.segment), key=lambda bounds: bounds[1] - bounds[0])
    known = a + np.flatnonzero(np.isfinite(logged[a:b]).all(axis=1))
    if len(known) < SHORTEST:
        return 0.0
    index, interval_s = lattice(readings.t[known])
    x = fill(index, logged[known] * scale)
    frequency, density = power_density(x, interval_s, min(len(x), max(SHORTEST, round(SPECTRUM_S / interval_s))))
    low = min(NOISE_HZ[0], 0.5 * frequency[-1])
    band = (frequency >= low) & (frequency <= max(NOISE_HZ[1], low))
    return 0.5 * float(np.mean(np.median(density[band], axis=0)))
