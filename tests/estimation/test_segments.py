"""Runs of labels and of true values, against counting them one by one."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest

from fieldcal.estimation.segments import begins_run, run_bounds, run_starts, true_runs

LABELS = [
    np.array([3]),
    np.array([1, 1, 1]),
    np.array([0, 1, 2]),
    np.array([5, 5, 2, 5, 5, 5, 0]),  # a label that comes again is another run
    np.array(["b", "b", "a"]),
    np.random.default_rng(4).integers(0, 2, 200),
]


def counted(label: np.ndarray) -> list[tuple[int, int]]:
    """Bounds of runs by `itertools.groupby`."""
    bounds, at = [], 0
    for _, run in groupby(label.tolist()):
        length = len(list(run))
        bounds.append((at, at + length))
        at += length
    return bounds


@pytest.mark.parametrize("label", LABELS)
def test_runs(label: np.ndarray) -> None:
    wanted = counted(label)
    assert run_bounds(label) == wanted
    assert run_starts(label).tolist() == [start for start, _ in wanted]
    assert np.flatnonzero(begins_run(label)).tolist() == [start for start, _ in wanted]


def test_nothing_has_no_runs() -> None:
    assert run_bounds(np.array([])) == []
    assert run_starts(np.array([])).size == 0
    assert true_runs(np.array([], dtype=bool))[0].size == 0


@pytest.mark.parametrize(
    ("mask", "bounds"),
    [
        ([False, False], []),
        ([True], [(0, 1)]),
        ([True, True, False, True], [(0, 2), (3, 4)]),
        ([False, True, False, True, True, False], [(1, 2), (3, 5)]),
    ],
)
def test_true_runs(mask: list[bool], bounds: list[tuple[int, int]]) -> None:
    starts, stops = true_runs(np.array(mask))
    assert list(zip(starts.tolist(), stops.tolist(), strict=True)) == bounds
