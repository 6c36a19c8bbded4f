"""Poses at the knots: exact without noise, derivatives by finite differences, limits from both sides."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numerics_support import angle
from small_record import Small, attitude, moved, small

from fieldcal.estimation.clock_sync.by_rates import SyncFit
from fieldcal.estimation.joint.chain_solver import GRADIENT, Normal
from fieldcal.estimation.joint.measurement_model import layout_of, trajectory
from fieldcal.estimation.joint.pose_measurement import MIN_POSES, VpsRecord
from fieldcal.geometry.rotation import Array, continuous, from_rotation_vector, multiply

LAG_S, SKEW_PPM, MIDDLE_S = -0.15, 2000.0, 0.7
WORLD, BODY = from_rotation_vector([0.02, -0.03, 0.2]), from_rotation_vector([-0.1, 0.05, 0.02])
INTERPOLATED_RAD = 2e-4
STEP = 1e-5
INTERVAL_S = 0.005
MISSED = 1e-6  # of derivatives, per unit: second order of turns by some mrad, a cubic between poses


def clock(lag_s: float = LAG_S, skew_ppm: float = SKEW_PPM) -> SyncFit:
    return SyncFit(
        lag_mid_s=lag_s, skew_ppm=skew_ppm, covariance=np.eye(2), peak=1.0, runner_up=0.0, peak_width_s=1.0,
        explained=1.0, matrix=np.eye(3), reference_s=MIDDLE_S, first_s=0.0, turning=np.eye(3),
    )  # fmt: skip


def poses(interval_s: float = INTERVAL_S) -> tuple[Array, Array]:
    """Stamps of the VPS's clock and attitudes of its body in its world, of both stretches."""
    t = np.concatenate([np.arange(-0.05, 0.70, interval_s), np.arange(1.05, 1.65, interval_s)])
    q = np.concatenate([attitude(0, t[t < 0.9]), attitude(1, t[t > 0.9])])
    inverse = [x * [-1.0, -1.0, -1.0, 1.0] for x in (WORLD, BODY)]
    stamps = (t - MIDDLE_S) * (1.0 + 1e-6 * SKEW_PPM) + MIDDLE_S - LAG_S
    return stamps, multiply(multiply(inverse[0], q), inverse[1])


def record(flight: Small, interval_s: float = INTERVAL_S, **changes: Any) -> VpsRecord:
    t, q = poses(interval_s)
    given: dict[str, Any] = {"t": t, "q": q, "clock": clock(), **changes}
    found = VpsRecord.of(
        given["t"], given["q"], given["clock"], flight.model, flight.state, trajectory(flight.model, flight.state),
        max_gap_s=0.02,
    )  # fmt: skip
    assert found is not None
    return found


def aligned(flight: Small) -> VpsRecord:
    """With the true constant rotations, which a short record tells apart slowly."""
    return replace(record(flight), world=WORLD, body=BODY)


def flight(**how: Any) -> Small:
    """With knots every 25 ms: more than the fewest that poses are used at."""
    own = small(spacing_s=0.025, missing=False, **how)
    assert len(own.model.knots.index) > MIN_POSES
    return own


def with_vps(own: Small, vps: VpsRecord, **values: Array) -> Small:
    state = replace(own.state, values={**own.state.values, **vps.start(), **values})
    return replace(own, state=state)


@pytest.fixture(scope="module")
def own() -> Small:
    return flight()


def test_rotations_and_poses_are_those_of_the_truth(own: Small) -> None:
    vps = aligned(own)
    assert vps.used.all()
    given = with_vps(own, vps)
    left, counts = vps.residual(given.model, given.state)
    assert counts.all()
    assert np.abs(left).max() < INTERPOLATED_RAD
    values = given.state.values
    assert angle(vps.mounting(values), BODY) < INTERPOLATED_RAD
    assert angle(vps.world_rotation(values), WORLD) < INTERPOLATED_RAD
    assert vps.clock_of(values) == pytest.approx((LAG_S, 1e-6 * SKEW_PPM))
    some = {
        "vps_clock": np.array([0.01, 1e-4]),
        "vps_world": np.array([0.1, 0.2, 0.3]),
        "vps_body": np.array([0.3, 0, 0]),
    }
    assert vps.clock_of(some) == pytest.approx((LAG_S + 0.01, 1e-6 * SKEW_PPM + 1e-4))
    assert angle(vps.mounting(some), multiply(vps.body, from_rotation_vector([0.3, 0.0, 0.0]))) < 1e-12
    assert angle(vps.world_rotation(some), multiply(from_rotation_vector([0.1, 0.2, 0.3]), vps.world)) < 1e-12
    t = np.array([0.0, 1.0])
    on_vps_clock = (t - MIDDLE_S) * (1.0 + 1e-6 * SKEW_PPM + 1e-4) + MIDDLE_S - LAG_S - 0.01
    np.testing.assert_allclose(vps.to_imu_clock(on_vps_clock, some), t, atol=1e-12)
    again = vps.at_knots(own.model, own.state, trajectory(own.model, own.state))
    assert again is not None
    assert again.sigma_rad == vps.sigma_rad
    assert [name for name, x in vps.start().items() if not x.any()] == ["vps_clock", "vps_world", "vps_body"]


def test_a_clock_that_starts_off_is_in_the_residual(own: Small) -> None:
    """Where the lag is 10 ms wrong the pose is that of 10 ms before; where the skew is, by what it makes of the time
    from the middle."""
    vps = aligned(own)
    given = with_vps(own, vps, vps_clock=np.array([0.01, 0.004]))
    left, _ = vps.residual(given.model, given.state)
    t = own.model.readings.t[own.model.knots.index]
    late = (t - MIDDLE_S) * (1.0 + 1e-6 * SKEW_PPM + 0.004) - 0.01
    late = late / (1.0 + 1e-6 * SKEW_PPM) + MIDDLE_S - t
    turned = angle(attitude_at(own, t + late), attitude_at(own, t))
    np.testing.assert_allclose(np.linalg.norm(left, axis=1), turned, atol=5.0 * INTERPOLATED_RAD)


def attitude_at(own: Small, t: Array) -> Array:
    segment = own.model.readings.segment[own.model.knots.index]
    return np.array([attitude(int(s), np.array([at]))[0] for s, at in zip(segment, t, strict=True)])


def test_derivatives_are_finite_differences(own: Small) -> None:
    vps = aligned(own)
    given = with_vps(own, vps, vps_clock=np.array([1e-3, -1e-4]))
    layout, p = layout_of(given.model, given.state.values, dip=True, lever_arm=True)
    found = vps.sensitivity(given.model, given.state, trajectory(given.model, given.state), layout, p)
    assert found.shape == (len(given.model.knots.index), 3, p)
    for name in ("vps_clock", "vps_world", "vps_body"):
        columns = layout[name]
        for i in range(columns.stop - columns.start):
            by = STEP * np.eye(columns.stop - columns.start)[i]
            plus, minus = (vps.residual(given.model, moved(given.state, name, s * by))[0] for s in (1.0, -1.0))
            expected = -(plus - minus) / (2.0 * STEP)
            np.testing.assert_allclose(found[:, :, columns.start + i], expected, atol=0.01, err_msg=name)
            assert np.abs(expected).max() > 0.3
    others = np.ones(p, dtype=bool)
    for name in ("vps_clock", "vps_world", "vps_body"):
        others[layout[name]] = False
    assert not found[:, :, others].any()
    for axis in range(3):
        step = np.zeros((len(given.model.knots.index), 12))
        step[:, axis] = STEP
        plus, minus = (vps.residual(given.model, given.state.moved(s * step, np.zeros(p), {}))[0] for s in (1.0, -1.0))
        expected = -(plus - minus) / (2.0 * STEP)
        np.testing.assert_allclose(expected, np.broadcast_to(np.eye(3)[axis], expected.shape), atol=5e-3)


def test_normal_equations_are_those_of_weighed_residuals(own: Small) -> None:
    """Knot by knot, written out: one pose is not used, and the noise is the residuals' where that is larger."""
    vps = record(own)
    used = vps.used.copy()
    used[4] = False
    vps = replace(vps, used=used)
    turn = 1e-3 * np.random.default_rng(1).normal(size=(len(own.state.q), 3))
    given = with_vps(own, vps)
    given = replace(given, state=replace(given.state, q=multiply(from_rotation_vector(turn), given.state.q)))
    layout, p = layout_of(given.model, given.state.values, dip=True, lever_arm=True)
    path = trajectory(given.model, given.state)
    k = len(used)
    normal = Normal.empty(k, p, 5)
    vps.add(normal, given.model, given.state, path, layout)
    left, counts = vps.residual(given.model, given.state)
    assert counts.tolist() == used.tolist()
    sigma = 1.4826 * np.median(np.abs(left[used]))
    assert vps.sigma(left[used]) == pytest.approx(sigma)
    assert replace(vps, sigma_rad=2.0 * sigma).sigma(left[used]) == pytest.approx(2.0 * sigma)
    g = vps.sensitivity(given.model, given.state, path, layout, p)
    whole = np.zeros((3 * k, 12 * k + p))
    for i in range(k):
        whole[3 * i : 3 * i + 3, 12 * i : 12 * i + 3] = np.eye(3)
        whole[3 * i : 3 * i + 3, 12 * k :] = g[i]
    weight = np.repeat(used, 3) / sigma**2
    matrix, right = whole.T @ (whole * weight[:, None]), whole.T @ (left.ravel() * weight)
    for i in range(k):
        own_block = slice(12 * i, 12 * i + 12)
        np.testing.assert_allclose(normal.diagonal[i], matrix[own_block, own_block], rtol=1e-9)
        np.testing.assert_allclose(normal.right[i, :, :p], matrix[own_block, 12 * k :], rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(normal.right[i, :, p + GRADIENT], right[own_block], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(normal.parameters, matrix[12 * k :, 12 * k :], rtol=1e-9)
    np.testing.assert_allclose(normal.parameters_right[:, GRADIENT], right[12 * k :], rtol=1e-9)
    assert not normal.below.any()
    response = np.random.default_rng(2).normal(size=(k, 12, p))
    seen, residual = vps.whitened(given.model, given.state, path, layout, response)
    np.testing.assert_allclose(seen, (g - response[:, :3]) * used[:, None, None] / sigma, rtol=1e-9)
    np.testing.assert_allclose(residual, left * used[:, None] / sigma, rtol=1e-9)


def test_a_pose_s_noise_is_that_from_sample_to_sample(own: Small) -> None:
    t, q = poses()
    rng = np.random.default_rng(3)
    sd = np.array([1e-3, 3e-3, 2e-3])
    straight = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    noisy = from_rotation_vector(sd * rng.normal(size=(len(t), 3)))
    assert record(own, q=noisy).sigma_rad == pytest.approx(3e-3, rel=0.25)
    still = record(own, q=straight)
    assert still.sigma_rad == 2e-5
    # Of either sign.
    flipped = np.where(np.arange(len(t))[:, None] % 2, q, -q)
    assert record(own, q=flipped).sigma_rad == record(own, q=continuous(q)).sigma_rad


@pytest.mark.parametrize(("n", "enough"), [(30, True), (29, False)])
def test_thirty_poses_at_knots_are_enough(own: Small, n: int, enough: bool) -> None:
    """Poses end between the last knot that is wanted and the next."""
    t, q = poses()
    index = own.model.knots.index
    end = 0.5 * (own.model.readings.t[index[n - 1]] + own.model.readings.t[index[n]])
    kept = t < (end - MIDDLE_S) * (1.0 + 1e-6 * SKEW_PPM) + MIDDLE_S - LAG_S
    path = trajectory(own.model, own.state)
    found = VpsRecord.of(t[kept], q[kept], clock(), own.model, own.state, path, max_gap_s=0.02)
    assert (found is not None) == enough
    if found is not None:
        assert np.flatnonzero(found.used).tolist() == list(range(n))


def test_knots_in_gaps_have_no_pose(own: Small) -> None:
    t, q = poses()
    index = own.model.knots.index
    at = (own.model.readings.t[index[5]] - MIDDLE_S) * (1.0 + 1e-6 * SKEW_PPM) + MIDDLE_S - LAG_S
    for reach, whole in ((0.012, False), (0.003, True)):
        kept = np.abs(t - at) > reach
        assert record(own, t=t[kept], q=q[kept]).used.tolist() == [whole or i != 5 for i in range(len(index))]


def test_a_pose_that_jumps_away_and_back_is_left_out(own: Small) -> None:
    """And none beside it; a jump that stays is no outlier, nor is one beside a pause."""
    t, q = poses()
    rng = np.random.default_rng(4)
    noisy = multiply(from_rotation_vector(2e-4 * rng.normal(size=(len(t), 3))), q)
    index = own.model.knots.index
    at = (own.model.readings.t[index] - MIDDLE_S) * (1.0 + 1e-6 * SKEW_PPM) + MIDDLE_S - LAG_S
    for wrong in (4, 12, len(index) - 3):
        near = np.abs(t - at[wrong]) < 0.011
        thrown = noisy.copy()
        thrown[near] = multiply(from_rotation_vector([0.0, 0.02, 0.0]), noisy[near])
        found = record(own, q=thrown)
        assert np.flatnonzero(~found.used).tolist() == [wrong]
    last = np.flatnonzero(~own.model.knots.joined)[0]
    for edge in (0, last, last + 1, len(index) - 1):
        near = np.abs(t - at[edge]) < 0.011
        thrown = noisy.copy()
        thrown[near] = multiply(from_rotation_vector([0.0, 0.02, 0.0]), noisy[near])
        assert edge not in np.flatnonzero(~record(own, q=thrown).used)


@pytest.mark.parametrize(("times", "out"), [(5.9, False), (6.1, True)])
@pytest.mark.parametrize("knot", [1, 8, 12, -2])
def test_an_outlier_is_six_sd_of_second_differences_away(own: Small, knot: int, times: float, out: bool) -> None:
    """Errors of ±c in turn have second differences of 4 c; one that is off by a beside them has 4 c + 2 a. The start's
    jumps, which the gyroscope knows nothing of, do not count; a knot without a pose or at a pause says nothing."""
    vps = replace(record(own), world=np.array([0.0, 0.0, 0.0, 1.0]), body=np.array([0.0, 0.0, 0.0, 1.0]))
    knots = own.model.knots
    k = len(knots.index)
    knot %= k
    c = 1e-5
    sign = np.where((np.arange(k) - knot) % 2, -1.0, 1.0)
    way = np.array([0.6, 0.0, 0.8])
    error = c * sign[:, None] * way
    error[knot] += 0.5 * (times * 1.4826 - 1.0) * 4.0 * c * way
    jump = 1e-3 * np.random.default_rng(6).normal(size=(k - 1, 3))
    gone = np.vstack([np.zeros((1, 3)), np.cumsum(jump, axis=0)])
    start = from_rotation_vector(gone - error)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (k, 1))
    path = replace(trajectory(own.model, own.state), jump=jump)
    every = np.ones(k, dtype=bool)
    assert np.flatnonzero(vps._outliers(own.model, path, start, still, every)).tolist() == ([knot] if out else [])
    for beside in (knot - 1, knot, knot + 1):
        missing = every & (np.arange(k) != beside)
        assert not vps._outliers(own.model, path, start, still, missing).any()
    assert not vps._outliers(own.model, path, start, still, ~every).any()
    for side in (knot - 1, knot):
        parted = replace(own.model, knots=replace(knots, joined=knots.joined & (np.arange(k - 1) != side)))
        assert not vps._outliers(parted, path, start, still, every).any()


def test_a_knot_between_the_first_two_poses_has_one_and_between_the_last_two(own: Small) -> None:
    t, q = poses()
    index = own.model.knots.index
    at = (own.model.readings.t[index] - MIDDLE_S) * (1.0 + 1e-6 * SKEW_PPM) + MIDDLE_S - LAG_S
    first, last = 3, len(index) - 4
    kept = slice(int(np.flatnonzero(t < at[first])[-1]), int(np.flatnonzero(t > at[last])[0]) + 1)
    used = record(own, t=t[kept], q=q[kept]).used
    assert np.flatnonzero(used)[[0, -1]].tolist() == [first, last]
