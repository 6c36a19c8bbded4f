"""Which reading of a quaternion makes a rotation of the VPS's turns: each misreading, wrong wiring, plane motion."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import random_attitudes
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.clock_sync.by_rates import SyncFit
from fieldcal.estimation.clock_sync.handedness import (
    READINGS,
    Handedness,
    better_readings,
    handedness,
    mounting_deg,
)
from fieldcal.geometry.rotation import conjugate, from_rotation_vector, multiply
from fieldcal.simulation.experiment import Experiment, Motion

LIMITS = {"min_peak": 0.5, "max_gap_s": 0.05}
WRITTEN = {"inverse": conjugate, "scalar first": lambda q: q[..., [3, 0, 1, 2]]}  # how the mistakes are made
Record = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def record(seed: int = 3, turned: tuple[float, float, float] = (1.0, 1.0, 1.0), tremor_rad: float = 0.01) -> Record:
    rng = np.random.default_rng(seed)
    motion = Motion(Experiment(seed=seed, turned=turned, tremor_rad=tremor_rad), rng)
    t, t_vps = np.arange(0.0, 40.0, 1.0 / 185.0), np.arange(0.0, 40.0, 1.0 / 120.0)
    return t, motion.rate(t) + 0.1 * rng.normal(size=(len(t), 3)), t_vps, motion.attitude(t_vps)


def test_readings_undo_the_mistakes() -> None:
    q = random_attitudes(np.random.default_rng(0), 5)
    assert set(READINGS) == set(WRITTEN)
    for name, read in READINGS.items():
        np.testing.assert_array_equal(read(WRITTEN[name](q)), q)


@pytest.mark.parametrize("seed", range(3, 7))
def test_right_quaternions_are_a_rotation_whatever_the_mounting(seed: int) -> None:
    t, rate, t_vps, q = record(seed)
    world, body = random_attitudes(np.random.default_rng(seed), 2)
    fit = by_rates.synchronise(t, rate * [1.0, 0.7, 1.6], t_vps, multiply(multiply(world, q), body))
    found = handedness(fit)
    assert found.is_rotation
    assert found.from_rotation < 0.01
    assert found.from_mirror > 0.5
    assert not better_readings(t, rate, t_vps, {n: read(q) for n, read in READINGS.items()}, fit.explained, **LIMITS)


@pytest.mark.parametrize("seed", range(3, 7))
@pytest.mark.parametrize("mistake", list(WRITTEN))
def test_each_mistake_is_a_mirror_and_named_first(mistake: str, seed: int) -> None:
    t, rate, t_vps, q = record(seed)
    logged = WRITTEN[mistake](multiply(q, from_rotation_vector(np.array([0.03, -0.04, 0.02]))))
    given = by_rates.synchronise(t, rate, t_vps, logged)
    assert handedness(given).is_mirror
    assert not handedness(given).is_rotation
    readings = {name: read(logged) for name, read in READINGS.items()}
    better = better_readings(t, rate, t_vps, readings, given.explained, **LIMITS)
    assert next(iter(better)) == mistake
    assert mounting_deg(better[mistake]) == pytest.approx(np.degrees(0.0539), abs=0.5)  # √(3² + 4² + 2²) centirad


@pytest.mark.parametrize("axis", range(3))
def test_an_axis_wired_the_other_way_is_a_mirror_that_no_reading_mends(axis: int) -> None:
    t, rate, t_vps, q = record()
    wired = np.where(np.arange(3) == axis, -1.0, 1.0)
    given = by_rates.synchronise(t, rate * wired, t_vps, q)
    assert handedness(given).is_mirror
    readings = {name: read(q) for name, read in READINGS.items()}
    assert not better_readings(t, rate * wired, t_vps, readings, given.explained, **LIMITS)


def test_turns_about_two_axes_are_no_mirror() -> None:
    t, rate, t_vps, q = record(turned=(1.0, 0.0, 0.0), tremor_rad=0.003)
    assert handedness(by_rates.synchronise(t, rate, t_vps, q)).is_rotation


def test_a_shear_is_no_rotation() -> None:
    t, rate, t_vps, q = record()
    sheared = rate @ np.array([[1.0, 0.9, 0.9], [0.0, 1.0, 0.9], [0.0, 0.0, 1.0]])
    found = handedness(by_rates.synchronise(t, sheared, t_vps, q))
    assert not found.is_mirror
    assert not found.is_rotation


def mapped(matrix: np.ndarray, turning: np.ndarray) -> SyncFit:
    return SyncFit(0.0, 0.0, np.eye(2), 1.0, 0.0, 0.1, 1.0, matrix, 0.0, 0.0, turning)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_map_that_is_a_rotation_is_off_a_mirror_by_four_times_the_least_turns(mirrored: bool) -> None:
    """Of turns about three axes the nearest mirror flips the one that moves least; the gyroscope's scales are out."""
    rng = np.random.default_rng(4)
    axes = Rotation.random(random_state=rng).as_matrix()
    turning = axes @ np.diag([3.0, 2.0, 0.7]) @ axes.T
    matrix = np.diag([0.7, 1.3, 2.0]) @ Rotation.random(random_state=rng).as_matrix() * (-1.0 if mirrored else 1.0)
    found = handedness(mapped(matrix, turning))
    off = (found.from_mirror, found.from_rotation) if mirrored else (found.from_rotation, found.from_mirror)
    assert off == (pytest.approx(0.0, abs=1e-12), pytest.approx(4.0 * 0.7 / 5.7))


def test_the_mounting_is_the_maps_rotation_whatever_the_scales() -> None:
    for degrees in (0.0, 30.0, 170.0):
        turn = Rotation.from_rotvec(np.radians(degrees) * np.array([2.0, -1.0, 2.0]) / 3.0).as_matrix()
        assert mounting_deg(mapped(np.diag([0.7, 1.3, 2.0]) @ turn, np.eye(3))) == pytest.approx(degrees, abs=1e-5)
    rough = np.array([[1.0, 0.3, -0.2], [-0.1, 1.5, 0.4], [0.3, -0.2, 0.6]])  # sheared too: the nearest of its rows
    nearest, _ = polar(rough / np.linalg.norm(rough, axis=1)[:, None])
    assert mounting_deg(mapped(rough, np.eye(3))) == pytest.approx(
        np.degrees(Rotation.from_matrix(nearest).magnitude())
    )
    for seed in range(50):  # a trace of three but for rounding
        tiny = np.eye(3) + 1e-9 * np.random.default_rng(seed).normal(size=(3, 3))
        assert mounting_deg(mapped(tiny, np.eye(3))) < 1e-4


def test_what_is_plainly_a_mirror_and_what_may_be_a_rotation() -> None:
    assert Handedness(0.5, 0.449).is_mirror
    assert not Handedness(0.5, 0.451).is_mirror
    assert Handedness(0.149, 0.5).is_rotation
    assert Handedness(0.15, 0.5).is_rotation
    assert not Handedness(0.151, 0.5).is_rotation
    assert not Handedness(0.14, 0.01).is_rotation


@pytest.mark.parametrize(("leaves", "better"), [(0.96, True), (0.98, False)])
def test_a_reading_is_better_that_leaves_three_per_cent_less_unexplained(leaves: float, better: bool) -> None:
    t, rate, t_vps, q = record()
    explained = 1.0 - (1.0 - by_rates.synchronise(t, rate, t_vps, q).explained) / leaves
    assert list(better_readings(t, rate, t_vps, {"as it is": q}, explained, **LIMITS)) == ["as it is"][: int(better)]
