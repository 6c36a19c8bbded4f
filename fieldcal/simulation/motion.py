"""What every simulated motion has in common: attitude and rate from its Euler angles, and sums of sinusoids."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.random import Generator

from fieldcal.geometry.rotation import Array, from_euler

Lines = tuple[Array, Array, Array]
"""Amplitudes, angular frequencies, rad/s, and phases, (3, lines): sinusoids on three axes."""


class Kinematics(ABC):
    """A motion that can be asked at any time."""

    @abstractmethod
    def euler(self, t: Array) -> tuple[Array, Array]:
        """Bank, pitch, heading (n, 3) and their derivatives at times t (n,)."""

    @abstractmethod
    def velocity(self, t: Array) -> Array:
        """Velocity of the centre of mass, m/s, NED."""

    @abstractmethod
    def acceleration(self, t: Array) -> Array:
        """Translational acceleration of the centre of mass, m/s², NED."""

    @abstractmethod
    def position(self, t: Array) -> Array:
        """Position, m, NED."""

    def attitude(self, t: Array) -> Array:
        return from_euler(self.euler(t)[0])

    def attitude_and_rate(self, t: Array) -> tuple[Array, Array]:
        """Both for the price of one."""
        angle, dot = self.euler(t)
        return from_euler(angle), self._body_rate(angle, dot)

    def rate(self, t: Array) -> Array:
        """Body rates, rad/s."""
        return self._body_rate(*self.euler(t))

    @staticmethod
    def _body_rate(angle: Array, dot: Array) -> Array:
        """3-2-1 Euler kinematics."""
        (sf, cf), (st, ct) = ((np.sin(angle[:, i]), np.cos(angle[:, i])) for i in (0, 1))
        return np.stack(
            [dot[:, 0] - st * dot[:, 2], cf * dot[:, 1] + sf * ct * dot[:, 2], -sf * dot[:, 1] + cf * ct * dot[:, 2]],
            axis=1,
        )

    def rate_dot(self, t: Array) -> Array:
        """Angular acceleration, rad/s², by a central difference of the closed form over 20 µs (error below 1e-8)."""
        h = 1e-5
        return (self.rate(t + h) - self.rate(t - h)) / (2 * h)


def sinusoids(rng: Generator, rms_per_axis: float, band_hz: tuple[float, float], *, lines: int) -> Lines:
    """Amplitudes, angular frequencies (log-uniform in the band) and phases (3, lines), of given rms on each axis."""
    low, high = np.log(band_hz)
    omega = 2 * np.pi * np.exp(rng.uniform(low, high, size=(3, lines)))
    amplitude = rng.uniform(0.5, 1.0, size=(3, lines))
    amplitude *= rms_per_axis / np.sqrt(0.5 * np.sum(amplitude**2, axis=1, keepdims=True))
    return amplitude, omega, rng.uniform(0, 2 * np.pi, size=(3, lines))


def total(lines: Lines, t: Array, derivative: int) -> Array:
    """Σ a sin(ωt + φ) per axis, (n, 3), differentiated (or integrated: negative) in time."""
    amplitude, omega, phase = lines
    shifted = np.multiply.outer(t, omega) + phase + 0.5 * np.pi * derivative
    return np.asarray(np.sum(amplitude * omega**derivative * np.sin(shifted), axis=-1))
