"""All triads, attitude and velocity by a receiver's velocity: Gauss–Newton with noise levels estimated beside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.by_velocity.equations import (
    FIELD,
    GROUPS,
    LEVEL,
    PUSH,
    TURN,
    VERTICAL,
    Rows,
    Setting,
    Solved,
    noise_in_readings,
    predicted,
    pulls,
    rows_of,
    solve,
)
from fieldcal.estimation.by_velocity.known import LAG_S, known_beforehand
from fieldcal.estimation.by_velocity.problem import (
    LARGEST_LAG_S,
    SMALLEST_LAG_S,
    TRIADS,
    Epochs,
    Levels,
    State,
    layout_of,
    of_other_form,
    place_knots,
)
from fieldcal.estimation.by_velocity.start import attitudes, velocities_at_knots
from fieldcal.estimation.by_velocity.strapdown import Grid, Integrated, grid_of, integrate
from fieldcal.estimation.by_velocity.walk import walk_density
from fieldcal.estimation.gyroscope.output_error import propagate_stretches
from fieldcal.estimation.joint.problem import PriorConstants, Readings
from fieldcal.estimation.joint.variance_components import COLOUR_S, LARGEST_COLOUR
from fieldcal.estimation.statistics import (
    huber_inflation,
    low_frequency_density,
    robust_sigma,
    variance_by_blocks,
)
from fieldcal.geometry.rotation import (
    Array,
    body_from_inertial,
    conjugate,
    continuous,
    from_rotation_vector,
    multiply,
    slerp,
)
from fieldcal.reason_codes import ReasonCode

UNKNOWN_SD_MPS = 0.3  # of a velocity of which the receiver does not say
LEAST_SD_MPS = 0.02
FEWEST_EPOCHS, FEWEST_FIELDS = 50, 20  # readings of the magnetometer, with fewer it is left out
# Length of a row over its sd beyond which it loses influence, as in the joint estimate; the median of χ with three.
CLIP_SD, MEDIAN_LENGTH = 4.0, 1.538
MOST_ITERATIONS = 40
ROUGH_ITERATIONS = 4  # while jumps are the start's errors, not noise
UNDAMPED_ITERATIONS, DAMPING = 8, 0.5  # of the levels, which may swing about where they belong
# Converged: no constant moves by more than this share of its sd, no level by more
# than that share, or that many of its sd where it is less well known.
CONVERGED_SD, CONVERGED_LEVEL = 0.03, 0.03
# A walk's density over that which the triad's noise makes: at the start, where attitudes are wrong by more than noise;
# it is 1 at least. Logarithm of the factor by which a level may change in an iteration.
START_RATIO, LARGEST_LOG_STEP = 30.0, 1.5
LEAST_TURN, LEAST_PUSH = 1e-10, 1e-8
LARGEST_TURN_RAD, LARGEST_LAG_STEP_S = 0.5, 0.05


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
            carried = slerp(times, turned, np.clip(readings.t[here], *times[[0, -1]])) if len(times) > 1 else turned
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
    epochs = replace(epochs, sd=np.maximum(np.where(np.isfinite(epochs.sd), epochs.sd, UNKNOWN_SD_MPS), LEAST_SD_MPS))
    knots = place_knots(readings, epochs)
    if int(np.sum(knots.epoch >= 0)) < FEWEST_EPOCHS:
        raise UnusableFlight(
            ReasonCode.VELOCITY_TOO_SHORT, "The receiver has too few velocities where the vehicle was moved."
        )
    return _Fit(readings, epochs, start, priors, field_known).run()


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
        with_field = "magnetometer" in start and _between(readings, self.knots.offset) >= FEWEST_FIELDS
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
        lit = (path.count > 0) & self.knots.joined & with_field
        self.setting = Setting(self.knots, epochs, gravity, np.asarray(readings.field_ned, dtype=float), lit)
        q = attitudes(self.setting, path, values.get("magnetometer"))
        self.state = State(q, velocities_at_knots(self.setting), values)
        self.signs: list[Array] = []
        self.damping, self.change = 1.0, np.inf
        self.known, self.expected = known_beforehand(values, self.layout, priors, field_known=field_known)
        self.noise_turn = max(walk_density(readings, readings.gyroscope, start["gyroscope"][0]), LEAST_TURN)
        assert readings.accelerometer is not None
        self.noise_push = max(walk_density(readings, readings.accelerometer, start["accelerometer"][0]), LEAST_PUSH)
        field_variance = float(np.sum(self.setting.field**2)) * 0.05**2
        if with_field:
            field_variance *= float(np.mean(values["magnetometer"][:3] ** 2))
        self.least_receiver = float((LEAST_SD_MPS / np.median(epochs.sd)) ** 2)
        self.levels = Levels(
            START_RATIO * self.noise_turn, START_RATIO * self.noise_push, np.ones(2), field_variance, np.ones(3)
        )

    def _integrated(self, grid: Grid, values: Mapping[str, Array]) -> Integrated:
        triads = values["gyroscope"], values["drift"], values["accelerometer"]
        return integrate(grid, *triads, self.sign, self.middle_s)

    def run(self) -> VelocityFit:
        rng = np.random.default_rng(0)
        for iteration in range(1, MOST_ITERATIONS + 1):
            grid = grid_of(self.readings, self.knots, self.state.lag_s)
            path = self._integrated(grid, self.state.values)
            rows = rows_of(self.setting, self.state, path, self.levels, self.layout)
            if not self.signs:
                self.signs = [rng.choice([-1.0, 1.0], size=one.residual.shape) for one in rows]
                if len(rows) > 2 and len(rows[2].knot):
                    self.levels = replace(self.levels, field=float(robust_sigma(rows[2].residual)) ** 2)
                    continue
            weight = self._weights(rows)
            theta = np.concatenate([self.state.values[name] for name in self.layout])
            score: Array
            pulled, score = self.known @ (self.expected - theta), np.zeros(len(theta))
            if iteration > ROUGH_ITERATIONS:
                shares = self.noise_turn / self.levels.turn, self.noise_push / self.levels.push
                score = noise_in_readings(rows[0], self.state, self.layout, *shares)
            try:
                solved = solve(rows, weight, len(self.knots.offset), (self.known, pulled), score, self.signs)
            except np.linalg.LinAlgError as error:
                raise _diverged() from error
            sd = np.sqrt(np.diagonal(solved.covariance))
            if not np.isfinite(solved.theta).all() or not np.isfinite(solved.knots).all():
                raise _diverged()
            self._move(solved, path)
            self.damping = 1.0 if iteration <= UNDAMPED_ITERATIONS else DAMPING
            self.levels = self._renewed(rows, weight, solved)
            if np.max(np.abs(solved.theta) / sd) < CONVERGED_SD and self.change < CONVERGED_LEVEL:
                return self._result(rows, weight, solved, path, iteration)
        raise _diverged()

    def _weights(self, rows: list[Rows]) -> list[Array]:
        """Redescending weights of the receiver's epochs and the magnetometer's means, by a row's length over the median
        one: 1 up to CLIP_SD, (CLIP_SD/d)⁴ beyond. Links are the model's own."""
        out = [np.ones_like(rows[0].residual)]
        for one in rows[1:]:
            distance = np.linalg.norm(one.residual / np.sqrt(one.variance), axis=1)
            distance /= max(float(np.median(distance)), 1e-12) / MEDIAN_LENGTH
            own = np.minimum(1.0, CLIP_SD / np.maximum(distance, 1e-12)) ** 4
            out.append(np.repeat(own[:, None], one.residual.shape[1], axis=1))
        return out

    def _move(self, solved: Solved, path: Integrated) -> None:
        """A step; a turn or lag too far for the linearisation is shortened, and with the lag the knots move."""
        step = min(1.0, LARGEST_TURN_RAD / max(float(np.max(np.linalg.norm(solved.knots[:, :3], axis=1))), 1e-12))
        theta = step * solved.theta
        values = {name: self.state.values[name] + theta[columns] for name, columns in self.layout.items()}
        late = float(np.clip(theta[self.layout["lag"]][0], -LARGEST_LAG_STEP_S, LARGEST_LAG_STEP_S))
        lag = float(np.clip(self.state.lag_s + late, SMALLEST_LAG_S, LARGEST_LAG_S))
        late = lag - self.state.lag_s
        values["lag"] = np.array([lag])
        q = multiply(from_rotation_vector(step * solved.knots[:, :3]), self.state.q)
        frame_force = np.einsum("nij,nj->ni", path.turned.transpose(0, 2, 1), path.force)
        acceleration = np.einsum("nji,nj->ni", body_from_inertial(q), frame_force) + self.setting.gravity
        velocity = self.state.velocity + step * solved.knots[:, 3:] - acceleration * late
        q = multiply(q, from_rotation_vector(-path.rate * late))
        self.state = State(q, velocity, values)

    def _renewed(self, rows: list[Rows], weight: list[Array], solved: Solved) -> Levels:
        """Variance components (REML) by the residuals after the step, to first order: their sums of squares against
        the degrees of freedom left, by Newton's method in the logarithm."""
        square, free, information = np.zeros((3, len(GROUPS)))
        after: list[Array] = []
        step = np.column_stack([solved.theta, solved.probes[0]])
        knots = np.concatenate([solved.knots[..., None], solved.probes[1]], axis=2)
        for one, robust, sign in zip(rows, weight, self.signs, strict=True):
            root = np.sqrt(robust / one.variance)
            changed = predicted(one, step, knots) * root[..., None]
            whitened = one.residual * root + changed[..., 0]
            after.append(whitened)
            for column, group in enumerate(one.group):
                kept = sign[:, column] - changed[:, column, 1 + group]
                counted = robust[:, column]
                square[group] += np.sum(whitened[:, column] ** 2)
                free[group] += np.sum(sign[:, column] * kept) - np.sum(1.0 - counted)
                information[group] += np.sum(kept**2)
        old = self.levels
        # Rows were weighted by coloured variances: white ones would be so many times as heavy.
        of_group = np.ones(len(GROUPS))
        of_group[[LEVEL, VERTICAL, FIELD]] = old.colour
        ratio = np.ones(len(GROUPS))
        given = information > 0.0
        seen, free, information = (square * of_group)[given], np.maximum(free[given], 1e-6), information[given]
        # Downwards the fixed point is the faster where Newton's step would be.
        logarithm = np.minimum((seen - free) / information, np.where(seen < free, np.log(seen / free), np.inf))
        ratio[given] = np.exp(self.damping * np.clip(logarithm, -LARGEST_LOG_STEP, LARGEST_LOG_STEP))
        # Walks are no less than what the triads' noise makes.
        ratio[TURN] = max(ratio[TURN], self.noise_turn / old.turn)
        ratio[PUSH] = max(ratio[PUSH], self.noise_push / old.push)
        # A receiver is no better than what it is rounded to.
        ratio[[LEVEL, VERTICAL]] = np.maximum(ratio[[LEVEL, VERTICAL]], self.least_receiver / old.receiver)
        self.change = float(np.max(np.abs(ratio[given] - 1.0) * np.minimum(1.0, np.sqrt(0.5 * information))))
        return Levels(
            old.turn * ratio[TURN],
            old.push * ratio[PUSH],
            old.receiver * ratio[[LEVEL, VERTICAL]],
            old.field * ratio[FIELD],
            self._colour(rows, after),
        )

    def _colour(self, rows: list[Rows], after: list[Array]) -> Array:
        out = np.ones(3)
        for place, (which, columns) in enumerate(((1, [0, 1]), (1, [2]), (2, [0, 1, 2]))):
            if which >= len(rows) or len(after[which]) < 10:
                continue
            x = after[which][:, columns]
            interval_s = float(np.median(np.diff(self.knots.offset[rows[which].knot])))
            lags = int(np.clip(COLOUR_S / interval_s, 1, len(x) // 4))
            out[place] = low_frequency_density(x, lags, together=x.shape[1], largest=LARGEST_COLOUR)[0]
        return out

    def _result(
        self, rows: list[Rows], weight: list[Array], solved: Solved, path: Integrated, iterations: int
    ) -> VelocityFit:
        receiver = rows[1]
        # What is known of lag, arm, drift, … belongs to the record, what is known of the constants does not.
        beside = np.ones(len(self.known), dtype=bool)
        for name in TRIADS:
            beside[self.layout.get(name, slice(0))] = False
        theta = np.concatenate([self.state.values[name] for name in self.layout])
        wider = np.sqrt(huber_inflation(weight[1][:, 0])) * self._wider(rows, weight, solved)
        narrower = np.outer(1.0 / wider, 1.0 / wider)
        information = solved.information + np.where(np.outer(beside, beside), self.known, 0.0)
        return VelocityFit(
            self.state,
            self.layout,
            solved.covariance * np.outer(wider, wider),
            information * narrower,
            (solved.pull + np.where(beside, self.known @ (self.expected - theta), 0.0)) / wider,
            self.levels,
            self.knots.offset[receiver.knot],
            -receiver.residual,
            weight[1][:, 0],
            float(weight[2].mean()) if len(weight) > 2 and weight[2].size else 1.0,
            iterations,
            self.setting,
            path,
        )

    def _wider(self, rows: list[Rows], weight: list[Array], solved: Solved) -> Array:
        """Factors (p,) on the sd, 1 at least: what blocks of time do to each constant may vary by more than noise of
        the fitted levels would have it."""
        moved, t = [], []
        for one, robust in zip(rows, weight, strict=True):
            residual = one.residual * np.sqrt(robust / one.variance)
            moved.append(pulls(one, robust, residual, solved.followed) @ solved.covariance)
            t.append(self.knots.offset[one.knot])
        times = np.concatenate(t)
        order = np.argsort(times, kind="stable")
        variance = variance_by_blocks(np.concatenate(moved)[order], times[order])
        return np.asarray(np.sqrt(np.maximum(1.0, variance / np.diagonal(solved.covariance))))


def _between(readings: Readings, at: Array) -> int:
    """How many readings of the magnetometer lie between the first knot and the last."""
    if readings.magnetometer is None:
        return 0
    given = np.isfinite(readings.magnetometer).all(axis=1)
    return int(np.sum(given & (readings.t > at[0]) & (readings.t < at[-1] - LARGEST_LAG_S)))


def _diverged() -> EstimationError:
    return EstimationError(
        ReasonCode.VELOCITY_DIVERGED, "The estimate by the receiver's velocity did not converge: the two contradict."
    )
