"""The estimate by velocity as a problem: a receiver's epochs, where the knots are, and what is unknown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldcal.estimation.joint.problem import Readings
from fieldcal.estimation.segments import run_bounds
from fieldcal.geometry.rotation import Array

TRIADS = ("gyroscope", "accelerometer", "magnetometer")
SIZES = {
    "gyroscope": 6,
    "drift": 3,
    "accelerometer": 6,
    "magnetometer": 6,
    "field": 2,
    "delay": 1,
    "lag": 1,
    "smoothing": 1,
    "arm": 3,
}
"""Unknowns beside the knots, in their order: scale and bias of the gyroscope, and how its bias changes with time,
rad/s², about the middle of the record; scale and bias of the accelerometer; gain and zero of the magnetometer
(readings = gain · field + zero); dip and declination of the field, rad, less those configured, and the
magnetometer's delay behind the gyroscope, s; the receiver's lag, s,
and what it adds of the velocity's second derivative, s² (T²/24 of a mean over T); from the sensor to its antenna, m,
sensor axes."""
LARGEST_LAG_S, SMALLEST_LAG_S = 0.6, -0.2
KNOT_SPACING_S = 0.25  # at most, where epochs are further apart
FASTEST_EPOCHS_S = 0.08  # epochs that follow closer than this are thinned
LONGEST_BRIDGE_S = 5.0  # between epochs: over a longer time nothing links what was before to what comes after


@dataclass(frozen=True)
class Epochs:
    """Velocities of a receiver's antenna: `t` (g,) s on the IMU's clock, `velocity` (g, 3) m/s, NED, `sd` (g,) m/s as
    the receiver claims it."""

    t: Array
    velocity: Array
    sd: Array

    def of(self, which: np.ndarray) -> Epochs:
        """Some of them."""
        return Epochs(self.t[which], self.velocity[which], self.sd[which])


@dataclass(frozen=True)
class Knots:
    """`offset` (K,) s: stamps of the knots, which are where the velocity with that stamp was if the lag is 0; `epoch`
    (K,) which epoch a knot is at, −1 where it is at none; `joined` (K−1,) whether readings lead from one to the
    next."""

    offset: Array
    epoch: np.ndarray
    joined: np.ndarray

    @property
    def interval_s(self) -> Array:
        """Between knots, (K−1,); 1 where they are not joined."""
        return np.where(self.joined, np.diff(self.offset), 1.0)


def place_knots(readings: Readings, epochs: Epochs) -> Knots:
    """A knot at each epoch that readings surround at every lag that may be, and between epochs further apart than
    KNOT_SPACING_S."""
    offset, epoch, joined = [], [], []
    for a, b in run_bounds(readings.segment):
        first, last = readings.t[a] + LARGEST_LAG_S, readings.t[b - 1] + SMALLEST_LAG_S
        inside = np.flatnonzero((epochs.t >= first) & (epochs.t <= last))
        before = -np.inf
        for k in inside:
            apart = epochs.t[k] - before
            if apart < FASTEST_EPOCHS_S:
                continue
            linked = bool(apart <= LONGEST_BRIDGE_S)
            parts = int(np.ceil(apart / KNOT_SPACING_S)) if linked else 1
            between = list(before + apart * np.arange(1, parts) / parts)
            offset += [*between, float(epochs.t[k])]
            epoch += [*[-1] * len(between), int(k)]
            joined += [linked] * (len(between) + 1)
            before = epochs.t[k]
    return Knots(np.array(offset), np.array(epoch, dtype=np.int64), np.array(joined[1:], dtype=bool))


@dataclass(frozen=True)
class State:
    """All unknowns: at the knots `q` (K, 4) attitude of the sensor axes, NED, and `velocity` (K, 3) m/s of the sensor;
    `values` by the names of SIZES."""

    q: Array
    velocity: Array
    values: Mapping[str, Array]

    @property
    def lag_s(self) -> float:
        """By how much the receiver's velocity is later than the readings with its stamp."""
        return float(self.values["lag"][0])

    def with_values(self, **changes: Array) -> State:
        """With other values for some names."""
        return replace(self, values={**self.values, **changes})


def of_other_form(constants: Array) -> tuple[Array, Array]:
    """A triad's scale and bias (6,) as gain and zero, or these as those, and ∂ of them (6, 6): both ways are one map,
    (1/λ, −b/λ)."""
    one, other = constants[:3], constants[3:]
    jacobian = np.block([[np.diag(-1.0 / one**2), np.zeros((3, 3))], [np.diag(other / one**2), np.diag(-1.0 / one)]])
    return np.r_[1.0 / one, -other / one], jacobian


def layout_of(names: Mapping[str, Array]) -> dict[str, slice]:
    """Where each unknown's columns are."""
    out, at = {}, 0
    for name, size in SIZES.items():
        if name in names:
            out[name] = slice(at, at + size)
            at += size
    return out


@dataclass(frozen=True)
class Levels:
    """Noise: `turn` rad²/s and `push` (m/s)²/s, densities of the random walks that gyroscope and accelerometer make of
    attitude and velocity; `receiver` (2,) level and vertical variance over what the receiver claims; `field` variance
    of a magnetometer's mean over an interval; `colour` (3,) density at low frequency over that of white noise, of level
    and vertical velocity and of the magnetometer."""

    turn: float
    push: float
    receiver: Array
    field: float
    colour: Array


@dataclass(frozen=True)
class Prior:
    """What is known beforehand of some unknowns: `value` and `covariance` in their units."""

    value: Array
    covariance: Array
