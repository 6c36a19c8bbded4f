"""The attitude and motion of a whole record as one chain of knots: its process noise and its normal equations.

This is a smoother over a whole record (fixed-interval smoothing), written as least squares on its states: multiple
shooting with soft joints. Between neighbouring knots the gyroscope is integrated; where one interval ends and the next
begins the attitude may jump, by the process noise that gyroscope noise accumulates over the interval. Beside the
attitude a knot carries the translation that the accelerometer senses: velocity, acceleration and jerk, driven by white
noise behind three equal low-passes, so that the acceleration has no constant part, like that of a vehicle that stays
near one place. All knots are eliminated from the normal equations by block cyclic reduction (the Schur complement), in
time linear in the record's length.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from fieldcal import compiled
from fieldcal.compiled import chain
from fieldcal.errors import EstimationError
from fieldcal.estimation.segments import run_bounds
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

# Peak of the acceleration's spectral density; at a quarter and at four times this frequency a tenth of it remains.
MOTION_HZ = 0.7
ORDER = 3  # of the translation's process: velocity, acceleration, jerk, all scaled to m/s²
# Of a knot: attitude error, rad, inertial axes; velocity, acceleration and jerk of the translation, three axes each.
STATES = 3 + 3 * ORDER
# Right-hand sides after the columns of the parameters: the gradient, then one for each group of residuals whose noise
# level is estimated, for its probe (`Probe`): sensor rows, attitude jumps, translation, gyroscope noise within
# intervals.
GRADIENT, SENSORS, JUMP, MOTION, BRIDGE = RIGHTS = range(5)
KNOTS_AT_ONCE = 128  # eliminated together: what a processor's cache holds
# Information on each knot's attitude error: keeps directions that nothing observes (heading without a magnetometer)
# from being singular.
ATTITUDE_PRIOR_PER_RAD2 = 1e-2


@dataclass(frozen=True)
class Knots:
    """Where the knots are: `index` (K,) sample of each knot; `of_sample` (n,) the knot at or before each sample;
    `share` (n,) of the interval that has passed there; `joined` (K−1,) whether neighbours belong to one contiguous
    segment; `interval_s` (K−1,) between them (1 where not joined); `sample_s` between samples, median; `motion` the
    translation's process over each interval."""

    index: np.ndarray
    of_sample: np.ndarray
    share: Array
    joined: np.ndarray
    interval_s: Array
    sample_s: float
    motion: Motion


@dataclass(frozen=True)
class Motion:
    """y_{k+1} = F y_k + noise for y = (ω0 v, a, j/ω0) of an axis, stationary covariance P with P_aa = 1.

    `whitener` (K−1, 3, 3) is L⁻¹ with LLᵀ = P − FPFᵀ, the covariance of the process noise; `whitened_transition`
    (K−1, 3, 3) is L⁻¹F; `start_whitener` (3, 3) is L⁻¹ with LLᵀ = P, for the first knot of a segment."""

    whitener: Array
    whitened_transition: Array
    start_whitener: Array


def place_knots(t: Array, segment: np.ndarray, spacing_s: float) -> Knots:
    """Knots on the samples that cut contiguous segments into equal parts of at most `spacing_s`, both ends included."""
    n = len(t)
    index = []
    for a, b in run_bounds(segment):
        parts = max(1, int(np.ceil((t[b - 1] - t[a]) / spacing_s)))
        edges = np.searchsorted(t[a:b], np.linspace(t[a], t[b - 1], parts + 1)[1:-1]) + a
        index.append(np.unique(np.r_[a, edges, b - 1]))
    knot = np.concatenate(index)
    joined = segment[knot[1:]] == segment[knot[:-1]]
    interval = np.where(joined, t[knot[1:]] - t[knot[:-1]], 1.0)
    of_sample = np.searchsorted(knot, np.arange(n), side="right") - 1
    share = (t - t[knot[of_sample]]) / np.r_[interval, 1.0][of_sample]
    return Knots(knot, of_sample, share, joined, interval, float(np.median(np.diff(t))), _motion(interval))


def _motion(interval_s: Array) -> Motion:
    # Neighbouring intervals differ by a sample at most: one process for each length in whole milliseconds.
    lengths, which = np.unique(np.maximum(np.round(interval_s, 3), 1e-3), return_inverse=True)
    # v‴ + 3ω0 v″ + 3ω0² v′ + ω0³ v = white: the acceleration's density peaks at ω0/√2.
    omega = 2 * np.pi * MOTION_HZ * np.sqrt(2.0)
    rate = omega * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -3.0, -3.0]])
    stationary = solve_continuous_lyapunov(rate, -np.diag([0.0, 0.0, 1.0]))
    stationary /= stationary[1, 1]
    whitener, transition = np.empty((2, len(lengths), ORDER, ORDER))
    for i, length in enumerate(lengths):
        f = expm(rate * length)
        whitener[i] = np.linalg.inv(np.linalg.cholesky(stationary - f @ stationary @ f.T))
        transition[i] = whitener[i] @ f
    return Motion(whitener[which], transition[which], np.linalg.inv(np.linalg.cholesky(stationary)))


@dataclass
class Normal:
    """Normal equations of the chain, bordered by the parameters: N x = b for every column of `right`.

    `diagonal` (K, s, s), `below` (K−1, s, s) couples knot k+1 (rows) to k; `right` (K, s, c): first p columns couple
    the knots to the parameters, the others are right-hand sides; `parameters` (p, p), `parameters_right` (p, c − p)."""

    diagonal: Array
    below: Array
    right: Array
    parameters: Array
    parameters_right: Array

    @classmethod
    def empty(cls, knots: int, parameters: int, rights: int) -> Normal:
        return cls(
            np.zeros((knots, STATES, STATES)),
            np.zeros((knots - 1, STATES, STATES)),
            np.zeros((knots, STATES, parameters + rights)),
            np.zeros((parameters, parameters)),
            np.zeros((parameters, rights)),
        )

    def blocks(self) -> tuple[Array, Array, Array, Array, Array]:
        """All arrays, in the order above."""
        return self.diagonal, self.below, self.right, self.parameters, self.parameters_right

    def eliminate(self) -> Elimination:
        """Eliminate the knots. Raises EstimationError `joint_singular`."""
        p = len(self.parameters)
        factors: tuple[Array, Array] | None = None
        if (library := compiled.LIBRARY) is not None:
            found = chain.eliminate(library, self.diagonal, self.below, self.right, p)
            if found is None:
                raise _singular()
            factors, carried, absorbed = found[:2], *found[2:]
        else:
            carried = chain_solve(self.diagonal, self.below, self.right)
            flat, solved = (x.reshape(-1, x.shape[2]) for x in (self.right, carried))
            absorbed = (flat.T @ solved)[:p]
        information, gradient = self.parameters - absorbed[:, :p], self.parameters_right - absorbed[:, p:]
        return Elimination(0.5 * (information + information.T), gradient, carried, factors)


@dataclass(frozen=True)
class Elimination:
    """Normal equations without their knots: `information` (p, p) of θ, the Schur complement N_θθ − N_θx N_xx⁻¹ N_xθ;
    `gradient` (p, c − p).

    `carried` (K, s, c) is N_xx⁻¹ right or, where there are `factors` of N_xx (`compiled.chain`), half of the way
    there: columns that nobody asks for are not solved for."""

    information: Array
    gradient: Array
    carried: Array
    factors: tuple[Array, Array] | None = None

    def solved(self, columns: slice) -> Array:
        """N_xx⁻¹ of these columns of the right-hand sides, (K, s, ·)."""
        return self._whole(self.carried[:, :, columns])

    def response(self, theta: Array) -> Array:
        """The knots' part of the solution where the parameters' is `theta` (p, c − p): N_xx⁻¹ (right − N_xθ θ)."""
        p = len(theta)
        return self._whole(self.carried[:, :, p:] - self.carried[:, :, :p] @ theta)

    def _whole(self, columns: Array) -> Array:
        if self.factors is None or compiled.LIBRARY is None:
            return columns
        return chain.substitute(compiled.LIBRARY, *self.factors, columns)


def chain_solve(diagonal: Array, below: Array, right: Array) -> Array:
    """Solve the positive block tridiagonal system with blocks (K, m, m), (K−1, m, m) for right-hand sides (K, m, c).

    Block cyclic reduction: every other knot is eliminated at once, which leaves a chain of half the length; each level
    is a handful of products of stacked blocks, in runs that a processor's cache holds. Raises EstimationError
    `joint_singular`."""
    if len(diagonal) == 1:
        return np.asarray(_inverse(diagonal) @ right)
    # `before` couples an odd knot to the even one before it, `after` the next even one to that odd knot.
    odd, before, after = diagonal[1::2], below[0::2], below[1::2]
    even, rest, between = np.empty_like(diagonal[0::2]), np.empty_like(right[0::2]), np.empty_like(after)
    even[0], rest[0] = diagonal[0], right[0]  # a run begins with the even knot with which the run before it ended
    back, forth, solved = np.empty_like(before), np.empty_like(after), np.empty_like(right)
    odd_solved = solved[1::2]
    ends = [*range(0, len(odd), KNOTS_AT_ONCE), len(odd)]
    runs = [(slice(a, b), slice(a + 1, b + 1)) for a, b in pairwise(ends)]
    for run, following in runs:
        inverse, up, down = _inverse(odd[run]), before[run].transpose(0, 2, 1), after[run]
        back[run], odd_solved[run] = inverse @ before[run], inverse @ right[1::2][run]
        forth[run] = inverse[: len(down)] @ down.transpose(0, 2, 1)
        between[run] = -down @ back[run][: len(down)]
        even[following] = diagonal[0::2][following] - down @ forth[run]
        rest[following] = right[0::2][following] - down @ odd_solved[run][: len(down)]
        even[run] -= up @ back[run]
        rest[run] -= up @ odd_solved[run]
    solved[0::2] = chain_solve(even, between, rest)
    for run, following in runs:
        odd_solved[run] -= back[run] @ solved[0::2][run]
        odd_solved[run][: len(forth[run])] -= forth[run] @ solved[0::2][following]
    return solved


def _inverse(blocks: Array) -> Array:
    try:
        root = np.linalg.inv(np.linalg.cholesky(blocks))
    except np.linalg.LinAlgError as error:
        raise _singular() from error
    return np.asarray(root.transpose(0, 2, 1) @ root)


def _singular() -> EstimationError:
    return EstimationError(
        ReasonCode.JOINT_SINGULAR, "The joint equations are singular: the readings contradict the start."
    )


def solve_scaled(information: Array, gradient: Array) -> Array:
    """information⁻¹ gradient with columns scaled to one; directions without information do not move."""
    scale = np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    solved = np.linalg.lstsq(information / np.outer(scale, scale), gradient / scale[:, None], rcond=1e-12)[0]
    return np.asarray(solved / scale[:, None])


@dataclass(frozen=True)
class Joints:
    """The links between neighbouring knots, linearised: `jump` (K−1, 3) rad, from the integrated attitude to the next
    knot's, inertial axes; `moved` (K−1, 3, p) ∂(integrated attitude)/∂θ; `walk` density of the attitude's random walk
    by gyroscope noise, rad²/s; `motion` (K, 9) translation; `strength` stationary rms of its acceleration, m/s² an
    axis."""

    jump: Array
    moved: Array
    walk: float
    motion: Array
    strength: float


def add_joints(normal: Normal, knots: Knots, joints: Joints, probe: Probe) -> None:
    """Add attitude jumps and the translation's process to the normal equations."""
    p = len(normal.parameters)
    weight = knots.joined / (joints.walk * knots.interval_s)
    if (library := compiled.LIBRARY) is not None:
        chain.add_jumps(library, joints.jump, joints.moved, weight, probe.jump, normal.blocks())
        process = _process(knots, joints.strength)
        drawn = probe.motion * knots.joined[:, None, None]
        chain.add_motion(library, process, joints.motion, drawn, probe.start, normal.blocks())
        normal.diagonal[:, range(3), range(3)] += ATTITUDE_PRIOR_PER_RAD2
        return
    eye = np.eye(3) * weight[:, None, None]
    normal.diagonal[:-1, :3, :3] += eye
    normal.diagonal[1:, :3, :3] += eye
    normal.diagonal[:, range(3), range(3)] += ATTITUDE_PRIOR_PER_RAD2
    normal.below[:, :3, :3] -= eye
    coupling = joints.moved * weight[:, None, None]
    rights = np.zeros((len(weight), 3, normal.right.shape[2] - p))
    rights[..., GRADIENT], rights[..., JUMP] = -joints.jump * weight[:, None], probe.jump * np.sqrt(weight)[:, None]
    normal.right[1:, :3, :p] -= coupling
    normal.right[:-1, :3, :p] += coupling
    normal.right[1:, :3, p:] += rights
    normal.right[:-1, :3, p:] -= rights
    flat = joints.moved.reshape(-1, p)
    normal.parameters += flat.T @ coupling.reshape(-1, p)
    normal.parameters_right -= flat.T @ rights.reshape(len(flat), -1)
    _add_motion(normal, knots, joints, probe)


def _process(knots: Knots, strength: float) -> tuple[Array, Array, Array]:
    """The translation's process over its sd: its factors of the next knot (K−1, 3, 3), of this knot (K−1, 3, 3) and of
    the first knot of a segment (K, 3, 3)."""
    on = (knots.joined / strength)[:, None, None]
    first = (np.r_[True, ~knots.joined] / strength)[:, None, None]
    return knots.motion.whitener * on, knots.motion.whitened_transition * on, knots.motion.start_whitener * first


def _add_motion(normal: Normal, knots: Knots, joints: Joints, probe: Probe) -> None:
    p = len(normal.parameters)
    ahead, behind, first = _process(knots, joints.strength)
    back, forth, begin = (x.transpose(0, 2, 1) for x in (behind, ahead, first))
    for into, block in (
        (normal.diagonal[1:], forth @ ahead),
        (normal.diagonal[:-1], back @ behind),
        (normal.below, -forth @ behind),
        (normal.diagonal, begin @ first),
    ):
        for axis in range(3):
            of_axis = slice(3 + axis, STATES, 3)
            into[:, of_axis, of_axis] += block
    y = joints.motion.reshape(-1, ORDER, 3)
    drawn = (probe.motion * knots.joined[:, None, None], probe.start)
    for column, (step, start) in ((GRADIENT, (behind @ y[:-1] - ahead @ y[1:], -(first @ y))), (MOTION, drawn)):
        right = begin @ start
        right[1:] += forth @ step
        right[:-1] -= back @ step
        normal.right[:, 3:, p + column] += right.reshape(-1, 3 * ORDER)


def whitened_joints(knots: Knots, joints: Joints) -> Array:
    """Attitude jump and process noise of the translation over each interval, over their sd, (K−1, 3 + 9)."""
    jump = joints.jump * np.sqrt(knots.joined / (joints.walk * knots.interval_s))[:, None]
    return np.hstack([jump, whitened_motion(knots, joints.strength, joints.motion)[1:]])


def whitened_motion(knots: Knots, strength: float, motion: Array) -> Array:
    """Process noise of the translation into each knot, or the state itself at the first knot of a segment, over its sd:
    (K, 9) or (K, 9, p) like `motion`, in which it is linear."""
    ahead, behind, first = _process(knots, strength)
    y = motion.reshape(len(motion), ORDER, -1)
    out = first @ y
    out[1:] += ahead @ y[1:] - behind @ y[:-1]
    return out.reshape(motion.shape)


def joint_squares(knots: Knots, joints: Joints, state: Array, theta: Array, probe: Probe) -> Array:
    """(2, 3): for attitude jumps and for the translation, the sum s of the whitened squares, its expectation e = tr M,
    and tr M², for M = I − (the projection on what the unknowns can explain). ½(s − e) and ½ tr M² are score and
    information of the logarithm of the group's variance.

    `state` (K, s, c) and `theta` (p, c) are the responses of the unknowns to the right-hand sides: those to a group's
    probe z give e = zᵀMz and tr M² = ‖Mz‖²."""
    root = np.sqrt(knots.joined / (joints.walk * knots.interval_s))[:, None]
    by_jump, by_motion = state[..., JUMP], state[..., MOTION]
    left = probe.jump * knots.joined[:, None]
    left = left - root * (by_jump[1:, :3] - by_jump[:-1, :3] - joints.moved @ theta[:, JUMP])
    ahead, behind, first = _process(knots, joints.strength)
    y, dy = (x.reshape(-1, ORDER, 3) for x in (joints.motion, by_motion[:, 3:]))
    drawn = probe.motion * knots.joined[:, None, None], probe.start * np.r_[True, ~knots.joined][:, None, None]
    steps, starts = drawn[0] - (ahead @ dy[1:] - behind @ dy[:-1]), drawn[1] - first @ dy
    square = np.sum((ahead @ y[1:] - behind @ y[:-1]) ** 2) + np.sum((first @ y) ** 2)
    return np.array(
        [
            [np.sum((root * joints.jump) ** 2), np.sum(probe.jump * left), np.sum(left**2)],
            [square, np.sum(drawn[0] * steps) + np.sum(drawn[1] * starts), np.sum(steps**2) + np.sum(starts**2)],
        ]
    )


@dataclass(frozen=True)
class Probe:
    """Fixed random signs, one for each residual: passed through the fit they measure how many degrees of freedom of
    each group of residuals the unknowns absorb (Monte-Carlo variance components: García-Cortés et al. 1992, Kusche
    2003).

    `bridge` is the attitude error that gyroscope noise of unit density about each body axis leaves at every row, zero
    at the knots on either side (a Brownian bridge)."""

    sensors: Array  # (n, rows)
    jump: Array  # (K−1, 3)
    motion: Array  # (K−1, 3, 3)
    start: Array  # (K, 3, 3)
    bridge: Array  # (n, 3), √s

    @classmethod
    def draw(cls, knots: Knots, t: Array, at: np.ndarray, rows: int, *, seed: int = 0) -> Probe:
        """For `rows` residuals at each of the samples `at` (m,) of `t` (n,)."""
        rng = np.random.default_rng(seed)
        k = len(knots.index)
        shapes = ((len(at), rows), (k - 1, 3), (k - 1, ORDER, 3), (k, ORDER, 3), (len(t), 3))
        sensors, jump, motion, start, noise = (rng.integers(0, 2, shape) * 2.0 - 1.0 for shape in shapes)
        steps = 0.5 * (noise[1:] + noise[:-1]) * np.sqrt(np.diff(t))[:, None]  # trapezoidal, like the attitude
        walked = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        knot, share = knots.of_sample[at], knots.share[at, None]
        after = np.minimum(knot + 1, k - 1)
        bridge = walked[at] - (1.0 - share) * walked[knots.index[knot]] - share * walked[knots.index[after]]
        return cls(sensors, jump, motion, start, bridge * np.r_[knots.joined, False][knot, None])
