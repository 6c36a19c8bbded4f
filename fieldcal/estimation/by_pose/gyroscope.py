"""The gyroscope against the VPS's attitude: the joint estimate's chain of knots with poses and without vectors, so that
neither translation nor a disturbed field can reach its constants."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.clock_sync.by_field import block_rates
from fieldcal.estimation.clock_sync.by_rates import SyncFit
from fieldcal.estimation.gyroscope.output_error import propagate_stretches
from fieldcal.estimation.joint.chain_solver import STATES, place_knots
from fieldcal.estimation.joint.fit import JointFit, fit_joint
from fieldcal.estimation.joint.initialise import KNOT_SPACING_S
from fieldcal.estimation.joint.measurement_model import trajectory
from fieldcal.estimation.joint.pose_measurement import VpsRecord
from fieldcal.estimation.joint.problem import Model, Readings, State
from fieldcal.estimation.joint.variance_components import gyro_walk
from fieldcal.estimation.wahba import nearest_rotation
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import (
    Array,
    conjugate,
    continuous,
    from_matrix,
    hermite,
    multiply,
    slerp,
)
from fieldcal.reason_codes import ReasonCode

# Walk of the attitude over that by the gyroscope's sample-to-sample noise, at most. Free, it follows the VPS: right
# where the VPS's noise is white, and for a trajectory. Where it is coloured over seconds (marker geometry, smoothing)
# that leaves too much to the shortest spans, which the VPS's bandwidth falsifies: there the walk has to be held down,
# and what is left is the poses' error.
FREE_WALK_RATIO, STIFF_WALK_RATIO = 10.0, 0.03
# Both fits agree: χ²₃ of the difference of their scales, exceeded by chance once in a thousand.
AGREEMENT_CHI2 = 16.3
# A mounting further from the configured one than this is taken for another one, if the rates show a rotation at all:
# singular values of the map between them within this share of 1.
OTHER_MOUNTING_RAD, LARGEST_STRETCH = np.pi / 4, 0.3


def start_by_rates(matrix: ArrayLike, polarity: ArrayLike, nominal: ArrayLike | None) -> tuple[Array, Array]:
    """Scales (3,) to start from, and the rotation (3, 3) from the VPS's body axes to the sensor's.

    `matrix` (3, 3) maps VPS rates, rad/s, to logged ones; `polarity` (3,) of ±1; `nominal` (3,) the unit's |scale| or
    None. Scales are nominal where the rates agree within a factor of two; the rotation is the identity unless the rates
    plainly show another one."""
    m, sign = np.asarray(matrix, dtype=float), np.asarray(polarity, dtype=float)
    found = 1.0 / np.maximum(np.linalg.norm(m, axis=1), 1e-300)
    scale = sign * found
    if nominal is not None:
        known = np.asarray(nominal, dtype=float)
        agrees = (found > 0.5 * known) & (found < 2.0 * known)
        # One factor for all axes is a wrong unit; single axes off are axes that hardly turned.
        scale = sign * (known if agrees.any() else known * np.median(found / known))
    turned = m * scale[:, None]
    rotation = nearest_rotation(turned)
    stretch = np.linalg.svd(turned, compute_uv=False)
    angle = np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0))
    if np.max(np.abs(stretch - 1.0)) > LARGEST_STRETCH or angle < OTHER_MOUNTING_RAD:
        rotation = np.eye(3)
    return scale, rotation


def fit_gyroscope(
    readings: Readings,
    t_vps: ArrayLike,
    q_vps: ArrayLike,
    clock: SyncFit,
    start: tuple[Array, Array],
    rotation: Array,
    *,
    max_gap_s: float,
) -> tuple[JointFit, JointFit]:
    """Gyroscope, clock and mounting by attitude alone.

    Parameters
    ----------
    readings : Readings
        The record; its vector triads are not looked at.
    t_vps, q_vps : (m,), (m, 4) arrays
        VPS stamps on the VPS clock, s, and attitudes, inertial NED, outliers removed.
    clock : SyncFit
        Where the clock starts.
    start : ((3,), (3,)) arrays
        Scale and bias of the gyroscope, within a factor of two.
    rotation : (3, 3) array
        From the VPS's body axes to the sensor's, within some tens of degrees.
    max_gap_s : float
        Longest gap between poses that is interpolated over.

    Returns
    -------
    Two fits with `vps`, in the VPS's world: the first for the constants, the second for trajectory, clock and mounting.

    Raises
    ------
    UnusableFlight
        `vps_too_short`: fewer poses at knots than the estimate needs.
    EstimationError
        See `fit_joint`.
    """
    r = readings.gyroscope_alone()
    t_vps = np.asarray(t_vps, dtype=float)
    q_vps = multiply(continuous(q_vps), from_matrix(rotation))
    knots = place_knots(r.t, r.segment, KNOT_SPACING_S)
    model = Model.of(r, knots)
    q = attitudes(r, t_vps, q_vps, clock, start, max_gap_s)
    values = {"dip": np.zeros(1), "lever_arm": np.zeros(3), "gyroscope": model.triads["gyroscope"].scaled(*start)}
    state = State(q[knots.index], np.zeros((len(knots.index), STATES - 3)), values)
    vps = VpsRecord.of(t_vps, q_vps, clock, model, state, trajectory(model, state), max_gap_s=max_gap_s)
    if vps is None:
        raise UnusableFlight(ReasonCode.VPS_TOO_SHORT, "The VPS has too few poses where the vehicle was moved.")
    state = State(state.q, state.motion, {**values, **vps.start()})
    fit = partial(fit_joint, model, free_dip=False, try_lever_arm=False, vps=vps)
    free = fit(state, largest_walk_ratio=FREE_WALK_RATIO)
    walk = STIFF_WALK_RATIO * gyro_walk(model, free.state)
    stiff = fit(free.state, levels=replace(free.levels, walk=walk), largest_walk_ratio=STIFF_WALK_RATIO)
    return _trusted(free, stiff), free


def _trusted(free: JointFit, stiff: JointFit) -> JointFit:
    """The free fit is the more exact where its noise model holds: it then claims less and agrees with the stiff one
    (Hausman, 1978). Claims are compared by the volume of the scales' covariance: of three sd one is larger by chance
    in one flight of four."""
    (scale, _, covariance), (other, _, larger) = (fit.constants("gyroscope") for fit in (free, stiff))
    difference = scale - other
    claims_less = bool(np.linalg.det(covariance[:3, :3]) < np.linalg.det(larger[:3, :3]))
    agrees = float(difference @ np.linalg.solve(larger[:3, :3], difference)) < AGREEMENT_CHI2
    return free if claims_less and agrees else stiff


def attitudes(
    r: Readings, t_vps: Array, q_vps: Array, clock: SyncFit, start: tuple[Array, Array], max_gap_s: float
) -> Array:
    """Attitude (n, 4) at every sample: the VPS's, carried over its gaps by the gyroscope. Raises `vps_too_short` where
    there is none."""
    relative = propagate_stretches(r.t, r.gyroscope * start[0] + start[1], r.segment)
    on_vps_clock = clock.to_vps_clock(r.t)
    at = interval_of(t_vps, on_vps_clock)
    seen = (on_vps_clock >= t_vps[0]) & (on_vps_clock <= t_vps[-1]) & (t_vps[at + 1] - t_vps[at] <= max_gap_s)
    if not seen.any():
        raise UnusableFlight(ReasonCode.VPS_TOO_SHORT, "The VPS has no poses where the vehicle was moved.")
    own = hermite(t_vps, q_vps, block_rates(t_vps, q_vps, max_gap_s), on_vps_clock[seen])
    offset = multiply(own, conjugate(relative[seen]))
    out: Array = np.empty_like(relative)
    for number in np.unique(r.segment):
        here = r.segment == number
        # A segment without a pose takes the offset of its neighbour: its heading is anyone's guess, its constants not.
        inside = here[seen] if here[seen].any() else np.ones(len(offset), dtype=bool)
        times, values = r.t[seen][inside], continuous(offset[inside])
        carried = slerp(times, values, np.clip(r.t[here], times[0], times[-1])) if len(times) > 1 else values
        out[here] = multiply(carried, relative[here])
    return out
