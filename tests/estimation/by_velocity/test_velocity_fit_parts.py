"""Parts of the fit by themselves, in closed form: attitude between knots, claims of a receiver, what is too little."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fieldcal.estimation.by_velocity.equations import Setting
from fieldcal.estimation.by_velocity.fit import VelocityFit, readings_between, sd_of_claims
from fieldcal.estimation.by_velocity.problem import LARGEST_LAG_S, Epochs, Knots, Levels, State
from fieldcal.estimation.by_velocity.strapdown import Integrated
from fieldcal.estimation.joint.problem import Readings
from fieldcal.geometry.rotation import Array

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
SCALE, ZERO, DRIFT = np.array([0.9, 1.1, 1.2]), np.array([0.02, -0.01, 0.03]), 0.01 * AXIS
RATE = 0.4
"""About AXIS, rad/s; 0.05 rad/s² more of the drift that the fit has found: exact by trapezoids."""


def record(t: Array, segment: np.ndarray, magnetometer: Array | None = None) -> Readings:
    logged = (np.outer(np.full(len(t), RATE), AXIS) - ZERO) / SCALE
    return Readings(t, segment, logged, logged, magnetometer, -9.81, np.zeros(3), np.zeros((2, len(t), 3)))


def fit_at(offset: Array, angle: Array, lag_s: float) -> VelocityFit:
    """A fit of which only the gyroscope's constants, and knots at `offset`, turned by `angle` about AXIS, count."""
    values = {"gyroscope": np.r_[SCALE, ZERO], "drift": DRIFT, "lag": np.array([lag_s])}
    state = State(Rotation.from_rotvec(angle[:, None] * AXIS).as_quat(), np.zeros((len(offset), 3)), values)
    nothing = np.zeros(0)
    knots = Knots(offset, np.arange(len(offset)), np.ones(len(offset) - 1, dtype=bool))
    setting = Setting(knots, Epochs(offset, np.zeros((len(offset), 3)), offset), np.zeros(3), np.zeros(3), nothing)
    levels = Levels(1.0, 1.0, np.ones(2), 1.0, np.ones(3))
    path = Integrated(*[nothing] * len(Integrated.__dataclass_fields__))
    return VelocityFit(state, {}, nothing, nothing, nothing, levels, nothing, nothing, nothing, 1.0, 1, setting, path)


def test_attitude_is_the_gyroscopes_integral_turned_onto_the_knots() -> None:
    """Knots that are off the integral by an error: between them it goes evenly from one to the next, beyond the first
    and last of a stretch it stays; a stretch without any takes its neighbour's."""
    t = np.r_[np.arange(0.0, 4.001, 0.01), np.arange(6.0, 9.001, 0.01), np.arange(20.0, 21.001, 0.01)] + 100.0
    segment = np.r_[np.zeros(401), np.ones(301), np.full(101, 2)].astype(np.int64)
    middle, lag_s = 0.5 * (t[0] + t[-1]), 0.1

    def integral(at: Array) -> Array:
        return RATE * (at - middle) + 0.5 * 0.01 * (at - middle) ** 2

    at = np.array([101.0, 102.0, 103.0, 106.5, 108.0])
    error = np.array([0.01, 0.03, -0.02, 0.2, 0.1])
    found = fit_at(at + lag_s, integral(at) + error, lag_s).attitude(record(t, segment))
    expected = integral(t)
    expected[:401] += np.interp(t[:401], at[:3], error[:3])
    expected[401:702] += np.interp(t[401:702], at[3:], error[3:])
    # The last stretch: the integral begins anew, and with the offset that the stretch before had at its start.
    expected[702:] += error[4] - integral(t[702:703]) + integral(t[401:402])
    off = (Rotation.from_rotvec(expected[:, None] * AXIS).inv() * Rotation.from_quat(found)).as_rotvec()
    assert np.abs(off).max() < 1e-7


def test_one_knot_turns_its_whole_stretch() -> None:
    t = np.arange(0.0, 4.001, 0.01)
    angle = RATE * (t - 2.0) + 0.5 * 0.01 * (t - 2.0) ** 2
    found = fit_at(np.array([t[0]]), angle[:1] + 0.3, 0.0).attitude(record(t, np.zeros(len(t), dtype=np.int64)))
    off = (Rotation.from_rotvec((angle + 0.3)[:, None] * AXIS).inv() * Rotation.from_quat(found)).as_rotvec()
    assert np.abs(off).max() < 1e-7


def test_a_receiver_that_claims_nothing_or_too_much_is_taken_at_a_usual_sd() -> None:
    claimed = np.array([np.nan, np.inf, 0.0, 0.019, 0.5])
    np.testing.assert_array_equal(sd_of_claims(claimed), [0.3, 0.3, 0.02, 0.02, 0.5])


def test_readings_of_the_magnetometer_count_between_the_first_knot_and_the_last_whatever_the_lag() -> None:
    t = np.arange(0.0, 8.0, 0.5)
    magnetometer = np.ones((len(t), 3))
    magnetometer[4, 1] = np.nan  # at 2 s
    at = np.array([1.0, 3.0, 6.0 + LARGEST_LAG_S])
    count = readings_between(record(t, np.zeros(len(t), dtype=np.int64), magnetometer), at)
    assert count == len([1.5, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5])
    assert readings_between(record(t, np.zeros(len(t), dtype=np.int64)), at) == 0
