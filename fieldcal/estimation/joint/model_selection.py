"""Optional terms of the joint estimate, each included only where it predicts held-out data better.

A term that the score shows and the prediction does not is left out, and what it would move the constants by is in their
covariance: one of the two is wrong about it.

Cross-axis terms (a triad whose axes are not quite orthogonal or not quite the accelerometer's; soft iron), a delay of a
vector triad behind the gyroscope, the gyroscope's slope with temperature, and, where a VPS tells the attitude, its
sensitivity to specific force. On data without the effect each costs
accuracy, so a term must pass two tests: a score test on the whole record (cheap, no fit); then constants fitted on the
first part of the record with and without the term predict the readings of the rest, where only attitude and translation
are free.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from fieldcal.errors import EstimationError
from fieldcal.estimation.joint.chain_solver import GRADIENT, Probe, place_knots, whitened_joints
from fieldcal.estimation.joint.fit import JointFit, fit_joint, linearised
from fieldcal.estimation.joint.measurement_model import layout_of, residuals, trajectory
from fieldcal.estimation.joint.pose_measurement import PARAMETERS, VpsRecord
from fieldcal.estimation.joint.problem import TERMS, Model, State
from fieldcal.estimation.joint.variance_components import Levels, robust_weight
from fieldcal.geometry.rotation import Array
from fieldcal.names import Json

# Score test: χ² exceeded by chance once in a thousand, by degrees of freedom.
SCORE_CHI2 = {size: round(float(chdtri(size, 1e-3)), 1) for size in set(TERMS.values())}
# Least gain of the held-out likelihood over its sd, which comes from at least so many blocks of this length.
LEAST_GAIN_SD, BLOCK_S, FEWEST_BLOCKS = 3.0, 2.0, 6
# A gain by one Gauss–Newton step decides outside these; between them the term is fitted.
REFUSED_BY_A_STEP, KEPT_BY_A_STEP = 1.5, 5.0
FIT_SHARE = 0.6  # of the record; the rest is held out
PREDICT_ITERATIONS, PREDICT_STEP_RAD = 10, 1e-6  # most iterations, and the step at which they end
STEP_ITERATIONS = 2  # for constants one step away from those whose attitudes are known
LEAST_TEMPERATURE_RANGE_DEGC = 1.0
LEAST_FORCE_MPS2 = 2.0  # rms about the mean; below it gravity hardly turned in the sensor's axes
LEAST_RATE_RADPS = 0.2  # rms: below it a delay does nothing


@dataclass(frozen=True)
class TermTest:
    """`score` χ² of the whole record; `gain` of the held-out likelihood over its sd (by one Gauss–Newton step, unless
    that lay near the limit), None where the score refused."""

    name: str
    score: float
    gain: float | None
    kept: bool


def add_terms(fit: JointFit) -> tuple[JointFit, list[TermTest]]:
    """The fit with the optional terms that pass both tests, and the result of the tests."""
    names = candidates(fit)
    scores, moved = _scores(fit, names) if names else ({}, {})
    over = {name: score / SCORE_CHI2[TERMS[name]] for name, score in scores.items()}
    tried = sorted((name for name in over if over[name] > 1.0), key=lambda name: -over[name])
    gains = _gains(fit, tried) if tried else {}
    kept = [name for name in tried if gains.get(name, -np.inf) > LEAST_GAIN_SD]
    if kept:
        try:
            fit = with_terms(fit, kept)
        except EstimationError:
            kept = []
    fit = _doubted(fit, [moved[name] for name in tried if name not in kept])
    return fit, [TermTest(name, score, gains.get(name), name in kept) for name, score in scores.items()]


def _doubted(fit: JointFit, moved: list[dict[str, Array]]) -> JointFit:
    """The fit with these changes of its parameters, by name, in the covariance."""
    for change in moved:
        by = np.zeros(len(fit.covariance))
        for name, values in change.items():
            if name in fit.layout:  # the term itself is not; a lever arm is tested anew beside the terms
                by[fit.layout[name]] = values
        fit = fit.doubted(by)
    return fit


def with_terms(fit: JointFit, names: list[str]) -> JointFit:
    """The same record with these terms free. Raises EstimationError."""
    refitted = _refitted(fit.model, fit.state, fit.levels, fit, names, fit.vps)
    return replace(refitted, iterations=fit.iterations + refitted.iterations)


def candidates(fit: JointFit) -> list[str]:
    """Terms that this record could determine at all."""
    readings = fit.model.readings
    out = ["gyroscope_cross"] if len(fit.model.vectors) == 2 else []
    if readings.warmth is not None and float(np.ptp(readings.warmth)) > LEAST_TEMPERATURE_RANGE_DEGC:
        out.append("gyroscope_temperature")
    # Vectors alone can't tell it: the same accelerometer would be both the cause and the witness.
    # Nor where the walk had to be held down: then the poses' error is coloured, and it would take that for its own.
    force = readings.force if fit.vps is not None and fit.options.walk_ratio >= 1.0 else None
    if force is not None and float(np.sqrt(np.mean(np.sum(force**2, axis=1)))) > LEAST_FORCE_MPS2:
        out.append("gyroscope_g_sensitivity")
    if float(np.sqrt(np.mean(np.sum(fit.path.rate**2, axis=1)))) > LEAST_RATE_RADPS:
        out += [f"{name}_delay" for name in fit.model.vectors]
    return out + [f"{name}_cross" for name in fit.model.vectors]


def first_part(fit: JointFit, split: int) -> JointFit | None:
    """The same constants from the samples before `split` alone, started from the whole record's; None where the part
    has too few poses of a VPS that the fit is by. Raises EstimationError."""
    model, state, vps = _part(fit, 0, split)
    if vps is None and fit.vps is not None:
        return None
    # What doubt of a lever arm does to the accelerometer's sd is not asked of a part.
    like = replace(fit, options=replace(fit.options, doubt_lever_arm=False))
    return _refitted(model, state, fit.levels, like, [], vps)


def with_zeros(state: State, names: list[str]) -> State:
    """The state with these terms free too, at zero where they have no value yet."""
    return replace(state, values={**{name: np.zeros(TERMS[name]) for name in names}, **state.values})


def _refitted(
    model: Model, state: State, levels: Levels, like: JointFit, names: list[str], vps: VpsRecord | None
) -> JointFit:
    return fit_joint(
        model,
        with_zeros(state, names),
        free_dip="dip" in like.layout,
        try_lever_arm="lever_arm" in like.layout,
        vps=vps,
        levels=levels,
        largest_walk_ratio=like.options.walk_ratio,
        priors=like.priors,
        doubt_lever_arm=like.options.doubt_lever_arm,
    )


def _scores(fit: JointFit, names: list[str]) -> tuple[dict[str, float], dict[str, dict[str, Array]]]:
    """χ² of each candidate's first step, with all candidates free and the other parameters following; `fit` is at its
    optimum. By candidate, if it were free alone: its first step, and what that moves the other parameters by, by
    name."""
    model, state = fit.model, with_zeros(fit.state, names)
    layout, p = layout_of(model, state.values, dip="dip" in fit.layout, lever_arm="lever_arm" in fit.layout)
    probe = Probe.draw(model.knots, model.readings.t, model.at, 3 * len(model.vectors))
    normal, _, _ = linearised(model, state, fit.path, layout, p, fit.weight, fit.levels, probe, fit.vps)
    eliminated = normal.eliminate()
    information, gradient = eliminated.information, eliminated.gradient
    tested = np.concatenate([np.arange(p)[layout[name]] for name in names])
    rest = np.setdiff1d(np.arange(p), tested)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    unit = information * np.outer(scale, scale)
    left = (
        unit[np.ix_(tested, tested)]
        - unit[np.ix_(tested, rest)]
        @ np.linalg.lstsq(unit[np.ix_(rest, rest)], unit[np.ix_(rest, tested)], rcond=1e-10)[0]
    )
    covariance = np.linalg.pinv(left, rcond=1e-6, hermitian=True)
    step = covariance @ (gradient[tested, GRADIENT] * scale[tested])
    out: dict[str, float] = {}
    moved: dict[str, dict[str, Array]] = {}
    at = 0
    for name in names:
        these = slice(at, at + TERMS[name])
        out[name] = float(step[these] @ np.linalg.lstsq(covariance[these, these], step[these], rcond=1e-10)[0])
        own = np.arange(p)[layout[name]]
        follow = np.linalg.lstsq(unit[np.ix_(rest, rest)], unit[np.ix_(rest, own)], rcond=1e-10)[0]
        alone = np.linalg.pinv(left[these, these], rcond=1e-6, hermitian=True) @ (gradient[own, GRADIENT] * scale[own])
        by = np.zeros(p)
        by[rest] = -scale[rest] * (follow @ alone)
        by[own] = scale[own] * alone
        moved[name] = {other: by[layout[other]] for other in (*fit.layout, name)}
        at = these.stop
    return out, moved


def _gains(fit: JointFit, names: list[str]) -> dict[str, float]:
    """Forward selection on the first part of the record, tested on the rest: gain over its sd of each term, beside the
    terms accepted before it.

    Constants that one Gauss–Newton step of the first part gives decide where the gain is plain; they cost two
    linearisations, a fit two dozen."""
    # Predictions ask for no sd.
    fit = replace(fit, options=replace(fit.options, doubt_lever_arm=False))
    n = len(fit.model.readings.t)
    split = int(fit.model.knots.index[np.searchsorted(fit.model.knots.index, int(FIT_SHARE * n))])
    early, late = (_part(fit, a, b) for a, b in ((0, split + 1), (split, n)))
    out: dict[str, float] = {}
    try:
        current = _refitted(*early[:2], fit.levels, fit, [], early[2])
        without = _predicted(*late, current, current)
        steps = _scores(current, names)[1]
        for i, name in enumerate(names):
            stepped = replace(current, state=_stepped(current.state, name, steps[name]))
            rest = late[0], without.state, late[2]
            gain = _gain(late[0], without, _predicted(*rest, stepped, current, iterations=STEP_ITERATIONS))
            plain = not REFUSED_BY_A_STEP < gain < KEPT_BY_A_STEP
            others = names[i + 1 :]
            if not plain or (gain > LEAST_GAIN_SD and others):
                other = _refitted(early[0], stepped.state, current.levels, fit, [name], early[2])
                gain = gain if plain else _gain(late[0], without, _predicted(*rest, other, current))
                if gain > LEAST_GAIN_SD and others:
                    current, without = other, _predicted(*rest, other, other)
                    steps = _scores(current, others)[1]
            out[name] = gain
    except EstimationError:
        pass
    return out


def _stepped(state: State, name: str, moved: Mapping[str, Array]) -> State:
    """The state with a term free, after its first step."""
    values = dict(with_zeros(state, [name]).values)
    for other, change in moved.items():
        values[other] = values[other] + change
    return replace(state, values=values)


def _part(fit: JointFit, a: int, b: int) -> tuple[Model, State, VpsRecord | None]:
    """Samples a to b of the fitted record, its attitudes and translation as the start."""
    readings, old = fit.model.readings, fit.model.knots
    spacing = float(np.max(old.interval_s[old.joined]))
    knots = place_knots(readings.t[a:b], readings.segment[a:b], spacing * 1.001)
    model = fit.model.part(a, b, knots)
    at = a + knots.index
    state = replace(fit.state, q=fit.path.q[at], motion=fit.state.motion[old.of_sample[at]])
    if fit.vps is None:
        return model, state, None
    vps = fit.vps.at_knots(model, state, trajectory(model, state))
    # The constant rotations of the VPS are aligned anew for the part.
    return model, replace(state, values={**state.values, **fit.vps.start()}), vps


@dataclass(frozen=True)
class _Prediction:
    """Residuals over their sd: of readings (m, r), with their robust weights, and of the links between knots (K−1,
    c); the `state` whose attitudes and translation are the likeliest."""

    rows: Array
    weight: Array
    links: Array
    state: State


def _predicted(
    model: Model,
    state: State,
    vps: VpsRecord | None,
    constants: JointFit,
    noise: JointFit,
    *,
    iterations: int = PREDICT_ITERATIONS,
) -> _Prediction:
    """Prediction with the constants of one fit and the noise levels of another; attitudes and translation are free."""
    levels = noise.levels
    state = replace(state, values=constants.state.values)
    reference = None
    if vps is not None and constants.vps is not None and noise.vps is not None:
        residual, counts = noise.vps.residual(noise.model, noise.state)
        reference = replace(constants.vps, used=vps.used, sigma_rad=noise.vps.sigma(residual[counts]))
    free = {name: v for name, v in state.values.items() if name in TERMS or name in PARAMETERS}
    layout, p = layout_of(model, free, dip=False, lever_arm=False)
    probe = Probe.draw(model.knots, model.readings.t, model.at, 3 * len(model.vectors))
    for _ in range(iterations):
        path = trajectory(model, state)
        weight = robust_weight(model, residuals(model, state, path), levels)
        normal, joints, _ = linearised(model, state, path, layout, p, weight, levels, probe, reference)
        step = normal.eliminate().solved(slice(p + GRADIENT, p + GRADIENT + 1))[:, :, 0]
        state = state.moved(step, np.zeros(p), layout)
        if np.max(np.abs(step[:, :3])) < PREDICT_STEP_RAD:
            break
    path = trajectory(model, state)
    residual = residuals(model, state, path)
    links = whitened_joints(model.knots, replace(joints, jump=path.jump, motion=state.motion))
    if reference is not None:
        error, available = reference.residual(model, state)
        links = np.hstack([links, (error * available[:, None] / reference.sigma_rad)[:-1]])
    return _Prediction(
        residual / np.sqrt(levels.variance * levels.colour), robust_weight(model, residual, levels), links, state
    )


def _gain(model: Model, without: _Prediction, term: _Prediction) -> float:
    """Drop d of the sum of squares over its sd. Where the term is right d is |Δ|² + 2Δᵀe with Δ the change of the
    residuals and e noise, so d − |Δ|², summed by blocks of BLOCK_S, longer than the noise is correlated, gives the
    sd."""
    knots = model.knots
    blocks = max(1, round(float(knots.interval_s.sum()) / BLOCK_S))
    if blocks < FEWEST_BLOCKS:
        return 0.0
    of_knot = np.arange(len(knots.index)) * blocks // len(knots.index)
    drop, changed = np.zeros(blocks), np.zeros(blocks)
    for a, b, weight, block in (
        (without.rows, term.rows, without.weight, of_knot[knots.of_sample[model.at]]),
        (without.links, term.links, np.ones_like(without.links), of_knot[:-1]),
    ):
        drop += np.bincount(block, np.sum(weight * (a**2 - b**2), axis=1), minlength=blocks)
        changed += np.bincount(block, np.sum(weight * (a - b) ** 2, axis=1), minlength=blocks)
    sd = float(np.sqrt(np.sum((drop - changed) ** 2)))
    return float(drop.sum()) / sd if sd > 0.0 else 0.0


def summary(tests: list[TermTest], fit: JointFit) -> Mapping[str, Mapping[str, Json]]:
    """Plain numbers for `measured`: the test results of each term and, where kept, its values and sd."""
    out: dict[str, dict[str, Json]] = {}
    for test in tests:
        out[test.name] = {"kept": test.kept, "score": test.score, "held_out_gain": test.gain}
        if test.kept:
            columns = fit.layout[test.name]
            out[test.name] |= {
                "value": fit.state.values[test.name].tolist(),
                "sd": np.sqrt(np.diagonal(fit.covariance)[columns]).tolist(),
            }
    return out
