"""The adjusted ellipsoid from moments: six kinds of tests."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import Array, directions, rms
from onboard_support import readings, tilting
from scipy import linalg

from fieldcal.onboard import Limits, Moments, MomentsFit
from fieldcal.onboard.ellipsoid import PRODUCT
from fieldcal.onboard.moments import EXPONENTS, sums_of, translate, without_noise
from fieldcal.reason_codes import ReasonCode

SCALE = np.diag([1.05, 0.93, 1.02])
CROSS = np.array([[0.0, 0.02, -0.01], [0.02, 0.0, 0.015], [-0.01, 0.015, 0.0]])
BIAS = np.array([0.2, -0.1, 0.15])
NOISE = 0.005
NOISE_FREE = 1e-8
"""Rounding of fourth-order moments and of their square root."""


def solve(z: Array, *, full: bool = False, in_mean: int = 2, **limits: float) -> MomentsFit:
    moments = Moments(in_mean=in_mean)
    moments.feed(z)
    return moments.solve(Limits(magnitude=1.0, full=full, **limits))


@pytest.mark.parametrize("full", [False, True])
def test_exact_without_noise(full: bool) -> None:
    rng = np.random.default_rng(1)
    scale = SCALE + CROSS if full else SCALE
    fit = solve(readings(tilting(rng, 2000, 60.0), scale, BIAS, 0.0, rng), full=full)
    assert fit.reason_code is None
    np.testing.assert_allclose(fit.scale, scale, atol=NOISE_FREE)
    np.testing.assert_allclose(fit.bias, BIAS, atol=NOISE_FREE)


@pytest.mark.parametrize(("parameter", "changed"), [("bias", [0.0, 0.3, 0.0]), ("scale", [0.0, 0.0, 0.1])])
def test_one_fault_moves_one_parameter(parameter: str, changed: list[float]) -> None:
    a = tilting(np.random.default_rng(2), 2000, 75.0)
    fault = np.array(changed)
    scale, bias = (SCALE + np.diag(fault), BIAS) if parameter == "scale" else (SCALE, BIAS + fault)
    before, after = (
        solve(readings(a, own, offset, 0.0, np.random.default_rng(3))) for own, offset in ((SCALE, BIAS), (scale, bias))
    )
    np.testing.assert_allclose(np.diagonal(after.scale - before.scale), np.diagonal(scale - SCALE), atol=NOISE_FREE)
    np.testing.assert_allclose(after.bias - before.bias, bias - BIAS, atol=NOISE_FREE)


@pytest.mark.parametrize(("full", "tilt_deg"), [(False, 75.0), (False, 45.0), (True, 75.0), (True, 45.0)])
def test_errors_are_as_large_as_claimed_and_have_no_mean(full: bool, tilt_deg: float) -> None:
    scale = SCALE + CROSS if full else SCALE
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        fit = solve(readings(tilting(rng, 3000, tilt_deg), scale, BIAS, NOISE, rng), full=full, max_scale_sd=0.2)
        constants = np.concatenate([np.diagonal(fit.scale - scale), fit.bias - BIAS])
        whitened = linalg.cholesky(np.linalg.inv(fit.covariance)) @ constants
        ratios.append(whitened)
    assert 0.8 < rms(ratios) < 1.2
    assert np.abs(np.mean(ratios, axis=0)).max() < 4.0 / np.sqrt(len(ratios))


def test_without_the_correction_the_scale_would_be_wrong() -> None:
    """The quadric of moments that noise is left in is more than one per cent off within ±45°; adjusted it is not."""
    rng = np.random.default_rng(5)
    moments = Moments()
    moments.feed(readings(tilting(rng, 20000, 45.0), SCALE + CROSS, BIAS, NOISE, rng))
    fit = moments.solve(Limits(magnitude=1.0, full=True))
    assert np.abs(np.diagonal(fit.scale - SCALE) / np.diagonal(fit.scale_sd)).max() < 3.0
    mean = moments.values[1:4] / moments.n_samples
    raw = translate(moments.values, mean)[PRODUCT] / moments.n_samples
    free = np.eye(10)
    free[:2, 2] = -1.0
    free = np.delete(free, 2, axis=0)
    start = np.array([1.0, 1, 1, 0, 0, 0, 0, 0, 0, 0])
    a, b, c, *_, d = start - free.T @ np.linalg.solve(free @ raw @ free.T, free @ raw @ start)
    plain = np.sqrt(np.array([a, b, c]) / (a + b + c))
    true = np.diagonal((SCALE + CROSS) @ (SCALE + CROSS))
    assert d < 0
    assert np.abs(plain / np.sqrt(true / true.sum()) - 1.0).max() > 0.01


def test_noise_behind_a_filter_and_of_each_axis_its_own_is_honest() -> None:
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(300 + seed)
        a = tilting(rng, 4000, 60.0)
        white = rng.normal(size=(4001, 3)) * NOISE * np.array([0.5, 1.0, 2.0])
        z = readings(a, SCALE, BIAS, 0.0, rng) + 0.5 * (white[1:] + white[:-1]) * np.sqrt(2.0)
        fit = solve(z, in_mean=4)
        ratios.append(np.diagonal(fit.scale - SCALE) / np.diagonal(fit.scale_sd))
        assert fit.excess < 0.75  # the marginal variance is half of what averaging sees
    assert 0.8 < rms(ratios) < 1.25


def test_other_accelerations_make_it_less_certain_not_wrong() -> None:
    rng = np.random.default_rng(7)
    t = 0.01 * np.arange(6000)
    sway = 0.02 * np.sin(2 * np.pi * rng.uniform(0.3, 2.0, (3, 6)) * t[:, None, None] + rng.uniform(0, 7, (3, 6)))
    z = readings(tilting(rng, 6000, 75.0), SCALE, BIAS, NOISE, rng)
    calm, swaying = solve(z), solve(z + sway.sum(axis=2), max_scale_sd=1.0)
    assert swaying.excess > 10 * calm.excess
    assert (np.diagonal(swaying.scale_sd) > 10 * np.diagonal(calm.scale_sd)).all()
    assert np.abs(np.diagonal(swaying.scale - SCALE) / np.diagonal(swaying.scale_sd)).max() < 3.0


def test_noise_as_large_as_a_tenth_of_the_field_is_no_hindrance() -> None:
    """Newton's first step goes further than the moments allow."""
    rng = np.random.default_rng(21)
    z = readings(tilting(rng, 20000, 75.0), SCALE, BIAS, 0.1, rng)
    fit = solve(z, max_residual=0.5, max_scale_sd=0.1, full=True, max_condition=200.0)
    assert fit.reason_code is None
    assert np.abs(np.diagonal(fit.scale - SCALE) / np.diagonal(fit.scale_sd)).max() < 3.0
    np.testing.assert_allclose(fit.noise_sd, 0.1, rtol=0.05)


@pytest.mark.parametrize("full", [False, True])
def test_units_axes_pieces_and_centres_do_not_matter(full: bool) -> None:
    rng = np.random.default_rng(8)
    z = readings(tilting(rng, 3000, 60.0), SCALE, BIAS, NOISE, rng)
    fit = solve(z, full=full)
    counts = solve(z / 1e-4 + 32768.0, full=full)
    np.testing.assert_allclose(counts.scale, fit.scale * 1e-4, rtol=1e-6, atol=1e-11)
    turned = solve(z[:, [2, 0, 1]], full=full)
    np.testing.assert_allclose(np.diagonal(turned.scale), np.diagonal(fit.scale)[[2, 0, 1]], rtol=1e-9)
    np.testing.assert_allclose(turned.covariance[0, 0], fit.covariance[2, 2], rtol=1e-7)
    pieces = Moments()
    for start in (0, 1, 2, 7, 1000):
        pieces.feed(z[start : {0: 1, 1: 2, 2: 7, 7: 1000, 1000: 3000}[start]])
    np.testing.assert_allclose(pieces.solve(Limits(magnitude=1.0, full=full)).scale, fit.scale, atol=1e-12)
    merged = Moments(centre=(5.0, -4.0, 3.0))
    for part in (z[:700], z[700:2100], z[2100:]):
        own = Moments(centre=part[17])
        own.feed(part)
        merged.merge(own)
    assert merged.n_samples == len(z)
    again = merged.solve(Limits(magnitude=1.0, full=full))
    np.testing.assert_allclose(again.scale, fit.scale, atol=1e-3 * fit.scale_sd.max())
    np.testing.assert_allclose(again.scale_sd, fit.scale_sd, rtol=0.02)  # six differences are missing


def test_moments_about_another_point_are_those_of_readings_less_that_point() -> None:
    rng = np.random.default_rng(9)
    x, by = rng.normal(size=(50, 3)), np.array([0.7, -2.0, 1.1])
    own = np.concatenate([[50.0], sums_of(x, 34)])
    np.testing.assert_allclose(translate(own, by)[1:], sums_of(x - by, 34), rtol=1e-11, atol=1e-10)
    np.testing.assert_allclose(translate(np.stack([own, own]), by)[1], translate(own, by), rtol=1e-15)


def test_expectation_of_moments_without_noise_is_that_of_the_truth() -> None:
    """Oracle: Gauss–Hermite quadrature over the noise, exact to the ninth degree."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    weight = np.prod(np.stack(np.meshgrid(weights, weights, weights, indexing="ij"), axis=-1), axis=-1).ravel()
    weight = weight / weight.sum()
    truth, sd = np.array([0.4, -1.2, 0.9]), np.array([0.3, 0.1, 0.5])
    noisy = truth + sd * grid
    powers = [np.prod(noisy ** np.array(e), axis=1) for e in EXPONENTS]
    expected = np.array([weight @ power for power in powers])
    clean = [np.prod(truth ** np.array(e)) for e in EXPONENTS]
    np.testing.assert_allclose(without_noise(expected, sd**2), clean, atol=1e-12)


def test_the_quadric_is_that_of_the_generalised_eigenproblem() -> None:
    """Oracle: with isotropic noise of known variance, readings of one sphere; Kukush et al.'s eigenvector."""
    rng = np.random.default_rng(11)
    x = directions(rng, 20000) + 0.02 * rng.normal(size=(20000, 3))
    own = np.concatenate([[len(x)], sums_of(x, 34)]) / len(x)
    clean = without_noise(own, np.full(3, 0.02**2))[PRODUCT]
    vector = np.linalg.eigh(clean)[1][:, 0]
    fit = solve(x, full=True)
    a = fit.scale.T @ fit.scale
    quadric = np.array([a[0, 0], a[1, 1], a[2, 2], 2 * a[1, 2], 2 * a[0, 2], 2 * a[0, 1]])
    np.testing.assert_allclose(vector[:6] / vector[:3].sum(), quadric / quadric[:3].sum(), atol=2e-4)


def test_refusals() -> None:
    rng = np.random.default_rng(12)
    z = readings(tilting(rng, 3000, 20.0), SCALE, BIAS, NOISE, rng)
    little = solve(z)
    assert (little.reason_code, little.condition > 50) == (ReasonCode.TOO_LITTLE_MOTION, True)
    uncertain = solve(z, max_condition=1e4, max_scale_sd=0.001)
    assert uncertain.reason_code == ReasonCode.SCALE_UNCERTAIN
    assert solve(z[:40]).reason_code == ReasonCode.TOO_FEW_SAMPLES
    assert solve(np.ones((500, 3))).reason_code == ReasonCode.ELLIPSOID_DEGENERATE
    rough = solve(readings(tilting(rng, 3000, 75.0), SCALE, BIAS, 0.2, rng), max_scale_sd=1.0)
    assert (rough.reason_code, rough.residual_rms > 0.1) == (ReasonCode.NOT_A_SPHERE, True)
    with pytest.raises(ValueError, match="magnitude must be positive"):
        Moments().solve(Limits(magnitude=0.0))
    with pytest.raises(ValueError, match="needs 34 sums"):
        Moments(sums=24).solve(Limits(magnitude=1.0, full=True))


def test_what_is_not_finite_or_too_large_is_left_out() -> None:
    rng = np.random.default_rng(13)
    z = readings(tilting(rng, 2000, 75.0), SCALE, BIAS, NOISE, rng)
    broken = z.copy()
    broken[[0, 500, 501, 1200]] = [[np.nan, 0, 0], [np.inf, 0, 0], [0, 1e9, 0], [0, 0, -np.inf]]
    moments = Moments()
    moments.feed(broken)
    assert moments.n_samples == 1996
    alone = Moments(centre=broken[1])
    for a, b in ((1, 500), (502, 1200), (1201, 2000)):
        alone.feed(z[a:b])
        alone.gap()
    np.testing.assert_allclose(moments.values, alone.values, rtol=1e-12)
    np.testing.assert_allclose(moments.noise.squares, alone.noise.squares, rtol=1e-12)
