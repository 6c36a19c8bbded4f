"""Products and attitudes between stamps by the compiled kernel against their NumPy counterparts."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal import compiled
from fieldcal.geometry.rotation import Array, hermite, multiply, normalise, slerp

pytestmark = pytest.mark.skipif(compiled.LIBRARY is None, reason="No kernel was compiled, or FIELDCAL_KERNEL=numpy.")
N = 400


def record() -> tuple[Array, Array, Array]:
    """Uneven stamps with a pause, attitudes of either sign up to half a turn apart, and rates some of which nobody
    knows."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.002, 0.02, size=N)) + 4.0 * (np.arange(N) > 250)
    rate = 3.0 * rng.normal(size=(N, 3))
    rate[rng.random(N) < 0.1] = np.nan
    rate[7, 1] = np.inf
    return t, normalise(np.cumsum(rng.normal(size=(N, 4)), axis=0)), rate


def times(t: Array) -> dict[str, Array]:
    rng = np.random.default_rng(4)
    inside = rng.uniform(t[0], t[-1], size=3 * N)
    return {
        "rising": np.sort(inside),
        "in any order": inside,
        "falling": np.sort(inside)[::-1],
        "the stamps themselves": t,
        "outside": np.array([t[0] - 1.0, t[0], t[-1], t[-1] + 1.0, t[0] - 1e9, t[-1] + 1e9]),
        "one": t[3:4] + 1e-3,
        "none": np.zeros(0),
        "not a number": np.r_[t[5] + 1e-3, np.nan, t[9] + 1e-3, np.nan],
        "far apart": t[::97],
    }


@pytest.mark.parametrize("which", list(times(np.arange(10.0))))
def test_attitudes_between_stamps_are_the_same(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    t, q, rate = record()
    at = times(t)[which]
    own = slerp(t, q, at), hermite(t, q, rate, at)
    monkeypatch.setattr(compiled, "LIBRARY", None)
    for mine, oracle in zip(own, (slerp(t, q, at), hermite(t, q, rate, at)), strict=True):
        assert mine.shape == (len(at), 4)
        np.testing.assert_allclose(mine, oracle, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize(
    ("p", "q"),
    [((N, 4), (N, 4)), ((N, 4), (4,)), ((4,), (N, 4)), ((1, 4), (1, 4)), ((0, 4), (4,)), ((1, 4), (N, 4)), ((4,), (4,)),
     ((3, 1, 4), (N, 4))],
)  # fmt: skip
def test_products_are_the_same(p: tuple[int, ...], q: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=p), rng.normal(size=q)
    a[..., 2][a[..., 1] > 2.0] = np.nan
    strided = np.asfortranarray(b)[..., ::-1]
    own = multiply(a, b), multiply(a, strided)
    monkeypatch.setattr(compiled, "LIBRARY", None)
    for mine, oracle in zip(own, (multiply(a, b), multiply(a, strided)), strict=True):
        assert mine.shape == oracle.shape
        np.testing.assert_allclose(mine, oracle, rtol=0.0, atol=1e-14)


def test_of_two_stamps_and_of_attitudes_that_are_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    q = normalise(np.array([[0.1, -0.3, 0.2, 0.9], [0.1, -0.3, 0.2, 0.9]]))
    at = np.array([-1.0, 0.0, 0.3, 1.0, 2.0])
    own = slerp(np.array([0.0, 1.0]), q, at)
    np.testing.assert_allclose(own, np.repeat(q[:1], 5, axis=0), atol=1e-15)
    monkeypatch.setattr(compiled, "LIBRARY", None)
    np.testing.assert_allclose(own, slerp(np.array([0.0, 1.0]), q, at), atol=1e-15)


def test_other_shapes_are_refused() -> None:
    t, q, rate = record()
    with pytest.raises(ValueError, match="instead of"):
        slerp(t, q[:-1], t)
    with pytest.raises(ValueError, match="instead of"):
        hermite(t, q, rate[:, :2], t)
    with pytest.raises(ValueError, match="instead of"):
        multiply(q[:, :3], q)
