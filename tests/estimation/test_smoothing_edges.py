"""Short records, exact limits and holes of the smoothing: the filter written out, SciPy and counting."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_filter
from test_smoothing import FFT_ROUNDING, direct_sum

from fieldcal.estimation import smoothing

INTERVAL_S = 1.0 / 64.0
CUTOFF_HZ = 3.0


def noise(n: int) -> np.ndarray:
    return np.random.default_rng(n).normal(size=(n, 3))


@pytest.mark.parametrize("changes", [{"cutoff_hz": 0.0}, {"interval_s": 0.0}, {"side": 0}, {"cutoff_hz": -1.0}])
def test_weights_need_positive_numbers(changes: dict[str, float]) -> None:
    good = {"cutoff_hz": CUTOFF_HZ, "interval_s": INTERVAL_S, "side": 1}
    assert len(smoothing.low_pass_weights(**good)) == 3
    with pytest.raises(ValueError, match="must be positive"):
        smoothing.low_pass_weights(**{**good, **changes})


@pytest.mark.parametrize(("ends", "sign"), [("odd", -1.0), ("even", 1.0)])
@pytest.mark.parametrize("n", [2, 3, 4, 20, 32, 33, 34])
def test_a_short_record_uses_what_there_is(n: int, ends: str, sign: float) -> None:
    """Half a second is 32 samples; a record of fewer has weights as long as it reaches."""
    weights = smoothing.low_pass_weights(CUTOFF_HZ, INTERVAL_S, min(32, n - 1))
    found = smoothing.low_pass(noise(n), CUTOFF_HZ, INTERVAL_S, ends=ends)
    np.testing.assert_allclose(found, direct_sum(noise(n), weights, sign), atol=FFT_ROUNDING)


@pytest.mark.parametrize("cutoff_hz", [31.9, 32.0, 33.0])
def test_nothing_is_filtered_from_nyquist_on(cutoff_hz: float) -> None:
    x = noise(100)
    same = np.array_equal(smoothing.low_pass(x, cutoff_hz, INTERVAL_S), x)
    assert same == (cutoff_hz >= 32.0)
    assert np.array_equal(smoothing.low_pass(x[:1], CUTOFF_HZ, INTERVAL_S), x[:1])


@pytest.mark.parametrize(("n", "window_s", "width"), [(5, 0.0, 5), (5, 9.0, 5), (6, 9.0, 5), (7, 9.0, 7), (8, 9.0, 7)])
def test_the_window_is_no_wider_than_the_record(n: int, window_s: float, width: int) -> None:
    found = smoothing.differentiate(noise(n), INTERVAL_S, window_s=window_s)
    wanted = savgol_filter(noise(n), width, 2, deriv=1, delta=INTERVAL_S, axis=0, mode="interp")
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


def test_four_samples_are_too_few() -> None:
    with pytest.raises(ValueError, match="at least 5 samples, got 4"):
        smoothing.differentiate(noise(4), INTERVAL_S)


def test_five_points_unless_told_otherwise() -> None:
    t = 10.0 + INTERVAL_S * np.arange(50)
    wanted = savgol_filter(noise(50), 5, 2, deriv=1, delta=INTERVAL_S, axis=0, mode="interp")
    np.testing.assert_allclose(smoothing.differentiate_samples(t, noise(50)), wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("interval_s", [1 / 256, 1.0, 512.0])
@pytest.mark.parametrize(
    ("others", "counts"),
    [
        ([0.53, 1.47], [1, 1]),
        ([0.53], [1]),
        ([1.47], [1]),
        ([1.6, 2.4], [2, 2]),
        ([1.53], [2]),
        ([0.47], [1]),
        ([0.5], [1]),
        ([1.5], [2]),
    ],
)
def test_single_steps_settle_the_interval(others: list[float], counts: list[int], interval_s: float) -> None:
    """Two steps in ten are others than one interval, and there is a hole of samples whose number tells which of them
    were taken for single ones: those between half and one and a half intervals."""
    pattern = [1.0] * 8 + [others[0], others[-1]]
    steps, index = pattern * 10, ([1] * 8 + [counts[0], counts[-1]]) * 10
    single = [s for s in steps if 0.5 < s < 1.5]
    hole = 60
    steps, index = [*steps, hole * float(np.mean(single)), *steps], [*index, hole, *index]
    t = interval_s * np.cumsum([0.0, *steps])
    found, found_interval_s = smoothing.lattice(t)
    # Two intervals less a bit are two: rounding to even at one and a half.
    np.testing.assert_array_equal(found, np.cumsum([0, *index]))
    assert found_interval_s == pytest.approx(t[-1] / sum(index), rel=1e-12)


def test_holes_are_filled_up_to_the_last_sample() -> None:
    index = np.array([0, 1, 4, 5])
    x = np.array([[0.0, 8.0], [1.0, 8.0], [7.0, 2.0], [9.0, 0.0]])
    wanted = [[0.0, 8.0], [1.0, 8.0], [3.0, 6.0], [5.0, 4.0], [7.0, 2.0], [9.0, 0.0]]
    np.testing.assert_allclose(smoothing.fill(index, x), wanted, rtol=1e-15)
    np.testing.assert_array_equal(smoothing.fill(np.arange(4), x), x)


def test_three_samples_are_filtered_two_are_not() -> None:
    t = INTERVAL_S * np.arange(3)
    assert np.array_equal(smoothing.smooth_samples(t[:2], noise(2), CUTOFF_HZ), noise(2))
    assert np.array_equal(smoothing.smooth_samples(t, noise(3), 0.0), noise(3))
    weights = smoothing.low_pass_weights(CUTOFF_HZ, INTERVAL_S, 2)
    found = smoothing.smooth_samples(t, noise(3), CUTOFF_HZ)
    np.testing.assert_allclose(found, direct_sum(noise(3), weights, -1.0), atol=FFT_ROUNDING)
