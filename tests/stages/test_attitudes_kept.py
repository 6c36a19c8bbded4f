"""The attitude that the joint estimate keeps: rounded far below what it knows, and a third of its size."""

from __future__ import annotations

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import angle_between, from_matrix, multiply
from fieldcal.stages.joint.found import QUATERNION_STEP, trajectory_table
from fieldcal.stages.tables import QUATERNION, matrix
from fieldcal.warehouse.store import frame_bytes

N = 4000
AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def wandering() -> np.ndarray:
    q = np.array([0.3, -0.2, 0.1, 0.9]) + np.cumsum(0.003 * np.random.default_rng(1).normal(size=(N, 4)), axis=0)
    return np.asarray(q / np.linalg.norm(q, axis=1)[:, None])


def test_attitudes_are_kept_to_half_a_microradian_in_a_third_of_the_bytes() -> None:
    attitude = wandering()
    samples = pl.DataFrame({"t_ns": np.arange(N), "segment": np.zeros(N, dtype=np.int32)})
    kept = trajectory_table(attitude, {"samples": samples}, AXES)
    q, exact = matrix(kept, QUATERNION), multiply(attitude, from_matrix(AXES))
    assert np.max(angle_between(q / np.linalg.norm(q, axis=1)[:, None], exact)) < 5e-7
    assert np.max(np.abs(q - exact)) > 0.4 * QUATERNION_STEP  # it is rounded
    np.testing.assert_array_equal(q / QUATERNION_STEP, np.round(q / QUATERNION_STEP))
    whole = kept.with_columns(**{name: exact[:, i] for i, name in enumerate(QUATERNION)})
    assert len(frame_bytes(kept.select(QUATERNION), {})) < 0.5 * len(frame_bytes(whole.select(QUATERNION), {}))
