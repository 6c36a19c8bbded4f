"""Attitudes to start from are those of a flight without noise; velocities between epochs are linear."""

from __future__ import annotations

import numpy as np
import pytest
from velocity_support import epochs_of, field_of, readings_of, short_flight

from fieldcal.estimation.by_velocity.equations import Setting
from fieldcal.estimation.by_velocity.problem import Epochs, Knots, of_other_form, place_knots
from fieldcal.estimation.by_velocity.start import attitudes, velocities_at_knots
from fieldcal.estimation.by_velocity.strapdown import grid_of, integrate
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


def test_velocities_between_epochs_are_linear() -> None:
    knots = Knots(np.array([1.0, 1.5, 2.0, 3.0]), np.array([1, -1, -1, 2]), np.ones(3, dtype=bool))
    velocity = np.array([[9.0, 9.0, 9.0], [1.0, 0.0, -4.0], [5.0, 2.0, 4.0]])
    setting = Setting(knots, Epochs(np.arange(3.0), velocity, np.ones(3)), np.zeros(3), np.zeros(3), knots.joined)
    expected = velocity[1] + np.array([0.0, 0.25, 0.5, 1.0])[:, None] * (velocity[2] - velocity[1])
    np.testing.assert_allclose(velocities_at_knots(setting), expected)
