"""The joint estimation problem: readings, triads in centred units, the model of a record, and the state to estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fieldcal.estimation.gyroscope.equation_error import from_centred
from fieldcal.estimation.joint.chain_solver import Knots
from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.statistics import white_noise_sigma
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply

# Vector readings are averaged over at most this turn of the vehicle and this time.
MAX_TURN_RAD, MAX_AVERAGE_S = 0.1, 0.02
TRIADS = ("gyroscope", "accelerometer", "magnetometer")
# Off-diagonal elements of a triad's matrix that are free: body axes are the accelerometer's, whose x stays where it is.
OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
CROSS = {"gyroscope": OFF_DIAGONAL, "accelerometer": ((1, 0), (2, 0), (2, 1)), "magnetometer": OFF_DIAGONAL}
RATE_SIDE_S = 0.03  # of the running mean of rates for a delay, on either side
# Optional parameters and their sizes: cross-axis terms, the gyroscope's slope with temperature and its sensitivity to
# specific force, delays of the vector triads behind it, s (`model_selection`); then the clock and the mounting of a VPS
# (`pose_measurement`).
TERMS = {
    "gyroscope_cross": 6,
    "gyroscope_temperature": 3,
    "gyroscope_g_sensitivity": 9,
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
    units (for the lever arm); `warmth` (n,) temperature less its mean, °C, or None; `force` (n, 3) specific force
    less its mean, m/s², by an accelerometer known to some per cent, or None (for the gyroscope's sensitivity to it: its
    zero is then that at the mean force, as it is without the term)."""

    t: Array
    segment: np.ndarray
    gyroscope: Array
    accelerometer: Array | None
    magnetometer: Array | None
    gravity_mps2: float
    field_ned: Array
    turning: Array
    warmth: Array | None = None
    force: Array | None = None

    def part(self, samples: slice) -> Readings:
        """These samples alone."""

        def cut(x: Array | None) -> Array | None:
            return None if x is None else x[samples]

        return replace(
            self,
            t=self.t[samples],
            segment=self.segment[samples],
            gyroscope=self.gyroscope[samples],
            accelerometer=cut(self.accelerometer),
            magnetometer=cut(self.magnetometer),
            turning=self.turning[:, samples],
            warmth=cut(self.warmth),
            force=cut(self.force),
        )

    def gyroscope_alone(self) -> Readings:
        """Without the vector triads."""
        return replace(self, accelerometer=None, magnetometer=None)


@dataclass(frozen=True)
class PriorConstants:
    """What is known of a triad beforehand, logged units: `scale` (3,), `bias` (3,), `covariance` (6, 6) of both."""

    scale: Array
    bias: Array
    covariance: Array


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
    """A triad's readings as x = (logged − centre)/spread, so that its constants (λ', b') are of order one.

    `x` (m, 3), 0 where `valid` (m,) says that there is no reading; `centre`, `spread` (3,) logged units."""

    x: Array
    valid: np.ndarray
    centre: Array
    spread: Array

    @classmethod
    def of(cls, logged: Array) -> Centred:
        valid = np.asarray(np.isfinite(logged).all(axis=1))
        centre = logged[valid].mean(axis=0)
        spread = np.maximum(logged[valid].std(axis=0), 1e-300)
        return cls(np.where(valid[:, None], (logged - centre) / spread, 0.0), valid, centre, spread)

    def averaged(self, at: np.ndarray, side: int) -> Centred:
        """At samples `at` only, each the mean of itself and `side` neighbours on either side."""
        x = sum(self.x[at + k] for k in range(-side, side + 1)) / (2 * side + 1)
        return replace(self, x=np.asarray(x), valid=self.valid[at])

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
    """All unknowns: knot attitudes `q` (K, 4) of the sensor axes, `motion` (K, 9), and `values` by name: each triad's
    (λ', b') (6,), `dip` (1,) rad, `lever_arm` (3,) m, sensor axes, and those of `OPTIONAL` that are estimated."""

    q: Array
    motion: Array
    values: Mapping[str, Array]

    def moved(self, knots: Array, theta: Array, layout: Mapping[str, slice]) -> State:
        """The state after a step of the knots (K, s) and of the parameters θ (p,), which `layout` orders."""
        values = dict(self.values)
        for name, columns in layout.items():
            values[name] = values[name] + theta[columns]
        return State(multiply(from_rotation_vector(knots[:, :3]), self.q), self.motion + knots[:, 3:], values)


@dataclass(frozen=True)
class Model:
    """The record prepared for fitting.

    `vectors` names the vector triads present. They are compared with their prediction at the samples `at` (m,): a row
    of the measurement model is one such sample, with three residuals for each vector triad. `triads` holds the readings
    of the vector triads at the rows and of the gyroscope at every sample."""

    readings: Readings
    triads: Mapping[str, Centred]
    knots: Knots
    vectors: tuple[str, ...]
    at: np.ndarray

    @classmethod
    def of(cls, readings: Readings, knots: Knots, *, side: int = 0) -> Model:
        """`side`: vector readings are averaged over that many neighbours on either side (see `averaging_side`)."""
        given = {name: getattr(readings, name) for name in TRIADS}
        triads = {name: Centred.of(x) for name, x in given.items() if x is not None and np.isfinite(x).any()}
        vectors = tuple(name for name in TRIADS[1:] if name in triads)
        at = np.concatenate([np.arange(a + side, b - side, 2 * side + 1) for a, b in run_bounds(readings.segment)])
        triads = {name: x.averaged(at, side) if name in vectors else x for name, x in triads.items()}
        # Nothing is compared at the rows of a model without vectors: one an interval will do.
        return cls(readings, triads, knots, vectors, at if vectors else knots.index)

    @cached_property
    def gyroscope_noise(self) -> Array:
        """Sample-to-sample noise of the gyroscope, (3,), units of x."""
        return white_noise_sigma(self.triads["gyroscope"].x)

    @cached_property
    def turning_rows(self) -> Array:
        """`Readings.turning` at the rows, (2, m, 3)."""
        return np.take(self.readings.turning, self.at, axis=1)

    def valid_rows(self) -> np.ndarray:
        """Which vector triads have a reading at each row, (m, vectors) bool."""
        return np.array([self.triads[name].valid for name in self.vectors], dtype=bool).reshape(-1, len(self.at)).T

    def part(self, a: int, b: int, knots: Knots) -> Model:
        """Samples a to b alone, in the same centred units, with `knots` placed on them."""
        rows = slice(*np.searchsorted(self.at, [a, b]))
        spans = {name: slice(a, b) if name == "gyroscope" else rows for name in self.triads}
        triads = {name: replace(x, x=x.x[spans[name]], valid=x.valid[spans[name]]) for name, x in self.triads.items()}
        return Model(self.readings.part(slice(a, b)), triads, knots, self.vectors, self.at[rows] - a)

    def without(self, name: str, rows: np.ndarray) -> Model:
        """The model without the readings of a vector triad at `rows` (m,) bool."""
        triad = self.triads[name]
        remaining = replace(triad, valid=triad.valid & ~rows, x=np.where(rows[:, None], 0.0, triad.x))
        return replace(self, triads={**self.triads, name: remaining})

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


def corrected(model: Model, values: Mapping[str, Array], name: str, span: slice = slice(None)) -> Array:
    """Readings of a triad, (m, 3), with the optional terms applied to x: (I + E) x + slope × temperature + G × force;
    Λ' and b' follow."""
    x = model.triads[name].x[span]
    out = x
    cross = values.get(f"{name}_cross")
    if cross is not None:
        out = x + x @ off_diagonal(name, cross).T
    slope = values.get(f"{name}_temperature")
    if slope is not None and model.readings.warmth is not None:
        out = out + model.readings.warmth[span, None] * slope
    sensitivity = values.get(f"{name}_g_sensitivity")
    if sensitivity is not None and model.readings.force is not None:
        out = out + model.readings.force[span] @ sensitivity.reshape(3, 3).T
    return out


def off_diagonal(name: str, cross: Array) -> Array:
    """E (3, 3) of a triad's cross-axis terms."""
    e = np.zeros((3, 3))
    e[tuple(np.array(CROSS[name]).T)] = cross
    return e


@dataclass(frozen=True)
class Trajectory:
    """The record predicted from a state: attitude `q` (n, 4) of the sensor axes; `rate` (n, 3), rad/s, the calibrated
    gyroscope's; `jump` (K−1, 3) of the attitude at the end of each interval, rad, inertial axes, which q has spread
    over the interval."""

    q: Array
    rate: Array
    jump: Array


def slow_rate(model: Model, path: Trajectory, span: slice = slice(None)) -> Array:
    """Running mean of the rate over 2 RATE_SIDE_S, (m, 3): the gyroscope's noise would bias the delay."""
    at = model.at[span]
    side = max(1, round(RATE_SIDE_S / model.knots.sample_s))
    first, last = max(int(at[0]) - side, 0), int(at[-1]) + side + 1
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(path.rate[first:last], axis=0)])
    low, high = np.maximum(at - side - first, 0), np.minimum(at + side + 1 - first, len(total) - 1)
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def turning_at_rows(model: Model, state: State, span: slice = slice(None)) -> tuple[Array, Array]:
    """Low-passed rate, rad/s, and its derivative, rad/s², at the rows, sensor axes, (m, 3) each."""
    scaled, gyro = state.values["gyroscope"], model.triads["gyroscope"]
    scale = scaled[:3] / gyro.spread
    low_passed, change = model.turning_rows[:, span]
    return scale * (low_passed - gyro.centre) + scaled[3:], scale * change
