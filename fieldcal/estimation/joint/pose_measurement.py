"""The VPS attitude as a measurement in the joint estimate (`use_vps`): poses at the knots.

The residual at a knot is r = log(world ⊗ q_vps ⊗ body ⊗ q⁻¹), with the VPS interpolated at the knot's time on the VPS
clock. Estimated with the triads' constants are the clock's lag and skew and both constant rotations (so a reference
that is level or north only to a degree is no worse). The error of the integrated gyroscope is then judged against poses
instead of two noisy vectors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldcal.estimation.clock_sync.by_field import block_rates
from fieldcal.estimation.clock_sync.by_rates import SyncFit, align_frames
from fieldcal.estimation.joint.chain_solver import GRADIENT, Normal
from fieldcal.estimation.joint.problem import OPTIONAL, Model, State, Trajectory
from fieldcal.estimation.statistics import robust_sigma, white_noise_sigma
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import (
    IDENTITY,
    Array,
    body_from_inertial,
    conjugate,
    continuous,
    from_rotation_vector,
    hermite,
    multiply,
    to_rotation_vector,
)

PARAMETERS = ("vps_clock", "vps_world", "vps_body")
LEAST_SIGMA_RAD = 2e-5
# A pose is not used where second differences of VPS minus gyroscope between knots exceed so many robust sd.
OUTLIER_SD = 6.0
MIN_POSES = 30  # at knots; with fewer the VPS is not used


@dataclass(frozen=True)
class VpsRecord:
    """VPS poses for the joint estimate.

    `t` (m,) s, VPS clock; `q` (m, 4) attitude, inertial NED, of the sensor axes but for constant rotations near the
    identity; `rate` (m, 3) its body rate, rad/s, to interpolate with; `max_gap_s` longest gap interpolated over;
    `clock` start of the VPS clock's estimate; `world`, `body` (4,) start of the constant rotations; `used` (K,) knots
    whose pose is used; `sigma_rad` noise of a pose, an axis."""

    t: Array
    q: Array
    rate: Array
    max_gap_s: float
    clock: SyncFit
    world: Array
    body: Array
    used: np.ndarray
    sigma_rad: float

    @classmethod
    def of(
        cls, t: Array, q: Array, clock: SyncFit, model: Model, state: State, path: Trajectory, *, max_gap_s: float
    ) -> VpsRecord | None:
        """The record for a model and its start; None where fewer than MIN_POSES knots have a pose. Poses that
        contradict both their neighbours and the gyroscope are left out."""
        q = continuous(q)
        turned = to_rotation_vector(multiply(q[1:], conjugate(q[:-1])))
        noise = float(np.max(white_noise_sigma(np.cumsum(turned, axis=0))))
        every = np.ones(len(model.knots.index), dtype=bool)
        record = cls(t, q, block_rates(t, q, max_gap_s), max_gap_s, clock, IDENTITY, IDENTITY, every, noise)
        at_knots, available = record._read(model, np.zeros(2))
        if available.sum() < MIN_POSES:
            return None
        start = state.q
        world, body = align_frames(start[available], at_knots[available])
        record = replace(record, world=world, body=body, sigma_rad=max(noise, LEAST_SIGMA_RAD))
        return replace(record, used=available & ~record._outliers(model, path, start, at_knots, available))

    def _outliers(
        self, model: Model, path: Trajectory, start: Array, at_knots: Array, available: np.ndarray
    ) -> np.ndarray:
        """Knots whose pose jumps away from the integrated gyroscope and back."""
        turned = multiply(multiply(self.world, at_knots), self.body)
        # Difference to the attitude of the start without its jumps between knots: to the integrated gyroscope.
        error = to_rotation_vector(multiply(turned, conjugate(start)))
        gone = np.r_[np.zeros((1, 3)), np.cumsum(path.jump, axis=0)]
        second = np.diff(error + gone, n=2, axis=0)
        whole = available[:-2] & available[1:-1] & available[2:] & model.knots.joined[:-1] & model.knots.joined[1:]
        length = np.linalg.norm(second, axis=1)
        bad = np.zeros(len(start), dtype=bool)
        limit = OUTLIER_SD * robust_sigma(length[whole]) if whole.any() else np.inf
        suspect = whole & (length > limit)
        # A wrong pose shows in three second differences, in the middle one most.
        score = np.r_[0.0, np.where(suspect, length, 0.0), 0.0]
        bad[1:-1] = suspect & (score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:])
        return bad

    def at_knots(self, model: Model, state: State, path: Trajectory) -> VpsRecord | None:
        """The same record for the knots of another model; clock and mounting start from this one's."""
        return VpsRecord.of(self.t, self.q, self.clock, model, state, path, max_gap_s=self.max_gap_s)

    def start(self) -> dict[str, Array]:
        """Start of the parameters: zero corrections to `clock`, `world` and `body`."""
        return {name: np.zeros(OPTIONAL[name]) for name in PARAMETERS}

    def clock_of(self, values: Mapping[str, Array]) -> tuple[float, float]:
        """Estimated lag at mid-record, s, and skew (a ratio)."""
        lag, skew = values["vps_clock"]
        return self.clock.lag_mid_s + float(lag), 1e-6 * self.clock.skew_ppm + float(skew)

    def mounting(self, values: Mapping[str, Array]) -> Array:
        """Estimated rotation (4,) between the VPS's body axes and the triads'."""
        return multiply(self.body, from_rotation_vector(values["vps_body"]))

    def world_rotation(self, values: Mapping[str, Array]) -> Array:
        """Estimated rotation (4,) from the VPS's world to the fit's."""
        return multiply(from_rotation_vector(values["vps_world"]), self.world)

    def to_imu_clock(self, t: Array, values: Mapping[str, Array]) -> Array:
        """VPS stamps, s, on the IMU's clock."""
        lag, skew = self.clock_of(values)
        return replace(self.clock, lag_mid_s=lag, skew_ppm=1e6 * skew).to_imu_clock(t)

    def _read(self, model: Model, correction: Array) -> tuple[Array, np.ndarray]:
        """VPS attitude at the knots (K, 4), and which of them lie between poses no more than `max_gap_s` apart."""
        lag, skew = self.clock_of({"vps_clock": correction})
        middle = self.clock.reference_s
        at = (model.readings.t[model.knots.index] - middle) * (1 + skew) + middle - lag
        i = interval_of(self.t, at)
        available = (at >= self.t[0]) & (at <= self.t[-1]) & (self.t[i + 1] - self.t[i] <= self.max_gap_s)
        return hermite(self.t, self.q, self.rate, at), available

    def residual(self, model: Model, state: State) -> tuple[Array, np.ndarray]:
        """VPS less estimate (K, 3), rad, inertial axes; and which knots count (K,)."""
        q, available = self._read(model, state.values["vps_clock"])
        world = self.world_rotation(state.values)
        body = self.mounting(state.values)
        error = to_rotation_vector(multiply(multiply(multiply(world, q), body), conjugate(state.q)))
        return error, available & self.used

    def sensitivity(self, model: Model, state: State, path: Trajectory, layout: Mapping[str, slice], p: int) -> Array:
        """Minus ∂(residual)/∂θ, (K, 3, p)."""
        samples = model.knots.index
        r_nb = body_from_inertial(state.q).transpose(0, 2, 1)
        turning = np.einsum("kij,kj->ki", r_nb, path.rate[samples])
        late = model.readings.t[samples] - self.clock.reference_s
        out = np.zeros((len(samples), 3, p))
        out[:, :, layout["vps_clock"]] = np.stack([turning, -turning * late[:, None]], axis=2)
        out[:, :, layout["vps_world"]] = -np.eye(3)
        out[:, :, layout["vps_body"]] = -r_nb
        return out

    def add(self, normal: Normal, model: Model, state: State, path: Trajectory, layout: Mapping[str, slice]) -> None:
        """Add the poses to the normal equations."""
        p = len(normal.parameters)
        residual, available = self.residual(model, state)
        weight = available / self.sigma(residual[available]) ** 2
        g = self.sensitivity(model, state, path, layout, p)
        weighted = g * weight[:, None, None]
        normal.diagonal[:, range(3), range(3)] += weight[:, None]
        normal.right[:, :3, :p] += weighted
        normal.right[:, :3, p + GRADIENT] += residual * weight[:, None]
        flat = g.reshape(-1, p)
        normal.parameters += flat.T @ weighted.reshape(-1, p)
        normal.parameters_right[:, GRADIENT] += weighted.reshape(-1, p).T @ residual.reshape(-1)

    def whitened(
        self, model: Model, state: State, path: Trajectory, layout: Mapping[str, slice], response: Array
    ) -> tuple[Array, Array]:
        """Sensitivities (K, 3, p), knots eliminated by their `response` (K, s, p) to the parameters, and residuals
        (K, 3), both over the noise; 0 where no pose counts."""
        residual, available = self.residual(model, state)
        root = (available / self.sigma(residual[available]))[:, None]
        left = self.sensitivity(model, state, path, layout, response.shape[2]) - response[:, :3]
        return left * root[..., None], residual * root

    def sigma(self, residual: Array) -> float:
        """Noise of a pose, rad an axis: that from sample to sample or, where larger, that of the residuals (k, 3) that
        count."""
        return max(self.sigma_rad, robust_sigma(residual))
