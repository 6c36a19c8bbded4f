"""What the tests of the numerics share: seeded directions, attitudes and coloured noise, and the ratio that says
whether a claimed standard deviation is honest."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from fieldcal.geometry.rotation import from_rotation_vector, propagate
from fieldcal.simulation.experiment import BIAS, SCALE

Array = NDArray[np.floating[Any]]

MICRODEGREE_RAD = float(np.radians(1e-6))
ROUNDING = 1e-12
AXES = np.eye(3)


def directions(rng: Generator, n: int) -> Array:
    """Unit vectors (n, 3), uniform on the sphere."""
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def random_attitudes(rng: Generator, n: int) -> Array:
    """Attitudes (n, 4), uniform over all rotations."""
    q = rng.normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def angle(p: ArrayLike, q: ArrayLike) -> Array:
    """Angle, rad, between attitudes (…, 4), by the chord: exact for small ones, blind to sign."""
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    chord = np.minimum(np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1))
    return np.asarray(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))


def rms(x: ArrayLike) -> float:
    """Root mean square of everything in x."""
    return float(np.sqrt(np.mean(np.square(x))))


def autoregressive(rng: Generator, shape: tuple[int, ...], correlation: float) -> Array:
    """Stationary first-order autoregressive noise of unit variance along the first axis."""
    settling = int(np.ceil(20.0 / (1.0 - correlation)))
    white = rng.normal(size=(shape[0] + settling, *shape[1:])) * np.sqrt(1.0 - correlation**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -correlation], white, axis=0)[settling:])


def turning_rates(t: Array, rng: Generator, peak: float = 0.7) -> Array:
    """Smooth body rates (n, 3), rad/s, about all axes: three sinusoids each between 0.1 and 0.5 Hz."""
    frequency, phase = rng.uniform(0.1, 0.5, (3, 3)), rng.uniform(0.0, 2.0 * np.pi, (3, 3))
    return peak * np.sum(np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase), axis=2)


def finely_integrated(t: Array, rng: Generator, *, refinement: int = 20) -> tuple[Array, Array]:
    """Attitudes (n, 4) and body rates (n, 3) at stamps t of a turning motion, integrated on steps `refinement` times
    finer."""
    edges = np.interp(np.arange((len(t) - 1) * refinement + 1) / refinement, np.arange(len(t)), t)
    rate = turning_rates(edges, rng)
    q = propagate(edges, rate, from_rotation_vector(rng.normal(size=3)))
    return q[::refinement], rate[::refinement]


def constants(sensor: str) -> tuple[Array, Array]:
    """Scale and bias, each (3,), of a simulated triad."""
    return np.array(SCALE[sensor]), np.array(BIAS[sensor])


def logged(values: Array, scale: Array, bias: Array) -> Array:
    """Eq. 5 inverted: what a triad with these constants logs for true values (n, 3)."""
    return (values - bias) / scale
