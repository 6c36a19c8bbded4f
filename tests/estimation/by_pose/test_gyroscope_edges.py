"""The gyroscope by poses: limits of its start from both sides, which of two fits is trusted, attitudes over gaps."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numerics_support import angle
from test_gyroscope import ABOUT_NOSE, readings

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_pose import gyroscope
from fieldcal.estimation.by_pose.gyroscope import attitudes, start_by_rates
from fieldcal.estimation.clock_sync.by_rates import SyncFit
from fieldcal.estimation.joint.problem import Readings
from fieldcal.estimation.joint.variance_components import Levels
from fieldcal.geometry.rotation import Array, body_from_inertial, conjugate, from_rotation_vector, multiply, propagate
from fieldcal.simulation.experiment import simulate

POSITIVE, UNIT = (1, 1, 1), (1.0, 1.0, 1.0)
NEAR = 1e-3  # of a limit, relative


@pytest.mark.parametrize("nominal", [1.0, 0.25])
@pytest.mark.parametrize(
    ("found", "agrees"),
    [
        (0.5 * (1.0 + NEAR), True),
        (0.5 * (1.0 - NEAR), False),
        (0.5, False),
        (2.0 * (1.0 - NEAR), True),
        (2.0 * (1.0 + NEAR), False),
        (2.0, False),
    ],
)
def test_a_unit_holds_within_a_factor_of_two(found: float, agrees: bool, nominal: float) -> None:
    scale, _ = start_by_rates(np.eye(3) / (found * nominal), POSITIVE, (nominal,) * 3)
    expected = nominal if agrees else found * nominal
    assert scale == pytest.approx(np.full(3, expected), rel=1e-12)


def test_one_axis_that_agrees_decides_for_all() -> None:
    scale, _ = start_by_rates(np.diag([1.0 / 3.0, 1.0 / 4.0, 1.0 / 1.9]), POSITIVE, (1.0, 2.0, 1.0))
    assert scale.tolist() == [1.0, 2.0, 1.0]
    scale, _ = start_by_rates(np.diag([1.0 / 3.0, 1.0 / 8.0, 1.0 / 5.0]), POSITIVE, (1.0, 2.0, 1.0))
    assert scale == pytest.approx([4.0, 8.0, 4.0])  # the median of 3, 4 and 5


def test_a_rotation_is_that_of_the_rates_alone() -> None:
    """Signs of the axes are configuration: a rotation of the sensor, seen through a scale of either sign."""
    turn = body_from_inertial(from_rotation_vector([0.0, 1.2, 0.0]))
    sign = np.array([1.0, -1.0, -1.0])
    scale = np.array([2.0, 1.0, 0.5])
    matrix = turn / (sign * scale)[:, None]
    for nominal in (None, scale):
        found, rotation = start_by_rates(matrix, sign, nominal)
        assert found == pytest.approx(sign * scale)
        assert rotation == pytest.approx(turn)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("angle_rad", "another"), [(np.pi / 4 + NEAR, True), (np.pi / 4 - NEAR, False)])
def test_another_mounting_begins_at_an_eighth_of_a_turn(axis: int, angle_rad: float, another: bool) -> None:
    turn = body_from_inertial(from_rotation_vector(angle_rad * np.eye(3)[axis]))
    rotation = start_by_rates(turn, POSITIVE, UNIT)[1]
    assert rotation == pytest.approx(turn if another else np.eye(3))


@pytest.mark.parametrize("stretch", [1.3, 0.7])
def test_rates_that_are_stretched_show_no_mounting(stretch: float) -> None:
    """By three tenths, of a unit that holds."""
    for share, known in ((1.0 - NEAR, True), (1.0 + NEAR, False)):
        matrix = np.diag([1.0, 1.0, 1.0 + (stretch - 1.0) * share]) @ ABOUT_NOSE
        rotation = start_by_rates(matrix, POSITIVE, UNIT)[1]
        assert rotation == pytest.approx(ABOUT_NOSE if known else np.eye(3)), share


def test_an_axis_without_any_rate_has_a_start() -> None:
    scale, rotation = start_by_rates(np.diag([1.0, 1.0, 0.0]), POSITIVE, UNIT)
    assert scale.tolist() == [1.0, 1.0, 1.0]
    assert rotation.tolist() == np.eye(3).tolist()


def fit(scale: Array, sd: Array) -> Any:
    """As much of a fit as is asked for: its scales, their sd, biases of no sd at all."""
    covariance = np.diag(np.r_[np.square(sd), np.full(3, 1e6)])
    return SimpleNamespace(constants=lambda name: {"gyroscope": (scale, np.zeros(3), covariance)}[name])


@pytest.mark.parametrize(("chi2", "trusted"), [(16.2, True), (16.4, False)])
def test_the_sharper_fit_is_trusted_while_both_agree(chi2: float, trusted: bool) -> None:
    """χ²₃ of the difference of their scales: by the stiff one's covariance, once in a thousand."""
    way = np.array([2.0, -1.0, 2.0]) / 3.0
    sd = np.array([0.01, 0.02, 0.03])
    stiff = fit(np.ones(3) + np.sqrt(chi2) * sd * way, sd)
    free = fit(np.ones(3), 0.5 * sd)
    assert (gyroscope._trusted(free, stiff) is free) == trusted
    assert gyroscope._trusted(stiff, free) is free


def test_claims_are_compared_as_a_whole() -> None:
    """By volume: an axis may be a little wider by chance, correlated claims are smaller than their sd."""
    sd = np.array([0.01, 0.02, 0.03])
    stiff = fit(np.ones(3), sd)
    for axis in range(3):
        is_axis = np.arange(3) == axis
        assert gyroscope._trusted(free := fit(np.ones(3), sd * np.where(is_axis, 1.2, 0.9)), stiff) is free
        assert gyroscope._trusted(fit(np.ones(3), sd * np.where(is_axis, 1.3, 0.9)), stiff) is stiff
    as_wide = fit(np.ones(3), sd)
    assert gyroscope._trusted(as_wide, stiff) is stiff


SKEW_PPM, LAG_S, BIASED_RADPS = 300.0, -0.2, 0.02
INTERPOLATED_RAD = 2e-4  # a cubic between poses 10 ms apart, a rate from a window of them


def flown(segment: Array | None = None) -> tuple[Readings, Array, Array, Array, SyncFit]:
    """A gyroscope with a bias, its true attitudes, poses on another clock, and that clock."""
    t = np.arange(0.0, 20.0, 0.005)
    rate = np.stack([np.sin(0.7 * t), 0.8 * np.cos(0.5 * t), 0.6 * np.sin(1.1 * t + 1.0)], axis=1)
    q = propagate(t, rate, np.array([0.0, 0.0, 0.0, 1.0]))
    given = readings(simulate(seed=1, duration_s=2.0, sets=1, vps=False))
    n = len(t)
    own = Readings(**{
        **vars(given), "t": t, "gyroscope": rate / 0.5, "turning": np.zeros((2, n, 3)),
        "segment": np.zeros(n, dtype=np.int64) if segment is None else segment,
    })  # fmt: skip
    clock = SyncFit(
        lag_mid_s=LAG_S, skew_ppm=SKEW_PPM, covariance=np.eye(2), peak=1.0, runner_up=0.0, peak_width_s=1.0,
        explained=1.0, matrix=np.eye(3), reference_s=10.0, first_s=0.0, turning=np.eye(3),
    )  # fmt: skip
    on_vps_clock = 10.0 + (t - 10.0) * (1.0 + 1e-6 * SKEW_PPM) - LAG_S
    return own, q, on_vps_clock[::2], q[::2], clock


def errors(own: Readings, q: Array, t_vps: Array, q_vps: Array, clock: SyncFit, bias: float = 0.0) -> Array:
    start = np.full(3, 0.5), np.full(3, bias)
    found = attitudes(own, t_vps, q_vps, clock, start, 0.05)
    assert found.shape == q.shape
    return angle(found, q)


def test_where_there_are_poses_the_attitude_is_theirs() -> None:
    """Whatever the gyroscope's bias."""
    assert errors(*flown(), bias=BIASED_RADPS).max() < INTERPOLATED_RAD


def test_a_gap_is_carried_over_by_the_gyroscope() -> None:
    """Three seconds: exactly by a right gyroscope; by one with a bias as far off as that turns in half of them, less
    the half that the pose at the other end takes back."""
    own, q, t_vps, q_vps, clock = flown()
    kept = (t_vps < t_vps[800]) | (t_vps > t_vps[1100])
    given = own, q, t_vps[kept], q_vps[kept], clock
    assert errors(*given).max() < INTERPOLATED_RAD
    off = errors(*given, bias=BIASED_RADPS)
    assert off.max() < 0.25 * np.sqrt(3.0) * BIASED_RADPS * 3.0 * 2.0
    assert off[1900] > 10.0 * INTERPOLATED_RAD


def test_the_gyroscope_s_own_bias_is_taken_off() -> None:
    own, q, t_vps, q_vps, clock = flown()
    biased = replace(own, gyroscope=own.gyroscope - BIASED_RADPS / 0.5)
    kept = (t_vps < t_vps[800]) | (t_vps > t_vps[1100])
    assert errors(biased, q, t_vps[kept], q_vps[kept], clock, bias=BIASED_RADPS).max() < INTERPOLATED_RAD


def test_the_first_pose_holds_where_a_gap_follows_it() -> None:
    """Poses about the first sample alone, then none for three seconds."""
    own, q, t_vps, q_vps, clock = flown()
    on_vps_clock = 10.0 + (own.t[:2] - 10.0) * (1.0 + 1e-6 * SKEW_PPM) - LAG_S - 1e-6
    t_vps, q_vps = np.r_[on_vps_clock, t_vps[300:]], np.r_[q[:2], q_vps[300:]]
    off = errors(own, q, t_vps, q_vps, clock, bias=BIASED_RADPS)
    assert off[:4].max() < 0.02 * BIASED_RADPS * 3.0


def test_a_gap_between_two_stretches_is_either_s_own() -> None:
    """A stretch's attitude begins anew: what lies in the gap is turned as the poses of its own stretch are."""
    own, q, t_vps, q_vps, clock = flown((np.arange(4000) >= 3000).astype(np.int64))
    kept = (t_vps < t_vps[1450]) | (t_vps > t_vps[1550])
    assert errors(own, q, t_vps[kept], q_vps[kept], clock).max() < INTERPOLATED_RAD


def test_hardly_any_rotation_is_none_and_half_a_turn_is_one() -> None:
    """Whichever way their cosines are rounded, beyond one too."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        stretched = np.diag(1.0 + rng.uniform(-0.2, 0.2, 3)) + 1e-9 * rng.normal(size=(3, 3))
        axis = rng.normal(size=3)
        half = 2.0 * np.outer(axis, axis) / (axis @ axis) - np.eye(3)
        with np.errstate(invalid="raise"):
            assert start_by_rates(stretched, POSITIVE, UNIT)[1].tolist() == np.eye(3).tolist()
            assert start_by_rates(half, POSITIVE, UNIT)[1] == pytest.approx(half)


def test_the_walk_is_held_down_for_one_of_two_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first may be ten times the walk by the gyroscope's noise, the second 0.03 of it, from where that ended; no
    vector stands beside them: no dip, no lever arm."""
    asked: list[dict[str, Any]] = []

    def fit_joint(model: Any, state: Any, **how: Any) -> Any:
        asked.append({"model": model, "state": state, **how})
        levels = Levels(np.ones(0), np.ones(0), np.ones(0), 1.0, 1.0)
        return SimpleNamespace(state=state, levels=levels, constants=fit(np.ones(3), np.ones(3)).constants)

    monkeypatch.setattr(gyroscope, "fit_joint", fit_joint)
    own, _, t_vps, q_vps, clock = flown()
    noise = 1e-3 * np.random.default_rng(1).normal(size=own.gyroscope.shape)
    start = np.full(3, 0.5), np.zeros(3)
    noisy = replace(own, gyroscope=own.gyroscope + noise)
    gyroscope.fit_gyroscope(noisy, t_vps, q_vps, clock, start, np.eye(3), max_gap_s=0.05)
    free, stiff = asked
    assert (free["largest_walk_ratio"], stiff["largest_walk_ratio"]) == (10.0, 0.03)
    assert [how[name] for how in asked for name in ("free_dip", "try_lever_arm")] == [False] * 4
    # White noise of 0.5 · 1e-3 rad/s every 5 ms; the largest of three axes.
    assert stiff["levels"].walk == pytest.approx(0.03 * (0.5e-3) ** 2 * 0.005, rel=0.15)
    assert free["model"].vectors == ()
    assert {name: x.shape for name, x in free["state"].values.items()} == {
        "dip": (1,), "lever_arm": (3,), "gyroscope": (6,), "vps_clock": (2,), "vps_world": (3,), "vps_body": (3,),
    }  # fmt: skip


def test_before_and_after_the_poses_the_gyroscope_goes_on() -> None:
    own, q, t_vps, q_vps, clock = flown()
    given = own, q, t_vps[300:-300], q_vps[300:-300], clock
    assert errors(*given).max() < INTERPOLATED_RAD


def test_a_segment_without_a_pose_takes_its_neighbours_offset() -> None:
    """Turned as a whole, its turning kept."""
    segment = (np.arange(4000) >= 3000).astype(np.int64)
    own, q, t_vps, q_vps, clock = flown(segment)
    found = attitudes(own, t_vps[:1400], q_vps[:1400], clock, (np.full(3, 0.5), np.zeros(3)), 0.05)
    assert angle(found[:3000], q[:3000]).max() < INTERPOLATED_RAD
    since, expected = (multiply(conjugate(x[3000]), x[3000:]) for x in (found, q))
    assert angle(since, expected).max() < INTERPOLATED_RAD


@pytest.mark.parametrize("n_seen", [1, 2, 3])
def test_a_segment_with_hardly_a_pose_takes_what_there_is(n_seen: int) -> None:
    """Poses end a microsecond behind its first samples."""
    segment = (np.arange(4000) >= 3000).astype(np.int64)
    own, q, _, _, clock = flown(segment)
    on_vps_clock = 10.0 + (own.t - 10.0) * (1.0 + 1e-6 * SKEW_PPM) - LAG_S
    last = 3000 + n_seen
    t_vps = np.r_[on_vps_clock[: last - 1], on_vps_clock[last - 1] + 1e-6]
    assert errors(own, q, t_vps, q[:last], clock).max() < INTERPOLATED_RAD


def test_no_pose_at_all_is_refused() -> None:
    own, _, t_vps, q_vps, clock = flown()
    with pytest.raises(UnusableFlight) as error:
        attitudes(own, t_vps + 1000.0, q_vps, clock, (np.full(3, 0.5), np.zeros(3)), 0.05)
    assert error.value.reason_code == "vps_too_short"
