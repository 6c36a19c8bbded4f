"""The joint estimate by vectors that always ends: from what is known beforehand, over starts and models that ask less
and less of the record, the first that stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.joint import initialise
from fieldcal.estimation.joint.fit import JointFit, fit_joint
from fieldcal.estimation.joint.problem import PriorConstants, Readings
from fieldcal.estimation.joint.turning_start import gyroscope_by_turning
from fieldcal.geometry.rotation import Array, body_from_inertial
from fieldcal.names import Rung
from fieldcal.reason_codes import ReasonCode

if TYPE_CHECKING:
    from fieldcal.estimation.joint.initialise import Constants

# Where gravity moved less than this in sensor axes, rms over the axes, in g, the accelerometer tells nothing of its
# constants: they are held at those known beforehand, since translation would draw them along.
LEAST_TILT = 0.15
FROM_GIVEN = (Rung.FREE, Rung.TURNING_START, Rung.FIELD_ALONE)  # the others start from what is known beforehand
WITH_ARM = (Rung.FREE, Rung.TURNING_START, Rung.INERTIAL_START)  # these estimate the lever arm too
HELD_SD = 1e-5  # of held constants, as a share of what is known of them


@dataclass(frozen=True)
class Outcome:
    """The fit, the rung that it stands on, and why those before it did not (rung → sentence)."""

    fit: JointFit
    rung: Rung
    failed: Mapping[str, str]


def fit_with_fallbacks(
    readings: Readings,
    start: Mapping[str, Constants | None],
    priors: Mapping[str, PriorConstants],
    *,
    lever_arm: Array | None = None,
    doubt_lever_arm: bool = True,
) -> Outcome:
    """The joint estimate on the first rung that has a minimum.

    `free`: every constant, from the start given. `held`: the accelerometer's constants held at those known beforehand.
    `inertial_start`: attitudes from accelerometer and gyroscope alone, the magnetometer's start from those. `zeros`:
    the gyroscope's scales held too. Of a gyroscope in counts, of which nothing is known beforehand, `turning_start`:
    all from how fast the field turns, without a magnetometer gravity; `field_alone`: from there without an
    accelerometer in counts too.

    Parameters
    ----------
    readings : Readings
    start : mapping
        As of `initialise.prepare`.
    priors : mapping
        Sensor → what is known of it beforehand; of counts nothing is.
    lever_arm : (3,) array, optional
        As measured on the vehicle, sensor axes.
    doubt_lever_arm : bool
        As of `fit_joint`.

    Raises
    ------
    UnusableFlight, EstimationError
        What the first rung that was tried met, when none stands.
    """
    failed: dict[str, str] = {}
    first: UnusableFlight | EstimationError | None = None
    known = {name: (prior.scale, prior.bias) for name, prior in priors.items()}
    level, prepared = False, None
    if "accelerometer" in priors and readings.accelerometer is not None:
        try:
            prepared = initialise.prepare(readings, start, lever_arm=lever_arm)
            level = tilt_rms(prepared[1].q) < LEAST_TILT
        except (UnusableFlight, EstimationError) as error:
            failed[Rung.FREE] = str(error)
    for rung in _rungs(readings, start, priors, level):
        own_start, own_priors = dict(start), dict(priors)
        if rung not in FROM_GIVEN:
            own_start |= {name: known[name] for name in ("accelerometer", "gyroscope") if name in known}
        if rung in (Rung.HELD, Rung.ZEROS) or level:
            own_priors["accelerometer"] = held(priors["accelerometer"])
        if rung == Rung.ZEROS:
            own_priors["gyroscope"] = scales_held(priors["gyroscope"])
        try:
            if rung == Rung.INERTIAL_START:
                own_start["magnetometer"] = magnetometer_start(readings, own_start)
            if rung in (Rung.TURNING_START, Rung.FIELD_ALONE):
                own_start["gyroscope"] = gyroscope_by_turning(readings, own_start)
            if rung == Rung.FIELD_ALONE:
                own_start["accelerometer"] = None
            if rung != Rung.FREE or prepared is None:
                prepared = initialise.prepare(readings, own_start, lever_arm=lever_arm)
            model, state = prepared
            free_arm = lever_arm is None and not level and rung in WITH_ARM
            fit = fit_joint(model, state, try_lever_arm=free_arm, priors=own_priors, doubt_lever_arm=doubt_lever_arm)
        except (UnusableFlight, EstimationError) as error:
            failed[rung] = str(error)
            first = first or error
            continue
        return Outcome(fit, rung, failed)
    assert first is not None
    raise first


def _rungs(
    readings: Readings, start: Mapping[str, Constants | None], priors: Mapping[str, PriorConstants], level: bool
) -> list[Rung]:
    """What is tried, in this order."""
    in_counts = "gyroscope" not in priors
    rungs = [] if level else [Rung.FREE]
    if in_counts and not level:
        rungs.append(Rung.TURNING_START)
    if "accelerometer" in priors:
        rungs.append(Rung.HELD)
        if "gyroscope" in priors:
            rungs += [Rung.ZEROS] if readings.magnetometer is None else [Rung.INERTIAL_START, Rung.ZEROS]
    elif in_counts and start.get("magnetometer") is not None:
        rungs.append(Rung.FIELD_ALONE)
    return rungs


def held(prior: PriorConstants) -> PriorConstants:
    """The same, known beyond doubt."""
    return replace(prior, covariance=prior.covariance * HELD_SD**2)


def scales_held(prior: PriorConstants) -> PriorConstants:
    """The same, its scales known beyond doubt."""
    shrink = np.r_[np.full(3, HELD_SD), np.ones(3)]
    return replace(prior, covariance=prior.covariance * np.outer(shrink, shrink))


def tilt_rms(q: Array) -> float:
    """Rms over the axes of how far gravity moves in the sensor axes of attitudes q (n, 4), as a share of g."""
    down = body_from_inertial(q)[..., 2]
    return float(np.sqrt(np.mean(np.var(down, axis=0))))


def magnetometer_start(readings: Readings, start: Mapping[str, Constants | None]) -> Constants:
    """Scale and bias of the magnetometer from attitudes by accelerometer and gyroscope: beside a scale common to its
    axes and the field, in the attitudes' world, the readings are linear in the bias. Raises `no_start`."""
    given, logged = start.get("magnetometer"), readings.magnetometer
    if logged is None or given is None:
        raise UnusableFlight(ReasonCode.NO_START, "The magnetometer's unit tells no start.")
    without = replace(readings, magnetometer=None)
    model, state = initialise.prepare(without, {**start, "magnetometer": None})
    valid = np.isfinite(logged[model.knots.index]).all(axis=1)
    turn = body_from_inertial(state.q[valid])
    reading = logged[model.knots.index][valid] * given[0]
    # λ m = Rᵀh − b: three equations a knot for the field h and the bias b.
    columns = np.concatenate([turn, -np.broadcast_to(np.eye(3), turn.shape)], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(columns, reading.reshape(-1), rcond=1e-8)[0]
    length = float(np.linalg.norm(solution[:3]))
    common = float(np.linalg.norm(readings.field_ned)) / max(length, 1e-300)
    return given[0] * common, solution[3:] * common
