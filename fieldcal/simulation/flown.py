"""Motion of ordinary flights: a trajectory, and the attitude that the vehicle needs to fly it.

A multirotor's specific force is thrust along its z axis and drag: to accelerate it banks. A fixed wing turns by banking
and points its nose into the air that it meets."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator

from fieldcal.geometry.rotation import Array
from fieldcal.simulation.motion import Kinematics, sinusoids, total

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

GRID_HZ = 100.0
MARGIN_S = 2.0  # of the grid beyond the record
DRAG_PER_S = 0.25  # of a multirotor's rotors: specific force against the air speed across its z axis
TURBULENCE_HZ = (0.05, 2.0)
LINES = 12
INCIDENCE_RAD = 0.06  # of a wing
STANDARD_GRAVITY_MPS2 = 9.81


class Flown(StrEnum):
    """What is flown."""

    MANOEUVRE = "manoeuvre"
    """The paper's doublets, tilted by hand near one place."""
    MISSION = "mission"
    """A multirotor from waypoint to waypoint."""
    LIVELY = "lively"
    """A multirotor that never rests: banks of 20–40°, turns, climbs."""
    HOVER = "hover"
    """A multirotor that stays where it is, in wind."""
    FIXED_WING = "fixed_wing"
    """A fixed wing: legs, and turns of 25–45° of bank between them."""


ORDINARY = tuple(kind for kind in Flown if kind != Flown.MANOEUVRE)


class FlownMotion(Kinematics):
    """Attitude, rate, velocity and acceleration at any time, by cubic splines through a grid.

    The sensor is where the trajectory is: a lever arm is added to it as to any motion's."""

    def __init__(self, kind: Flown, duration_s: float, rng: Generator) -> None:
        from scipy.interpolate import CubicSpline

        t = np.arange(-MARGIN_S, duration_s + MARGIN_S, 1.0 / GRID_HZ)
        wind = np.r_[rng.normal(0.0, 2.0, 2), 0.0]
        if kind == Flown.FIXED_WING:
            air, euler = _fixed_wing(t, duration_s, rng)
            velocity = air + wind
        else:
            velocity, heading = {Flown.MISSION: _mission, Flown.LIVELY: _lively, Flown.HOVER: _hover}[kind](
                t, duration_s, rng
            )
            acceleration = CubicSpline(t, velocity)(t, 1)
            euler = _banked(velocity - wind, acceleration, heading)
        self._euler: CubicSpline = CubicSpline(t, euler)
        self._velocity: CubicSpline = CubicSpline(t, velocity)
        self._position = self._velocity.antiderivative()

    def euler(self, t: Array) -> tuple[Array, Array]:
        """Bank, pitch, heading (n, 3), rad, and their derivatives at times t (n,)."""
        return self._euler(t), self._euler(t, 1)

    def velocity(self, t: Array) -> Array:
        """Of the sensor, m/s, NED."""
        return np.asarray(self._velocity(t))

    def acceleration(self, t: Array) -> Array:
        """Of the sensor, m/s², NED."""
        return np.asarray(self._velocity(t, 1))

    def position(self, t: Array) -> Array:
        """Of the sensor, m, NED, from somewhere near the start."""
        return np.asarray(self._position(t))


def _banked(air: Array, acceleration: Array, heading: Array) -> Array:
    """Euler angles (n, 3) of a multirotor that flies these accelerations at this air speed (n, 3) and heading (n,).

    Specific force = −T z_b − k (v − (v·z_b) z_b), so that z_b is along −(a − g + k v) (Faessler et al. 2018)."""
    down = -(acceleration + DRAG_PER_S * air)
    down[:, 2] += STANDARD_GRAVITY_MPS2
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    c, s = np.cos(heading), np.sin(heading)
    ahead, right = c * down[:, 0] + s * down[:, 1], c * down[:, 1] - s * down[:, 0]
    return np.column_stack([-np.arcsin(right), np.arctan2(ahead, down[:, 2]), heading])


def _mission(t: Array, duration_s: float, rng: Generator) -> tuple[Array, Array]:
    """Legs at 3–9 m/s with a stop now and then, the nose along each; climbs and descents."""
    velocity, heading = np.zeros((len(t), 3)), np.zeros(len(t))
    before, pointed, clock = np.zeros(3), float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(2.0, 5.0))
    heading += pointed
    while clock < duration_s:
        turn = float(rng.uniform(-2.4, 2.4))
        pointed += turn
        speed = 0.0 if rng.uniform() < 0.2 else float(rng.uniform(3.0, 9.0))
        after = np.array([speed * np.cos(pointed), speed * np.sin(pointed), rng.uniform(-1.5, 1.5)])
        takes_s = max(2.0, float(np.linalg.norm(after - before)) / float(rng.uniform(1.5, 3.0)))
        velocity += _step(t, clock, takes_s)[:, None] * (after - before)
        heading += turn * _step(t, clock, max(1.0, abs(turn) / float(rng.uniform(0.5, 1.2))))
        clock += takes_s + float(rng.uniform(4.0, 12.0))
        before = after
    gusts = _wander(rng, 0.25, TURBULENCE_HZ, t)
    yaw = _wander(rng, 0.02, (0.1, 1.0), t, -1)[:, 0]
    return velocity + _integrated(gusts, t), heading + yaw


def _lively(t: Array, duration_s: float, rng: Generator) -> tuple[Array, Array]:
    """Accelerations of 2–3 m/s² rms in every direction, and a nose that follows its own ideas."""
    strength = float(rng.uniform(2.0, 3.0))
    acceleration = _wander(rng, strength, (0.12, 0.6), t) + _wander(rng, 0.4, (0.5, 2.5), t)
    turns = _wander(rng, 0.8, (0.05, 0.4), t, -1)[:, 0]
    heading = float(rng.uniform(-np.pi, np.pi)) + turns + float(rng.normal(0.0, 0.15)) * t
    acceleration[:, 2] *= 0.7
    return _integrated(acceleration, t), heading


def _hover(t: Array, duration_s: float, rng: Generator) -> tuple[Array, Array]:
    """Gusts that are flown out, a heading that is held to some degrees."""
    acceleration = _wander(rng, 0.15, (0.1, 2.0), t)
    yaw = _wander(rng, 0.03, (0.05, 0.5), t, -1)[:, 0]
    return _integrated(acceleration, t), float(rng.uniform(-np.pi, np.pi)) + yaw


def _fixed_wing(t: Array, duration_s: float, rng: Generator) -> tuple[Array, Array]:
    """Velocity through the air (n, 3) and Euler angles: legs, and coordinated turns between them."""
    speed = float(rng.uniform(13.0, 20.0)) + _wander(rng, 0.2, (0.02, 0.2), t, -1)[:, 0]
    climb = _wander(rng, 0.25, (0.02, 0.3), t, -1)[:, 1] + _wander(rng, 0.3, (0.3, 2.0), t, -1)[:, 2]
    bank, clock = np.zeros(len(t)), float(rng.uniform(2.0, 6.0))
    while clock < duration_s:
        tilt = float(rng.uniform(0.45, 0.8)) * float(rng.choice([-1.0, 1.0]))
        turn_s, roll_s = float(rng.uniform(3.0, 9.0)), float(rng.uniform(1.0, 2.0))
        bank += tilt * (_step(t, clock, roll_s) - _step(t, clock + roll_s + turn_s, roll_s))
        clock += 2.0 * roll_s + turn_s + float(rng.uniform(3.0, 10.0))
    bank += _wander(rng, 0.08, (0.2, 1.5), t, -1)[:, 0]
    rate = STANDARD_GRAVITY_MPS2 * np.tan(bank) / speed
    course = float(rng.uniform(-np.pi, np.pi)) + np.cumsum(rate) / GRID_HZ
    slope = climb / speed
    air = speed[:, None] * np.column_stack([np.cos(course) * np.cos(slope), np.sin(course) * np.cos(slope), -slope])
    incidence = INCIDENCE_RAD / np.cos(bank)
    # The nose is above the course by the incidence, which a bank turns out of the vertical.
    pitch = slope + incidence * np.cos(bank)
    return air, np.column_stack([bank, pitch, course + incidence * np.sin(bank)])


def _step(t: Array, start_s: float, takes_s: float) -> Array:
    """From 0 to 1 with continuous acceleration (n,)."""
    x = np.clip((t - start_s) / takes_s, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x**2))


def _wander(rng: Generator, rms: float, band_hz: tuple[float, float], t: Array, derivative: int = 0) -> Array:
    """Sinusoids of this rms on each axis (n, 3); integrated for −1."""
    return total(sinusoids(rng, rms, band_hz, lines=LINES), t, derivative)


def _integrated(acceleration: Array, t: Array) -> Array:
    """Velocity (n, 3) without a mean."""
    velocity = np.cumsum(acceleration, axis=0) / GRID_HZ
    return np.asarray(velocity - velocity.mean(axis=0))
