"""The interval a time lies in: at stamps, between them, outside; and the share of it, against linear interpolation."""

from __future__ import annotations

import numpy as np
from numerics_support import ROUNDING

from fieldcal.geometry.intervals import interval_of, share_of_interval

STAMPS = np.array([0.0, 1.0, 2.5, 3.0])
TIMES = np.array([-1.0, 0.0, 0.5, 1.0, 2.4, 2.5, 3.0, 9.0])


def test_a_stamp_begins_its_interval() -> None:
    assert interval_of(STAMPS, TIMES).tolist() == [0, 0, 0, 1, 1, 2, 2, 2]


def test_a_stamp_ends_its_interval() -> None:
    assert interval_of(STAMPS, TIMES, on_stamp="ends").tolist() == [0, 0, 0, 0, 1, 1, 2, 2]


def test_share_interpolates_as_numpy_does() -> None:
    value = np.array([4.0, -1.0, 0.5, 2.0])
    i = interval_of(STAMPS, TIMES)
    share = share_of_interval(STAMPS, i, TIMES)
    np.testing.assert_allclose(
        value[i] + share * (value[i + 1] - value[i]), np.interp(TIMES, STAMPS, value), atol=ROUNDING
    )


def test_shares_of_both_readings_of_a_stamp() -> None:
    begins, ends = interval_of(STAMPS, STAMPS[1:3]), interval_of(STAMPS, STAMPS[1:3], on_stamp="ends")
    assert share_of_interval(STAMPS, begins, STAMPS[1:3]).tolist() == [0.0, 0.0]
    assert share_of_interval(STAMPS, ends, STAMPS[1:3]).tolist() == [1.0, 1.0]
