"""Attitudes to start from are those of a flight without noise; velocities between epochs are linear."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from velocity_support import epochs_of, field_of, readings_of, short_flight

from fieldcal.estimation.by_velocity.equations import Setting
from fieldcal.estimation.by_velocity.problem import Epochs, Knots, of_other_form, place_knots
from fieldcal.estimation.by_velocity.start import attitudes, velocities_at_knots
from fieldcal.estimation.by_velocity.strapdown import Integrated, grid_of, integrate
from fieldcal.geometry.rotation import Array, angle_between
from fieldcal.simulation.experiment import constants_at


def off_by(with_field: bool, gap_s: float = 0.0) -> Array:
    """Degrees (K,) between a start and the truth, of a flight without noise whose constants are known; without
    velocities for a while in its middle."""
    quiet = {"noise": False, "gnss_lag_s": 0.1, "gnss_arm_m": (0.0, 0.0, 0.0), "rate_hz": 100.0, "duration_s": 30.0}
    flight = short_flight("lively", 3, **quiet)
    readings, epochs = readings_of(flight), epochs_of(flight)
    kept = np.abs(epochs.t - 15.0) >= 0.5 * gap_s
    epochs = Epochs(epochs.t[kept], epochs.velocity[kept], epochs.sd[kept])
    knots = place_knots(readings, epochs)
    own = {name: np.concatenate(constants_at(flight.experiment, name, 25.0)) for name in flight.counts}
    lag_s = flight.gnss_lag_s
    path = integrate(grid_of(readings, knots, lag_s), own["gyroscope"], np.zeros(3), own["accelerometer"], 1.0, 15.0)
    gravity = np.array([0.0, 0.0, abs(flight.experiment.gravity_mps2)])
    setting = Setting(knots, epochs, gravity, 3.0 * field_of(flight.experiment), knots.joined & (path.count > 0))
    magnetometer, _ = of_other_form(own["magnetometer"])
    magnetometer[:3] /= 3.0
    found = attitudes(setting, path, magnetometer if with_field else None)
    true = np.column_stack([np.interp(knots.offset - lag_s, flight.t, c) for c in flight.q.T])
    return np.degrees(angle_between(found, true / np.linalg.norm(true, axis=1, keepdims=True)))


@pytest.mark.parametrize(("with_field", "within"), [(True, 0.1), (False, 0.5)])
@pytest.mark.parametrize("gap_s", [0.0, 8.0])
def test_without_noise_the_start_is_the_truth(with_field: bool, within: float, gap_s: float) -> None:
    """Either side of a gap by itself, whose velocities and readings nothing joins."""
    assert off_by(with_field, gap_s).max() < within


@pytest.mark.parametrize(
    ("with_field", "lit", "window_s"),
    [(True, slice(2, None, 3), 4.0), (True, slice(0), 10.0), (False, slice(None), 10.0)],
    ids=["four seconds", "none of its readings counts", "ten without a magnetometer"],
)
def test_a_start_is_scipys_answer_to_wahbas_problem(with_field: bool, lit: slice, window_s: float) -> None:
    """What does not fit: changes of velocity count with sd 0.2 m/s, directions of the field with 0.1, of intervals that
    begin no earlier than the window before a knot and earlier than the window after it, in its stretch."""
    rng = np.random.default_rng(2)
    offset = np.arange(64) / 2.0
    joined = np.arange(63) != 40
    gravity, field, gain, zero = np.array([0.0, 0.0, 9.8]), np.array([0.5, -0.3, 1.2]), np.array([2.0, 3.0, 0.5]), 0.1
    velocity, push = np.cumsum(rng.normal(size=(64, 3)), axis=0), rng.normal(size=(63, 3)) - 0.4 * gravity
    turned, axes = (Rotation.random(n, random_state=rng).as_matrix() for n in (64, 63))
    seen = rng.normal(size=(63, 3)) + np.array([0.2, 0.1, 1.0])
    seen *= np.linalg.norm(field) / np.linalg.norm(seen, axis=1, keepdims=True)
    counts = np.zeros(63, dtype=bool)
    counts[lit] = True
    nothing = {name: np.zeros(0) for name in Integrated.__dataclass_fields__}
    parts = {"turned": turned, "push": push, "axes": axes, "reading": np.einsum("nij,nj->ni", axes, seen) * gain + zero}
    setting = Setting(
        Knots(offset, np.arange(64), joined), Epochs(offset, velocity, np.ones(64)), gravity, field, counts
    )
    found = attitudes(
        setting, Integrated(**{**nothing, **parts}), np.r_[gain, np.full(3, zero)] if with_field else None
    )
    change = np.diff(velocity, axis=0) - 0.5 * gravity
    stretch = np.r_[0, np.cumsum(~joined)]
    unit = field / np.linalg.norm(field)
    for k, own in enumerate(offset):
        begins = offset[:-1]
        near = (begins >= own - window_s) & (begins < own + window_s) & (stretch[:-1] == stretch[k]) & joined
        shown = near & counts & with_field
        found_there = np.vstack([change[near], np.tile(unit, (shown.sum(), 1))])
        integrated = np.vstack([push[near], seen[shown] / np.linalg.norm(field)])
        weight = np.r_[np.full(near.sum(), 0.2**-2), np.full(shown.sum(), 0.1**-2)]
        expected = Rotation.align_vectors(found_there, integrated, weight)[0] * Rotation.from_matrix(turned[k])
        assert (Rotation.from_quat(found[k]).inv() * expected).magnitude() < 1e-6


def test_velocities_between_epochs_are_linear() -> None:
    knots = Knots(np.array([1.0, 1.5, 2.0, 3.0]), np.array([0, -1, -1, 2]), np.ones(3, dtype=bool))
    velocity = np.array([[1.0, 0.0, -4.0], [9.0, 9.0, 9.0], [5.0, 2.0, 4.0]])
    setting = Setting(knots, Epochs(np.arange(3.0), velocity, np.ones(3)), np.zeros(3), np.zeros(3), knots.joined)
    expected = velocity[0] + np.array([0.0, 0.25, 0.5, 1.0])[:, None] * (velocity[2] - velocity[0])
    np.testing.assert_allclose(velocities_at_knots(setting), expected)
