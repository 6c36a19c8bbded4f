"""What a step makes of the state, in closed form: turned, shortened, carried along the path by the lag."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldcal.estimation.by_velocity.equations import Solved
from fieldcal.estimation.by_velocity.problem import State, layout_of
from fieldcal.estimation.by_velocity.step import moved
from fieldcal.estimation.by_velocity.strapdown import Integrated
from fieldcal.geometry.rotation import Array

KNOTS = 4
GRAVITY = np.array([0.0, 0.0, 9.8])
VALUES = {"gyroscope": np.arange(6.0), "lag": np.array([0.1]), "arm": np.array([0.3, 0.2, 0.1])}
LAYOUT = layout_of(VALUES)


def flown(seed: int = 1) -> tuple[State, Integrated, Array]:
    """A state, the path there, and the specific force in sensor axes."""
    rng = np.random.default_rng(seed)
    turned = Rotation.random(KNOTS, random_state=rng).as_matrix()
    force = rng.normal(size=(KNOTS, 3)) * 5.0
    nothing = {name: np.zeros(0) for name in Integrated.__dataclass_fields__}
    path = Integrated(
        **{
            **nothing,
            "turned": turned,
            "rate": rng.normal(size=(KNOTS, 3)),
            "force": np.einsum("nij,nj->ni", turned, force),
        }
    )
    q = Rotation.random(KNOTS, random_state=rng).as_quat()
    return State(q, rng.normal(size=(KNOTS, 3)), VALUES), path, force


def solved(theta: Array, turn: Array, push: Array) -> Solved:
    nothing = np.zeros(0)
    return Solved(theta, np.hstack([turn, push]), nothing, nothing, nothing, (nothing, nothing), nothing)


def rotation(state: State) -> Rotation:
    return Rotation.from_quat(state.q)


def test_a_step_turns_about_axes_of_the_earth_and_adds_the_rest() -> None:
    state, path, _ = flown()
    rng = np.random.default_rng(2)
    theta, turn, push = rng.normal(size=10), 0.1 * rng.normal(size=(KNOTS, 3)), rng.normal(size=(KNOTS, 3))
    theta[LAYOUT["lag"]] = 0.0
    found = moved(state, solved(theta, turn, push), path, LAYOUT, GRAVITY)
    np.testing.assert_allclose(found.velocity, state.velocity + push)
    expected = Rotation.from_rotvec(turn) * rotation(state)
    np.testing.assert_allclose((expected.inv() * rotation(found)).as_rotvec(), 0.0, atol=1e-12)
    for name, columns in LAYOUT.items():
        np.testing.assert_allclose(found.values[name], VALUES[name] + theta[columns])


@pytest.mark.parametrize(("largest", "share"), [(0.49, 1.0), (0.5, 1.0), (1.0, 0.5), (4.0, 0.125)])
def test_a_step_that_turns_a_knot_further_than_half_a_radian_is_shortened(largest: float, share: float) -> None:
    state, path, _ = flown()
    turn = np.zeros((KNOTS, 3))
    turn[2] = largest * np.array([2.0, -1.0, 2.0]) / 3.0
    turn[1] = 0.2 * turn[2]
    theta = np.arange(10.0) * 1e-3
    still = replace(path, force=np.zeros((KNOTS, 3)), rate=np.zeros((KNOTS, 3)))
    found = moved(state, solved(theta, turn, np.ones((KNOTS, 3))), still, LAYOUT, np.zeros(3))
    np.testing.assert_allclose(found.velocity, state.velocity + share)
    turned = (rotation(found) * rotation(state).inv()).as_rotvec()
    np.testing.assert_allclose(turned, share * turn, atol=1e-12)
    for name, columns in LAYOUT.items():
        np.testing.assert_allclose(found.values[name], VALUES[name] + share * theta[columns])


@pytest.mark.parametrize(
    ("lag", "longer", "found_lag"),
    [
        (0.1, 0.03, 0.13),
        (0.1, -0.02, 0.08),
        (0.1, 0.3, 0.15),  # no more in a step
        (0.1, -0.3, 0.05),
        (0.58, 0.04, 0.6),  # no longer than that
        (-0.19, -0.04, -0.2),
    ],
)
def test_with_a_longer_lag_knots_are_earlier_on_the_path(lag: float, longer: float, found_lag: float) -> None:
    """By the change δ of the lag: velocity less a δ, attitude turned back by ω δ about the sensor's axes."""
    state, path, force = flown()
    state = state.with_values(lag=np.array([lag]))
    theta = np.zeros(10)
    theta[LAYOUT["lag"]] = longer
    nothing = np.zeros((KNOTS, 3))
    found = moved(state, solved(theta, nothing, nothing), path, LAYOUT, GRAVITY)
    late = found_lag - lag
    assert found.lag_s == pytest.approx(found_lag)
    acceleration = rotation(state).apply(force) + GRAVITY
    np.testing.assert_allclose(found.velocity, state.velocity - acceleration * late)
    expected = rotation(state) * Rotation.from_rotvec(-path.rate * late)
    np.testing.assert_allclose((expected.inv() * rotation(found)).as_rotvec(), 0.0, atol=1e-12)
