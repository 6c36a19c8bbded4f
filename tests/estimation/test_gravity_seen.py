"""Gravity in an accelerometer's readings, of attitudes that scipy turns; taken off, in another unit, or hidden."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldcal.estimation import gravity_seen as module
from fieldcal.estimation.gravity_seen import GravitySeen, gravity_removed, gravity_seen

G = 9.8
RATE_HZ, SECONDS = 100, 30
BIAS = np.array([0.2, -0.1, 0.15])


def flight(tilt_rad: float = 0.9, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, body rates and gravity in body axes of a vehicle turned by hand."""
    t = np.arange(SECONDS * RATE_HZ) / RATE_HZ
    angles = tilt_rad * np.stack([np.sin(1.1 * t), np.sin(0.7 * t + 1), np.sin(0.9 * t + 2)], axis=1)
    attitude = Rotation.from_euler("ZYX", angles)
    rate = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * RATE_HZ
    gravity = attitude.inv().apply([0.0, 0.0, G])
    rng = np.random.default_rng(5)
    return (
        t,
        np.vstack([rate, rate[-1:]]) + rng.normal(0, 0.01, (len(t), 3)),
        gravity + rng.normal(0, noise, (len(t), 3)),
    )


def test_gravity_is_seen_with_its_length() -> None:
    t, rate, force = flight()
    seen = gravity_seen(t, rate, force + BIAS)
    assert seen is not None
    assert seen.turning == pytest.approx(G, rel=0.02)
    assert seen.mean == pytest.approx(G, rel=0.05)


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (1, -1, -1)])
@pytest.mark.parametrize("unit", [1.0, 9.80665, 9.80665e-3])
def test_readings_with_gravity_are_never_said_to_lack_it(signs: tuple[int, int, int], unit: float) -> None:
    """Wired otherwise, in another unit, with a bias."""
    t, rate, force = flight()
    assert gravity_removed(t, rate * np.array(signs), (force + BIAS) / unit, G) is None


@pytest.mark.parametrize("left", [0.0, 0.05, 0.16, 0.5])
def test_readings_without_gravity_are_told(left: float) -> None:
    """A share of it may be left, as of an estimated attitude that is off; a bias is there too. A sixth of it in m/s² is
    1.6 times as long as gravity in g."""
    t, rate, force = flight()
    rng = np.random.default_rng(6)
    fault = gravity_removed(t, rate, left * force + BIAS + rng.normal(0, 0.3, force.shape), G)
    assert fault is not None
    assert (fault.code, fault.sensor, fault.fatal) == ("gravity_removed", "accelerometer", True)
    assert fault.value == pytest.approx(left, abs=0.03)
    assert "Gravity has been taken off" in fault.sentence


def test_where_the_vehicle_does_not_tilt_nothing_is_told() -> None:
    t, rate, force = flight(tilt_rad=0.02)
    assert gravity_seen(t, rate, force) is None
    assert gravity_removed(t, rate, 0.1 * force, G) is None


def test_a_thrust_that_stays_with_the_body_is_long_enough_to_be_gravity() -> None:
    t, rate, _ = flight()
    assert gravity_removed(t, rate, np.broadcast_to([0.0, 0.0, 0.95 * G], rate.shape), G) is None


def test_too_short_a_recording_tells_nothing() -> None:
    t, rate, force = flight()
    few = t < 9.9
    assert gravity_seen(t[few], rate[few], force[few]) is None


@pytest.mark.parametrize(
    ("mean", "turning", "told"),
    [
        (0.89, 0.0, True),
        (0.91, 0.0, False),
        (1.11, 0.0, False),
        (1.12, 0.0, True),
        (0.0, 0.69, True),
        (0.0, 0.71, False),
        (0.0, 1.42, False),
        (0.0, 1.44, True),
    ],
)
def test_what_is_gravity_in_g_is_not_gravity_taken_off(
    monkeypatch: pytest.MonkeyPatch, mean: float, turning: float, told: bool
) -> None:
    """Shares of gravity that the readings would show if they were in g: a mean within a tenth of it, what turns within
    three."""
    g = 9.80665
    monkeypatch.setattr(module, "gravity_seen", lambda *_: GravitySeen(mean * G / g, turning * G / g))
    t, rate, force = flight()
    assert (gravity_removed(t, rate, 0.1 * force, G) is not None) == told
