"""The VPS clock to a tenth of a millisecond: the magnetometer turns with the vehicle and has less noise than rates.

With the VPS's attitude the field in sensor axes is determined except for constants: every logged component is linear in
the nine elements of A(q_vps), whatever the triad's calibration, the mounting and the local field. So nothing estimated
before can move the lag, neither an attitude that translation has spoiled nor a wrong constant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation.clock_sync.by_rates import SyncFit
from fieldcal.estimation.motion_selection import contiguous
from fieldcal.estimation.robust import reweighted
from fieldcal.estimation.smoothing import differentiate_samples
from fieldcal.estimation.statistics import huber_inflation, least_squares_covariance, robust_sigma
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import Array, body_from_inertial, body_rate, continuous, hermite

RATE_WINDOW_S, SHORTEST_BLOCK = 0.03, 12
MIN_READINGS = 200
MAX_ITERATIONS = 12
REGRESSION_ROUNDS = 3  # of reweighting, at each step of the clock
ELEMENTS = 10  # of A(q), and the bias
# χ²₂ of the difference to the gyroscope's clock: by chance one flight in a thousand.
AGREEMENT = 13.8


@dataclass(frozen=True)
class FieldClock:
    """Lag at mid-record, s, and skew by one vector triad, their covariance (2, 2), and χ²₂ of its difference to the
    gyroscope's."""

    lag_mid_s: float
    skew: float
    covariance: Array
    disagreement: float


def refine_by_field(
    t: ArrayLike, logged: ArrayLike, t_vps: ArrayLike, q_vps: ArrayLike, fit: SyncFit, *, max_gap_s: float = 0.05
) -> tuple[SyncFit, FieldClock | None]:
    """The gyroscope's lag and drift combined with the magnetometer's, each by its information.

    Parameters
    ----------
    t, logged : (n,), (n, 3) arrays
        Stamps, s, IMU clock, and readings of the magnetometer, any unit, not filtered; NaN where there is none.
    t_vps, q_vps : (m,), (m, 4) arrays
        VPS stamps on the VPS clock, s, and attitudes, outliers removed (`clock_sync.by_rates.mask_outliers`).
    fit : SyncFit
        From the rates: where to begin.

    Returns
    -------
    The combined fit, and the magnetometer's alone; None with too few readings. Where the two contradict each other
    (sensors with different filters: 11 ms were seen) the gyroscope's fit is returned as it was.

    Notes
    -----
    The lag contains the sensors' group delay, taken to be the same for both unless they contradict each other.
    `spread` stays the gyroscope's: what the VPS's bandwidth does to one clock, it does to the other.
    """
    by_field = _clock(np.asarray(t, float), np.asarray(logged, float), np.asarray(t_vps, float), q_vps, fit, max_gap_s)
    if by_field is None or by_field.disagreement > AGREEMENT:
        return fit, by_field
    gyro, field = np.linalg.inv(fit.covariance), np.linalg.inv(by_field.covariance)
    covariance = np.linalg.inv(gyro + field)
    lag, skewed = covariance @ (
        gyro @ [fit.lag_mid_s, 1e-6 * fit.skew_ppm] + field @ [by_field.lag_mid_s, by_field.skew]
    )
    return replace(fit, lag_mid_s=float(lag), skew_ppm=1e6 * float(skewed), covariance=covariance), by_field


def _clock(
    t: Array, logged: Array, t_vps: Array, q_vps: ArrayLike, fit: SyncFit, max_gap_s: float
) -> FieldClock | None:
    """Gauss–Newton on lag and skew, the linear coefficients eliminated at every step."""
    valid = np.isfinite(logged).all(axis=1)
    t, logged = t[valid], logged[valid]
    q = continuous(q_vps)
    rate = block_rates(t_vps, q, max_gap_s)
    lag, skewed = fit.lag_mid_s, 1e-6 * fit.skew_ppm
    for _ in range(MAX_ITERATIONS):
        at = (t - fit.reference_s) * (1 + skewed) + fit.reference_s - lag
        i = interval_of(t_vps, at)
        turning = np.column_stack([np.interp(at, t_vps, c) for c in rate.T])
        inside = (at >= t_vps[0]) & (at <= t_vps[-1]) & (t_vps[i + 1] - t_vps[i] <= max_gap_s)
        inside &= np.isfinite(turning).all(axis=1)
        if inside.sum() < MIN_READINGS:
            return None
        attitude = body_from_inertial(hermite(t_vps, q, rate, at[inside]))
        # Samples last: products with a weight for each go along the memory.
        a = np.ascontiguousarray(attitude.transpose(1, 2, 0))
        x = np.concatenate([a.reshape(9, -1), np.ones((1, a.shape[2]))])
        weight, coefficients, residual = _regressed(x, np.ascontiguousarray(logged[inside].T))
        # Ȧ = −S(ω)A; a later lag reads the VPS earlier.
        turn = np.ascontiguousarray(turning[inside].T)
        moved = np.stack([turn[k] * a[j] - turn[j] * a[k] for j, k in ((1, 2), (2, 0), (0, 1))])
        late = t[inside] - fit.reference_s
        root, deviation = np.sqrt(weight), np.std(residual, axis=1)[:, None]
        slope = coefficients[:9].T @ moved.reshape(9, -1) / deviation * root
        columns, weighted = np.stack([-slope, slope * late]), x * root
        flat = columns.reshape(6, -1)
        flat -= np.linalg.lstsq(weighted @ weighted.T, weighted @ flat.T, rcond=None)[0].T @ weighted
        e = residual / deviation * root
        by_clock = columns.reshape(2, -1)
        step = np.linalg.lstsq(by_clock @ by_clock.T, by_clock @ e.reshape(-1), rcond=1e-18)[0]
        lag, skewed = lag + float(step[0]), skewed + float(step[1])
        if abs(step[0]) < 1e-8 and abs(step[1]) < 1e-9:
            break
    _, covariance = least_squares_covariance(columns.transpose(2, 1, 0), e.T, nuisance=3 * ELEMENTS)
    covariance = covariance * huber_inflation(weight)
    difference = np.array([lag - fit.lag_mid_s, skewed - 1e-6 * fit.skew_ppm])
    total = covariance + fit.covariance + np.diag(fit.spread**2)
    disagreement = float(difference @ np.linalg.solve(total, difference))
    return FieldClock(lag, skewed, covariance, disagreement)


def block_rates(t: Array, q: Array, max_gap_s: float) -> Array:
    """Body rates (m, 3), rad/s, of VPS attitudes (m, 4), hemisphere continuous; NaN in blocks too short."""
    rate = np.full((len(t), 3), np.nan)
    for a, b in contiguous(t, max_gap_s):
        if b - a >= SHORTEST_BLOCK:
            rate[a:b] = body_rate(q[a:b], differentiate_samples(t[a:b], q[a:b], window_s=RATE_WINDOW_S))
    return rate


def _regressed(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """y (3, n) on x (m, n), robust: weights (n,), coefficients (m, 3), residuals (3, n)."""

    def solve(weight: Array) -> tuple[tuple[Array, Array], Array]:
        weighted = x * weight
        coefficients = np.linalg.lstsq(weighted @ x.T, weighted @ y.T, rcond=None)[0]
        residual = y - coefficients.T @ x
        sigma = np.array([robust_sigma(r) for r in residual])
        return (coefficients, residual), np.sqrt(np.sum((residual / sigma[:, None]) ** 2, axis=0))

    (coefficients, residual), weight = reweighted(solve, x.shape[1], rounds=REGRESSION_ROUNDS)
    return weight, coefficients, residual
