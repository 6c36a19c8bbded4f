"""All three triads, attitude, dip and lever arm at once: the joint maximum-likelihood estimator (method `joint`).

"The method is serial in nature, so good estimates must be determined at each step or the error will compound." Here
no estimate is passed on: the gyroscope is integrated between knots (`chain_solver`), every magnetometer and
accelerometer reading is predicted in its sensor's logged units (`measurement_model`), and Gauss–Newton estimates all
unknowns together. Noise levels (each sensor axis, the attitude's random walk by gyroscope noise, strength of the
translation) are estimated at the same time as variance components, so nothing has to be tuned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fieldcal import compiled
from fieldcal.errors import EstimationError
from fieldcal.estimation.joint import initialise, kernel
from fieldcal.estimation.joint.bias_walk import bias_walk
from fieldcal.estimation.joint.chain_solver import (
    BRIDGE,
    GRADIENT,
    RIGHTS,
    SENSORS,
    Joints,
    Normal,
    Probe,
    add_joints,
    joint_squares,
    solve_scaled,
    whitened_motion,
)
from fieldcal.estimation.joint.covariance import Noise, RowSums, inverse_information, noise_of, sums_of_rows
from fieldcal.estimation.joint.measurement_model import (
    SENSED,
    Rows,
    accumulate,
    body_jumps,
    layout_of,
    residuals,
    sensitivities,
    trajectory,
)
from fieldcal.estimation.joint.pose_measurement import VpsRecord
from fieldcal.estimation.joint.problem import (
    CROSS,
    TRIADS,
    Model,
    PriorConstants,
    State,
    Trajectory,
    off_diagonal,
)
from fieldcal.estimation.joint.score_corrections import logged_units, within_intervals
from fieldcal.estimation.joint.variance_components import (
    CHANCE_COLOUR_RATIO,
    LARGEST_WALK_RATIO,
    Levels,
    first_levels,
    gyro_walk,
    largest_level_change,
    passing_fields,
    renewed_levels,
    robust_weight,
    slow_colour,
)
from fieldcal.estimation.statistics import white_noise_sigma
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

# Largest step of an attitude and of a scale: a longer one is shortened as a whole.
LARGEST_STEP_RAD, LARGEST_STEP_RELATIVE = 0.5, 0.3
BURST_ROUNDS = 3  # of searching the magnetometer's residuals for passing fields and fitting again without them
MAX_ITERATIONS = 50
# A step that reverses more than this share of the one before is shortened to this share: the normal equations lack the
# derivative of the gradient's corrections, so that steps may be too long.
LARGEST_REVERSED_STEP_SHARE = 0.5
RESTART_AFTER_ITERATIONS = 20  # a fit that has not converged by then starts anew from the constants it has reached
# Converged: every step below this share of the parameter's sd (inverse information), every relative change of a noise
# level below it too.
CONVERGED_STEP_SD = 0.1
SMALLEST_STEP = 1e-8  # of centred parameters, which are of order one: rounding; also converged
LARGEST_NOISE_SHARE = 0.4  # of an axis' readings, rms: with more sample-to-sample noise its scale cannot be estimated
# Wald test of the lever arm, χ²₃: exceeded by chance once in a thousand.
LEVER_ARM_CHI2 = 16.3
# Weak prior: relative sd of scales, and sd of biases in units of the sensed range.
PRIOR_RELATIVE_SD = 0.5
OTHER_PRIOR_SD = 1.0  # of all other parameters, each in its unit: rad of dip, m of lever arm, s of delay …


@dataclass(frozen=True)
class Options:
    """What a fit is made with: a free `dip`, a free `lever_arm`, a VPS, a bound of the walk, `priors` by sensor,
    colour of the rows over seconds (`slow`), and whether a lever arm that is found is doubted."""

    dip: bool = True
    lever_arm: bool = True
    vps: VpsRecord | None = None
    walk_ratio: float = LARGEST_WALK_RATIO
    priors: Mapping[str, PriorConstants] = field(default_factory=dict)
    slow: bool = False
    doubt_lever_arm: bool = True


@dataclass(frozen=True)
class JointFit:
    """The solution in centred coordinates; θ is ordered by `layout`.

    `covariance` (p, p) of θ, coloured-residual form; `information` (p, p) with the knots eliminated, of which `known`
    (p, p) is what was known beforehand, whose part of the gradient is `pull` (p,); `noise` as the residuals show it
    and `doubt` (p, p) beside noise, both in the covariance already; `weight` (m, r) robust weights; `iterations` of all
    rounds; `bias_walk` of the gyroscope's bias, rad/s/√s, whose spread over the record is part of its covariance;
    `lever_arm_test` the Wald statistic (χ²₃) of a free lever arm, None where it was not estimated."""

    model: Model
    state: State
    path: Trajectory
    levels: Levels
    weight: Array
    layout: Mapping[str, slice]
    covariance: Array
    information: Array
    iterations: int
    known: Array
    pull: Array
    noise: Noise | None
    doubt: Array
    bias_walk: float = 0.0
    lever_arm_test: float | None = None
    vps: VpsRecord | None = None
    options: Options = Options()

    @property
    def priors(self) -> Mapping[str, PriorConstants]:
        """What was known beforehand, by sensor."""
        return self.options.priors

    def doubted(self, change: Array) -> JointFit:
        """The same, θ doubted by a change (p,) of it."""
        by = np.outer(change, change)
        return replace(self, covariance=self.covariance + by, doubt=self.doubt + by)

    def constants(self, name: str) -> tuple[Array, Array, Array]:
        """(λ (3,), b (3,), covariance (6, 6)) of a triad without cross-axis terms, logged units."""
        triad, columns = self.model.triads[name], self.layout[name]
        transform = triad.to_logged()
        return *triad.logged(self.state.values[name]), transform @ self.covariance[columns, columns] @ transform.T

    def full_constants(self, name: str) -> tuple[Array, Array, Array]:
        """(Λ (3, 3), b (3,), covariance (12, 12) of Λ by rows and b) of a triad with cross-axis terms, logged units."""
        triad, columns, scaled = self.model.triads[name], self.layout[name], self.state.values[name]
        cross = f"{name}_cross"
        e = off_diagonal(name, self.state.values[cross]) if cross in self.layout else np.zeros((3, 3))
        matrix = scaled[:3, None] * (np.eye(3) + e) / triad.spread
        jacobian = np.zeros((12, len(self.covariance)))
        for i in range(3):
            jacobian[3 * i : 3 * i + 3, columns.start + i] = matrix[i] / scaled[i]
            jacobian[9 + i, columns.start + 3 + i] = 1.0
        if cross in self.layout:
            for k, (i, j) in enumerate(CROSS[name]):
                jacobian[3 * i + j, self.layout[cross].start + k] = scaled[i] / triad.spread[j]
        jacobian[9:] -= np.einsum("ijp,j->ip", jacobian[:9].reshape(3, 3, -1), triad.centre)
        return matrix, scaled[3:] - matrix @ triad.centre, jacobian @ self.covariance @ jacobian.T


def fit_joint(
    model: Model,
    start: State,
    *,
    free_dip: bool = True,
    try_lever_arm: bool = True,
    vps: VpsRecord | None = None,
    levels: Levels | None = None,
    largest_walk_ratio: float = LARGEST_WALK_RATIO,
    priors: Mapping[str, PriorConstants] | None = None,
    doubt_lever_arm: bool = True,
) -> JointFit:
    """Estimate all constants, attitudes and noise levels from a start within some tens of per cent.

    Parameters
    ----------
    model : Model
        The record, knots placed.
    start : State
        Attitudes of the knots within about 30°, constants with the right polarity. Its lever arm is kept unless
        `try_lever_arm`. Optional terms (`joint.problem.OPTIONAL`) that it has a value for are estimated too.
    free_dip : bool
        Estimate the dip angle; otherwise that of the configured field holds.
    try_lever_arm : bool
        Estimate the lever arm, and keep it only where it differs from zero (Wald test): estimating it on data that do
        not determine it costs accuracy.
    vps : VpsRecord, optional
        Reference attitudes; `start` then holds `VpsRecord.start()` too.
    levels : Levels, optional
        Noise to start from, that of a similar fit.
    largest_walk_ratio : float
        Most that the attitude's walk may be over that by the gyroscope's sample-to-sample noise.
    priors : mapping, optional
        Sensor → what is known of its constants before the first sample; of the others nearly nothing is.
    doubt_lever_arm : bool
        Put half of what a lever arm changes of the accelerometer's constants into their sd, which takes a second fit;
        nothing else depends on it.

    Raises
    ------
    EstimationError
        `joint_singular`, `joint_diverged`, `axis_not_turned`.

    Notes
    -----
    The likelihood is maximised over the attitudes, with every residual in logged units: that is consistent (a rate or
    a length in SI units would shrink with its scale). Translation is noise to the accelerometer's scale, which is
    estimated from gravity and lever arm alone: then no spectrum or direction of translation biases it, whatever its
    prior.

    It cannot see what turns with the body and all triads: a common rotation of the axes, or a field that turns with the
    vehicle other than hard iron.
    """
    free = try_lever_arm and "accelerometer" in model.vectors
    how = Options(free_dip, free, vps, largest_walk_ratio, priors or {}, doubt_lever_arm=doubt_lever_arm)
    try:
        fit, response = _iterate(model, start, levels, 0, how)
    except EstimationError:
        # Rows that are correlated over seconds may have counted for too much.
        if not model.vectors:
            raise
        how = replace(how, slow=True)
        fit, response = _iterate(model, start, levels, 0, how)
    for _ in range(BURST_ROUNDS):
        passing = passing_fields(fit.model, fit.weight)
        if not passing.any():
            break
        model = fit.model.without("magnetometer", passing)
        fit, response = _iterate(model, fit.state, fit.levels, fit.iterations, how)
    if model.vectors and not how.slow and _is_slow(fit):
        how = replace(how, slow=True)
        fit, response = _iterate(fit.model, fit.state, fit.levels, fit.iterations, how)
    if not free:
        return _enlarged(fit, response)
    test = _lever_arm_test(fit)
    if test >= LEVER_ARM_CHI2:  # the coloured covariance can only make it smaller
        fit = _enlarged(fit, response)
        test = _lever_arm_test(fit)
    if test < LEVER_ARM_CHI2:
        return replace(_enlarged(*_without_lever_arm(fit, response, how)), lever_arm_test=test)
    if doubt_lever_arm:
        fit = _or_without_arm(fit, _without_lever_arm(fit, response, how)[0])
    return replace(fit, lever_arm_test=test)


def _is_slow(fit: JointFit) -> bool:
    """Whether the rows are correlated over seconds."""
    residual = residuals(fit.model, fit.state, fit.path)
    slow = slow_colour(fit.model, residual, fit.weight)
    return bool(np.any(slow > CHANCE_COLOUR_RATIO * fit.levels.colour))


def _without_lever_arm(fit: JointFit, response: Array, how: Options) -> tuple[JointFit, Array]:
    """The fit with a lever arm of zero: every other parameter starts where its covariance with the lever arm says."""
    columns = fit.layout["lever_arm"]
    to_zero = np.linalg.solve(fit.covariance[columns, columns], fit.state.values["lever_arm"])
    change = fit.covariance[:, columns] @ to_zero
    without = fit.state.moved(response @ change, -change, fit.layout)
    without = replace(without, values={**without.values, "lever_arm": np.zeros(3)})
    return _iterate(fit.model, without, fit.levels, fit.iterations, replace(how, lever_arm=False))


def _or_without_arm(fit: JointFit, without: JointFit) -> JointFit:
    """The fit, half of what a lever arm changes of the accelerometer's constants in their sd: a hand that turns an IMU
    has a pivot, which passes every test that an arm of the sensor passes (it explains a third of the acceleration, as
    an arm on a vehicle does) but is not as constant."""
    change = np.zeros(len(fit.covariance))
    moved = fit.state.values["accelerometer"] - without.state.values["accelerometer"]
    change[fit.layout["accelerometer"]] = 0.5 * moved
    return fit.doubted(change)


def _lever_arm_test(fit: JointFit) -> float:
    columns, arm = fit.layout["lever_arm"], fit.state.values["lever_arm"]
    return float(arm @ np.linalg.solve(fit.covariance[columns, columns], arm))


def _enlarged(fit: JointFit, response: Array) -> JointFit:
    """The fit with its covariance from coloured residuals; `response` (K, s, p) of the knots to the parameters."""
    given = fit.model, fit.state, fit.path, fit.layout
    whitening = _whitening(fit.weight, fit.levels)
    if (library := compiled.LIBRARY) is not None:
        rows = RowSums(*kernel.covariance_rows(library, *given, whitening, response))
    else:
        rows = sums_of_rows(fit.model, sensitivities(*given, len(fit.information)), response, whitening)
    poses = None if fit.vps is None else fit.vps.whitened(fit.model, fit.state, fit.path, fit.layout, response)
    knots = fit.model.knots
    jumps = fit.path.jump, np.sqrt(knots.joined / (fit.levels.walk * knots.interval_s))
    strength = fit.levels.strength
    process = whitened_motion(knots, strength, response[:, 3:]), whitened_motion(knots, strength, fit.state.motion)
    noise = noise_of(fit.model, rows, response, jumps, process, poses)
    inverse = inverse_information(fit.information)
    factors = noise.enlargement(inverse, np.diagonal(inverse))
    doubt: Array = np.zeros_like(fit.information)
    # The bias is the mean over the record, from which its random walk takes it away towards either end.
    rate = body_jumps(fit.state, fit.path) / knots.interval_s[:, None]
    walk = bias_walk(rate, knots.interval_s, knots.joined)
    bias = np.arange(3, 6) + fit.layout["gyroscope"].start
    doubt[bias, bias] = walk**2 * (fit.model.readings.t[-1] - fit.model.readings.t[0]) / 3.0
    enlarged = inverse * np.outer(factors, factors) + doubt
    return replace(fit, covariance=enlarged, noise=noise, doubt=doubt, bias_walk=walk)


def _iterate(model: Model, state: State, levels: Levels | None, spent: int, how: Options) -> tuple[JointFit, Array]:
    """Gauss–Newton with noise levels estimated anew at every step: the fit with the inverse information as covariance,
    and the knots' response N_xx⁻¹N_xθ. `spent` iterations are counted on top."""
    layout, p = layout_of(model, state.values, dip=how.dip, lever_arm=how.lever_arm)
    knots, prior, vps = model.knots, _Prior.at(model, state, layout, p, how.priors), how.vps
    probe = Probe.draw(knots, model.readings.t, model.at, 3 * len(model.vectors))
    path = trajectory(model, state)
    residual = residuals(model, state, path)
    levels = levels or first_levels(model, state, path, residual)
    previous: Array = np.zeros(p)
    for iteration in range(1, MAX_ITERATIONS + 1):
        if iteration == RESTART_AFTER_ITERATIONS and model.vectors:
            state = initialise.anew(model, state)
            path = trajectory(model, state)
            residual = residuals(model, state, path)
            levels, previous = first_levels(model, state, path, residual), np.zeros(p)
        weight = robust_weight(model, residual, levels)
        normal, joints, reaction = linearised(model, state, path, layout, p, weight, levels, probe, vps)
        prior.add(normal, state, layout)
        eliminated = normal.eliminate()
        information, gradient = eliminated.information, eliminated.gradient
        scales = layout["gyroscope"].start + np.arange(3)
        gradient[scales, GRADIENT] += logged_units(model, state, path, levels.walk)
        bridge = eliminated.solved(slice(p + BRIDGE, p + BRIDGE + 1))[:, :, 0]
        within = levels.walk * within_intervals(model, state, layout, reaction, bridge)
        gradient[:, GRADIENT] += within
        # The step (column GRADIENT), and the responses of all unknowns to the probes.
        theta = solve_scaled(information, gradient)
        response = eliminated.response(theta)
        step, change = response[:, :, GRADIENT], theta[:, GRADIENT]
        share = _step_share(state, step, change, layout)
        if change @ information @ previous < -LARGEST_REVERSED_STEP_SHARE * (previous @ information @ previous):
            share *= LARGEST_REVERSED_STEP_SHARE
        previous = share * change
        state = state.moved(share * step, share * change, layout)
        path = trajectory(model, state)
        residual = residuals(model, state, path)
        if not np.isfinite(residual).all():
            break
        # Noise levels, by how many degrees of freedom the unknowns absorb of each group of residuals.
        at_knots, at_parameters = (x[..., : residual.shape[1]] for x in (reaction[0], reaction[1][:p]))
        absorbed = np.einsum("kcr,kc->r", at_knots, response[:, SENSED, SENSORS]) + at_parameters.T @ theta[:, SENSORS]
        joints = replace(joints, jump=path.jump, motion=state.motion)
        squares = joint_squares(knots, joints, response, theta, probe)
        renewed = renewed_levels(
            model, residual, levels, absorbed, squares, how.walk_ratio * gyro_walk(model, state), slow=how.slow
        )
        level_change, levels = largest_level_change(levels, renewed, squares), renewed
        sd = 1.0 / np.sqrt(np.diagonal(information))
        converged = max(level_change, float(np.max(np.abs(change) / sd))) < CONVERGED_STEP_SD
        if converged or float(np.max(np.abs(change))) < SMALLEST_STEP:
            plain = inverse_information(information)
            solution = model, state, path, levels, weight, layout, plain, information, spent + iteration
            known = prior.information, prior.pull(state, layout), None, np.zeros((p, p))
            fit = JointFit(*solution, *known, vps=vps, options=how)
            return fit, eliminated.solved(slice(p))
    raise _no_minimum(model, iteration)


def _no_minimum(model: Model, iterations: int) -> EstimationError:
    """Why no minimum was found: axes that read little but noise, if there are any, or else contradictory readings."""
    still = [
        f"{name} {'xyz'[axis]}"
        for name, triad in model.triads.items()
        for axis in np.flatnonzero(white_noise_sigma(triad.x[triad.valid]) > LARGEST_NOISE_SHARE)
    ]
    if still:
        return EstimationError(
            ReasonCode.AXIS_NOT_TURNED,
            f"The joint estimate found no minimum: {', '.join(still)} read hardly more than noise. Add 60° either way"
            " about every axis.",
            {"iterations": iterations, "still": still},
        )
    return EstimationError(
        ReasonCode.JOINT_DIVERGED,
        "The joint estimate found no minimum: the readings contradict each other or the start is too far off.",
        {"iterations": iterations},
    )


def linearised(
    model: Model,
    state: State,
    path: Trajectory,
    layout: Mapping[str, slice],
    p: int,
    weight: Array,
    levels: Levels,
    probe: Probe,
    vps: VpsRecord | None,
) -> tuple[Normal, Joints, tuple[Array, Array]]:
    """Normal equations without the prior, the joints that they contain, and what reacts to each row's probe
    (`accumulate`)."""
    knots, rows = len(model.knots.index), 3 * len(model.vectors)
    normal = Normal.empty(knots, p, len(RIGHTS))
    reaction = np.zeros((knots, len(SENSED), 2 * rows + 3)), np.zeros((p + 1, 2 * rows + 3))
    moved = np.zeros((knots, 3, p))  # ∂(integrated attitude)/∂θ
    whitening = _whitening(weight, levels)
    if (library := compiled.LIBRARY) is not None:
        kernel.normal_rows(library, normal, model, state, path, layout, whitening, probe, reaction, moved)
    else:
        chunk: Rows
        for knot_span, chunk, ends in sensitivities(model, state, path, layout, p):
            accumulate(normal, model, chunk, knot_span, whitening[chunk.span], probe, reaction)
            moved[knot_span] = ends
    joints = Joints(path.jump, moved[:-1], levels.walk, state.motion, levels.strength)
    add_joints(normal, model.knots, joints, probe)
    if vps is not None:
        vps.add(normal, model, state, path, layout)
    return normal, joints, reaction


def _whitening(weight: Array, levels: Levels) -> Array:
    """Robust weights over the density of the rows' noise at low frequency, (m, r), 1/x²."""
    return np.asarray(weight / (levels.variance * levels.colour))


@dataclass(frozen=True)
class _Prior:
    """What is known beforehand, which keeps directions that the record does not determine: `mean` (p,), `information`
    (p, p)."""

    mean: Array
    information: Array

    @classmethod
    def at(
        cls, model: Model, state: State, layout: Mapping[str, slice], p: int, priors: Mapping[str, PriorConstants]
    ) -> _Prior:
        mean, sd = np.zeros(p), np.full(p, OTHER_PRIOR_SD)
        for name, columns in layout.items():
            mean[columns] = state.values[name]
            if name in model.triads:
                sd[columns] = PRIOR_RELATIVE_SD * np.tile(np.abs(state.values[name][:3]), 2)
        if "lever_arm" in layout:
            mean[layout["lever_arm"]] = 0.0
        information = np.diag(1.0 / sd**2)
        for name, known in priors.items():
            if name in layout:
                columns, transform = layout[name], model.triads[name].to_logged()
                mean[columns] = model.triads[name].scaled(known.scale, known.bias)
                information[columns, columns] = transform.T @ np.linalg.inv(known.covariance) @ transform
        return cls(mean, information)

    def pull(self, state: State, layout: Mapping[str, slice]) -> Array:
        """Its part (p,) of the gradient."""
        now = np.concatenate([state.values[name] for name in layout])
        return np.asarray(self.information @ (self.mean - now))

    def add(self, normal: Normal, state: State, layout: Mapping[str, slice]) -> None:
        normal.parameters += self.information
        normal.parameters_right[:, GRADIENT] += self.pull(state, layout)


def _step_share(state: State, step: Array, theta: Array, layout: Mapping[str, slice]) -> float:
    """Share of a step to take: no attitude by more than LARGEST_STEP_RAD, no scale by LARGEST_STEP_RELATIVE."""
    longest = [float(np.max(np.abs(step[:, :3]))) / LARGEST_STEP_RAD]
    for name, columns in layout.items():
        if name in TRIADS:
            scale = np.abs(state.values[name][:3])
            longest.append(float(np.max(np.abs(theta[columns][:3]) / scale)) / LARGEST_STEP_RELATIVE)
    return 1.0 / max(1.0, *longest)
