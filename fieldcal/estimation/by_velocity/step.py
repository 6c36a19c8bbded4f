"""A step of Gauss and Newton: what corrections make of the state, no further than the linearisation holds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fieldcal.estimation.by_velocity.equations import Solved
from fieldcal.estimation.by_velocity.problem import LARGEST_LAG_S, SMALLEST_LAG_S, State
from fieldcal.estimation.by_velocity.strapdown import Integrated
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector, multiply

LARGEST_TURN_RAD, LARGEST_LAG_STEP_S = 0.5, 0.05


def moved(state: State, solved: Solved, path: Integrated, layout: Mapping[str, slice], gravity: Array) -> State:
    """The state after a step; a turn or lag too far for the linearisation is shortened, and with the lag the knots
    move: where it is longer they are earlier on the path. `gravity` (3,) m/s² NED."""
    largest = float(np.max(np.linalg.norm(solved.knots[:, :3], axis=1)))
    step = LARGEST_TURN_RAD / max(largest, LARGEST_TURN_RAD)
    theta = step * solved.theta
    values = {name: state.values[name] + theta[columns] for name, columns in layout.items()}
    late = float(np.clip(theta[layout["lag"]][0], -LARGEST_LAG_STEP_S, LARGEST_LAG_STEP_S))
    lag = float(np.clip(state.lag_s + late, SMALLEST_LAG_S, LARGEST_LAG_S))
    late = lag - state.lag_s
    values["lag"] = np.array([lag])
    q = multiply(from_rotation_vector(step * solved.knots[:, :3]), state.q)
    force = np.einsum("nij,nj->ni", path.turned.transpose(0, 2, 1), path.force)
    acceleration = np.einsum("nji,nj->ni", body_from_inertial(q), force) + gravity
    velocity = state.velocity + step * solved.knots[:, 3:] - acceleration * late
    return State(multiply(q, from_rotation_vector(-path.rate * late)), velocity, values)
