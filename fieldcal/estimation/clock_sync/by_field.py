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
from fieldcal.geometry.rotation import Array, body_from_inertial, body_rate, continuous, hermite, skew

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
        x = np.column_stack([attitude.reshape(-1, 9), np.ones(len(attitude))])
        weight, coefficients, residual = _regressed(x, logged[inside])
        # Ȧ = −S(ω)A; a later lag reads the VPS earlier.
        slope = (-skew(turning[inside]) @ attitude).reshape(-1, 9) @ coefficients[:9]
        late = t[inside] - fit.reference_s
        columns = np.stack([-slope, slope * late[:, None]], axis=2) / np.std(residual, axis=0)[:, None]
        root = np.sqrt(weight)[:, None]
        flat, weighted = columns.reshape(len(x), 6) * root, x * root
        flat = flat - weighted @ np.linalg.lstsq(weighted, flat, rcond=1e-10)[0]
        sensitivity, e = flat.reshape(len(x), 3, 2), residual / np.std(residual, axis=0) * root
        step = np.linalg.lstsq(sensitivity.reshape(-1, 2), e.reshape(-1), rcond=1e-14)[0]
        lag, skewed = lag + float(step[0]), skewed + float(step[1])
        if abs(step[0]) < 1e-8 and abs(step[1]) < 1e-9:
            break
    _, covariance = least_squares_covariance(sensitivity, e, nuisance=3 * ELEMENTS)
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
    """y (n, 3) on x (n, m), robust: weights (n,), coefficients (m, 3), residuals (n, 3)."""

    def solve(weight: Array) -> tuple[tuple[Array, Array], Array]:
        root = np.sqrt(weight)[:, None]
        coefficients = np.linalg.lstsq(x * root, y * root, rcond=1e-10)[0]
        residual = y - x @ coefficients
        return (coefficients, residual), np.linalg.norm(residual / [robust_sigma(r) for r in residual.T], axis=1)

    (coefficients, residual), weight = reweighted(solve, len(x), rounds=REGRESSION_ROUNDS)
    return weight, coefficients, residual
