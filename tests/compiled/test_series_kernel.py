"""The compiled prediction errors of series of sessions against their NumPy counterpart."""

from __future__ import annotations

import numpy as np
import pytest

import fieldcal.estimation.pooled.strengths as module
from fieldcal import compiled
from fieldcal.estimation.pooled.strengths import Series, Strengths, innovations

pytestmark = pytest.mark.skipif(compiled.LIBRARY is None, reason="No kernel was compiled, or FIELDCAL_KERNEL=numpy.")


@pytest.mark.parametrize("lengths", [(7, 3, 0, 1, 9), (1,), (0, 0), ()])
def test_errors_and_variances_are_the_same(lengths: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(len(lengths))
    series = Series.of(
        [
            np.column_stack(
                [np.cumsum(rng.uniform(1, 9, m)), rng.normal(size=m), 4.0 * rng.normal(size=m), rng.uniform(size=m)]
            )
            for m in lengths
        ]
    )
    series.value[2:3] = np.nan  # a session that says nothing of any
    strengths = Strengths(0.05, 0.3, 0.2)
    in_c = innovations(series, strengths)
    monkeypatch.setattr(module, "LIBRARY", None)
    for found, expected in zip(in_c, innovations(series, strengths), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
