"""Noise levels against the dense hat matrix and closed forms; outliers' weights; colour of what does not change."""

from __future__ import annotations

import numpy as np
import pytest
from rows_by_velocity import dense, drawn_rows

from fieldcal.estimation.by_velocity.equations import (
    FIELD,
    GROUPS,
    LEVEL,
    PUSH,
    STATES,
    TURN,
    VERTICAL,
    Rows,
    Solved,
    solve,
)
from fieldcal.estimation.by_velocity.levels import (
    by_group,
    colour,
    colours,
    growth,
    left_over,
    renewed,
    robust_weights,
)
from fieldcal.estimation.by_velocity.problem import Levels
from fieldcal.geometry.rotation import Array

KNOTS, P = 9, 5
RTOL = 1e-9


def solved_rows(seed: int) -> tuple[list[Rows], list[Array], list[Array], Solved]:
    rng = np.random.default_rng(seed)
    rows = drawn_rows(rng, KNOTS, P)
    weight = [rng.uniform(0.3, 1.0, one.residual.shape) for one in rows]
    signs = [rng.choice([-1.0, 1.0], one.residual.shape) for one in rows]
    nothing = np.zeros(P)
    return rows, weight, signs, solve(rows, weight, KNOTS, (0.3 * np.eye(P), nothing), nothing, signs)


def test_what_is_left_is_what_the_dense_hat_matrix_leaves() -> None:
    """A probe z of a group: its freedom is zᵀ(1 − H)z less what weights take, its information |(1 − H)z|² there."""
    rows, weight, signs, solved = solved_rows(1)
    after, square, free, information = left_over(rows, weight, signs, solved)
    a, b, group = dense(rows, weight, KNOTS)
    known = np.diag(np.r_[np.tile([1e-2] * 3 + [1e-6] * 3, KNOTS), np.full(P, 0.3)])
    hat = a @ np.linalg.solve(a.T @ a + known, a.T)
    left = (np.eye(len(b)) - hat) @ -b
    np.testing.assert_allclose(np.concatenate([own.ravel() for own in after]), left, rtol=1e-6, atol=1e-7)
    sign, w = (np.concatenate([own.ravel() for own in parts]) for parts in (signs, weight))
    for kind in GROUPS:
        at = group == kind
        kept = (sign - hat @ np.where(at, sign, 0.0))[at]
        assert square[kind] == pytest.approx(np.sum(left[at] ** 2), rel=1e-6)
        assert free[kind] == pytest.approx(sign[at] @ kept - np.sum(1.0 - w[at]), rel=1e-6)
        assert information[kind] == pytest.approx(kept @ kept, rel=1e-6)


@pytest.mark.parametrize(
    ("square", "logarithm"),
    [
        (50.0, 0.0),  # as large as it should be
        (70.0, 0.5),  # (70 − 50)/40
        (150.0, 1.5),  # the most in an iteration, for 2.5
        (25.0, np.log(0.5)),  # further down than −25/40
        (48.0, -2.0 / 40.0),  # further down than log 0.96
        (5.0, -1.5),  # the most, for log 0.1
    ],
)
@pytest.mark.parametrize("damping", [1.0, 0.5])
def test_a_variance_grows_by_newtons_step_in_its_logarithm(square: float, logarithm: float, damping: float) -> None:
    found = growth(np.array([1.0, square]), np.array([1.0, 50.0]), np.array([1.0, 40.0]), damping)
    np.testing.assert_allclose(found, [1.0, np.exp(damping * logarithm)], rtol=RTOL)


def white(square: Array, old: Levels) -> tuple[list[Rows], list[Array], list[Array], Solved]:
    """Rows of which nothing is to be estimated, each as far off as √`square` (5,) of its group says."""
    knots, sizes = 8, ((TURN,) * 3 + (PUSH,) * 3, (LEVEL, LEVEL, VERTICAL), (FIELD,) * 3)
    variance = by_group(old) * np.r_[1.0, 1.0, old.colour]
    rows = []
    for group in sizes:
        shape = (knots, len(group))
        off = np.sqrt((square * variance)[list(group)]) * np.ones(shape)
        zero = np.zeros((*shape, STATES))
        each = variance[list(group)] * np.ones(shape)
        rows.append(Rows(off, zero, None, np.zeros((*shape, 1)), np.arange(knots), each, group))
    ones = [np.ones_like(one.residual) for one in rows]
    nothing = Solved(
        np.zeros(1), np.zeros((knots, 6)), np.eye(1), np.eye(1), np.zeros(1),
        (np.zeros((1, 5)), np.zeros((knots, 6, 5))), np.zeros((knots, 6, 1)),
    )  # fmt: skip
    return rows, ones, ones, nothing


OLD = Levels(2.0, 3.0, np.array([0.5, 0.7]), 11.0, np.array([1.0, 2.0, 3.0]))


def test_levels_of_rows_that_nothing_is_estimated_from_are_their_mean_squares() -> None:
    """In one step down; rows were as heavy as coloured ones, so that their squares are so many times as large."""
    share = np.array([0.5, 0.6, 0.7, 0.9, 0.8])
    new, change = renewed(OLD, np.zeros(5), 1.0, *white(share / np.r_[1.0, 1.0, OLD.colour], OLD), np.arange(8.0))
    np.testing.assert_allclose(by_group(new), by_group(OLD) * share, rtol=RTOL)
    np.testing.assert_array_equal(new.colour, 1.0)  # too few to tell
    assert change == pytest.approx(0.5)


def test_no_level_falls_below_its_least() -> None:
    least = by_group(OLD) * np.array([0.8, 0.9, 0.75, 0.95, 0.85])
    new, change = renewed(OLD, least, 1.0, *white(np.full(5, 0.1), OLD), np.arange(8.0))
    np.testing.assert_allclose(by_group(new), least, rtol=RTOL)
    assert change == pytest.approx(0.25)


def test_a_group_without_rows_keeps_its_level_and_a_change_counts_in_sd_where_little_is_known() -> None:
    """One epoch: its vertical velocity, whose square is twice as large as it should be, has a logarithm of sd √2."""
    rows, *_, solved = white(np.array([1.0, 1.0, 0.9, 1.0, 1.0]), OLD)
    one = [Rows(r.residual[:1], r.here[:1], None, r.theta[:1], r.knot[:1], r.variance[:1], r.group) for r in rows[:2]]
    ones = [np.ones_like(r.residual) for r in one]
    new, change = renewed(OLD, np.zeros(5), 1.0, one, ones, ones, solved, np.arange(8.0))
    assert new.field == OLD.field
    np.testing.assert_allclose(new.receiver, OLD.receiver * [0.9, np.e], rtol=RTOL)
    assert change == pytest.approx(np.expm1(1.0) * np.sqrt(0.5))


def test_weights_fall_with_the_fourth_power_beyond_four_sd() -> None:
    """Of lengths by the median one, which is 1.538 of three normal numbers."""
    links, *_ = drawn_rows(np.random.default_rng(2), 8, 1)
    lengths = np.array([0.0, 1.0, 1.0, 2.6, 2.602, 5.2, 1.0, 0.5])
    sd = np.outer([1.0, 3.0, 0.5, 2.0, 1.0, 0.2, 5.0, 1.0], [1.0, 2.0, 4.0])
    way = np.array([2.0, 1.0, -2.0]) / 3.0
    size = 7.0 * lengths[:, None] * way * sd
    receiver = Rows(size, links.here, None, links.theta, np.arange(8), sd**2, (LEVEL, LEVEL, VERTICAL))
    of_links, found = robust_weights([links, receiver])
    np.testing.assert_array_equal(of_links, np.ones(links.residual.shape))
    distance = 1.538 * lengths
    expected = np.where(distance > 4.0, (4.0 / np.maximum(distance, 1.0)) ** 4, 1.0)
    np.testing.assert_allclose(found, np.repeat(expected[:, None], 3, axis=1), rtol=RTOL)
    assert np.count_nonzero(expected < 1.0) == 2


def steady(rows: int, lags: int) -> float:
    """Density of `rows` equal residuals: Σ over lags k up to `lags`, tapered, of (rows − k)/rows."""
    k = np.arange(1, lags + 1)
    return float(1.0 + 2.0 * np.sum((1.0 - k / (lags + 1)) * (rows - k) / rows))


@pytest.mark.parametrize(
    ("rows", "interval_s", "lags"),
    [(100, 0.25, 12), (20, 0.25, 5), (10, 0.25, 2), (100, 7.0, 1), (9, 0.25, 0)],
    ids=["three seconds", "a quarter of the record", "ten", "one at least", "too few"],
)
def test_colour_of_what_does_not_change_in_closed_form(rows: int, interval_s: float, lags: int) -> None:
    t = 5.0 + interval_s * np.arange(rows)
    t[-1] += 40.0  # a gap
    assert colour(np.full((rows, 2), 0.3), t) == pytest.approx(steady(rows, lags))
    flipping = np.where(np.arange(rows) % 2, 1.0, -1.0)[:, None]
    assert colour(flipping, t) == 1.0


def test_level_and_vertical_velocity_and_the_field_have_colours_of_their_own() -> None:
    """One column steady, the other flipping: together the mean of both densities, by their squares."""
    rng = np.random.default_rng(3)
    links, receiver, field = drawn_rows(rng, 61, 1)
    m = len(receiver.knot)
    steadily, flipping = np.ones(m), np.where(np.arange(m) % 2, 1.0, -1.0)
    of_field = np.ones((60, 3)) * [1.0, 2.0, 3.0]
    of_field[::2, 1] *= -1.0
    whitened = [links.residual, np.column_stack([flipping, 3.0 * steadily, flipping]), of_field]
    offset = np.arange(61.0)
    found = colours([links, receiver, field], whitened, offset)
    k = np.array([1, 2, 3])
    of_flipping, of_60 = (1.0 + 2.0 * np.sum((1.0 - k / 4.0) * (-1.0) ** k * (n - k) / n) for n in (m, 60))
    expected = [0.1 * of_flipping + 0.9 * steady(m, 3), 1.0, (4.0 * of_60 + 10.0 * steady(60, 3)) / 14.0]
    np.testing.assert_allclose(found, expected, rtol=RTOL)
    np.testing.assert_array_equal(colours([links, receiver], whitened[:2], offset)[2], 1.0)
