"""From a VPS's world to NED: gravity comes out down and the field north, whatever world the poses were in."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import angle, random_attitudes
from scipy.spatial.transform import Rotation

from fieldcal.estimation.by_pose.level import mean_in_world, ned_from_world
from fieldcal.geometry.rotation import body_from_inertial, multiply

FIELD_NED = np.array([0.4, 0.1, 0.8])


@pytest.mark.parametrize("seed", range(5))
def test_attitudes_come_into_ned(seed: int) -> None:
    """World = any rotation of NED; sensors see gravity and field by the true attitude."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()  # components in the world of NED's
    q_world = random_attitudes(rng, 50)
    sensor_from_world = body_from_inertial(q_world)
    down, field = (np.einsum("nij,j->ni", sensor_from_world @ turn, v) for v in (np.array([0, 0, 9.81]), FIELD_NED))
    p = ned_from_world(mean_in_world(q_world, down), mean_in_world(q_world, field), FIELD_NED)
    sensor_from_ned = body_from_inertial(multiply(p, q_world))
    np.testing.assert_allclose(sensor_from_ned, sensor_from_world @ turn, atol=1e-9)


def test_what_is_not_known_stays() -> None:
    assert ned_from_world(None, None, FIELD_NED).tolist() == [0.0, 0.0, 0.0, 1.0]
    level = body_from_inertial(ned_from_world([0.0, 1.0, 1.0], None, FIELD_NED))
    np.testing.assert_allclose(level.T @ np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0), [0.0, 0.0, 1.0], atol=1e-12)
    upside_down = body_from_inertial(ned_from_world([1e-6, 0.0, -1.0], None, FIELD_NED))
    np.testing.assert_allclose(upside_down.T @ np.array([1e-6, 0.0, -1.0]), [0.0, 0.0, 1.0], atol=1e-5)


@pytest.mark.parametrize("tilt_rad", [0.1, 1.0, np.pi / 2, 1e-9])
def test_without_a_field_the_turn_is_the_shortest(tilt_rad: float) -> None:
    """North is left where it is as far as a tilt allows: the turn is by the tilt alone."""
    for way in np.linspace(0.0, 6.0, 7):
        level = np.sin(tilt_rad) * np.array([np.cos(way), np.sin(way)])
        p = ned_from_world([*level, np.cos(tilt_rad) if tilt_rad < 1.5 else 0.0], None, FIELD_NED)
        assert angle(p, [0.0, 0.0, 0.0, 1.0]) == pytest.approx(tilt_rad, rel=1e-6)


def test_a_single_reading_is_its_mean() -> None:
    assert mean_in_world([[0.0, 0.0, 0.0, 1.0]], [[1.0, 2.0, 3.0]]).tolist() == [1.0, 2.0, 3.0]


def test_rows_without_a_reading_are_left_out_of_the_mean() -> None:
    q = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    vectors = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [3.0, 2.0, 1.0]])
    assert mean_in_world(q, vectors).tolist() == [2.0, 2.0, 2.0]
