"""Ellipsoid fits: exact on truth, one fault at a time, honest under coloured noise, refused on poor geometry."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numerics_support import autoregressive, constants, directions, logged, rms
from scipy.optimize import least_squares

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.ellipsoid import METHODS, TriadFit, direction_condition, fit_ellipsoid
from fieldcal.estimation.ellipsoid_refusals import require_determined
from fieldcal.geometry.rotation import body_from_inertial, from_euler
from fieldcal.simulation.experiment import NOISE_VARIANCE, Experiment, simulate

GRAVITY_MPS2 = 9.81
SCALE, BIAS = constants("accelerometer")
POLARITY = np.sign(SCALE)
SOLVER_PRECISION = 1e-9
NOISE_SHARE = 0.005  # of gravity: Table 1's accelerometer
HONEST = (0.8, 1.4)
LIMITS = {"max_condition": 50.0, "max_scale_sd": 0.05, "max_residual": 0.1}
EVERY_METHOD = pytest.mark.parametrize("method", sorted(METHODS))


def turned(rng: np.random.Generator, n: int, tilt_deg: float) -> np.ndarray:
    """The down axis in the body, (n, 3), at attitudes with bank, pitch and heading uniform within ± tilt_deg."""
    euler = np.radians(tilt_deg) * rng.uniform(-1.0, 1.0, (n, 3))
    return body_from_inertial(from_euler(euler)) @ [0.0, 0.0, 1.0]


def slowly_turned(rng: np.random.Generator, n: int, tilt_deg: float) -> np.ndarray:
    """The down axis in the body, (n, 3), along a smooth motion that reaches about tilt_deg on every axis."""
    t = np.linspace(0.0, 1.0, n)[:, None, None]
    frequency, phase = rng.uniform(2.0, 9.0, (3, 4)), rng.uniform(0.0, 2 * np.pi, (3, 4))
    amplitude = rng.uniform(0.5, 1.0, (3, 4))
    amplitude *= 1.3 * np.radians(tilt_deg) / amplitude.sum(axis=1, keepdims=True)
    euler = np.sum(amplitude * np.sin(2 * np.pi * frequency * t + phase), axis=2)
    return body_from_inertial(from_euler(euler)) @ [0.0, 0.0, 1.0]


def counts(unit: np.ndarray, noise: np.ndarray | float = 0.0) -> np.ndarray:
    """What the triad logs of gravity along `unit` (n, 3), noise as a share of gravity."""
    return logged(GRAVITY_MPS2 * (unit + noise), SCALE, BIAS)


def fit(z: np.ndarray, method: str = "robust", magnitude: float = GRAVITY_MPS2) -> TriadFit:
    return fit_ellipsoid(z, magnitude, method=method, polarity=POLARITY)


def relative_errors(found: TriadFit, scale: np.ndarray = SCALE, bias: np.ndarray = BIAS) -> np.ndarray:
    return np.r_[found.scale_diagonal / scale - 1.0, found.bias / bias - 1.0]


# exact ---------------------------------------------------------------------------------------------------------------


@EVERY_METHOD
@pytest.mark.parametrize("tilt_deg", [180.0, 75.0, 45.0, 20.0])
def test_noise_free_truth(method: str, tilt_deg: float) -> None:
    found = fit(counts(turned(np.random.default_rng(0), 2000, tilt_deg)), method)
    assert np.abs(relative_errors(found)).max() < SOLVER_PRECISION
    assert np.abs(found.scale - np.diag(found.scale_diagonal)).max() < SOLVER_PRECISION * np.abs(SCALE).min()
    assert found.residual_rms < SOLVER_PRECISION


def test_cross_axis_scales_of_the_full_form() -> None:
    """λ symmetric 3×3, as a length can see it: soft iron and non-orthogonal axes."""
    full = np.diag([1.0, 1.2, 0.9]) + 0.05 * np.array([[0, 1, -1], [1, 0, 0.5], [-1, 0.5, 0]])
    bias = np.array([0.3, -0.1, 0.2])
    z = np.linalg.solve(full, (directions(np.random.default_rng(1), 1000) - bias).T).T
    found = fit_ellipsoid(z, 1.0, method="li_full")
    np.testing.assert_allclose(found.scale, full, atol=SOLVER_PRECISION)
    np.testing.assert_allclose(found.bias, bias, atol=SOLVER_PRECISION)
    np.testing.assert_allclose(np.linalg.norm(found.apply(z), axis=1), 1.0, atol=SOLVER_PRECISION)


# one fault at a time -------------------------------------------------------------------------------------------------


@EVERY_METHOD
def test_an_injected_bias_moves_only_the_bias(method: str) -> None:
    unit = turned(np.random.default_rng(2), 1000, 75.0)
    extra = np.array([0.5, -0.3, 0.8])
    found = fit(logged(GRAVITY_MPS2 * unit, SCALE, BIAS + extra), method)
    np.testing.assert_allclose(found.scale_diagonal, SCALE, rtol=SOLVER_PRECISION)
    np.testing.assert_allclose(found.bias - BIAS, extra, rtol=1e-7)


@EVERY_METHOD
def test_an_injected_scale_moves_only_that_scale_and_its_bias(method: str) -> None:
    unit = turned(np.random.default_rng(3), 1000, 75.0)
    changed = SCALE * np.array([1.0, 1.07, 1.0])
    zero = -BIAS / SCALE  # in counts: what a sensor's scale leaves alone
    found = fit(GRAVITY_MPS2 * unit / changed + zero, method)
    np.testing.assert_allclose(found.scale_diagonal, changed, rtol=SOLVER_PRECISION)
    np.testing.assert_allclose(-found.bias / found.scale_diagonal, zero, rtol=SOLVER_PRECISION)


# invariance ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noisy() -> np.ndarray:
    rng = np.random.default_rng(4)
    return counts(slowly_turned(rng, 3000, 75.0), NOISE_SHARE * autoregressive(rng, (3000, 3), 0.6))


@EVERY_METHOD
def test_unit_of_the_readings(noisy: np.ndarray, method: str) -> None:
    a, b = fit(noisy, method), fit(1e-6 * noisy, method)
    np.testing.assert_allclose(1e-6 * b.scale, a.scale, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(b.bias, a.bias, rtol=1e-7)
    unit = np.r_[np.full(3, 1e-6), np.ones(3)]
    np.testing.assert_allclose(np.diagonal(b.covariance) * unit**2, np.diagonal(a.covariance), rtol=1e-5)
    assert b.condition == pytest.approx(a.condition, rel=1e-6)


@EVERY_METHOD
def test_unit_of_the_field(noisy: np.ndarray, method: str) -> None:
    a, b = fit(noisy, method), fit(noisy, method, magnitude=1.0)
    np.testing.assert_allclose(GRAVITY_MPS2 * b.scale, a.scale, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(GRAVITY_MPS2**2 * b.covariance, a.covariance, rtol=1e-6)
    assert b.residual_rms == pytest.approx(a.residual_rms, rel=1e-9)


@EVERY_METHOD
def test_shift_of_the_readings(noisy: np.ndarray, method: str) -> None:
    a, b = fit(noisy, method), fit(noisy + 20000.0, method)
    np.testing.assert_allclose(b.scale_diagonal, a.scale_diagonal, rtol=1e-8)
    np.testing.assert_allclose(b.bias + b.scale @ np.full(3, 20000.0), a.bias, rtol=1e-8)


@EVERY_METHOD
def test_order_of_axes(noisy: np.ndarray, method: str) -> None:
    order = [2, 0, 1]
    a, b = fit(noisy, method), fit_ellipsoid(noisy[:, order], GRAVITY_MPS2, method=method, polarity=POLARITY[order])
    tolerance = 1e-3 if method == "two_step" else 1e-7  # its first step singles out x; its second stops near the same
    np.testing.assert_allclose(b.scale_diagonal, a.scale_diagonal[order], rtol=tolerance)
    np.testing.assert_allclose(b.bias, a.bias[order], rtol=tolerance)


@pytest.mark.parametrize("method", ["li", "li_full", "tls", "two_step"])
def test_order_of_samples(noisy: np.ndarray, method: str) -> None:
    """The robust fit reads the sensor's noise from neighbouring samples, so only it depends on their order."""
    shuffled = fit(noisy[np.random.default_rng(5).permutation(len(noisy))], method)
    np.testing.assert_allclose(shuffled.scale_diagonal, fit(noisy, method).scale_diagonal, rtol=1e-7)


def test_polarity_is_taken_not_found(noisy: np.ndarray) -> None:
    a, b = fit(noisy), fit_ellipsoid(noisy, GRAVITY_MPS2, polarity=-POLARITY)
    np.testing.assert_allclose(b.scale, -a.scale, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(b.bias, -a.bias, rtol=1e-12)
    np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-9)


# oracle --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["two_step", "robust"])
def test_refinement_is_scipys_least_distance(method: str) -> None:
    """SciPy's optimiser on the same distances r = (n − f)/‖Λu‖, and nothing else, lands on the same constants.

    `robust` also takes the mean of the noise across u off its distances, 1e-5 of the field here."""
    rng = np.random.default_rng(6)
    unit = directions(rng, 4000)
    z = logged(unit + 0.005 * rng.normal(size=unit.shape), np.array([1.0, 1.2, 0.9]), np.array([0.2, -0.1, 0.3]))
    z *= [1.0, 1.2, 0.9]  # the same noise on every axis, in logged units

    def distances(theta: np.ndarray) -> np.ndarray:
        h = z * theta[:3] + theta[3:]
        n = np.linalg.norm(h, axis=1)
        return (n - 1.0) / np.linalg.norm(theta[:3] * h / n[:, None], axis=1)

    oracle = least_squares(distances, [0.9, 0.9, 0.9, 0.0, 0.0, 0.0], x_scale="jac", ftol=1e-14, xtol=1e-14).x
    found = fit_ellipsoid(z, 1.0, method=method)
    tolerance = 3e-5 if method == "two_step" else 1e-4
    np.testing.assert_allclose(np.r_[found.scale_diagonal, found.bias], oracle, atol=tolerance)


def test_least_residual_of_the_algebraic_fit(noisy: np.ndarray) -> None:
    """Total least squares is the smallest singular vector: no nearby quadric of the same norm fits better."""
    x = (noisy - noisy.mean(axis=0)) / np.sqrt(np.mean((noisy - noisy.mean(axis=0)) ** 2))
    d = np.column_stack([x * x, 2 * x, np.ones(len(x))])
    d /= np.linalg.norm(d, axis=0)
    found = fit_ellipsoid(x, 1.0, method="tls")
    lam, b = found.scale_diagonal, found.bias
    plain = np.column_stack([x * x, 2 * x, np.ones(len(x))])
    theta = np.r_[lam**2, lam * b, b @ b - 1.0] * np.linalg.norm(plain, axis=0)
    smallest = np.linalg.svd(d, compute_uv=False)[-1]
    assert np.linalg.norm(d @ theta) / np.linalg.norm(theta) == pytest.approx(smallest, rel=1e-9)


def test_printed_equations_change_with_the_scale_of_theta_and_ours_do_not() -> None:
    """Eq. 7–8 as printed divide θ10 by θ1, θ2 and θ3 in turn. A quadric is the same for every multiple of θ: the
    printed constants are not."""
    lam, b, f = np.array([2.0, 1.5, 0.8]), np.array([0.3, -0.2, 0.1]), 1.0

    def printed(theta: np.ndarray) -> np.ndarray:
        bracket = np.sum(theta[6:9] ** 2 / theta[:3]) - theta[9] / theta[:3]
        return f / np.sqrt(bracket / theta[:3])

    def corrected(theta: np.ndarray) -> np.ndarray:
        g = np.sum(theta[6:9] ** 2 / theta[:3]) - theta[9]
        return f * np.sqrt(theta[:3] / g)

    theta = np.r_[lam**2, np.zeros(3), lam * b, b @ b - f**2]
    for factor in (1.0, 4.0, 0.1):
        np.testing.assert_allclose(corrected(factor * theta), lam, rtol=1e-12)
    assert np.abs(printed(theta) / lam - 1.0).max() > 0.1
    assert np.abs(printed(4.0 * theta) / printed(theta) - 1.0).max() > 0.1
    # the module, fed readings of that quadric in units that rescale θ, gives the constants in those units
    z = (directions(np.random.default_rng(7), 500) - b) / lam
    for unit in (1.0, 30.0, 0.01):
        found = fit_ellipsoid(unit * z, f, method="li")
        np.testing.assert_allclose(unit * found.scale_diagonal, lam, rtol=SOLVER_PRECISION)


def test_condition_numbers() -> None:
    rng = np.random.default_rng(8)
    assert direction_condition(directions(rng, 5000)) == pytest.approx(1.6, abs=0.15)
    for tilt_deg, expected in ((75.0, 10.0), (45.0, 37.0), (20.0, 240.0)):
        assert direction_condition(turned(rng, 5000, tilt_deg)) == pytest.approx(expected, rel=0.15)
    yaw = body_from_inertial(from_euler(np.c_[np.zeros((500, 2)), rng.uniform(-3, 3, 500)]))
    for seen in (yaw @ [1.0, 0.0, 0.0], yaw @ [0.0, 0.0, 1.0]):
        assert direction_condition(seen) > 1e6


# honest --------------------------------------------------------------------------------------------------------------


@lru_cache
def flights(seeds: int = 60) -> dict[str, list[TriadFit]]:
    """Robust fits of the simulated experiment's raw counts: band-limited noise, quantised, seed by seed."""
    experiment = Experiment(vps=False)
    fits: dict[str, list[TriadFit]] = {"magnetometer": [], "accelerometer": []}
    for seed in range(5000, 5000 + seeds):
        recording = simulate(experiment, seed=seed)
        for name, magnitude in (("magnetometer", 1.0), ("accelerometer", GRAVITY_MPS2)):
            polarity = np.sign(constants(name)[0])
            fits[name].append(fit_ellipsoid(recording.counts[name], magnitude, polarity=polarity))
    return fits


@pytest.mark.parametrize("sensor", ["magnetometer", "accelerometer"])
def test_claimed_sd_is_honest_on_simulated_flights(sensor: str) -> None:
    """Measured: 1.18 and 1.06; the Cramér–Rao bound would claim 1.5 and 1.3 times too little."""
    truth = np.concatenate(constants(sensor))
    errors = np.array([np.r_[f.scale_diagonal, f.bias] - truth for f in flights()[sensor]])
    sd, plain = (
        np.sqrt([np.diagonal(getattr(f, which)) for f in flights()[sensor]])
        for which in ("covariance", "covariance_white")
    )
    assert HONEST[0] < rms(errors / sd) < HONEST[1]
    assert rms(errors / plain) > rms(errors / sd)
    joint = [
        e @ np.linalg.solve(f.covariance, e) / len(e) for e, f in zip(errors, flights()[sensor], strict=True)
    ]  # correlations included
    assert HONEST[0] < np.sqrt(np.mean(joint)) < HONEST[1]


@pytest.mark.parametrize("sensor", ["magnetometer", "accelerometer"])
def test_no_bias_is_left_by_the_refinement(sensor: str) -> None:
    """Li–Griffiths is 6–10 % off on these counts. Here the mean over flights is within its own scatter."""
    scale = constants(sensor)[0]
    relative = np.array([f.scale_diagonal / scale - 1.0 for f in flights()[sensor]])
    assert np.abs(relative.mean(axis=0)).max() < 3.0 * (relative.std(axis=0) / np.sqrt(len(relative))).max()


def test_residual_is_the_sensors_noise() -> None:
    expected = np.sqrt(NOISE_VARIANCE["accelerometer"]) / GRAVITY_MPS2
    assert np.mean([f.residual_rms for f in flights()["accelerometer"]]) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_claimed_sd_is_honest_on_poor_geometry(correlation: float) -> None:
    """±45° of tilt, condition about 33 of the 50 that is accepted. Measured: 1.15 white, 1.17 coloured."""
    ratios = []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        unit = slowly_turned(rng, 4000, 45.0)
        try:
            found = fit(counts(unit, NOISE_SHARE * autoregressive(rng, unit.shape, correlation)))
            require_determined(found, **LIMITS)
        except (UnusableFlight, EstimationError):
            continue
        ratios.append(
            (np.r_[found.scale_diagonal, found.bias] - np.r_[SCALE, BIAS]) / np.sqrt(np.diagonal(found.covariance))
        )
    assert len(ratios) > 60
    assert HONEST[0] < rms(ratios) < HONEST[1]


def test_outliers_cost_the_robust_fit_little() -> None:
    """2 % of the readings disturbed by 17 % of the field pull the algebraic fit by several per cent."""
    errors: dict[str, list[np.ndarray]] = {"robust": [], "li": []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        unit = slowly_turned(rng, 4000, 75.0)
        disturbed = NOISE_SHARE * rng.normal(size=unit.shape)
        disturbed[rng.uniform(size=4000) < 0.02] += [0.15, 0.0, 0.09]
        for method, found in errors.items():
            found.append(relative_errors(fit(counts(unit, disturbed), method))[:3])
    assert rms(errors["robust"]) < 0.003
    assert rms(errors["li"]) > 0.02


# refusal -------------------------------------------------------------------------------------------------------------


def refused(z: np.ndarray, method: str = "robust", **limits: object) -> UnusableFlight | EstimationError:
    """The refusal that must come, from the fit or from its judge."""
    with pytest.raises((UnusableFlight, EstimationError)) as caught:
        require_determined(fit(z, method), **{**LIMITS, **limits})
    assert caught.value.sentence.endswith(".")
    return caught.value


POOR = {
    "yaw only, horizontal field": lambda e: body_from_inertial(from_euler(e * [0, 0, 3.0])) @ [1.0, 0.0, 0.0],
    "yaw only, 53° dip": lambda e: body_from_inertial(from_euler(e * [0, 0, 3.0])) @ [0.6, 0.0, 0.8],
    "yaw only, gravity": lambda e: body_from_inertial(from_euler(e * [0, 0, 3.0])) @ [0.0, 0.0, 1.0],
    "±20° of tilt, gravity": lambda e: body_from_inertial(from_euler(0.35 * e)) @ [0.0, 0.0, 1.0],
    "±20° of tilt, horizontal field": lambda e: body_from_inertial(from_euler(0.35 * e)) @ [1.0, 0.0, 0.0],
    "pitch only": lambda e: body_from_inertial(from_euler(e * [0, 1.5, 0])) @ [0.0, 0.0, 1.0],
}


@EVERY_METHOD
@pytest.mark.parametrize("noise", [0.0, NOISE_SHARE])
@pytest.mark.parametrize("motion", sorted(POOR))
def test_too_little_of_the_sphere(method: str, noise: float, motion: str) -> None:
    """Whatever the method, poor geometry ends in a refusal. At a collapsed solution the condition number looks
    healthy (2 to 5): one of the other checks speaks."""
    rng = np.random.default_rng(10)
    error = refused(counts(POOR[motion](rng.uniform(-1, 1, (1500, 3))), noise * rng.normal(size=(1500, 3))), method)
    assert error.reason_code in {
        "ellipsoid_degenerate",
        "ellipsoid_diverged",
        "too_little_motion",
        "scale_uncertain",
        "not_a_sphere",
    }


def test_tilt_of_20_degrees_carries_its_number() -> None:
    error = refused(counts(turned(np.random.default_rng(11), 2000, 20.0)))
    assert error.reason_code == "too_little_motion"
    assert error.measured["condition_number"] == pytest.approx(240.0, rel=0.15)
    assert f"{error.measured['condition_number']:.3g}" in error.sentence


@EVERY_METHOD
def test_stuck_sensor(method: str) -> None:
    error = refused(np.tile([31243.0, 34100.0, 33601.0], (500, 1)), method)
    assert error.reason_code == "ellipsoid_degenerate"


@EVERY_METHOD
def test_one_stuck_axis(method: str) -> None:
    z = counts(directions(np.random.default_rng(12), 800))
    z[:, 1] = 32768.0
    assert refused(z, method).reason_code in {"ellipsoid_degenerate", "ellipsoid_diverged", "too_little_motion"}


@EVERY_METHOD
def test_noise_is_no_sphere(method: str) -> None:
    error = refused(30000.0 + 500.0 * np.random.default_rng(13).normal(size=(2000, 3)), method)
    assert error.reason_code in {"not_a_sphere", "scale_uncertain", "ellipsoid_diverged", "ellipsoid_degenerate"}


@pytest.mark.parametrize(("factor", "named"), [(9.80665, "m/s²"), (1 / 9.80665, "g"), (100.0, "uT for G")])
def test_wrong_unit_against_a_nominal_scale(factor: float, named: str) -> None:
    """An SI log whose unit is declared wrongly: a perfect ellipsoid, of the wrong size."""
    z = factor * GRAVITY_MPS2 * (directions(np.random.default_rng(14), 1000))
    found = fit_ellipsoid(z, GRAVITY_MPS2)
    require_determined(found, **LIMITS)
    with pytest.raises(UnusableFlight) as caught:
        require_determined(found, nominal_scale=(1.0, 1.0, 1.0), **LIMITS)
    assert caught.value.reason_code == "scale_not_nominal"
    np.testing.assert_allclose(caught.value.measured["scale_over_nominal"], 1.0 / factor, rtol=1e-9)


def test_nominal_scale_within_a_factor_of_two_is_accepted(noisy: np.ndarray) -> None:
    require_determined(fit(noisy), nominal_scale=1.9 * np.abs(SCALE), **LIMITS)
    require_determined(fit(noisy), nominal_scale=SCALE / 1.9, **LIMITS)


@pytest.mark.parametrize(
    ("limit", "code"),
    [("max_condition", "too_little_motion"), ("max_scale_sd", "scale_uncertain"), ("max_residual", "not_a_sphere")],
)
def test_each_limit_alone(noisy: np.ndarray, limit: str, code: str) -> None:
    measured = fit(noisy).measured()
    value = {
        "max_condition": measured["condition_number"],
        "max_scale_sd": max(measured["scale_relative_sd"]),
        "max_residual": measured["residual_rms_relative"],
    }[limit]
    assert refused(noisy, **{limit: 0.99 * value}).reason_code == code
    require_determined(fit(noisy), **{**LIMITS, limit: 1.01 * value})


def test_callers_errors(noisy: np.ndarray) -> None:
    holed = noisy.copy()
    holed[3, 1] = np.nan
    for z, options, said in (
        (noisy[:9], {}, "n ≥ 10"),
        (noisy[:, :2], {}, r"\(n, 3\)"),
        (holed, {}, "non-finite"),
        (noisy, {"magnitude": 0.0}, "positive"),
        (noisy, {"method": "magneto"}, "robust"),
    ):
        with pytest.raises(ValueError, match=said):
            fit(z, **options)
