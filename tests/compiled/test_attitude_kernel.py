"""The compiled kernel of output error against its NumPy counterpart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fieldcal import compiled
from fieldcal.estimation.gyroscope.equation_error import GyroFit
from fieldcal.estimation.gyroscope.output_error import fit_output_error, propagate_stretches
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply

pytestmark = pytest.mark.skipif(compiled.LIBRARY is None, reason="No kernel was compiled, or FIELDCAL_KERNEL=numpy.")
N = 2000
SCALE, BIAS = np.array([2e-4, -3e-4, 4e-4]), np.array([0.02, -0.01, 0.03])


def record() -> tuple[Array, Array, Array]:
    """Uneven stamps, s, counts and noisy attitudes of a tumbling gyroscope, with two pauses."""
    rng = np.random.default_rng(4)
    t = np.cumsum(0.01 + 0.002 * rng.uniform(size=N)) + np.repeat([0.0, 3.0, 5.0], [700, 800, 500])
    rate = np.stack([np.sin(1.3 * t), 0.8 * np.cos(0.9 * t), 0.5 * np.sin(0.4 * t)], axis=1)
    segment = np.repeat([0, 1, 2], [700, 800, 500])
    q = multiply(from_rotation_vector(0.01 * rng.normal(size=(N, 3))), propagate_stretches(t, rate, segment))
    return t, (rate - BIAS) / SCALE, q


@pytest.mark.parametrize("initial_attitude", ["estimated", "fixed"])
def test_output_error_is_the_same(initial_attitude: str, monkeypatch: pytest.MonkeyPatch) -> None:
    t, logged, q = record()
    weight = np.random.default_rng(5).uniform(size=N)
    start = GyroFit(1.02 * SCALE, BIAS, np.eye(6), np.eye(6), 0.0, N)

    def fitted() -> Any:
        segment = np.repeat([0, 1, 2], [700, 800, 500])
        how = {"segment": segment, "initial_attitude": initial_attitude, "weights": weight, "stretch_s": 4.0}
        return fit_output_error(t, q, logged, start, **how)

    own = fitted()
    monkeypatch.setattr(compiled, "LIBRARY", None)
    oracle = fitted()
    sd = np.sqrt(np.diagonal(oracle.covariance))
    assert own.iterations == oracle.iterations
    assert np.abs(own.scale - oracle.scale).max() < 1e-9 * sd[:3].min()
    assert np.abs(own.bias - oracle.bias).max() < 1e-9 * sd[3:].min()
    np.testing.assert_allclose(own.covariance, oracle.covariance, rtol=1e-8, atol=1e-9 * np.outer(sd, sd).min())


def test_stretches_begin_at_the_identity_and_run_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    t, rate = np.cumsum(rng.uniform(0.001, 0.3, size=300)), 5.0 * rng.normal(size=(300, 3))
    stretch = np.repeat([0, 1, 1, 2, 5], 60)
    own = propagate_stretches(t, rate, stretch)
    monkeypatch.setattr(compiled, "LIBRARY", None)
    np.testing.assert_allclose(own, propagate_stretches(t, rate, stretch), atol=1e-12)
    assert own[[0, 60, 180, 240]].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 4
