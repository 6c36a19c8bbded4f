"""Parts of the fit by themselves, in closed form: attitude between knots, claims of a receiver, what is too little."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldcal.estimation.by_velocity.equations import Setting
from fieldcal.estimation.by_velocity.fit import VelocityFit, readings_between, sd_of_claims
from fieldcal.estimation.by_velocity.problem import LARGEST_LAG_S, Epochs, Knots, Levels, State, layout_of
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


@pytest.mark.parametrize(
    "at", [(101.0, 102.0, 103.0, 106.5, 108.0), (100.0, 102.0, 104.0, 106.0, 109.0)], ids=["between", "at the ends"]
)
def test_attitude_is_the_gyroscopes_integral_turned_onto_the_knots(at: tuple[float, ...]) -> None:
    """Knots that are off the integral by an error: between them it goes evenly from one to the next, beyond the first
    and last of a stretch it stays; a stretch without any takes its neighbour's."""
    t = 100.0 + np.r_[np.arange(513), np.arange(768, 1153), np.arange(2560, 2689)] / 128.0
    segment = np.repeat([0, 1, 2], [513, 385, 129])
    middle, lag_s = 0.5 * (t[0] + t[-1]), 0.125

    def integral(at: Array) -> Array:
        return RATE * (at - middle) + 0.5 * 0.01 * (at - middle) ** 2

    knots = np.array(at)
    error = np.array([0.01, 0.03, -0.02, 0.2, 0.1])
    found = fit_at(knots + lag_s, integral(knots) + error, lag_s).attitude(record(t, segment))
    expected = integral(t)
    for own, which in ((segment == 0, slice(3)), (segment == 1, slice(3, 5))):
        expected[own] += np.interp(t[own], knots[which], error[which])
    # The last stretch: the integral begins anew, and with the offset that the stretch before had at its start.
    expected[segment == 2] += error[4] - integral(t[segment == 2][:1]) + integral(t[segment == 1][:1])
    off = (Rotation.from_rotvec(expected[:, None] * AXIS).inv() * Rotation.from_quat(found)).as_rotvec()
    assert np.abs(off).max() < 1e-7


def test_one_knot_turns_its_whole_stretch() -> None:
    t = np.arange(0.0, 4.001, 0.01)
    angle = RATE * (t - 2.0) + 0.5 * 0.01 * (t - 2.0) ** 2
    found = fit_at(np.array([t[0]]), angle[:1] + 0.3, 0.0).attitude(record(t, np.zeros(len(t), dtype=np.int64)))
    off = (Rotation.from_rotvec((angle + 0.3)[:, None] * AXIS).inv() * Rotation.from_quat(found)).as_rotvec()
    assert np.abs(off).max() < 1e-7


def test_unknowns_stand_one_after_the_other_in_their_order_without_those_that_there_are_not() -> None:
    sizes = {"gyroscope": 6, "drift": 3, "accelerometer": 6, "magnetometer": 6, "field": 2, "delay": 1, "lag": 1}
    sizes |= {"smoothing": 1, "arm": 3}
    for left_out in (set(), {"magnetometer", "field", "delay"}):
        names = [name for name in sizes if name not in left_out]
        layout = layout_of(dict.fromkeys(reversed(names), np.zeros(0)))
        ends = np.cumsum([sizes[name] for name in names])
        assert list(layout.items()) == [(n, slice(e - sizes[n], e)) for n, e in zip(names, ends, strict=True)]


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
