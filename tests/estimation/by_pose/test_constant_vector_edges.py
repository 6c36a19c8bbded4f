"""A constant vector by attitude: against a least squares of another library, in other units, its blocks and limits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.by_pose import constant_vector
from fieldcal.estimation.by_pose.constant_vector import fit_constant_vector
from fieldcal.estimation.by_pose.triad import TriadByPose
from fieldcal.estimation.statistics import colour, least_squares_covariance
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector

FIELD = np.array([0.2, 0.05, 0.43])
LENGTH = float(np.linalg.norm(FIELD))
MATRIX = np.array([[1.05, 0.03, 0.0], [0.03, 0.95, -0.02], [0.0, -0.02, -1.1]])
BIAS = np.array([0.12, -0.08, 0.2])
POLARITY = np.array([1.0, 1.0, -1.0])
RATE_HZ, SECONDS, BLOCK = 100.0, 30.0, 5
NOISE, LATE_S = 0.002, 0.01
SHARP = 0.12  # relative, of the mean of six sd: residuals' colour is measured on a tenth of their number
ROBUST_SD = 0.4  # by which an estimate with weights differs from one without, in sd
ALIKE = 1e-3  # relative, of results in other units or with the other sign: an iteration's end


def attitude(t: Array) -> Array:
    """In closed form: sways about three axes with incommensurable periods."""
    angle = [1.2 * np.sin(0.9 * t), 1.0 * np.sin(1.3 * t + 1.0), 1.5 * np.sin(0.5 * t + 0.3)]
    return from_rotation_vector(np.stack(angle, axis=1))


def readings(seed: int, seconds: float = SECONDS, late_s: float = LATE_S) -> tuple[Array, Array]:
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ + 0.001
    logged = (body_from_inertial(attitude(t - late_s)) @ FIELD - BIAS) @ np.linalg.inv(MATRIX).T
    return t, logged + NOISE * np.random.default_rng(seed).normal(size=logged.shape)


def fitted(t: Array, logged: Array, polarity: Array = POLARITY) -> tuple[TriadByPose, Array, Array]:
    return fit_constant_vector(
        t, np.zeros(len(t), dtype=np.int64), logged, attitude(t), np.ones(len(t), dtype=bool), length=LENGTH,
        polarity=polarity,
    )  # fmt: skip


def all_of(fit: TriadByPose) -> Array:
    return np.r_[fit.matrix.ravel(), fit.bias]


def across_of(field: Array) -> Array:
    """Two directions across a field, (3, 2)."""
    return np.stack([np.cross(field, [1.0, 0.0, 0.0]), np.cross(field, [0.0, 1.0, 0.0])], axis=1)


def misses(t: Array, logged: Array, field: Array) -> Callable[[Array], Array]:
    """What (matrix, bias, two turns of the field, delay) (15,) leave of every block's mean reading."""
    x = logged.reshape(-1, BLOCK, 3).mean(axis=1)

    def left(v: Array) -> Array:
        h = field + across_of(field) @ v[12:14]
        late = body_from_inertial(attitude(t - v[14])) @ (h * LENGTH / np.linalg.norm(h))
        read = (late - v[9:12]) @ np.linalg.inv(v[:9].reshape(3, 3)).T
        return np.asarray(read.reshape(-1, BLOCK, 3).mean(axis=1) - x).ravel()

    return left


def test_estimate_and_sd_are_those_of_a_least_squares_of_another_library() -> None:
    """In the published numbers themselves (matrix, bias, field, delay), by SciPy from the truth, block by block; sd by
    its Jacobian and the noise that was drawn."""
    claimed, of_field, off = [], [], []
    across = across_of(FIELD)
    for seed in range(6):
        t, logged = readings(seed, late_s=0.0)
        fit, field, covariance = fitted(t, logged)
        left = misses(t, logged, FIELD)
        start = np.r_[MATRIX.ravel(), BIAS, np.zeros(3)]
        own = least_squares(left, start, x_scale="jac")
        cramer_rao = np.linalg.inv(own.jac.T @ own.jac) * NOISE**2 / BLOCK
        sd = np.sqrt(np.diagonal(cramer_rao))[[*range(12), 14]]
        # Both to first order about the true field.
        same_field = across @ cramer_rao[12:14, 12:14] @ across.T
        claimed.append(np.r_[np.sqrt(np.diagonal(fit.covariance)), fit.delay_sd_s] / sd)
        off.append((np.r_[all_of(fit), fit.delay_s] - own.x[[*range(12), 14]]) / sd)
        of_field.append(np.sqrt(np.diagonal(covariance) / np.diagonal(same_field)))
        off_field = (field - FIELD - across @ own.x[12:14]) / np.sqrt(np.diagonal(same_field))
        assert np.abs(off_field).max() < ROBUST_SD
    # A robust estimate is as good as the other to a twentieth, and thinks itself a tenth better.
    assert np.abs(np.mean(claimed, axis=0) - 0.95).max() < SHARP
    assert np.abs(np.mean(of_field, axis=0) - 0.95).max() < SHARP
    assert np.sqrt(np.mean(np.square(off), axis=0)).max() < ROBUST_SD
    assert fit.misfit == pytest.approx(np.sqrt(np.sum(MATRIX**2)) * NOISE / np.sqrt(BLOCK) / LENGTH, rel=0.05)


def test_units_of_the_readings_do_not_matter() -> None:
    """logged' = k · logged + c is the same triad with M/k and b − M c/k, and so are its sd."""
    t, logged = readings(4)
    k, c = 250.0, np.array([3000.0, -500.0, 100.0])
    one, field, covariance = fitted(t, logged)
    other, same_field, same_covariance = fitted(t, k * logged + c)
    change = np.eye(12)
    change[:9] /= k
    change[9:, :9] = -np.kron(np.eye(3), c) / k
    np.testing.assert_allclose(all_of(other), change @ all_of(one), rtol=ALIKE)
    sd = np.sqrt(np.diagonal(other.covariance))
    expected = change @ one.covariance @ change.T
    np.testing.assert_allclose(other.covariance / np.outer(sd, sd), expected / np.outer(sd, sd), atol=ALIKE)
    np.testing.assert_allclose(same_field, field, rtol=ALIKE)
    np.testing.assert_allclose(same_covariance, covariance, rtol=ALIKE)
    assert (other.misfit, other.delay_s) == pytest.approx((one.misfit, one.delay_s), rel=ALIKE)


def test_the_other_polarity_is_the_opposite_field() -> None:
    t, logged = readings(5)
    one, field, covariance = fitted(t, logged)
    other, opposite, same = fitted(t, logged, -POLARITY)
    np.testing.assert_allclose(all_of(other), -all_of(one), rtol=1e-9)
    np.testing.assert_allclose(opposite, -field, rtol=1e-9)
    sd = np.sqrt(np.diagonal(one.covariance))
    np.testing.assert_allclose(other.covariance / np.outer(sd, sd), one.covariance / np.outer(sd, sd), atol=1e-6)
    np.testing.assert_allclose(same, covariance, rtol=1e-6, atol=1e-15)
    assert np.sign(np.diagonal(one.matrix)).tolist() == POLARITY.tolist()
    assert (other.delay_s, other.delay_sd_s) == pytest.approx((one.delay_s, one.delay_sd_s), rel=1e-6)


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_two_of_three_signs_decide(wrong: int) -> None:
    """A triad of which one axis is turned round beside the configuration; and one of which two are."""
    t, logged = readings(6)
    polarity = np.where(np.arange(3) == wrong, -POLARITY, POLARITY)
    for sign in (1.0, -1.0):
        fit, field, _ = fitted(t, logged, sign * polarity)
        assert np.sign(field @ FIELD) == sign
        assert np.sign(np.diagonal(fit.matrix)).tolist() == (sign * POLARITY).tolist()


@pytest.mark.parametrize(("blocks", "enough"), [(100, True), (99, False)])
def test_a_hundred_blocks_are_enough(blocks: int, enough: bool) -> None:
    t, logged = readings(7, seconds=5.0)
    t, logged = t[: blocks * BLOCK - 2], logged[: blocks * BLOCK - 2]
    if enough:
        assert fitted(t, logged)[0].weight.shape == (100,)
        return
    with pytest.raises(UnusableFlight):
        fitted(t, logged)


def test_no_attitude_at_all_is_refused() -> None:
    t, logged = readings(7, seconds=5.0)
    with pytest.raises(UnusableFlight):
        fit_constant_vector(
            t, np.zeros(len(t), dtype=np.int64), logged, attitude(t), np.zeros(len(t), dtype=bool), length=LENGTH,
            polarity=POLARITY,
        )  # fmt: skip


def test_a_fit_that_does_not_settle_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constant_vector, "MAX_ITERATIONS", 1)
    with pytest.raises(EstimationError) as error:
        fitted(*readings(8, seconds=6.0))
    assert error.value.reason_code == "ellipsoid_diverged"


def test_blocks_are_means_of_what_is_read_and_known_in_them() -> None:
    """By a loop over 1/20 s from the first stamp on: two segments that meet within a block, readings with a part
    missing, attitudes that are not known; the slope of a straight line, none where fewer than five readings are."""
    t = np.arange(400) / 131.0 + 0.512
    segment = (np.arange(400) >= 150).astype(np.int64) + (np.arange(400) >= 300) + (np.arange(400) >= 304)
    slope = np.array([1.0, -2.0, 0.5])
    logged, q = slope * t[:, None] + 0.1, attitude(t)
    logged[20:23, 1] = np.nan
    known = np.ones(400, dtype=bool)
    known[200:215] = False
    x, turn, change = constant_vector._blocks(t, segment, logged, q, known)
    held: dict[tuple[int, int], list[int]] = {}
    for i in range(400):
        if known[i] and np.isfinite(logged[i]).all():
            held.setdefault((int(segment[i]), int(20.0 * (t[i] - t[0]) + 1e-9)), []).append(i)
    rows = [held[key] for key in sorted(held)]
    np.testing.assert_allclose(x, [logged[i].mean(axis=0) for i in rows], rtol=1e-12)
    np.testing.assert_allclose(turn, [body_from_inertial(q[i]).mean(axis=0) for i in rows], rtol=1e-12)
    expected = np.where(np.array([segment[i[0]] == 2 for i in rows])[:, None], 0.0, slope)
    np.testing.assert_allclose(change, expected, atol=1e-9)


def test_five_readings_have_a_slope() -> None:
    t = np.arange(25) / 128.0
    for n, slope in ((5, 3.0), (4, 0.0)):
        segment = (np.arange(25) >= 25 - n).astype(np.int64)
        change = constant_vector._blocks(t, segment, 3.0 * t[:, None] * np.ones(3), attitude(t), t >= 0.0)[2]
        assert change[-1] == pytest.approx(slope)
        assert change[0] == pytest.approx(3.0)


def test_what_is_told_is_of_the_weighed_blocks() -> None:
    """A magnet that passes slowly, 20 sd strong: misfit and colour by their definitions from the residuals of the
    solution, and the magnet's blocks have little weight."""
    t, logged = readings(9)
    logged[1000:1200] += 0.1
    fit, field, _ = fitted(t, logged)
    seen = body_from_inertial(attitude(t - fit.delay_s)) @ field
    residual = (logged @ fit.matrix.T + fit.bias - seen).reshape(-1, BLOCK, 3).mean(axis=1)
    weighed = np.sum(np.sum(residual**2, axis=1) * fit.weight) / fit.weight.sum()
    assert fit.misfit == pytest.approx(np.sqrt(weighed) / LENGTH, rel=0.01)
    assert fit.weight[205:235].max() < 0.2
    read = residual @ np.linalg.inv(MATRIX).T * np.sqrt(fit.weight)[:, None]
    assert fit.colour == pytest.approx(colour(read), rel=0.02)
    assert np.abs(fit.matrix - MATRIX).max() < 0.01


def test_a_wrong_block_is_told_on_the_quietest_axis() -> None:
    """Forty sd of the quiet axis, two of the loud ones."""
    t, _ = readings(10)
    sd = np.array([0.002, 0.04, 0.04])
    logged = (body_from_inertial(attitude(t)) @ FIELD - BIAS) @ np.linalg.inv(MATRIX).T
    logged += np.sqrt(BLOCK) * sd * np.random.default_rng(1).normal(size=logged.shape)
    logged.reshape(-1, BLOCK, 3)[::20, :, 0] += 0.08
    weight = fitted(t, logged)[0].weight
    assert weight[::20].max() < 0.5
    assert np.median(weight) > 0.9


def test_sd_beside_wrong_blocks_are_by_their_definition() -> None:
    """Derivatives of the published numbers by SciPy's differences, all of it weighed."""
    t, logged = readings(11, late_s=0.0)
    logged.reshape(-1, BLOCK, 3)[::20] += 0.1 * np.where(np.arange(30) % 2, 1.0, -1.0)[:, None, None]
    fit, field, _ = fitted(t, logged)
    assert fit.weight[::20].max() < 0.1
    left = misses(t, logged, field)
    found = least_squares(left, np.r_[all_of(fit), 0.0, 0.0, fit.delay_s], x_scale="jac", max_nfev=1)
    root = np.sqrt(fit.weight)[:, None]
    sensitivity, residual = found.jac.reshape(-1, 3, 15), found.fun.reshape(-1, 3)
    expected = least_squares_covariance(sensitivity * root[..., None], residual * root)[1]
    np.testing.assert_allclose(np.diagonal(fit.covariance), np.diagonal(expected)[:12], rtol=0.1)
    assert fit.delay_sd_s == pytest.approx(np.sqrt(expected[14, 14]), rel=0.05)
