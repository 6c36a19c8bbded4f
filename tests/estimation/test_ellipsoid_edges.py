"""The ellipsoid fit's own numbers: covariance by finite differences, noise of the axes, limits from both sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics_support import directions
from scipy.optimize import least_squares

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation import ellipsoid
from fieldcal.estimation.ellipsoid import TriadFit, direction_condition, fit_ellipsoid
from fieldcal.estimation.ellipsoid_refusals import require_determined
from fieldcal.estimation.statistics import least_squares_covariance

SCALE, BIAS, LENGTH = np.array([2e-4, -3e-4, 1.5e-4]), np.array([-6.0, 9.0, -4.5]), 9.81
POLARITY = np.sign(SCALE)


def logged(unit: np.ndarray, noise: np.ndarray | float = 0.0) -> np.ndarray:
    """Readings along `unit` (n, 3), noise in logged units."""
    return (LENGTH * unit - BIAS) / SCALE + noise


def distances(theta: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Distance of each reading from the ellipsoid ‖λ∘z + b‖ = f, to first order, in logged units."""
    h = z * theta[:3] + theta[3:]
    n = np.linalg.norm(h, axis=1)
    return (n - LENGTH) / np.linalg.norm(theta[:3] * h / n[:, None], axis=1)


def test_two_steps_and_their_covariance_are_those_of_the_distances() -> None:
    """SciPy's least squares on the same distances; σ²(JᵀJ)⁻¹ with J by finite differences about them."""
    rng = np.random.default_rng(0)
    z = logged(directions(rng, 600), 150.0 * rng.normal(size=(600, 3)))
    truth = np.r_[SCALE, BIAS]
    oracle = least_squares(lambda p: distances(p * truth, z), np.ones(6), xtol=1e-15, ftol=1e-15, gtol=1e-15).x * truth
    found = fit_ellipsoid(z, LENGTH, method="two_step", polarity=POLARITY)
    sd = np.sqrt(np.diagonal(found.covariance_white))
    # Distances whose gradient holds the noise term fixed: within a few per cent of their scatter of the least.
    np.testing.assert_allclose(np.r_[found.scale_diagonal, found.bias], oracle, atol=0.1 * sd.max(), rtol=1e-3)
    own = np.r_[found.scale_diagonal, found.bias]
    steps = 1e-6 * np.abs(own)
    j = np.stack([(distances(own + h, z) - distances(own - h, z)) / (2 * h.sum()) for h in np.diag(steps)], axis=1)
    white, coloured = least_squares_covariance(j[:, None, :], distances(own, z)[:, None])
    for claimed, expected in ((found.covariance_white, white), (found.covariance, coloured)):
        scale = np.sqrt(np.diagonal(expected))
        np.testing.assert_allclose(claimed / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.03)
    relative = np.linalg.norm(z * own[:3] + own[3:], axis=1) / LENGTH - 1.0
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean(relative**2)), rel=1e-9)
    assert (found.share_used, found.n_samples) == (1.0, 600)
    assert found.iterations > 1
    assert found.measured()["condition_number"] == found.condition
    np.testing.assert_allclose(found.scale_relative_sd, np.sqrt(np.diagonal(found.covariance)[:3]) / np.abs(own[:3]))


@pytest.mark.parametrize("method", ["li", "li_full", "tls"])
def test_algebraic_fits_take_one_step_with_every_reading(method: str) -> None:
    rng = np.random.default_rng(1)
    found = fit_ellipsoid(logged(directions(rng, 300), 50.0 * rng.normal(size=(300, 3))), LENGTH, method=method)
    assert (found.iterations, found.share_used) == (1, 1.0)


def test_the_noise_term_is_taken_off_the_lengths() -> None:
    """Noise across u makes a length too long, by σ²(‖Λ‖² − ‖Λu‖²)/2n on average: over ‖Λu‖ in logged units."""
    rng = np.random.default_rng(2)
    sigma = 0.05
    x = np.ascontiguousarray((directions(rng, 400_000) / 1.6 + sigma * rng.normal(size=(400_000, 3))).T)
    plain, corrected = (ellipsoid._distances(x, 1.6 * np.eye(3), np.zeros(3), s).residual for s in (0.0, sigma))
    assert plain.mean() == pytest.approx(1.6 * sigma**2, rel=0.1)
    assert abs(corrected.mean()) < 0.1 * plain.mean()
    lam, bias, some = np.array([1.0, 1.5, 0.7]), np.array([0.1, 0.0, -0.2]), x[:, :50]
    plain, corrected = (ellipsoid._distances(some, np.diag(lam), bias, s).residual for s in (0.0, sigma))
    h = lam * some.T + bias
    n = np.linalg.norm(h, axis=1)
    along = np.linalg.norm(lam * h / n[:, None], axis=1)
    np.testing.assert_allclose(plain - corrected, sigma**2 * (lam @ lam - along**2) / (2.0 * n * along), rtol=1e-9)
    np.testing.assert_allclose(plain, (n - 1.0) / along, rtol=1e-9, atol=1e-15)


def test_axes_that_differ_in_noise_are_weighed_alike() -> None:
    """Up to five times: white noise of each axis over their root mean square; beyond that, or none, they count as the
    same."""
    rng = np.random.default_rng(3)
    white = rng.normal(size=(20_000, 3))
    for sizes in ([1.0, 2.0, 4.5], [3.0, 3.0, 1.0]):
        expected = np.array(sizes) / np.sqrt(np.mean(np.square(sizes)))
        np.testing.assert_allclose(ellipsoid._noise_shape(white * sizes), expected, rtol=0.03)
    for sizes in ([1.0, 2.0, 5.4], [1.0, 0.0, 1.0]):
        np.testing.assert_array_equal(ellipsoid._noise_shape(white * sizes), np.ones(3))


@pytest.mark.parametrize(("outliers", "weighted"), [(24, False), (26, True)])
def test_robust_weights_are_for_records_with_outliers(outliers: int, weighted: bool) -> None:
    """More than six readings in a thousand far off, of lengths that are uniform within ±0.4 %, which is below 3σ."""
    rng = np.random.default_rng(4)
    length = LENGTH * (1.0 + 0.004 * rng.uniform(-1.0, 1.0, 4000))
    length[rng.permutation(4000)[:outliers]] *= 1.0 + 0.1 * rng.choice([-1.0, 1.0], outliers)
    found = fit_ellipsoid((length[:, None] * directions(rng, 4000) - BIAS) / 1e-4, LENGTH)
    assert (found.share_used < 1.0) == weighted


def test_clipped_readings_take_their_information_from_the_covariance() -> None:
    """Weighted distances and their gradient, by `statistics`, and Huber's inflation on top."""
    rng = np.random.default_rng(9)
    x = directions(rng, 500) + 0.01 * rng.normal(size=(500, 3))
    weight = rng.uniform(0.2, 1.5, 500).clip(max=1.0)
    found = ellipsoid._with_statistics(x, np.eye(3), np.zeros(3), weight, 4)
    length = np.linalg.norm(x, axis=1, keepdims=True)
    u, root = x / length, np.sqrt(weight)[:, None]
    gradient = np.hstack([u * u, u]) * root  # at the foot of each reading on the unit sphere
    white, coloured = least_squares_covariance(gradient[:, None, :], (length - 1.0) * root)
    inflation = (weight.mean() / np.mean(weight >= 1.0)) ** 2
    assert inflation > 1.5
    np.testing.assert_allclose(found.covariance, coloured * inflation, rtol=1e-6)
    np.testing.assert_allclose(found.covariance_white, white, rtol=1e-6)
    assert (found.share_used, found.iterations) == (weight.mean(), 4)


def test_ten_readings_are_enough_and_no_motion_is_none() -> None:
    z = logged(directions(np.random.default_rng(5), 10))
    found = fit_ellipsoid(z, LENGTH, method="li", polarity=POLARITY)
    np.testing.assert_allclose(found.scale_diagonal, SCALE, rtol=1e-6)
    with pytest.raises(ValueError, match="n ≥ 10"):
        fit_ellipsoid(z[:9], LENGTH)
    for wrong in (z[:, 0], z[:, :, None], z[:, :2]):
        with pytest.raises(ValueError, match=r"must be \(n, 3\)"):
            fit_ellipsoid(wrong, LENGTH)
    with pytest.raises(ValueError, match="positive"):
        fit_ellipsoid(z, -1.0)


def test_the_default_polarity_is_plus() -> None:
    z = directions(np.random.default_rng(6), 200) / 3.0
    np.testing.assert_allclose(fit_ellipsoid(z, 1.0).scale_diagonal, [3.0, 3.0, 3.0], rtol=1e-6)
    assert fit_ellipsoid(z, 1.0).scale_diagonal.base is None


def test_condition_is_that_of_the_normalised_columns() -> None:
    u = directions(np.random.default_rng(8), 100)
    j = np.hstack([u * (u - u.mean(axis=0)), u])
    expected = np.linalg.cond(j / np.linalg.norm(j, axis=0))
    assert direction_condition(7.0 * u) == pytest.approx(expected, rel=1e-9)
    assert direction_condition(np.tile([1.0, 0.0, 0.0], (20, 1))) == np.inf
    assert direction_condition(np.tile([0.6, 0.48, 0.64], (20, 1))) > 1e6


def fit_of(**changed: object) -> TriadFit:
    """A fit with just these numbers."""
    given = {
        "scale": np.diag([1.0, -1.0, 1.0]), "bias": np.zeros(3), "covariance": np.diag([1e-4, 4e-4, 1e-4, 1, 1, 1]),
        "covariance_white": np.eye(6), "residual_rms": 0.1, "condition": 50.0, "n_samples": 20, "share_used": 1.0,
        "iterations": 1,
    }  # fmt: skip
    return TriadFit(**{**given, **changed})


LIMITS = {"max_condition": 50.0, "max_scale_sd": 0.02, "max_residual": 0.1}


@pytest.mark.parametrize(
    ("changed", "code", "said"),
    [
        ({"condition": 50.001}, "too_little_motion", "number 50, at most 50"),
        ({"condition": np.nan}, "too_little_motion", "nan"),
        ({"covariance": np.diag([1e-4, 4.1e-4, 1e-4, 1, 1, 1])}, "scale_uncertain", "2.02 % (one sd); at most 2 %"),
        ({"covariance": np.full((6, 6), np.nan)}, "scale_uncertain", "not determined at all"),
        ({"residual_rms": 0.1001}, "not_a_sphere", "10 % rms, above 10 %"),
        ({"residual_rms": np.nan}, "not_a_sphere", "nan"),
    ],
)
def test_each_limit_is_allowed_and_no_more(changed: dict[str, object], code: str, said: str) -> None:
    require_determined(fit_of(), **LIMITS)
    with pytest.raises(UnusableFlight) as refused:
        require_determined(fit_of(**changed), **LIMITS)
    assert refused.value.reason_code == code
    assert said in refused.value.sentence


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("variance", [-1e-20, 0.0, np.nan])
def test_a_variance_that_rounding_took_is_none_that_is_known(axis: int, variance: float) -> None:
    """Whichever axis has it: the largest of numbers, one of which is none, depends on their order."""
    z = logged(directions(np.random.default_rng(3), 400), 20.0 * np.random.default_rng(4).normal(size=(400, 3)))
    found = fit_ellipsoid(z, LENGTH, polarity=POLARITY)
    covariance = found.covariance.copy()
    covariance[axis, axis] = variance
    assert replace(found, covariance=covariance).scale_relative_sd[axis] == np.inf
    with pytest.raises(UnusableFlight) as caught:
        require_determined(
            replace(found, covariance=covariance), max_condition=30.0, max_scale_sd=0.05, max_residual=0.1
        )
    assert caught.value.reason_code == "scale_uncertain"


def test_a_scale_may_be_half_or_twice_its_nominal_value() -> None:
    for nominal in ((2.0, 1.0, 1.0), (1.0, -0.5, 0.5)):
        require_determined(fit_of(), nominal_scale=nominal, **LIMITS)
    for nominal in ((2.001, 1.0, 1.0), (1.0, 1.0, 0.4999)):
        with pytest.raises(UnusableFlight, match=r"outside 0\.5 to 2") as refused:
            require_determined(fit_of(), nominal_scale=nominal, **LIMITS)
        assert refused.value.reason_code == "scale_not_nominal"
        assert refused.value.measured["scale_over_nominal"] == pytest.approx(1.0 / np.array(nominal))


def test_a_fit_without_a_minimum_says_how_far_off_it_was() -> None:
    """One step from the truth, readings 1 % off the sphere."""
    rng = np.random.default_rng(8)
    x = directions(rng, 2000) * (1.0 + 0.01 * rng.normal(size=(2000, 1)))
    with pytest.raises(EstimationError) as refused:
        ellipsoid._gauss_newton(x, np.eye(3), np.zeros(3), robust=False, max_iterations=1)
    assert refused.value.reason_code == "ellipsoid_diverged"
    assert refused.value.measured["iterations"] == 1
    assert refused.value.measured["residual_rms_relative"] == pytest.approx(0.01, rel=0.05)
