"""Runs of equal labels and of true values along the samples: where they begin and end.

`segment` numbers contiguous stretches of a record (`fieldcal`'s conventions); numerics go from run to run of it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np


def begins_run(label: np.ndarray) -> np.ndarray:
    """Which samples differ from the one before, (n,) bool; the first one does."""
    first = np.ones(len(label), dtype=bool)
    first[1:] = label[1:] != label[:-1]
    return first


def run_starts(label: np.ndarray) -> np.ndarray:
    """First sample of each run of equal neighbours in `label` (n,), (runs,) ascending."""
    return np.flatnonzero(begins_run(label))


def run_bounds(label: np.ndarray) -> list[tuple[int, int]]:
    """Samples [start, stop) of each run of equal neighbours in `label` (n,); none of an empty one."""
    return list(pairwise([*run_starts(label).tolist(), len(label)]))


def true_runs(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Starts and stops, each (runs,), of the runs of true values in `mask` (n,): mask[start:stop] is all true."""
    edge = np.flatnonzero(np.diff(np.r_[False, mask, False]))
    return edge[0::2], edge[1::2]
