"""All triads, attitude and velocity by a receiver's velocity: Gauss–Newton with noise levels estimated beside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.by_velocity.equations import (
    PUSH,
    TURN,
    Rows,
    Setting,
    Solved,
    noise_in_readings,
    rows_of,
    solve,
)
from fieldcal.estimation.by_velocity.known import LAG_S, known_beforehand
from fieldcal.estimation.by_velocity.levels import renewed, robust_weights
from fieldcal.estimation.by_velocity.problem import (
    LARGEST_LAG_S,
    TRIADS,
    Epochs,
    Levels,
    State,
    layout_of,
    of_other_form,
    place_knots,
)
from fieldcal.estimation.by_velocity.spread import wider, with_what_belongs
from fieldcal.estimation.by_velocity.start import attitudes, velocities_at_knots
from fieldcal.estimation.by_velocity.step import moved
from fieldcal.estimation.by_velocity.strapdown import Grid, Integrated, grid_of, integrate
from fieldcal.estimation.by_velocity.walk import walk_density
from fieldcal.estimation.gyroscope.output_error import propagate_stretches
from fieldcal.estimation.joint.problem import PriorConstants, Readings
from fieldcal.estimation.statistics import huber_inflation, robust_sigma
from fieldcal.geometry.rotation import Array, conjugate, continuous, multiply, slerp
from fieldcal.reason_codes import ReasonCode

UNKNOWN_SD_MPS = 0.3  # of a velocity of which the receiver does not say
LEAST_SD_MPS = 0.02
FEWEST_EPOCHS, FEWEST_FIELDS = 50, 20  # readings of the magnetometer, with fewer it is left out
MOST_ITERATIONS = 40
ROUGH_ITERATIONS = 4  # while jumps are the start's errors, not noise
UNDAMPED_ITERATIONS, DAMPING = 8, 0.5  # of the levels, which may swing about where they belong
# Converged: no constant moves by more than this share of its sd, no level by more
# than that share, or that many of its sd where it is less well known.
CONVERGED_SD, CONVERGED_LEVEL = 0.03, 0.03
# A walk's density over that which the triad's noise makes: at the start, where attitudes are wrong by more than noise;
# it is 1 at least.
START_RATIO = 30.0
LEAST_TURN, LEAST_PUSH = 1e-10, 1e-8


@dataclass(frozen=True)
class VelocityFit:
    """Constants by a receiver's velocity.

    `layout` places the constants of `state.values` in θ; `covariance` (p, p); `information` (p, p) without what is
    known of the triads and `pull` (p,) its gradient where the fit ended. `residual` (e, 3) of the receiver, m/s, at `t`
    (e,) s, with robust `weight` (e,); `field_weight` mean of the magnetometer's; `setting` and `path`, the record as it
    was integrated last."""

    state: State
    layout: Mapping[str, slice]
    covariance: Array
    information: Array
    pull: Array
    levels: Levels
    t: Array
    residual: Array
    weight: Array
    field_weight: float
    iterations: int
    setting: Setting
    path: Integrated

    def constants(self, name: str) -> tuple[Array, Array, Array]:
        """λ (3,), b (3,) of a triad in logged units and their covariance (6, 6)."""
        value, columns = self.state.values[name], self.layout[name]
        covariance = self.covariance[columns, columns]
        if name != "magnetometer":
            return value[:3], value[3:], covariance
        other, jacobian = of_other_form(value)
        return other[:3], other[3:], jacobian @ covariance @ jacobian.T

    def attitude(self, readings: Readings) -> Array:
        """At every sample (n, 4), sensor axes, NED: the gyroscope's integral turned onto the knots."""
        values = self.state.values
        since_middle = (readings.t - 0.5 * (readings.t[0] + readings.t[-1]))[:, None]
        rate = readings.gyroscope * values["gyroscope"][:3] + values["gyroscope"][3:] + since_middle * values["drift"]
        relative = propagate_stretches(readings.t, rate, readings.segment)
        at = self.setting.knots.offset - self.state.lag_s
        own = slerp(readings.t, relative, at)
        offset = multiply(self.state.q, conjugate(own))
        out = np.empty_like(relative)
        for number in np.unique(readings.segment):
            here = readings.segment == number
            first, last = readings.t[here][[0, -1]]
            inside = (at >= first) & (at <= last)
            # A stretch without an epoch takes the offset of its neighbour: its heading is anyone's guess.
            which = np.flatnonzero(inside) if inside.any() else np.array([int(np.argmin(np.abs(at - first)))])
            times, turned = at[which], continuous(offset[which])
            carried = slerp(times, turned, readings.t[here]) if len(times) > 1 else turned
            out[here] = multiply(carried, relative[here])
        return out

    def found(self, name: str) -> tuple[Array, Array]:
        """Value and covariance of another unknown."""
        return self.state.values[name], self.covariance[self.layout[name], self.layout[name]]


def fit_by_velocity(
    readings: Readings,
    epochs: Epochs,
    start: Mapping[str, tuple[Array, Array]],
    priors: Mapping[str, PriorConstants],
    *,
    field_known: bool,
) -> VelocityFit:
    """Scale and zero of all triads, the receiver's lag and its antenna's arm.

    Between the receiver's epochs the readings are integrated (preintegration); at them the velocity of the antenna is
    compared, never differentiated. Levels of noise are estimated with the constants, outliers lose weight by Huber's
    rule, and what is correlated over seconds counts as often as its spectrum at low frequency says.

    Parameters
    ----------
    readings : Readings
        The record; it has an accelerometer.
    epochs : Epochs
        Velocities and claimed accuracies; accuracies that are not finite are taken for UNKNOWN_SD_MPS.
    start : mapping
        Triad → (scale, bias) within some tens of per cent; a magnetometer without one is left out.
    priors : mapping
        Triad → what is known beforehand; of the inertial triads both, since ordinary flight shows no accelerometer's
        level scale.
    field_known : bool
        Whether dip and declination of `readings.field_ned` are those of the place.

    Raises
    ------
    UnusableFlight
        `velocity_too_short`: fewer than FEWEST_EPOCHS epochs with readings around them.
    EstimationError
        `velocity_diverged`: no minimum was found.

    Notes
    -----
    It cannot see axes out of square, nor a receiver whose velocity is filtered over more than some tenths of a second.

    References
    ----------
    Forster et al. (2017) for preintegration; Huber (1964).
    """
    epochs = replace(epochs, sd=sd_of_claims(epochs.sd))
    knots = place_knots(readings, epochs)
    if int(np.sum(knots.epoch >= 0)) < FEWEST_EPOCHS:
        raise UnusableFlight(
            ReasonCode.VELOCITY_TOO_SHORT, "The receiver has too few velocities where the vehicle was moved."
        )
    return _Fit(readings, epochs, start, priors, field_known).run()


def sd_of_claims(claimed: Array) -> Array:
    """Sd (g,), m/s, of velocities of which a receiver claims another or none."""
    return np.maximum(np.where(np.isfinite(claimed), claimed, UNKNOWN_SD_MPS), LEAST_SD_MPS)


class _Fit:
    """The iteration: `state` and `levels` change, the rest is the record."""

    def __init__(
        self,
        readings: Readings,
        epochs: Epochs,
        start: Mapping[str, tuple[Array, Array]],
        priors: Mapping[str, PriorConstants],
        field_known: bool,
    ) -> None:
        self.readings = readings
        self.knots = place_knots(readings, epochs)
        gravity = np.array([0.0, 0.0, abs(readings.gravity_mps2)])
        values = {name: np.concatenate(start[name]) for name in TRIADS if name in start}
        with_field = "magnetometer" in start and readings_between(readings, self.knots.offset) >= FEWEST_FIELDS
        if with_field:
            values["magnetometer"], _ = of_other_form(values["magnetometer"])
            values |= {"field": np.zeros(2), "delay": np.zeros(1)}
        else:
            values.pop("magnetometer", None)
        values |= {"drift": np.zeros(3), "lag": np.array([LAG_S]), "smoothing": np.zeros(1), "arm": np.zeros(3)}
        self.middle_s = 0.5 * float(readings.t[0] + readings.t[-1])
        self.layout = layout_of(values)
        self.sign = float(np.sign(readings.gravity_mps2))
        grid = grid_of(readings, self.knots, LAG_S)
        path = self._integrated(grid, values)
        self.setting = Setting(
            self.knots, epochs, gravity, np.asarray(readings.field_ned, dtype=float), self._lit(path, values)
        )
        q = attitudes(self.setting, path, values.get("magnetometer"))
        self.state = State(q, velocities_at_knots(self.setting), values)
        self.signs: list[Array] = []
        self.known, self.expected = known_beforehand(values, self.layout, priors, field_known=field_known)
        turn = max(walk_density(readings, readings.gyroscope, start["gyroscope"][0]), LEAST_TURN)
        assert readings.accelerometer is not None
        push = max(walk_density(readings, readings.accelerometer, start["accelerometer"][0]), LEAST_PUSH)
        # Walks are no less than what the triads' noise makes, a receiver is no better than what it is rounded to.
        rounded = float((LEAST_SD_MPS / np.median(epochs.sd)) ** 2)
        self.least = np.array([turn, push, rounded, rounded, 0.0])
        # The field's is known by its first residuals.
        self.levels = Levels(START_RATIO * turn, START_RATIO * push, np.ones(2), 1.0, np.ones(3))

    def _integrated(self, grid: Grid, values: Mapping[str, Array]) -> Integrated:
        triads = values["gyroscope"], values["drift"], values["accelerometer"]
        return integrate(grid, *triads, self.sign, self.middle_s)

    def _lit(self, path: Integrated, values: Mapping[str, Array]) -> np.ndarray:
        """Intervals with readings of the magnetometer that count: another lag puts readings into other intervals."""
        lit: np.ndarray = (path.count > 0) & self.knots.joined & ("magnetometer" in values)
        return lit

    def run(self) -> VelocityFit:
        rng = np.random.default_rng(0)
        for iteration in range(1, MOST_ITERATIONS + 1):
            grid = grid_of(self.readings, self.knots, self.state.lag_s)
            path = self._integrated(grid, self.state.values)
            self.setting = replace(self.setting, lit=self._lit(path, self.state.values))
            rows = rows_of(self.setting, self.state, path, self.levels, self.layout)
            if not self.signs:
                self.signs = [rng.choice([-1.0, 1.0], size=one.residual.shape) for one in rows]
                everywhere = rng.choice([-1.0, 1.0], size=(len(self.setting.lit), 3))
                for k, one in enumerate(rows[2:], 2):
                    everywhere[one.knot] = self.signs[k]
                    self.signs[k] = everywhere  # intervals that have readings at another lag
                if len(rows) > 2 and len(rows[2].knot):
                    self.levels = replace(self.levels, field=float(robust_sigma(rows[2].residual)) ** 2)
                    continue
            signs = [*self.signs[:2], *(own[one.knot] for own, one in zip(self.signs[2:], rows[2:], strict=True))]
            weight = robust_weights(rows)
            known = self.known, self._pulled()
            score: Array = np.zeros(len(self.known))
            if iteration > ROUGH_ITERATIONS:
                shares = self.least[TURN] / self.levels.turn, self.least[PUSH] / self.levels.push
                score = noise_in_readings(rows[0], self.state, self.layout, *shares)
            try:
                solved = solve(rows, weight, len(self.knots.offset), known, score, signs)
            except np.linalg.LinAlgError as error:
                raise _diverged() from error
            sd = np.sqrt(np.diagonal(solved.covariance))
            if not np.isfinite(solved.theta).all() or not np.isfinite(solved.knots).all():
                raise _diverged()
            self.state = moved(self.state, solved, path, self.layout, self.setting.gravity)
            damping = 1.0 if iteration <= UNDAMPED_ITERATIONS else DAMPING
            self.levels, change = renewed(
                self.levels, self.least, damping, rows, weight, signs, solved, self.knots.offset
            )
            if np.max(np.abs(solved.theta) / sd) < CONVERGED_SD and change < CONVERGED_LEVEL:
                return self._result(rows, weight, solved, path, iteration)
        raise _diverged()

    def _pulled(self) -> Array:
        """What is known beforehand pulls at the constants (p,) where they are."""
        values = np.concatenate([self.state.values[name] for name in self.layout])
        return np.asarray(self.known @ (self.expected - values))

    def _result(
        self, rows: list[Rows], weight: list[Array], solved: Solved, path: Integrated, iterations: int
    ) -> VelocityFit:
        receiver = rows[1]
        known = self.known, self._pulled()
        information, pull = with_what_belongs(self.layout, (solved.information, solved.pull), known)
        by = np.sqrt(huber_inflation(weight[1][:, 0])) * wider(rows, weight, solved, self.knots.offset)
        return VelocityFit(
            self.state,
            self.layout,
            solved.covariance * np.outer(by, by),
            information * np.outer(1.0 / by, 1.0 / by),
            pull / by,
            self.levels,
            self.knots.offset[receiver.knot],
            -receiver.residual,
            weight[1][:, 0],
            float(weight[2].mean()) if len(weight) > 2 and weight[2].size else 1.0,
            iterations,
            self.setting,
            path,
        )


def readings_between(readings: Readings, at: Array) -> int:
    """How many readings of the magnetometer lie between the first knot and the last, `at` (K,) s, at any lag."""
    if readings.magnetometer is None:
        return 0
    given = np.isfinite(readings.magnetometer).all(axis=1)
    return int(np.sum(given & (readings.t > at[0]) & (readings.t < at[-1] - LARGEST_LAG_S)))


def _diverged() -> EstimationError:
    return EstimationError(
        ReasonCode.VELOCITY_DIVERGED, "The estimate by the receiver's velocity did not converge: the two contradict."
    )
