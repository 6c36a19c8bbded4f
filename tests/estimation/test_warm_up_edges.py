"""Warm-up at its limits: windows counted by hand, curves that are known, each refusal from both sides."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import numpy as np
import pytest

from fieldcal.config.parameters import Parameters
from fieldcal.errors import UnusableFlight
from fieldcal.estimation import warm_up
from fieldcal.estimation.warm_up import fit_resting_accelerometer, fit_warm_up, rest_windows

RATE_HZ = 100.0


def stamps(windows: float) -> np.ndarray:
    """So many windows of two seconds."""
    return np.arange(round(2.0 * windows * RATE_HZ)) / RATE_HZ


def test_windows_are_two_seconds_long_and_their_mean_is_that_of_their_readings() -> None:
    t = 7.0 + stamps(5.4)
    logged = np.column_stack([3.0 + 0.01 * t, -t])
    middles, means = rest_windows(t, logged)
    np.testing.assert_allclose(middles, 7.995 + 2.0 * np.arange(5))
    np.testing.assert_allclose(means, np.column_stack([3.0 + 0.01 * middles, -middles]))
    for n in (0.9, 1.0):
        assert len(rest_windows(stamps(n), np.ones((len(stamps(n)), 2)))[0]) == int(n)
    assert rest_windows(stamps(0.9), np.ones((180, 2)))[1].shape == (0, 2)


@pytest.mark.parametrize(("gap_s", "windows"), [(0.095, 2), (0.105, 1)])
def test_a_window_is_cut_from_a_stretch_without_a_gap(gap_s: float, windows: int) -> None:
    t = stamps(2.2)
    t[250:] += gap_s - 1.0 / RATE_HZ
    assert len(rest_windows(t, np.ones((len(t), 1)))[0]) == windows
    assert len(rest_windows(t, np.ones((len(t), 1)), max_gap_s=0.2)[0]) == 2


def swaying(size: float) -> np.ndarray:
    """Two windows of readings that alternate by ± 1, and by ± size from one tenth of a second to the next."""
    i = np.arange(400)
    return (np.where(i % 2, -1.0, 1.0) + size * np.where(i // 10 % 2, -1.0, 1.0))[:, None]


@pytest.mark.parametrize(("share", "rest"), [(0.97, True), (1.04, False)])
def test_rest_is_three_times_the_noise_of_a_block(share: float, rest: bool) -> None:
    """Second differences of ± 1 are ± 4: sigma 1.4826 · 4/√6, over the root of a block's ten samples. Of the sway the
    window's own line takes 0.4 %."""
    limit = 3.0 * 1.4826 * 4.0 / np.sqrt(6.0) / np.sqrt(10.0)
    middles, _ = rest_windows(stamps(2.0), swaying(share * limit / 0.9962))
    assert len(middles) == (2 if rest else 0)
    drifting = swaying(share * limit / 0.9962) + 30.0 * stamps(2.0)[:, None]
    assert len(rest_windows(stamps(2.0), drifting)[0]) == (2 if rest else 0)
    both = np.hstack([swaying(0.0), swaying(share * limit / 0.9962)])
    assert len(rest_windows(stamps(2.0), both)[0]) == (2 if rest else 0)


def test_slow_sampling_has_a_sample_a_block() -> None:
    t = np.arange(40) / 4.0
    middles, means = rest_windows(t, np.ones((40, 1)), max_gap_s=0.5)
    np.testing.assert_allclose(middles, 0.875 + 2.0 * np.arange(5))
    assert (means == 1.0).all()


def warmed(windows: int, span: float) -> np.ndarray:
    """Temperature that rises evenly by `span` from the first window's middle to the last one's."""
    return 20.0 + span * stamps(windows) / (2.0 * (windows - 1))


def readings(warm: np.ndarray) -> np.ndarray:
    """A cubic curve on each axis, about 22 °C, and a little alternating noise."""
    x = (warm - 22.0) / 2.0
    curves = np.column_stack([5.0 + x, -3.0 * x + 0.5 * x**3, 7.0 - 2.0 * x**2])
    return curves + 0.05 * np.where(np.arange(len(warm)) % 2, -1.0, 1.0)[:, None]


@pytest.mark.parametrize(("windows", "span", "code"), [
    (8, 3.01, None), (7, 3.01, "too_little_rest"), (8, 2.99, "temperature_steady"), (7, 1.0, "too_little_rest"),
])  # fmt: skip
def test_eight_windows_and_three_degrees_are_enough(windows: int, span: float, code: str | None) -> None:
    t, warm = stamps(windows), warmed(windows, span)
    logged = (
        np.column_stack([2.0 * warm, -warm, 0.0 * warm]) + 1e-6 * np.where(np.arange(len(t)) % 2, -1.0, 1.0)[:, None]
    )
    still, gravity = np.zeros_like(logged), np.tile([0.0, 0.0, 9.8], (len(t), 1))
    if code is None:
        found = fit_warm_up(t, logged, warm)
        np.testing.assert_allclose(found.zero_per_degc, [2.0, -1.0, 0.0], atol=1e-6)
        assert (found.n_windows, found.bend) == (windows, None)
        assert found.span_degc == pytest.approx(span)
        assert found.width_degc == pytest.approx(0.5 * span)
        assert found.temperature_degc == pytest.approx(warm.mean())
        np.testing.assert_allclose(found.zero, [2.0 * warm.mean(), -warm.mean(), 0.0], atol=1e-6)
        rest = fit_resting_accelerometer(t, still, logged, warm, gravity)
        np.testing.assert_allclose(rest.zero_per_degc, [2.0, -1.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(rest.zero, found.zero, atol=1e-6)
        assert (rest.n_windows, rest.temperature_degc, rest.width_degc) == (
            windows, pytest.approx(warm.mean()), pytest.approx(0.5 * span)
        )  # fmt: skip
        return
    for fit in (
        lambda: fit_warm_up(t, logged, warm),
        lambda: fit_resting_accelerometer(t, still, logged, warm, gravity),
    ):
        with pytest.raises(UnusableFlight) as refused:
            fit()
        assert refused.value.reason_code == code
        assert refused.value.measured["rest_windows"] == windows


def test_nothing_at_rest_is_refused_with_nothing_measured() -> None:
    t = stamps(0.5)
    with pytest.raises(UnusableFlight) as refused:
        fit_resting_accelerometer(t, *(np.zeros((100, 3)),) * 2, np.full(100, 20.0), np.zeros((100, 3)))
    assert refused.value.measured == {"rest_windows": 0, "span_degc": 0.0}


@pytest.mark.parametrize("windows", [15, 16, 40])
def test_sixteen_windows_bear_a_cubic(windows: int) -> None:
    t, warm = stamps(windows), warmed(windows, 4.0)
    found = fit_warm_up(t, readings(warm), warm)
    if windows < 16:
        assert found.bend is None
        assert found.bend_covariance is None
        return
    assert found.bend is not None
    assert found.bend_covariance is not None
    assert found.bend.shape == (3, 3)
    assert found.bend_covariance.shape == (3, 3, 3)
    x = np.linspace(-1.0, 1.0, 9)
    curve = found.bend @ np.stack([x, x**2, x**3])
    degc = found.temperature_degc + found.width_degc * x
    truth = readings(degc) - readings(np.full(9, found.temperature_degc))
    np.testing.assert_allclose(curve, truth.T, atol=5e-3)  # means of windows, not readings at their middles


def test_gravity_along_an_axis_hides_the_slope_of_its_scale() -> None:
    """Without noise the sd is what a usual scale slope of 2e-4 per °C makes of gravity, and nothing else."""
    t, warm = stamps(12), warmed(12, 10.0)
    gravity = np.tile([0.0, 3.0, -9.0], (len(t), 1))
    found = fit_resting_accelerometer(t, np.zeros((len(t), 3)), gravity + 0.01 * warm[:, None], warm, gravity)
    np.testing.assert_allclose(found.sd, 2e-4 * np.abs(gravity[0]), atol=1e-9)
    np.testing.assert_allclose(found.zero_per_degc, 0.01, rtol=1e-6)


def test_the_longest_run_has_no_pause_of_more_than_a_window_and_a_half() -> None:
    def run(*middles: float) -> list[int]:
        chosen = warm_up._longest_run(np.array(middles, float))
        return list(range(len(middles)))[chosen]

    assert run(1, 3, 5, 20, 22, 24, 26) == [3, 4, 5, 6]
    assert run(1, 3, 5, 20, 22) == [0, 1, 2]
    assert run(1, 3.9, 6.8, 10) == [0, 1, 2]
    assert run(1, 3, 6.1) == [0, 1]
    assert run() == []
    assert run(4) == [0]


@pytest.mark.parametrize("function", [rest_windows, fit_warm_up, fit_resting_accelerometer])
def test_pauses_that_nobody_limits_are_the_configurations(function: Callable[..., object]) -> None:
    own = inspect.signature(function).parameters["max_gap_s"]
    assert own.default == Parameters.model_fields["manoeuvre_max_gap_s"].default
