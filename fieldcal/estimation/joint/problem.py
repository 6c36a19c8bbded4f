"""What the joint estimator is given and what it seeks: readings, centred triads, a record's model and its state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldcal.estimation.gyroscope.equation_error import from_centred
from fieldcal.estimation.joint.chain_solver import Knots
from fieldcal.estimation.segments import run_bounds
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply

MAX_TURN_RAD, MAX_AVERAGE_S = 0.1, 0.02
TRIADS = ("gyroscope", "accelerometer", "magnetometer")
# Off-diagonal elements of a triad's matrix that are free: body axes are the accelerometer's, whose x stays where it is.
OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
CROSS = {"gyroscope": OFF_DIAGONAL, "accelerometer": ((1, 0), (2, 0), (2, 1)), "magnetometer": OFF_DIAGONAL}
# What a start may hold beside constants, and how many numbers that is: cross-axis terms, the gyroscope's slope with
# temperature, delays of the vector triads behind it, s (`model_selection`); a VPS's clock and mounting
# (`pose_measurement`).
TERMS = {
    "gyroscope_cross": 6,
    "gyroscope_temperature": 3,
    "accelerometer_delay": 1,
    "magnetometer_delay": 1,
    "accelerometer_cross": 3,
    "magnetometer_cross": 6,
}
OPTIONAL = {**TERMS, "vps_clock": 2, "vps_world": 3, "vps_body": 3}


@dataclass(frozen=True)
class Readings:
    """One record, every triad in the same sensor axes, logged units.

    `t` (n,) s; `segment` (n,) contiguous stretches; `gyroscope` (n, 3) complete; `accelerometer`, `magnetometer` (n, 3)
    with NaN where there is no reading, or None; `gravity_mps2` signed: negative for a specific-force accelerometer;
    `field_ned` (3,) the configured local field; `turning` (2, n, 3) the gyroscope low-passed and its derivative, logged
    units (for the lever arm); `warmth` (n,) temperature less its mean, °C, or None."""

    t: Array
    segment: np.ndarray
    gyroscope: Array
    accelerometer: Array | None
    magnetometer: Array | None
    gravity_mps2: float
    field_ned: Array
    turning: Array
    warmth: Array | None = None

    def part(self, own: slice) -> Readings:
        """The samples `own` alone."""

        def cut(x: Array | None) -> Array | None:
            return None if x is None else x[own]

        return replace(
            self,
            t=self.t[own],
            segment=self.segment[own],
            gyroscope=self.gyroscope[own],
            accelerometer=cut(self.accelerometer),
            magnetometer=cut(self.magnetometer),
            turning=self.turning[:, own],
            warmth=cut(self.warmth),
        )


def averaging_side(readings: Readings, rate_radps: float) -> int:
    """How many neighbours on either side a vector reading may be averaged with: while the vehicle turns by less than
    MAX_TURN_RAD at `rate_radps` and both triads are complete."""
    for x in (readings.accelerometer, readings.magnetometer):
        if x is not None and not np.isfinite(x).all():
            return 0
    interval = float(np.median(np.diff(readings.t)))
    longest = min(MAX_TURN_RAD / max(rate_radps, 1e-9), MAX_AVERAGE_S)
    return max(0, int((longest / interval - 1.0) / 2.0))


@dataclass(frozen=True)
class Centred:
    """A triad's readings as x = (logged − centre)/spread, so that its constants (λ', b') are of order one."""

    x: Array
    known: np.ndarray
    centre: Array
    spread: Array

    @classmethod
    def of(cls, logged: Array) -> Centred:
        known = np.asarray(np.isfinite(logged).all(axis=1))
        centre = logged[known].mean(axis=0)
        spread = np.maximum(logged[known].std(axis=0), 1e-300)
        return cls(np.where(known[:, None], (logged - centre) / spread, 0.0), known, centre, spread)

    def averaged(self, at: np.ndarray, side: int) -> Centred:
        """At samples `at` only, each the mean of itself and `side` neighbours on either side."""
        x = sum(self.x[at + k] for k in range(-side, side + 1)) / (2 * side + 1)
        return replace(self, x=np.asarray(x), known=self.known[at])

    def scaled(self, scale: Array, bias: Array) -> Array:
        """(λ', b') (6,) of constants in logged units."""
        return np.concatenate([scale * self.spread, bias + scale * self.centre])

    def logged(self, scaled: Array) -> tuple[Array, Array]:
        """(λ, b) in logged units of (λ', b') (6,)."""
        value = self.to_logged() @ scaled
        return value[:3], value[3:]

    def to_logged(self) -> Array:
        """(λ, b) = T (λ', b'), (6, 6)."""
        return from_centred(self.centre, self.spread)


@dataclass(frozen=True)
class State:
    """Everything unknown: knot attitudes `q` (K, 4) of the sensor axes, `motion` (K, 9), and `values` by name: each
    triad's (λ', b') (6,), `dip` (1,) rad, `lever_arm` (3,) m, sensor axes, and the `OPTIONAL` ones there are."""

    q: Array
    motion: Array
    values: Mapping[str, Array]

    def moved(self, knots: Array, theta: Array, layout: Mapping[str, slice]) -> State:
        """After a step: knots (K, s), parameters (p,)."""
        values = dict(self.values)
        for name, own in layout.items():
            values[name] = values[name] + theta[own]
        return State(multiply(from_rotation_vector(knots[:, :3]), self.q), self.motion + knots[:, 3:], values)


@dataclass(frozen=True)
class Model:
    """The record prepared for fitting. `rows` names the vector triads present, three residual rows each; they are
    compared at samples `at` (m,), each triad's readings there in `triads` (the gyroscope's at every sample)."""

    readings: Readings
    triads: Mapping[str, Centred]
    knots: Knots
    rows: tuple[str, ...]
    at: np.ndarray

    @classmethod
    def of(cls, readings: Readings, knots: Knots, *, side: int = 0) -> Model:
        """`side`: vector readings are averaged over that many neighbours on either side (see `averaging_side`)."""
        given = {name: getattr(readings, name) for name in TRIADS}
        triads = {name: Centred.of(x) for name, x in given.items() if x is not None and np.isfinite(x).any()}
        rows = tuple(name for name in TRIADS[1:] if name in triads)
        at = np.concatenate(
            [np.arange(a + side, b - side, 2 * side + 1) for a, b in run_bounds(readings.segment) if b - a > 2 * side]
        )
        triads = {name: x.averaged(at, side) if name in rows else x for name, x in triads.items()}
        return cls(readings, triads, knots, rows, at)

    def part(self, a: int, b: int, knots: Knots) -> Model:
        """Samples a to b alone, in the same centred units, tied at `knots`."""
        rows = slice(*np.searchsorted(self.at, [a, b]))
        own = {name: slice(a, b) if name == "gyroscope" else rows for name in self.triads}
        triads = {name: replace(x, x=x.x[own[name]], known=x.known[own[name]]) for name, x in self.triads.items()}
        return Model(self.readings.part(slice(a, b)), triads, knots, self.rows, self.at[rows] - a)

    def without(self, name: str, rows: np.ndarray) -> Model:
        """Rows (m,) of a vector triad taken for no readings."""
        triad = self.triads[name]
        left = replace(triad, known=triad.known & ~rows, x=np.where(rows[:, None], 0.0, triad.x))
        return replace(self, triads={**self.triads, name: left})

    def field(self, dip: float) -> tuple[Array, Array]:
        """Local field (3,), NED, at a dip angle, rad, and its derivative."""
        north, east, _ = self.readings.field_ned
        strength, heading = np.linalg.norm(self.readings.field_ned), np.arctan2(east, north)
        level = np.array([np.cos(heading), np.sin(heading), 0.0])
        down = np.array([0.0, 0.0, 1.0])
        return (
            strength * (np.cos(dip) * level + np.sin(dip) * down),
            strength * (-np.sin(dip) * level + np.cos(dip) * down),
        )


def corrected(model: Model, values: Mapping[str, Array], name: str, own: slice = slice(None)) -> Array:
    """Readings x of a triad with cross-axis terms and the slope with temperature put in, (m, 3): Λ'(I + E) x + b'."""
    x = model.triads[name].x[own]
    out = x
    cross = values.get(f"{name}_cross")
    if cross is not None:
        out = x + x @ off_diagonal(name, cross).T
    slope = values.get(f"{name}_temperature")
    if slope is not None and model.readings.warmth is not None:
        out = out + model.readings.warmth[own, None] * slope
    return out


def off_diagonal(name: str, cross: Array) -> Array:
    """E (3, 3) of a triad's cross-axis terms."""
    e = np.zeros((3, 3))
    e[tuple(np.array(CROSS[name]).T)] = cross
    return e
