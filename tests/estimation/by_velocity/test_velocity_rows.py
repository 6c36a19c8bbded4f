"""What is compared: nothing is left over at the truth, and every sensitivity is what a difference shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from velocity_support import epochs_of, field_of, readings_of, short_flight

from fieldcal.estimation.by_velocity.equations import Rows, Setting, Solved, rows_of
from fieldcal.estimation.by_velocity.problem import LARGEST_LAG_S, Levels, State, layout_of, of_other_form, place_knots
from fieldcal.estimation.by_velocity.step import moved
from fieldcal.estimation.by_velocity.strapdown import Integrated, grid_of, integrate
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply
from fieldcal.simulation.experiment import SimulatedFlight, constants_at

LEVELS = Levels(0.2, 0.3, np.array([0.5, 0.7]), 11.0, np.array([2.0, 3.0, 5.0]))
MIDDLE_S, STEP = 7.0, 1e-5
KINDS = ("links", "receiver", "field")
WITHIN, OF_MEAN_TURN = 0.02, 0.1
"""Share of the largest sensitivity; that of a mean reading to a rate takes the mean turn of its interval for each."""


@dataclass(frozen=True)
class Record:
    """A flight without noise, and its truth at the knots."""

    flight: SimulatedFlight
    setting: Setting
    state: State

    def path(self, state: State) -> Integrated:
        grid = grid_of(readings_of(self.flight), self.setting.knots, state.lag_s)
        v = state.values
        return integrate(grid, v["gyroscope"], v["drift"], v["accelerometer"], 1.0, MIDDLE_S)

    def rows(self, state: State) -> list[Rows]:
        return rows_of(self.setting, state, self.path(state), LEVELS, layout_of(state.values))


@pytest.fixture(scope="module")
def record() -> Record:
    quiet = {"noise": False, "gnss_lag_s": 0.1, "rate_hz": 200.0, "duration_s": 15.0}
    flight = short_flight("lively", 3, gnss_arm_m=(0.4, -0.3, 0.2), **quiet)
    at_sensor = short_flight("lively", 3, gnss_arm_m=(0.0, 0.0, 0.0), **quiet)
    constants = {
        name: np.concatenate(constants_at(flight.experiment, name, 25.0)) for name in ("gyroscope", "accelerometer")
    }
    magnetometer, _ = of_other_form(np.concatenate(constants_at(flight.experiment, "magnetometer", 25.0)))
    e = flight.experiment
    values = {
        **constants,
        "magnetometer": magnetometer,
        "field": np.zeros(2),
        "delay": np.zeros(1),
        "drift": np.zeros(3),
        "lag": np.array([flight.gnss_lag_s]),
        "smoothing": np.zeros(1),
        "arm": np.array(e.gnss_arm_m),
    }
    late_enough = np.flatnonzero(flight.gnss_t > flight.t[0] + LARGEST_LAG_S)  # the first epoch has a knot
    readings, epochs = readings_of(flight), epochs_of(flight).of(late_enough)
    knots = place_knots(readings, epochs)
    q = np.column_stack([np.interp(knots.offset - flight.gnss_lag_s, flight.t, c) for c in flight.q.T])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    gravity = np.array([0.0, 0.0, abs(e.gravity_mps2)])
    setting = Setting(knots, epochs, gravity, field_of(e), knots.joined)
    return Record(flight, setting, State(q, at_sensor.gnss_velocity[late_enough[knots.epoch]], values))


def test_at_the_truth_nothing_is_left_over(record: Record) -> None:
    links, receiver, field = record.rows(record.state)
    assert np.abs(links.residual[:, :3]).max() < 1e-4  # rad
    assert np.abs(links.residual[:, 3:]).max() < 5e-4  # m/s
    assert np.abs(receiver.residual).max() < 0.02  # of the mean rate about an epoch
    assert np.abs(field.residual).max() < 1e-4


def off_the_truth(record: Record) -> State:
    """Where what the simulator has none of counts too."""
    return record.state.with_values(field=np.array([0.05, -0.08]), drift=np.array([1e-4, -2e-4, 3e-4]))


COLUMNS = [
    (name, k)
    for name, columns in layout_of(
        dict.fromkeys(
            ("gyroscope", "drift", "accelerometer", "magnetometer", "field", "delay", "smoothing", "arm"), np.zeros(0)
        )
    ).items()
    for k in range(columns.stop - columns.start)
]


def close(shown: Array, told: Array, kind: str, within: float = WITHIN) -> None:
    assert np.abs(shown - told).max() < within * np.abs(told).max() + 2e-4, kind


@pytest.mark.parametrize(("name", "k"), COLUMNS, ids=[f"{name} {k}" for name, k in COLUMNS])
def test_constants_change_residuals_as_they_say(record: Record, name: str, k: int) -> None:
    state = off_the_truth(record)
    layout = layout_of(state.values)
    step = STEP * (np.arange(len(state.values[name])) == k)
    ahead, behind = (record.rows(state.with_values(**{name: state.values[name] + sign * step})) for sign in (1.0, -1.0))
    for kind, one, other, told in zip(KINDS, ahead, behind, record.rows(state), strict=True):
        if (name, kind) != ("drift", "receiver"):  # by the arm's swing: left out for being small
            within = OF_MEAN_TURN if kind == "field" and name in ("gyroscope", "drift") else WITHIN
            says = told.theta[:, :, layout[name].start + k]
            close((one.residual - other.residual) / (2.0 * STEP), says, kind, within)


def test_a_magnetometer_that_is_late_shows_the_field_of_a_time_before(record: Record) -> None:
    late_s = 0.01
    readings = record.flight.counts["magnetometer"]
    late = np.column_stack([np.interp(record.flight.t - late_s, record.flight.t, c) for c in readings.T])
    behind = Record(
        replace(record.flight, counts={**record.flight.counts, "magnetometer": late}), record.setting, record.state
    )
    off = [np.abs(behind.rows(record.state.with_values(delay=np.array([s])))[2].residual).max() for s in (0.0, late_s)]
    assert off[1] < 0.05 * off[0]


def test_a_longer_lag_moves_the_knots_and_changes_the_receivers_residuals_alone(record: Record) -> None:
    state = off_the_truth(record)
    layout = layout_of(state.values)
    path, nothing, p = record.path(state), np.zeros(0), layout["arm"].stop
    residuals = []
    for sign in (1.0, -1.0):
        theta = sign * 1e-3 * (np.arange(p) == layout["lag"].start)
        step = Solved(theta, np.zeros((len(state.q), 6)), nothing, nothing, nothing, (nothing, nothing), nothing)
        there = moved(state, step, path, layout, record.setting.gravity)
        residuals.append([one.residual for one in record.rows(there)])
    for kind, one, other, told in zip(KINDS, *residuals, record.rows(state), strict=True):
        shown, says = (one - other) / 2e-3, told.theta[:, :, layout["lag"].start]
        assert np.sqrt(np.mean((shown - says) ** 2)) < 0.05 * max(1.0, np.sqrt(np.mean(says**2))), kind


@pytest.mark.parametrize("column", range(6))
@pytest.mark.parametrize("odd", [0, 1])
def test_knots_change_residuals_as_they_say(record: Record, column: int, odd: int) -> None:
    """Every other knot turned about an axis of the earth, or faster along it."""
    state = off_the_truth(record)
    at = np.arange(len(state.q)) % 2 == odd
    residuals = []
    for sign in (1.0, -1.0):
        change = sign * STEP * at[:, None] * (np.arange(6) == column)
        q = multiply(from_rotation_vector(change[:, :3]), state.q)
        there = replace(state, q=q, velocity=state.velocity + change[:, 3:])
        residuals.append([one.residual for one in record.rows(there)])
    for kind, one, other, told in zip(KINDS, *residuals, record.rows(state), strict=True):
        says = at[told.knot][:, None] * told.here[:, :, column]
        if told.there is not None:
            says = says + at[told.knot + 1][:, None] * told.there[:, :, column]
        close((one - other) / (2.0 * STEP), says, kind)


def test_noise_of_the_rows_is_that_of_the_levels(record: Record) -> None:
    """Of a walk of attitude of variance Δ an interval, half of an interval's velocity errs by |Δv|² Δ / 12."""
    path, (links, receiver, field) = record.path(record.state), record.rows(record.state)
    interval = np.diff(record.setting.knots.offset)[:, None]
    np.testing.assert_allclose(links.variance[:, :3], 0.2 * interval * np.ones(3))
    within = 0.2 * interval * np.sum(path.push**2, axis=1)[:, None] / 12.0
    np.testing.assert_allclose(links.variance[:, 3:], (0.3 * interval + within) * np.ones(3))
    sd = record.setting.epochs.sd[record.setting.knots.epoch][:, None]
    np.testing.assert_allclose(receiver.variance, sd**2 * [0.5 * 2.0, 0.5 * 2.0, 0.7 * 3.0])
    np.testing.assert_allclose(field.variance, 11.0 * 5.0)
    for one in (links, receiver, field):
        assert one.here.shape == (*one.residual.shape, 6)
    assert (links.group, receiver.group, field.group) == ((0, 0, 0, 1, 1, 1), (2, 2, 3), (4, 4, 4))
