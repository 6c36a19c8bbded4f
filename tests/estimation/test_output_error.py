"""Output error and the propagation of the vector triads' uncertainty: exact, honest, and right to first order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics_support import (
    angle,
    autoregressive,
    constants,
    directions,
    finely_integrated,
    logged,
    random_attitudes,
    rms,
    turning_rates,
)
from scipy.spatial.transform import Rotation

from fieldcal.errors import EstimationError
from fieldcal.estimation.gyroscope import output_error
from fieldcal.estimation.gyroscope.equation_error import GyroFit
from fieldcal.estimation.gyroscope.output_error import fit_output_error, shooting_segments, suitable_stretch_s
from fieldcal.estimation.smoothing import low_pass
from fieldcal.estimation.uncertainty_propagation import attitude_jacobian, constants_to_gyro
from fieldcal.estimation.wahba import attitudes
from fieldcal.geometry.rotation import conjugate, from_rotation_vector, multiply, propagate, to_rotation_vector
from fieldcal.geometry.sensor_model import calibrate

SCALE, BIAS = constants("gyroscope")
TRUTH = np.r_[SCALE, BIAS]
ZERO = -BIAS / SCALE
INTERVAL_S = 0.02
SOLVER_PRECISION = 1e-8
HONEST = (0.8, 1.25)

Flight = tuple[np.ndarray, np.ndarray, np.ndarray]


def start_at(scale: np.ndarray, bias: np.ndarray) -> GyroFit:
    return GyroFit(scale, bias, np.zeros((6, 6)), np.zeros((6, 6)), 0.0, 0)


def near(seed: int = 0) -> GyroFit:
    """Constants 3 % and some tens of counts off, as equation error leaves them."""
    rng = np.random.default_rng(seed)
    scale = SCALE * (1 + 0.03 * rng.normal(size=3))
    return start_at(scale, -scale * (ZERO + 30.0 * rng.normal(size=3)))


def errors(fit: GyroFit) -> np.ndarray:
    return np.r_[fit.scale / SCALE - 1.0, fit.bias / BIAS - 1.0]


def flown(t: np.ndarray, seed: int = 0) -> Flight:
    """Stamps, attitudes that the rates at the stamps integrate to, and those rates."""
    rng = np.random.default_rng(seed)
    rate = turning_rates(t, rng)
    return t, propagate(t, rate, random_attitudes(rng, 1)[0]), rate


@pytest.fixture(scope="module")
def flight() -> Flight:
    return flown(np.arange(0.0, 24.0, INTERVAL_S))


# parts ---------------------------------------------------------------------------------------------------------------


def test_stretches_are_equal_parts_of_segments() -> None:
    t = np.r_[np.arange(0.0, 40.0, 0.1), np.arange(50.0, 53.0, 0.1)]
    segment = np.r_[np.full(400, 7), np.full(30, 9)]
    stretch = shooting_segments(t, segment, 15.0)
    starts = np.flatnonzero(np.r_[True, np.diff(stretch) != 0])
    assert (np.diff(stretch) >= 0).all()
    assert len(starts) == 4
    assert starts[-1] == 400
    for a, b in zip(starts, np.r_[starts[1:], len(t)], strict=True):
        assert t[b - 1] - t[a] <= 15.0
    assert np.ptp(np.diff(starts)) <= 1


def test_propagation_restarts_at_each_stretch(flight: Flight) -> None:
    t, q, rate = flight
    stretch = shooting_segments(t, np.zeros(len(t)), 7.0)
    relative = output_error.propagate_stretches(t, rate, stretch)
    for number in np.unique(stretch):
        own = np.flatnonzero(stretch == number)
        expected = (Rotation.from_quat(q[own[0]]).inv() * Rotation.from_quat(q[own])).as_quat()
        assert angle(relative[own], expected).max() < 1e-9


def test_sensitivities_are_finite_differences(flight: Flight) -> None:
    t, q, rate = flight
    stretch = shooting_segments(t, np.zeros(len(t)), 8.0)
    first = np.r_[True, np.diff(stretch) != 0]
    x, theta, h = rate / rate.std(axis=0), np.r_[rate.std(axis=0), np.zeros(3)], 1e-6
    relative = output_error.propagate_stretches(t, rate, stretch)
    model = multiply(q[first][stretch], relative)
    sensitivity = output_error.attitude_sensitivity(np.where(first[1:], 0.0, np.diff(t)), model, x, first)
    for i in range(6):
        moved = []
        for sign in (1.0, -1.0):
            changed = theta + sign * h * np.eye(6)[i]
            own = output_error.propagate_stretches(t, changed[:3] * x + changed[3:], stretch)
            moved.append(multiply(q[first][stretch], own))
        difference = to_rotation_vector(multiply(moved[0], conjugate(moved[1]))) / (2 * h)
        trapezoid = 1e-3 * np.abs(difference).max()  # of the integral of R_nb over 0.02 s
        np.testing.assert_allclose(sensitivity[:, :, i], difference, atol=trapezoid)


def test_eliminating_initial_attitudes_is_solving_for_them() -> None:
    """Schur complement against NumPy's least squares with a free offset for each stretch and component."""
    rng = np.random.default_rng(1)
    stretch = np.repeat([0, 1, 2], [40, 30, 50])
    first = np.r_[True, np.diff(stretch) != 0]
    s, r, weight = rng.normal(size=(120, 3, 6)), rng.normal(size=(120, 3)), rng.uniform(0.1, 1.0, 120)
    offsets = np.kron(np.eye(3)[stretch], np.eye(3)).reshape(120, 3, 9)
    root = np.sqrt(weight)[:, None, None]
    full = (np.concatenate([s, offsets], axis=2) * root).reshape(360, 15)
    expected = np.linalg.lstsq(full, (r[:, :, None] * root).reshape(-1), rcond=None)[0][:6]
    own_s, own_r = (output_error.without_stretch_means(v, first, weight) for v in (s, r))
    flat = (own_s * root).reshape(360, 6)
    np.testing.assert_allclose(
        np.linalg.lstsq(flat, (own_r[:, :, None] * root).reshape(-1), rcond=None)[0], expected, atol=1e-10
    )


def test_walk_information_is_the_double_sum() -> None:
    """ΣΣ Sᵀ cov(i, j) S with the covariance of a random walk that starts anew with every stretch: q min(t_i, t_j)."""
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.01, 0.03, 60))
    stretch = np.repeat([0, 1], [35, 25])
    first = np.r_[True, np.diff(stretch) != 0]
    s, walk = rng.normal(size=(60, 3, 6)), 1.7
    since = t - t[first][stretch]
    covariance = np.where(stretch[:, None] == stretch, np.minimum.outer(since, since), 0.0)
    expected = walk * np.einsum("icp,ij,jcq->pq", s, covariance, s)
    dt = np.where(first[1:], 0.0, np.diff(t))
    np.testing.assert_allclose(output_error.walk_information(s, dt, first, walk), expected, rtol=1e-9, atol=1e-9)


def test_suitable_stretch_balances_walk_and_attitude() -> None:
    """Integrated white noise scatters about its mean by σ²Δt L/6 over a stretch L: Monte Carlo of 2000 walks."""
    sigma, interval, attitude_sd = 0.05, 0.01, 0.02
    length = suitable_stretch_s(sigma, interval, attitude_sd)
    walks = np.cumsum(sigma * interval * np.random.default_rng(3).normal(size=(2000, round(length / interval))), axis=1)
    assert rms(walks - walks.mean(axis=1, keepdims=True)) == pytest.approx(attitude_sd, rel=0.05)
    assert suitable_stretch_s(0.0, interval, attitude_sd) == 200.0
    assert suitable_stretch_s(10.0, interval, attitude_sd) == 5.0


# exact ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("initial_attitude", ["estimated", "fixed"])
@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("stretch_s", [100.0, 6.0])
def test_exact_without_noise(flight: Flight, initial_attitude: str, robust: bool, stretch_s: float) -> None:
    t, q, rate = flight
    fit = fit_output_error(
        t,
        q,
        logged(rate, SCALE, BIAS),
        near(),
        stretch_s=stretch_s,
        initial_attitude=initial_attitude,
        robust=robust,
    )
    assert np.abs(errors(fit)).max() < SOLVER_PRECISION
    assert fit.residual_rms < SOLVER_PRECISION


@pytest.mark.parametrize("lost_share", [0.0, 0.05])
def test_jittered_and_lost_stamps(lost_share: float) -> None:
    """Real stamps are integrated: exact where rates are linear between samples, whatever the spacing."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 24.0, INTERVAL_S) + 0.3 * INTERVAL_S * rng.uniform(-1, 1, 1200)
    t, q, rate = flown(t[rng.uniform(size=len(t)) >= lost_share], 4)
    fit = fit_output_error(t, q, logged(rate, SCALE, BIAS), near(4))
    assert np.abs(errors(fit)).max() < SOLVER_PRECISION
    even = np.linspace(t[0], t[-1], len(t))
    pretended = fit_output_error(even, q, logged(rate, SCALE, BIAS), near(4))
    assert rms(errors(pretended)[:3]) > 1e4 * rms(errors(fit)[:3])


def test_error_of_the_sampling_is_that_of_linear_rates() -> None:
    """Attitudes integrated 20 times finer: what is left is the curvature of the rates between samples."""
    worst = []
    for interval in (0.04, 0.02):
        t = np.arange(0.0, 24.0, interval)
        q, rate = finely_integrated(t, np.random.default_rng(5))
        worst.append(np.abs(errors(fit_output_error(t, q, logged(rate, SCALE, BIAS), near()))).max())
    assert worst[1] < 5e-4
    assert worst[0] / worst[1] > 3.0


def test_each_stretch_has_its_own_initial_attitude(flight: Flight) -> None:
    """A reference that jumps between segments and between stretches costs nothing; with one start it would."""
    t, q, rate = flight
    segment = np.repeat([3, 5, 6], 400)
    jumps = random_attitudes(np.random.default_rng(6), 3)
    jumped = multiply(jumps[np.repeat([0, 1, 2], 400)], q)
    fit = fit_output_error(t, jumped, logged(rate, SCALE, BIAS), near(), segment=segment, stretch_s=100.0)
    assert np.abs(errors(fit)).max() < SOLVER_PRECISION
    recovered, attitude_error = attempt(flight, jumped, near(), 100.0)
    assert not recovered
    assert attitude_error > 0.35


def test_nothing_is_integrated_across_a_gap() -> None:
    t = np.r_[np.arange(0.0, 12.0, INTERVAL_S), np.arange(40.0, 52.0, INTERVAL_S)]
    parts = [flown(np.arange(0.0, 12.0, INTERVAL_S), seed) for seed in (7, 8)]
    q, rate = (np.concatenate([p[i] for p in parts]) for i in (1, 2))
    fit = fit_output_error(t, q, logged(rate, SCALE, BIAS), near(), segment=np.repeat([0, 1], 600))
    assert np.abs(errors(fit)).max() < SOLVER_PRECISION


# one fault, invariance -----------------------------------------------------------------------------------------------


def test_one_fault_at_a_time(flight: Flight) -> None:
    t, q, rate = flight
    extra = np.array([0.02, -0.05, 0.01])
    biased = fit_output_error(t, q, logged(rate, SCALE, BIAS + extra), near())
    np.testing.assert_allclose(biased.scale, SCALE, rtol=SOLVER_PRECISION)
    np.testing.assert_allclose(biased.bias - BIAS, extra, rtol=1e-5)
    changed = SCALE * [1.0, 1.0, 1.04]
    scaled = fit_output_error(t, q, logged(rate, changed, changed * -ZERO), near())
    np.testing.assert_allclose(scaled.scale, changed, rtol=SOLVER_PRECISION)


def disturbed(flight: Flight, seed: int, correlation: float = 0.8, sd: float = 0.01) -> np.ndarray:
    _, q, _ = flight
    noise = sd * autoregressive(np.random.default_rng(seed), (len(q), 3), correlation)
    return multiply(q, from_rotation_vector(noise))


def test_invariances(flight: Flight) -> None:
    """Time origin, unit and offset of the readings, sign of the quaternions, orientation of the reference frame."""
    t, _, rate = flight
    q, counts = disturbed(flight, 0), logged(rate, SCALE, BIAS)
    a = fit_output_error(t, q, counts, near(), stretch_s=9.0)
    start = start_at(10.0 * near().scale, near().bias - 500.0 * near().scale)
    b = fit_output_error(t + 1e4, q, 0.1 * counts + 50.0, start, stretch_s=9.0)
    np.testing.assert_allclose(0.1 * b.scale, a.scale, rtol=1e-4)
    np.testing.assert_allclose(-(b.bias / b.scale) * 10.0 - 500.0, -a.bias / a.scale, rtol=1e-6)
    np.testing.assert_allclose(
        0.1 * np.sqrt(np.diagonal(b.covariance)[:3]), np.sqrt(np.diagonal(a.covariance)[:3]), rtol=1e-2
    )
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (len(q), 1))
    c = fit_output_error(
        t, signs * multiply(random_attitudes(np.random.default_rng(2), 1)[0], q), counts, near(), stretch_s=9.0
    )
    np.testing.assert_allclose(c.scale, a.scale, rtol=1e-4)


def test_wrong_attitudes_are_left_out(flight: Flight) -> None:
    """A burst of 2 s that is 0.5 rad off: by its weight, or by the robust loss."""
    t, q, rate = flight
    spoiled, weight = q.copy(), np.ones(len(q))
    spoiled[300:400] = multiply(q[300:400], from_rotation_vector([0.5, 0.0, 0.0]))
    weight[300:400] = 1e-9
    weighted = fit_output_error(t, spoiled, logged(rate, SCALE, BIAS), near(), weights=weight)
    assert rms(errors(weighted)) < 1e-6
    robust, plain = (
        fit_output_error(t, spoiled, logged(rate, SCALE, BIAS), near(), robust=value) for value in (True, False)
    )
    assert rms(errors(robust)[:3]) < 0.3 * rms(errors(plain)[:3])


# honest --------------------------------------------------------------------------------------------------------------


def noise_of(kind: str, rng: np.random.Generator, n: int) -> np.ndarray:
    """Stationary attitude noise (n, 3) of unit variance."""
    if kind == "8 Hz":
        x = low_pass(rng.normal(size=(n, 3)), 8.0, INTERVAL_S)
        return x / x.std()
    return autoregressive(rng, (n, 3), np.exp(-INTERVAL_S / float(kind.split()[0])))


def over_sd(flight: Flight, kind: str, seeds: int, *, gyro_noise: float = 0.0, stretch_s: float = 50.0) -> float:
    """RMS over seeds of error ÷ claimed sd of the six constants, attitude noise of 0.01 rad."""
    t, q, rate = flight
    ratios = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        measured = multiply(q, from_rotation_vector(0.01 * noise_of(kind, rng, len(q))))
        counts = logged(rate + gyro_noise * rng.normal(size=rate.shape), SCALE, BIAS)
        fit = fit_output_error(t, measured, counts, near(seed), stretch_s=stretch_s)
        ratios.append((np.r_[fit.scale, fit.bias] - TRUTH) / np.sqrt(np.diagonal(fit.covariance)))
    return rms(ratios)


@pytest.mark.parametrize("kind", ["8 Hz", "0.1 s", "0.4 s"])
def test_claimed_sd_is_honest_fed_true_attitude_and_coloured_noise(flight: Flight, kind: str) -> None:
    """200 seeds of 24 s, noise of 8 Hz bandwidth or of 0.1 and 0.4 s correlation time."""
    assert HONEST[0] < over_sd(flight, kind, 200) < HONEST[1]


def test_claimed_sd_is_honest_over_the_papers_40_seconds() -> None:
    assert HONEST[0] < over_sd(flown(np.arange(0.0, 40.0, INTERVAL_S)), "8 Hz", 100) < HONEST[1]


@pytest.mark.parametrize("stretch_s", [5.0, 12.0])
def test_claimed_sd_knows_of_the_gyroscopes_own_random_walk(stretch_s: float) -> None:
    """Gyroscope noise of 0.02 rad/s a sample, integrated over stretches where it outgrows the attitude's noise: the
    fit's residuals are no longer stationary."""
    long = flown(np.arange(0.0, 40.0, INTERVAL_S))
    assert HONEST[0] < over_sd(long, "0.1 s", 80, gyro_noise=0.02, stretch_s=stretch_s) < HONEST[1]


def test_plain_bound_would_claim_a_fraction(flight: Flight) -> None:
    t, _, rate = flight
    fit = fit_output_error(t, disturbed(flight, 3, 0.95), logged(rate, SCALE, BIAS), near())
    assert (np.diagonal(fit.covariance_white) < 0.25 * np.diagonal(fit.covariance)).all()


# wrong starts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("off_deg_s", [3.0, 10.0])
def test_recovers_from_a_start_some_degrees_a_second_off(flight: Flight, off_deg_s: float) -> None:
    t, q, rate = flight
    for seed in range(5):
        off = np.radians(off_deg_s) * directions(np.random.default_rng(seed), 1)[0]
        start = start_at(near(seed).scale, near(seed).bias + off)
        fit = fit_output_error(t, q, logged(rate, SCALE, BIAS), start, stretch_s=15.0)
        assert np.abs(errors(fit)).max() < SOLVER_PRECISION


def attempt(flight: Flight, q: np.ndarray, start: GyroFit, stretch_s: float) -> tuple[bool, float]:
    """Whether the constants came out right, and the attitude error, rad, that the fit or its refusal states."""
    t, _, rate = flight
    try:
        fit = fit_output_error(t, q, logged(rate, SCALE, BIAS), start, stretch_s=stretch_s)
    except EstimationError as error:
        return False, error.measured["attitude_error_rms_rad"]
    return bool(np.abs(errors(fit)[:3]).max() < 0.02), fit.residual_rms


@pytest.mark.parametrize("stretch_s", [5.0, 15.0, 50.0])
def test_a_hopeless_start_never_passes_for_a_fit(flight: Flight, stretch_s: float) -> None:
    """100 °/s off, or polarity reversed: recovered, or an error or a residual of many degrees, which the flight
    refuses."""
    for seed in range(6):
        far = np.radians(100.0) * directions(np.random.default_rng(seed), 1)[0]
        for start in (start_at(SCALE, BIAS + far), start_at(-SCALE, -BIAS + far)):
            recovered, attitude_error = attempt(flight, disturbed(flight, seed), start, stretch_s)
            assert recovered or attitude_error > 0.35


def test_no_minimum_is_an_error_with_its_numbers(flight: Flight) -> None:
    t, q, rate = flight
    with pytest.raises(EstimationError) as error:
        fit_output_error(t, q, logged(rate, SCALE, BIAS), near(), max_iterations=1)
    assert error.value.reason_code == "output_error_diverged"
    assert error.value.measured["iterations"] == 1
    assert error.value.measured["attitude_error_rms_rad"] > 0.0


def test_unrelated_attitudes_have_no_fit(flight: Flight) -> None:
    t, _, _ = flight
    recovered, attitude_error = attempt(flight, flown(t, 99)[1], near(), 15.0)
    assert not recovered
    assert attitude_error > 0.35


def test_callers_errors(flight: Flight) -> None:
    t, q, rate = flight
    with pytest.raises(ValueError, match="n ≥ 10"):
        fit_output_error(t[:5], q[:5], rate[:5], near())
    with pytest.raises(ValueError, match="shapes"):
        fit_output_error(t, q[:, :3], rate, near())


# propagation of the vector triads' uncertainty -----------------------------------------------------------------------

REFERENCE = np.array([[np.cos(1.0), 0.0, np.sin(1.0)], [0.0, 0.0, 1.0]])
SIGMA = np.array([0.006, 0.004])
AXES_TURN = Rotation.from_euler("xyz", [10.0, -30.0, 50.0], degrees=True).as_matrix()
TRIADS = ("magnetometer", "accelerometer")


def vectors_of(readings: list[np.ndarray], changed: dict[int, np.ndarray]) -> np.ndarray:
    """Calibrated vectors in body axes (n, 2, 3) with the constants of the triads moved by `changed` (6,)."""
    out = []
    for i, name in enumerate(TRIADS):
        scale, bias = constants(name)
        by = changed.get(i, np.zeros(6))
        out.append(calibrate(readings[i], scale + by[:3], bias + by[3:]) @ AXES_TURN.T)
    return np.stack(out, axis=1)


def readings_of(q: np.ndarray) -> list[np.ndarray]:
    """Noise-free counts of both triads at attitudes q (n, 4) of the body."""
    out = []
    for i, (name, size) in enumerate(zip(TRIADS, (1.0, 9.81), strict=True)):
        sensed = Rotation.from_quat(q).inv().apply(size * REFERENCE[i]) @ AXES_TURN
        out.append(logged(sensed, *constants(name)))
    return out


@pytest.mark.parametrize("which", [0, 1])
def test_attitude_jacobian_is_finite_differences_of_the_attitude(which: int) -> None:
    q = random_attitudes(np.random.default_rng(10), 200)
    readings = readings_of(q)
    jacobian = attitude_jacobian(vectors_of(readings, {}), SIGMA, which, readings[which], AXES_TURN)
    scale, _ = constants(TRIADS[which])
    step = np.r_[1e-5 * np.abs(scale), np.full(3, 1e-5)]
    for i in range(6):
        moved = [
            attitudes(vectors_of(readings, {which: sign * step[i] * np.eye(6)[i]}), REFERENCE, SIGMA).q
            for sign in (1.0, -1.0)
        ]
        # the rotation of the estimated body axes, in body axes: q_true* ⊗ q_found
        by = to_rotation_vector(multiply(conjugate(moved[1]), moved[0])) / (2 * step[i])
        np.testing.assert_allclose(jacobian[:, :, i], by, atol=2e-5 * np.abs(by).max())


def test_gyroscope_covariance_is_finite_differences_of_the_whole_chain(flight: Flight) -> None:
    """Move each constant of each triad by its sd, estimate attitudes and gyroscope anew: the sum of the outer products
    of what the gyroscope's constants do is the propagated covariance."""
    t, q, rate = flight
    readings, counts = readings_of(q), logged(rate, SCALE, BIAS)
    segment, weight = np.zeros(len(t), dtype=int), np.ones(len(t))
    found = attitudes(vectors_of(readings, {}), REFERENCE, SIGMA).q
    base = fit_output_error(t, found, counts, near(), stretch_s=12.0, robust=False)
    pairs, expected = [], np.zeros((6, 6))
    for which, name in enumerate(TRIADS):
        sd = np.r_[1e-3 * np.abs(constants(name)[0]), np.full(3, 1e-3)]
        jacobian = attitude_jacobian(vectors_of(readings, {}), SIGMA, which, readings[which], AXES_TURN)
        pairs.append((jacobian, np.diag(sd**2)))
        for i in range(6):
            moved = []
            for sign in (0.5, -0.5):
                own = attitudes(vectors_of(readings, {which: sign * sd[i] * np.eye(6)[i]}), REFERENCE, SIGMA).q
                moved.append(fit_output_error(t, own, counts, base, stretch_s=12.0, robust=False))
            by = np.r_[moved[0].scale - moved[1].scale, moved[0].bias - moved[1].bias]
            expected += np.outer(by, by)
    propagated = constants_to_gyro(t, found, segment, counts, weight, base, 12.0, pairs)
    np.testing.assert_allclose(
        propagated / np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected))),
        expected / np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected))),
        atol=0.02,
    )


def test_nothing_known_of_the_triads_adds_nothing(flight: Flight) -> None:
    t, q, rate = flight
    counts = logged(rate, SCALE, BIAS)
    fit = replace(near(), scale=SCALE, bias=BIAS)
    added = constants_to_gyro(t, q, np.zeros(len(t)), counts, np.ones(len(t)), fit, 12.0, [])
    np.testing.assert_array_equal(added, np.zeros((6, 6)))
