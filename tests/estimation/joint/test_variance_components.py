"""Noise levels of the joint estimate by closed forms: where they start, how they are renewed, what has no weight."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_record import small

from fieldcal.estimation.joint import variance_components
from fieldcal.estimation.joint.measurement_model import residuals, trajectory
from fieldcal.estimation.joint.problem import Model
from fieldcal.estimation.joint.variance_components import (
    Levels,
    colour_within,
    first_levels,
    gyro_walk,
    largest_level_change,
    passing_fields,
    renewed_levels,
    robust_weight,
    slow_colour,
)
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply

SHARP = 0.1  # relative, of a robust sd by some hundred residuals


def model(*, missing: bool = False, **how: Any) -> Model:
    return small(missing=missing, **how).model


def noise(of: Model, sd: Array, seed: int = 1) -> Array:
    valid = np.repeat(of.valid_rows(), 3, axis=1)
    return np.asarray(sd * np.random.default_rng(seed).normal(size=(len(of.at), len(sd))) * valid)


def levels(r: int = 6, **changes: Any) -> Levels:
    given: dict[str, Any] = {
        "variance": np.full(r, 0.01), "colour": np.ones(r), "colour_within": np.ones(r), "walk": 1e-4, "strength": 0.5
    }  # fmt: skip
    return Levels(**{**given, **changes})


SD = np.array([0.1, 0.2, 0.05, 0.02, 0.3, 0.1])
RATE_NOISE = 0.01


def test_levels_start_from_the_residuals() -> None:
    flight = small(missing=True)
    own = flight.model
    left = noise(own, SD)
    noisy = replace(own.triads["gyroscope"], x=own.triads["gyroscope"].x + noise_of(own))
    own = replace(own, triads={**own.triads, "gyroscope": noisy})
    path = trajectory(flight.model, flight.state)
    found = first_levels(own, flight.state, path, left)
    for i in range(6):
        valid = own.triads[own.vectors[i // 3]].valid
        expected = 1.4826 * np.median(np.abs(left[valid, i]))
        assert np.sqrt(found.variance[i]) == pytest.approx(expected, rel=1e-9)
    assert (found.colour == 1.0).all()
    assert (found.colour_within == 1.0).all()
    # Ten times the walk of white noise, of the axis where it is largest, each sample's for one interval.
    white = np.max(RATE_NOISE * np.abs(flight.state.values["gyroscope"][:3])) ** 2 * own.knots.sample_s
    assert gyro_walk(own, flight.state) == pytest.approx(white, rel=3.0 * SHARP)
    assert found.walk == pytest.approx(10.0 * gyro_walk(own, flight.state))
    # As strong as the accelerometer's residual, m/s², where that is more than a start in any case.
    scale = np.abs(flight.state.values["accelerometer"][:3])
    assert found.strength == pytest.approx(np.max(np.sqrt(found.variance[:3]) * scale))
    assert first_levels(own, flight.state, path, 1e-2 * left).strength == 0.2
    alone = replace(own, vectors=("accelerometer",))
    assert first_levels(alone, flight.state, path, left[:, :3]).strength == found.strength
    assert first_levels(own, flight.state, path, 0.0 * left).variance.tolist() == [1e-8] * 6


def noise_of(own: Model) -> Array:
    return RATE_NOISE * np.random.default_rng(9).normal(size=own.triads["gyroscope"].x.shape)


def test_a_start_whose_attitudes_jump_walks_as_far() -> None:
    flight = small(vectors=("magnetometer",))
    turn = 0.05 * np.random.default_rng(2).normal(size=(len(flight.state.q), 3))
    state = replace(flight.state, q=multiply(from_rotation_vector(turn), flight.state.q))
    path = trajectory(flight.model, state)
    knots = flight.model.knots
    found = first_levels(flight.model, state, path, np.zeros((len(flight.model.at), 3)))
    expected = np.mean(path.jump[knots.joined] ** 2) * knots.joined.sum() / knots.interval_s[knots.joined].sum()
    assert found.walk == pytest.approx(expected)
    assert found.strength == 0.2
    still = replace(flight.model.triads["gyroscope"], x=np.zeros((len(flight.model.readings.t), 3)))
    none = replace(flight.model, triads={**flight.model.triads, "gyroscope": still})
    without = replace(path, jump=np.zeros_like(path.jump))
    assert first_levels(none, state, without, np.zeros((len(flight.model.at), 3))).walk == 1e-9


def test_variances_are_squares_over_what_the_unknowns_leave() -> None:
    own = model()
    left, absorbed = noise(own, SD), np.array([10.0, 20.0, 30.0, 0.0, 50.0, 1e9])
    before = levels(variance=SD**2, colour=np.array([1.0, 2.0, 1.0, 1.0, 3.0, 1.0]))
    squares = np.array([[50.0, 50.0, 40.0], [60.0, 60.0, 50.0]])
    found = renewed_levels(own, left, before, absorbed, squares, 1.0, slow=False)
    weight = robust_weight(own, left, before)
    count = weight.sum(axis=0)
    freedom = np.maximum(count - before.colour * absorbed, 0.05 * count)
    np.testing.assert_allclose(found.variance, np.sum(weight * left**2, axis=0) / freedom, rtol=1e-9)
    assert (found.walk, found.strength) == pytest.approx((before.walk, before.strength))
    assert (found.colour == found.colour_within).all()
    assert renewed_levels(own, 0.0 * left, before, absorbed, squares, 1.0, slow=False).variance.tolist() == [1e-8] * 6


@pytest.mark.parametrize(
    ("square", "free", "information", "ratio"),
    [
        # More than expected: the fixed point. Less: Newton's step by the information, bounded.
        (75.0, 50.0, 20.0, 75.0 / 50.0),
        (45.0, 50.0, 20.0, 1.0 - 5.0 / 20.0),
        (45.0, 50.0, 80.0, 1.0 - 5.0 / 50.0),
        (45.0, 50.0, 50.0, 1.0 - 5.0 / 50.0),
        (0.0, 50.0, 20.0, "least"),
        (1e6, 50.0, 20.0, "most"),
    ],
)
def test_walk_and_strength_are_renewed_upwards_and_downwards(
    square: float, free: float, information: float, ratio: float | str
) -> None:
    own, before = model(), levels(walk=1e-3)
    left, none = noise(own, np.full(6, 0.1)), np.zeros(6)
    for row in (0, 1):
        squares = np.array([[50.0, 50.0, 40.0], [50.0, 50.0, 40.0]])
        squares[row] = square, free, information
        found = renewed_levels(own, left, before, none, squares, 1.0, slow=False)
        least, most = ((0.25, 4.0), (0.01, 10.0))[row]
        expected = {"least": least, "most": most}.get(str(ratio), ratio)
        assert (found.walk / before.walk, (found.strength / before.strength) ** 2)[row] == pytest.approx(expected)
        assert (found.walk / before.walk, (found.strength / before.strength) ** 2)[1 - row] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("walk", "most", "expected"),
    [(1e-3, 5e-4, 5e-4), (1e-3, 1e-5, 2.5e-4), (1e-3, 2e-3, 1e-3), (1e-9, 1e-12, 1e-9), (4e-10, 1e-12, 1e-9)],
)
def test_the_walk_falls_towards_its_bound_by_steps_of_four(walk: float, most: float, expected: float) -> None:
    own = model()
    squares = np.array([[50.0, 50.0, 40.0], [50.0, 50.0, 40.0]])
    found = renewed_levels(own, noise(own, np.full(6, 0.1)), levels(walk=walk), np.zeros(6), squares, most, slow=False)
    assert found.walk == pytest.approx(expected)


def test_a_translation_that_vanishes_stays_at_its_least() -> None:
    own = model()
    squares = np.array([[50.0, 50.0, 40.0], [0.0, 50.0, 40.0]])
    found = renewed_levels(
        own, noise(own, np.full(6, 0.1)), levels(strength=3e-3), np.zeros(6), squares, 1.0, slow=False
    )
    assert found.strength == 2e-3


def test_what_changes_most_is_told_in_its_own_measure() -> None:
    """Variances relative; walk and translation over their sd √(2/information), where that is more than themselves."""
    before = levels(variance=np.full(6, 0.01), walk=1e-4, strength=0.5)
    squares = np.array([[50.0, 50.0, 0.08], [50.0, 50.0, 0.5]])
    axis = replace(before, variance=np.array([0.01, 0.01, 0.008, 0.01, 0.01, 0.011]))
    assert largest_level_change(before, axis, squares) == pytest.approx(0.2)
    assert largest_level_change(before, replace(before, walk=1.5e-4), squares) == pytest.approx(0.5 * 0.2)
    assert largest_level_change(before, replace(before, strength=0.25), squares) == pytest.approx(0.75 * 0.5)
    sure = np.array([[50.0, 50.0, 200.0], [50.0, 50.0, 200.0]])
    assert largest_level_change(before, replace(before, walk=1.5e-4), sure) == pytest.approx(0.5)


@pytest.mark.parametrize("vectors", [("accelerometer",), ("magnetometer",), ("accelerometer", "magnetometer")])
def test_a_reading_loses_weight_beyond_four_sd(vectors: tuple[str, ...]) -> None:
    """1 up to d = 4 sd, (4/d)⁴ beyond; three axes together; none where there is no reading."""
    own = model(vectors=vectors, missing=True)
    r = 3 * len(vectors)
    before = levels(r, variance=np.linspace(0.5, 1.5, r) ** 2, colour_within=np.full(r, 100.0))
    left = np.zeros((len(own.at), r))
    d = np.linspace(0.0, 12.0, len(own.at))
    way = np.array([2.0, -1.0, 2.0]) / 3.0
    for i in range(len(vectors)):
        row = slice(3 * i, 3 * i + 3)
        left[:, row] = np.roll(d, 50 * i)[:, None] * way * np.sqrt(before.variance[row])
    for i, name in enumerate(vectors):
        row, own_d = slice(3 * i, 3 * i + 3), np.roll(d, 50 * i)
        weight = robust_weight(own, left, before)[:, row]
        expected = np.where(own_d <= 4.0, 1.0, (4.0 / np.maximum(own_d, 1.0)) ** 4) * own.triads[name].valid
        for axis in range(3):
            np.testing.assert_allclose(weight[:, axis], expected, rtol=1e-9)


def test_a_magnetometer_s_edge_is_told_by_the_mean_over_an_interval() -> None:
    """Readings that are all off by 2 sd: the mean of so many as an interval has is off by 2 √n of its own sd, less its
    colour. An accelerometer's common part is translation."""
    own = model()
    together = len(own.at) // len(own.knots.index)
    assert together > 4
    left = np.tile(np.tile([4.0 / 3.0, 0.0, -np.sqrt(20.0) / 3.0], 2), (len(own.at), 1))
    for within in (1.0, 2.0):
        before = levels(variance=np.ones(6), colour_within=np.full(6, within))
        weight = robust_weight(own, left, before)
        assert (weight[:, :3] == 1.0).all()
        square = 4.0 * together / within
        np.testing.assert_allclose(weight[:, 3:], min(1.0, (16.0 / square) ** 2), rtol=1e-9)


def weights(own: Model, outliers: list[int], value: float = 0.2) -> Array:
    out = np.ones((len(own.at), 6))
    out[outliers, 3:] = value
    return out


def test_a_passing_field_is_a_run_of_outliers_and_its_edges() -> None:
    """A quarter of its length on either side; a run of three has none, and is no passing field."""
    own = model()
    n = len(own.at)
    run = [*range(50, 61), *range(100, 103), *range(120, 124), *range(n - 9, n)]
    expected = [*range(48, 63), *range(119, 125), *range(n - 11, n)]
    assert np.flatnonzero(passing_fields(own, weights(own, run))).tolist() == expected
    assert np.flatnonzero(passing_fields(own, weights(own, [*range(8)]))).tolist() == [*range(10)]
    assert not passing_fields(own, weights(own, run, 0.25)).any()
    assert not passing_fields(own, np.where(np.arange(6) < 3, 0.0, np.ones((n, 1)))).any()


def test_no_reading_is_no_passing_field() -> None:
    own = model()
    holed = replace(own.triads["magnetometer"], valid=~np.isin(np.arange(len(own.at)), [48, 54]))
    own = replace(own, triads={**own.triads, "magnetometer": holed})
    found = np.flatnonzero(passing_fields(own, weights(own, [*range(50, 60)])))
    assert found.tolist() == [49, 50, 51, 52, 53, 55, 56, 57, 58, 59, 60]
    assert not passing_fields(model(vectors=("accelerometer",)), np.zeros((len(own.at), 3))).any()
    alone = model(vectors=("magnetometer",))
    assert passing_fields(alone, np.where(np.arange(len(alone.at))[:, None] < 8, 0.0, np.ones(3))).sum() == 10


def tapered(x: Array, lags: int) -> Array:
    """1 + 2 Σ (1 − k/(lags + 1)) ρ_k by sums, the three axes of a triad together."""
    out = []
    for i in range(0, x.shape[1], 3):
        own = x[:, i : i + 3]
        rho = [np.sum(own[k:] * own[: len(own) - k]) / np.sum(own**2) for k in range(1, lags + 1)]
        out += [1.0 + 2.0 * sum((1.0 - k / (lags + 1)) * r for k, r in enumerate(rho, 1))] * 3
    return np.array(out)


def coloured(own: Model, memory: float) -> Array:
    x = np.random.default_rng(3).normal(size=(len(own.at), 6))
    for i in range(1, len(x)):
        x[i] += memory * x[i - 1]
    return x


def test_colour_is_that_of_the_weighed_residuals_over_half_an_interval_and_over_seconds() -> None:
    own = model()
    n, k = len(own.at), len(own.knots.index)
    weight = np.random.default_rng(4).uniform(0.2, 1.0, size=(n, 6))
    left = coloured(own, 0.6)
    lags = int(np.clip(n / k / 2, 1, 8))
    assert lags == 6
    within = np.clip(tapered(left * np.sqrt(weight), lags), 1.0, 10.0)
    np.testing.assert_allclose(colour_within(own, left, weight), within, rtol=1e-9)
    interval_s = own.knots.interval_s[own.knots.joined].sum() / n
    long = int(min(3.0 / interval_s, n // 4))
    assert long == n // 4
    slow = np.maximum(np.clip(tapered(left * np.sqrt(weight), long), 1.0, 400.0), within)
    np.testing.assert_allclose(slow_colour(own, left, weight), slow, rtol=1e-9)
    assert (colour_within(own, coloured(own, -0.6), weight) == 1.0).all()
    steady = np.ones((n, 6))
    np.testing.assert_allclose(colour_within(own, steady, steady), tapered(steady, lags))
    sums = renewed_levels(own, left, levels(), np.zeros(6), np.ones((2, 3)), 1.0, slow=True)
    expected = robust_weight(own, left, levels())
    np.testing.assert_allclose(sums.colour, slow_colour(own, left, expected))
    np.testing.assert_allclose(sums.colour_within, colour_within(own, left, expected))


def test_colour_is_looked_for_over_three_seconds_and_eight_rows_and_no_further() -> None:
    """A record of twenty seconds, whose intervals have forty rows; so many that a transform would wrap if it were one
    shorter."""
    n = 4042  # with eight lags, less one, 4050 = 2 · 3⁴ · 5²
    own = small(missing=False).model
    knots = replace(
        own.knots, index=np.arange(101), joined=np.ones(100, dtype=bool), interval_s=np.full(100, n / 20002.0)
    )
    long = replace(own, at=np.arange(n), knots=knots)
    x = np.random.default_rng(5).normal(size=(n, 6))
    x[0] += 30.0
    x[-1] += 30.0
    for i in range(1, n):
        x[i] += 0.95 * x[i - 1]
    one = np.ones((n, 6))
    np.testing.assert_allclose(colour_within(long, x, one), tapered(x, 8), rtol=1e-9)
    np.testing.assert_allclose(slow_colour(long, x, one), tapered(x, 600), rtol=1e-9)
    assert tapered(x, 8).max() < 10.0


def test_intervals_of_a_single_row() -> None:
    """There the mean over an interval is the reading, and colour is looked for over one lag."""
    own = small(missing=False, rate_hz=40.0, spacing_s=0.026).model
    assert len(own.at) < 2 * len(own.knots.index)
    left = np.random.default_rng(8).normal(size=(len(own.at), 6))
    weight = robust_weight(own, left, levels(variance=np.full(6, 0.04)))
    square = np.sum(left[:, 3:] ** 2, axis=1) / 0.04
    np.testing.assert_allclose(weight[:, 4], np.minimum(1.0, 16.0 / square) ** 2)
    one = np.ones_like(left)
    np.testing.assert_allclose(colour_within(own, left, one), np.maximum(tapered(left, 1), 1.0), rtol=1e-9)


def test_colour_has_a_bound() -> None:
    """A residual that never changes: as coloured as the longest correlation allows."""
    own = small(missing=False).model
    knots = replace(own.knots, index=np.arange(3), joined=np.ones(2, dtype=bool), interval_s=np.full(2, 1.0))
    long = replace(own, at=np.arange(4000), knots=knots)
    steady = np.ones((4000, 6))
    assert slow_colour(long, steady, steady).tolist() == [400.0] * 6
    assert colour_within(long, steady, steady) == pytest.approx(np.full(6, tapered(steady, 8)[0]))
    assert variance_components.LARGEST_COLOUR_WITHIN == 10.0


def test_residuals_of_the_truth_have_their_levels() -> None:
    flight = small()
    left = residuals(flight.model, flight.state, trajectory(flight.model, flight.state))
    found = first_levels(flight.model, flight.state, trajectory(flight.model, flight.state), left)
    assert np.sqrt(found.variance).max() < 1e-3
