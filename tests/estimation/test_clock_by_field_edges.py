"""The magnetometer's clock: its covariance with every coefficient written out, and how two clocks become one."""

from __future__ import annotations

import inspect
from dataclasses import replace

import numpy as np
import pytest
from numerics_support import autoregressive

from fieldcal.config.parameters import Parameters
from fieldcal.estimation.clock_sync import by_field, by_rates
from fieldcal.estimation.clock_sync.by_field import FieldClock, block_rates, refine_by_field
from fieldcal.estimation.statistics import huber_inflation, least_squares_covariance
from fieldcal.geometry.rotation import body_from_inertial, continuous, from_rotation_vector, hermite
from fieldcal.simulation.experiment import simulate

Known = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, by_rates.SyncFit, by_rates.SyncFit, FieldClock]


@pytest.fixture(scope="module")
def known() -> Known:
    """t, counts, VPS stamps and attitudes; the gyroscope's clock, the refined one and the magnetometer's own."""
    r = simulate(seed=7, duration_s=25.0, vps_skew_ppm=200.0, vps_misalignment_rad=0.1)
    q = continuous(r.vps_q)
    gyro = r.counts["gyroscope"] - np.median(r.counts["gyroscope"], axis=0)
    fit = by_rates.synchronise(r.t, gyro, r.vps_t, q)
    refined, own = refine_by_field(r.t, r.counts["magnetometer"], r.vps_t, q, fit)
    assert own is not None
    return r.t, r.counts["magnetometer"], r.vps_t, q, fit, refined, own


def slow(t: np.ndarray) -> np.ndarray:
    """Attitudes (n, 4) of a sway of a few seconds: what lag and skew do to the field is much like what A(q) does."""
    return from_rotation_vector(np.stack([0.6 * np.sin(t), 0.5 * np.cos(1.4 * t), 0.3 * np.sin(1.7 * t)], axis=1))


def slow_known(interval_s: float = 1.0 / 128.0, seconds: float = 20.0, noise: float = 0.02) -> Known:
    """`known` of the slow sway, with 280 readings whose noise remembers a few; the clocks agree."""
    rng = np.random.default_rng(0)
    t_vps = np.arange(0.0, seconds + interval_s / 2, interval_s)
    t = np.linspace(0.05, seconds - 0.05, 280)
    logged = body_from_inertial(slow(t)) @ np.array([0.5, 0.2, -0.8])
    logged += noise * autoregressive(rng, logged.shape, 0.7)
    logged[rng.uniform(size=len(t)) < 0.03] += 20.0 * noise
    fit = by_rates.SyncFit(
        lag_mid_s=0.0, skew_ppm=0.0, covariance=np.diag([1e-4, 1e-4]), peak=1.0, runner_up=0.0, peak_width_s=1.0,
        explained=1.0, matrix=np.eye(3), reference_s=seconds / 2, first_s=0.0, turning=np.eye(3),
    )  # fmt: skip
    refined, own = refine_by_field(t, logged, t_vps, slow(t_vps), fit)
    assert own is not None
    return t, logged, t_vps, continuous(slow(t_vps)), fit, refined, own


@pytest.mark.parametrize(("case", "within"), [("long", 0.02), ("slow", 0.01)])
def test_covariance_is_that_of_lag_and_skew_among_thirty_coefficients(known: Known, case: str, within: float) -> None:
    """All 32 columns by finite differences and by definition, none eliminated; residuals weighed by their scatter."""
    t, logged, t_vps, q, fit, _, own = known if case == "long" else slow_known()
    rate = block_rates(t_vps, q, 0.05)

    def attitudes(lag: float, skew: float) -> np.ndarray:
        at = (t - fit.reference_s) * (1 + skew) + fit.reference_s - lag
        return body_from_inertial(hermite(t_vps, q, rate, at)).reshape(-1, 9)

    at = (t - fit.reference_s) * (1 + own.skew) + fit.reference_s - own.lag_mid_s
    inside = (at >= t_vps[0]) & (at <= t_vps[-1])
    a = attitudes(own.lag_mid_s, own.skew)
    x = np.column_stack([a, np.ones(len(t))])[inside]
    weight, coefficients, residual = by_field._regressed(x.T, logged[inside].T)
    residual = residual.T
    h = np.array([1e-4, 1e-5])
    moved = [
        (attitudes(own.lag_mid_s + d[0], own.skew + d[1]) - attitudes(own.lag_mid_s - d[0], own.skew - d[1]))
        / 2
        / d.sum()
        for d in np.diag(h)
    ]
    spread, root = residual.std(axis=0), np.sqrt(weight)
    columns = np.zeros((len(x), 3, 32))
    for i in range(2):
        columns[:, :, i] = moved[i][inside] @ coefficients[:9]
    for channel in range(3):
        columns[:, channel, 2 + 10 * channel : 12 + 10 * channel] = x
    columns *= root[:, None, None] / spread[:, None]
    covariance = least_squares_covariance(columns, residual * root[:, None] / spread)[1][:2, :2]
    expected = covariance * huber_inflation(weight)
    sd = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(own.covariance / np.outer(sd, sd), expected / np.outer(sd, sd), atol=within)


def test_the_refined_clock_is_both_by_their_information(known: Known) -> None:
    *_, fit, refined, own = known
    a, b = np.linalg.inv(fit.covariance), np.linalg.inv(own.covariance)
    both = np.linalg.solve(a + b, a @ [fit.lag_mid_s, 1e-6 * fit.skew_ppm] + b @ [own.lag_mid_s, own.skew])
    assert refined.lag_mid_s == pytest.approx(both[0], rel=1e-9)
    assert refined.skew_ppm == pytest.approx(1e6 * both[1], rel=1e-6)
    np.testing.assert_allclose(refined.covariance, np.linalg.inv(a + b), rtol=1e-9)
    off = np.array([own.lag_mid_s - fit.lag_mid_s, own.skew - 1e-6 * fit.skew_ppm])
    assert own.disagreement == pytest.approx(off @ np.linalg.solve(own.covariance + fit.covariance, off), rel=1e-9)


@pytest.mark.parametrize(("chi2", "heard"), [(13.7, True), (13.9, False)])
def test_a_clock_in_a_thousand_contradicts_by_chance(known: Known, chi2: float, heard: bool) -> None:
    """The gyroscope's clock is moved until the difference to the magnetometer's is so large."""
    t, logged, t_vps, q, fit, _, own = known
    total = own.covariance + fit.covariance
    off = np.sqrt(chi2 / np.linalg.inv(total)[0, 0])
    moved = replace(fit, lag_mid_s=own.lag_mid_s - off, skew_ppm=1e6 * own.skew)
    refined, again = refine_by_field(t, logged, t_vps, q, moved)
    assert again is not None
    assert again.disagreement == pytest.approx(chi2, abs=0.05)
    assert (refined is not moved) == heard


@pytest.mark.parametrize(("readings", "enough"), [(199, False), (200, True)])
def test_two_hundred_readings_are_enough(known: Known, readings: int, enough: bool) -> None:
    t, logged, t_vps, q, fit, _, _ = known
    own = logged.copy()
    there = np.linspace(400, len(t) - 400, readings).astype(int)
    own[np.setdiff1d(np.arange(len(t)), there)] = np.nan
    own[there[5] + 1, :2] = 3.0  # two axes of three are no reading
    assert (refine_by_field(t, own, t_vps, q, fit)[1] is not None) == enough


def test_readings_in_a_gap_are_none_of_the_two_hundred(known: Known) -> None:
    t, logged, t_vps, q, fit, _, _ = known
    kept = (t_vps < t_vps[0] + 8.0) | (t_vps > t_vps[0] + 9.0)
    at = t - fit.lag_mid_s
    gap = (at > t_vps[0] + 8.05) & (at < t_vps[0] + 8.95)
    own = logged.copy()
    outside = np.flatnonzero((at < t_vps[0] + 7.9) & (at > t_vps[0] + 1.0))
    own[np.setdiff1d(np.arange(len(t)), [*np.flatnonzero(gap), *outside[:: len(outside) // 150][:150]])] = np.nan
    assert gap.sum() > 100
    assert refine_by_field(t, own, t_vps, q, fit)[1] is not None
    assert refine_by_field(t, own, t_vps[kept], q[kept], fit)[1] is None


def test_readings_outside_the_vps_or_in_its_gaps_do_not_count(known: Known) -> None:
    t, logged, t_vps, q, fit, _, own = known
    spoiled = logged.copy()
    at = t - own.lag_mid_s
    kept = (t_vps < t_vps[0] + 8.0) | (t_vps > t_vps[0] + 8.2)
    inside_gap = (at > t_vps[0] + 8.0) & (at < t_vps[0] + 8.2)
    spoiled[inside_gap] += 1e6
    found = refine_by_field(t, spoiled, t_vps[kept], q[kept], fit)[1]
    assert found is not None
    assert abs(found.lag_mid_s - own.lag_mid_s) < 3.0 * np.sqrt(own.covariance[0, 0])
    half = (t_vps > t_vps[0] + 2.0) & (t_vps < t_vps[-1] - 2.0)
    spoiled = logged.copy()
    spoiled[(at < t_vps[0] + 1.9) | (at > t_vps[-1] - 1.9)] += 1e6
    found = refine_by_field(t, spoiled, t_vps[half], q[half], fit)[1]
    assert found is not None
    assert abs(found.lag_mid_s - own.lag_mid_s) < 3.0 * np.sqrt(own.covariance[0, 0])


@pytest.mark.parametrize(("n", "known_rate"), [(11, False), (12, True)])
def test_a_block_of_twelve_attitudes_has_rates(n: int, known_rate: bool) -> None:
    t = np.r_[np.arange(100) * 0.005, 1.0 + np.arange(n) * 0.005]
    rates = block_rates(t, from_rotation_vector(np.outer(t, [0.0, 0.5, 0.0])), 0.05)
    np.testing.assert_allclose(rates[:100], np.tile([0.0, 0.5, 0.0], (100, 1)), atol=1e-4)
    assert np.isfinite(rates[100:]).all() == known_rate
    assert np.isnan(rates[100:]).all() != known_rate


@pytest.mark.parametrize("end", ["first", "last"])
@pytest.mark.parametrize(("inside", "enough"), [(True, True), (False, False)])
def test_readings_count_from_the_first_attitude_to_the_last(end: str, inside: bool, enough: bool) -> None:
    """The two-hundredth reading lies within the outermost interval of the VPS, or beyond it."""
    *_, fit, _, _ = slow_known()
    t_vps = np.arange(321) * 0.0625
    t = np.linspace(0.5, 19.5, 199)
    off = 0.03 if inside else -0.03
    t = np.r_[off, t] if end == "first" else np.r_[t, 20.0 - off]
    logged = body_from_inertial(slow(t)) @ np.array([0.5, 0.2, -0.8])
    found = refine_by_field(t, logged, t_vps, slow(t_vps), fit, max_gap_s=0.0625)[1]  # no gap is longer than that
    assert (found is not None) == enough
    assert found is None or abs(found.lag_mid_s) < 0.01


def test_gaps_that_nobody_limits_are_the_configurations() -> None:
    own = inspect.signature(refine_by_field).parameters["max_gap_s"]
    assert own.default == Parameters.model_fields["vps_max_gap_s"].default


def test_rates_of_attitudes_are_slopes_over_thirty_milliseconds() -> None:
    """Of k t³ the slope of a quadratic through ±15 samples is 3 k t² + k Σu⁴ / Σu²."""
    t, k = np.arange(-60, 61) * 1e-3, 10.0
    u = np.arange(-15, 16) * 1e-3
    rates = block_rates(t, from_rotation_vector(np.outer(k * t**3, [1.0, 0.0, 0.0])), 0.05)
    inner = slice(15, -15)
    expected = 3.0 * k * t[inner] ** 2 + k * np.sum(u**4) / np.sum(u**2)
    np.testing.assert_allclose(rates[inner, 0], expected, rtol=1e-3)


def test_the_unit_of_an_axis_does_not_change_the_weights() -> None:
    """Residuals are held against the scatter of their own axis."""
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(300, 10)), rng.standard_t(3, size=(300, 3))
    expected = by_field._regressed(x.T, y.T)[0]
    found = by_field._regressed(x.T, (y * [1.0, 1e3, 1e-3]).T)[0]
    assert expected.min() < 0.7
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_the_clock_ends_at_the_same_place_from_either_side() -> None:
    t, logged, t_vps, q, fit, _, own = slow_known()
    for off in (-0.02, 0.03):
        found = refine_by_field(t, logged, t_vps, q, replace(fit, lag_mid_s=off))[1]
        assert found is not None
        assert found.lag_mid_s == pytest.approx(own.lag_mid_s, abs=1e-3 * np.sqrt(own.covariance[0, 0]))
