"""The VPS clock to a fraction of a millisecond: against the joint estimate's attitude instead of noisy rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.rotation import (
    Array,
    body_from_inertial,
    body_rate,
    conjugate,
    continuous,
    from_rotation_vector,
    multiply,
    slerp,
    to_rotation_vector,
)
from fieldcal.smoothing import differentiate_samples
from fieldcal.statistics import huber_inflation, huber_weights, least_squares_covariance, robust_sigma
from fieldcal.sync import SyncFit, align_frames

PAIR_S = 0.02  # VPS attitudes are compared about this far apart
MAX_PAIR_S = 0.03
MAX_ITERATIONS = 12


def refine_by_attitude(
    t_imu: ArrayLike, q_imu: ArrayLike, segment: np.ndarray, t_vps: ArrayLike, q_vps: ArrayLike, fit: SyncFit
) -> SyncFit:
    """Offset and drift by Gauss–Newton on r = log(world ⊗ q_vps ⊗ body ⊗ q_imu⁻¹), both constant rotations free.

    The estimate's attitude errs slowly, so neighbouring residuals are alike: each is taken less φ times the one before
    (first-order whitening, φ estimated), which leaves the fast differences that show a shift in time.

    Parameters
    ----------
    t_imu, q_imu : (n,), (n, 4) arrays
        Stamps, s, and estimated body attitudes, inertial NED.
    segment : (n,) array
        Contiguous stretches of them.
    t_vps, q_vps : (m,), (m, 4) arrays
        VPS stamps on its own clock, s, and attitudes, outliers removed.
    fit : SyncFit
        Where to begin: good to some milliseconds.
    """
    t, q = np.asarray(t_imu, dtype=float), continuous(q_imu)
    every = max(1, round(PAIR_S / float(np.median(np.diff(t_vps)))))
    clock, vps = np.asarray(t_vps, dtype=float)[::every], np.asarray(q_vps, dtype=float)[::every]
    rate = np.empty((len(t), 3))
    starts = np.flatnonzero(np.r_[True, segment[1:] != segment[:-1]])
    for a, b in zip(starts, np.r_[starts[1:], len(t)], strict=True):
        rate[a:b] = body_rate(q[a:b], differentiate_samples(t[a:b], q[a:b], window_s=0.03))
    lag, skew = fit.lag_mid_s, 1e-6 * fit.skew_ppm
    world = body = None
    for _ in range(MAX_ITERATIONS):
        at = (clock + lag - fit.reference_s) / (1 + skew) + fit.reference_s
        i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        inside = (at >= t[0]) & (at <= t[-1]) & (segment[i] == segment[i + 1])
        own, other = slerp(t, q, at)[inside], vps[inside]
        if world is None or body is None:
            world, body = align_frames(own, other)
        residual = to_rotation_vector(multiply(multiply(multiply(world, other), body), conjugate(own)))
        r_nb = body_from_inertial(own).transpose(0, 2, 1)
        body_w = np.column_stack([np.interp(at[inside], t, c) for c in rate.T])
        turning = np.einsum("nij,nj->ni", r_nb, body_w)
        # Of the residual's model: moving own attitude later by dt adds ω dt; rotations add w and R β.
        late = at[inside] - fit.reference_s
        world_columns = np.tile(np.eye(3), (len(own), 1, 1))
        columns = np.concatenate(
            [turning[..., None], -(turning * late[:, None])[..., None], -world_columns, -r_nb], axis=2
        )
        close = np.diff(clock[inside]) < MAX_PAIR_S
        phi = _correlation(residual, close)
        e = (residual[1:] - phi * residual[:-1])[close]
        s = (columns[1:] - phi * columns[:-1])[close]
        weight = huber_weights(np.linalg.norm(e, axis=1), robust_sigma(np.linalg.norm(e, axis=1)))
        root = np.sqrt(weight)[:, None]
        a, y = (s * root[..., None]).reshape(-1, 8), (e * root).reshape(-1)
        step = np.linalg.lstsq(a, y, rcond=1e-12)[0]
        lag, skew = lag + float(step[0]), skew + float(step[1])
        world = multiply(from_rotation_vector(step[2:5]), world)
        body = multiply(body, from_rotation_vector(step[5:8]))
        if abs(step[0]) < 1e-8 and abs(step[1]) < 1e-9:
            break
    _, covariance = least_squares_covariance(s * root[..., None], e * root)
    covariance = covariance[:2, :2] * huber_inflation(weight)
    first = np.array([1.0, fit.reference_s - float(t[0])])
    return replace(
        fit,
        lag_mid_s=lag,
        lag_s=lag + skew * (fit.reference_s - float(t[0])),
        lag_sd_s=float(np.sqrt(first @ covariance @ first)),
        skew_ppm=1e6 * skew,
        skew_sd_ppm=float(1e6 * np.sqrt(covariance[1, 1])),
    )


def _correlation(residual: Array, close: np.ndarray) -> float:
    """First-order autocorrelation of residuals (n, 3) over neighbours that are close in time."""
    centred = residual - np.median(residual, axis=0)
    before, after = centred[:-1][close], centred[1:][close]
    return float(np.clip(np.sum(before * after) / np.sum(before * before), 0.0, 0.99))
