"""Ordinary flights of the simulator: physics of what is flown, the receiver, and what is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldcal.config.configuration import load
from fieldcal.geometry.rotation import body_from_inertial
from fieldcal.logs import find_logs, read_log
from fieldcal.simulation.archive import truth, write_flights
from fieldcal.simulation.experiment import simulate
from fieldcal.simulation.flown import DRAG_PER_S, ORDINARY, STANDARD_GRAVITY_MPS2, Flown, FlownMotion
from fieldcal.simulation.ordinary import ordinary_flight

T = np.arange(0.0, 40.0, 0.05)
GRAVITY = np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
SPLINE_MPS2 = 2e-2
"""What the attitude between the points of its grid leaves of thrust across z."""
STEP_S = 1e-4


def body_force(motion: FlownMotion) -> np.ndarray:
    attitude = body_from_inertial(motion.attitude(T))
    return np.einsum("nij,nj->ni", attitude, motion.acceleration(T) - GRAVITY)


@pytest.mark.parametrize("kind", ORDINARY)
def test_velocity_rate_and_position_are_derivatives(kind: Flown) -> None:
    motion = FlownMotion(kind, 40.0, np.random.default_rng(3))
    for x, slope in ((motion.velocity, motion.acceleration), (motion.position, motion.velocity)):
        assert np.allclose((x(T + STEP_S) - x(T - STEP_S)) / (2 * STEP_S), slope(T), atol=1e-3)
    turned = body_from_inertial(motion.attitude(T + STEP_S)) @ body_from_inertial(motion.attitude(T)).transpose(0, 2, 1)
    rate = np.stack([turned[:, 1, 2], turned[:, 2, 0], turned[:, 0, 1]], axis=1) / STEP_S
    assert np.allclose(rate, motion.rate(T + 0.5 * STEP_S), atol=1e-3)


@pytest.mark.parametrize("kind", [Flown.MISSION, Flown.LIVELY, Flown.HOVER])
def test_a_multirotor_feels_thrust_along_z_and_drag(kind: Flown) -> None:
    """Drag is linear in the air speed: two axes of one constant wind explain what is felt across z."""
    motion = FlownMotion(kind, 40.0, np.random.default_rng(4))
    force, attitude = body_force(motion), body_from_inertial(motion.attitude(T))
    own = force[:, :2] + DRAG_PER_S * np.einsum("nij,nj->ni", attitude, motion.velocity(T))[:, :2]
    wind = np.linalg.lstsq(attitude[:, :2, :2].reshape(-1, 2), own.ravel(), rcond=None)[0]
    assert np.abs(own - attitude[:, :2, :2] @ wind).max() < SPLINE_MPS2
    assert force[:, 2].max() < 0.0


def test_a_fixed_wing_turns_without_slipping() -> None:
    force = body_force(FlownMotion(Flown.FIXED_WING, 40.0, np.random.default_rng(5)))
    assert np.abs(force[:, 1]).max() < 2.0  # the roll into a turn; a flat turn would feel half of g
    assert np.sqrt(np.mean(force[:, 1] ** 2)) < 0.6


def test_the_receiver_is_late_and_at_its_arm() -> None:
    e = ordinary_flight("lively", 6, duration_s=30.0, noise=False, band_limit=False)
    moved = simulate(e, gnss_arm_m=(0.0, 0.0, 0.0))
    motion = FlownMotion(Flown.LIVELY, 30.0, np.random.default_rng(np.random.SeedSequence(6).spawn(7)[0]))
    assert np.allclose(moved.gnss_velocity, motion.velocity(moved.gnss_t - e.gnss_lag_s), atol=1e-9)
    r = simulate(e)
    swing = np.linalg.norm(r.gnss_velocity - moved.gnss_velocity, axis=1)
    rate = np.linalg.norm(motion.rate(r.gnss_t - e.gnss_lag_s), axis=1)
    assert np.all(swing <= rate * np.linalg.norm(e.gnss_arm_m) + 1e-9)
    assert truth(r)["gnss_lag_s"] == pytest.approx(e.gnss_lag_s)


def test_lag_arm_and_constants_are_drawn_by_the_seed() -> None:
    one, again, other = (ordinary_flight("mission", seed) for seed in (1, 1, 2))
    assert one == again
    assert (one.gnss_lag_s, one.scale, one.gnss_arm_m) != (other.gnss_lag_s, other.scale, other.gnss_arm_m)
    with pytest.raises(ValueError, match="loop"):
        ordinary_flight("loop", 1)


@pytest.mark.parametrize("log_format", ["mcap", "ulog", "csv"])
def test_the_velocity_is_read_as_it_was_flown(tmp_path: Path, log_format: str) -> None:
    e = ordinary_flight("mission", 7, duration_s=10.0)
    write_flights(tmp_path, e, log_format=log_format)
    (log,) = find_logs(tmp_path)
    frames, _ = read_log(log.path, load(tmp_path / "fieldcal.toml").vehicle("sim-1"))
    r, found = simulate(e), frames["gnss_velocity"]
    columns = [f"velocity_{way}_mps" for way in ("north", "east", "down")]
    assert np.allclose(found.select(columns).to_numpy(), r.gnss_velocity, atol=1e-5)
    assert np.allclose(found["velocity_sd_mps"], r.gnss_sd, atol=1e-6)
    later = (found["t_ns"] - frames["imu"]["t_ns"][0]).to_numpy() * 1e-9
    assert np.allclose(later, r.gnss_t - r.t[0], atol=2e-6)
