"""How much wider sd are, against what each row does to dense least squares; what of the prior is the record's."""

from __future__ import annotations

import numpy as np
from rows_by_velocity import dense, drawn_rows

from fieldcal.estimation.by_velocity.equations import solve
from fieldcal.estimation.by_velocity.problem import layout_of
from fieldcal.estimation.by_velocity.spread import wider, with_what_belongs
from fieldcal.estimation.statistics import BLOCKS

KNOTS, P = 60, 4


def test_sd_are_wider_by_what_blocks_of_time_do_to_dense_least_squares() -> None:
    rng = np.random.default_rng(4)
    rows = drawn_rows(rng, KNOTS, P)
    weight = [rng.uniform(0.3, 1.0, one.residual.shape) for one in rows]
    nothing = np.zeros(P)
    # Further off than their noise for a while.
    for one in rows:
        one.residual[:] *= np.where((one.knot > 20) & (one.knot < 30), 4.0, 0.5)[:, None]
    signs = [np.ones_like(one.residual) for one in rows]
    solved = solve(rows, weight, KNOTS, (0.3 * np.eye(P), nothing), nothing, signs)
    offset = 100.0 + 50.0 * np.arange(KNOTS)
    found = wider(rows, weight, solved, offset)

    a, b, _ = dense(rows, weight, KNOTS)
    known = np.diag(np.r_[np.tile([1e-2] * 3 + [1e-6] * 3, KNOTS), np.full(P, 0.3)])
    inverse = np.linalg.inv(a.T @ a + known)[-P:]
    knot = np.concatenate([np.repeat(one.knot, one.residual.shape[1]) for one in rows])
    # Sums over blocks of neighbours, as `variance_by_blocks` forms them.
    moved = (inverse @ (a * -b[:, None]).T).T
    length = (offset[knot.max()] - offset[0]) / BLOCKS
    block = np.floor((offset[knot] - offset[0]) / length).astype(int)
    total = np.array([moved[block == k].sum(axis=0) for k in np.unique(block)])
    variance = len(total) * np.var(total, axis=0, ddof=1)
    expected = np.sqrt(np.maximum(1.0, variance / np.diagonal(inverse[:, -P:])))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert (found > 1.0).any()
    assert (found == 1.0).any()


def test_what_is_known_of_the_triads_is_not_the_records() -> None:
    values = {"gyroscope": np.zeros(6), "drift": np.zeros(3), "accelerometer": np.zeros(6), "lag": np.zeros(1)}
    layout = layout_of(values)
    rng = np.random.default_rng(1)
    own, known = ((rng.normal(size=(16, 16)), rng.normal(size=16)) for _ in range(2))
    information, pull = with_what_belongs(layout, own, known)
    beside = np.r_[6:9, 15]
    expected, expected_pull = own[0].copy(), own[1].copy()
    expected[np.ix_(beside, beside)] += known[0][np.ix_(beside, beside)]
    expected_pull[beside] += known[1][beside]
    np.testing.assert_array_equal(information, expected)
    np.testing.assert_array_equal(pull, expected_pull)
