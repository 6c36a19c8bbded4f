"""Fit metrics: Theil's inequality coefficient (Eq. 16) with its parts, and the physical units beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.geometry.rotation import angle_between


@dataclass(frozen=True)
class Fit:
    """TIC in [0, 1], its bias, variance and covariance shares (sum 1; NaN for a perfect fit), rms error and sample
    count."""

    tic: float
    bias: float
    variance: float
    covariance: float
    rms: float
    n_samples: int


def theil(measured: ArrayLike, model: ArrayLike) -> Fit:
    """TIC of outputs (n, m) against measurements (n, m) (Eq. 16), summed over channels.

    The parts split the mean square error: difference of means, of standard deviations, and lack of correlation.
    `rms` is that of the length of the error, in the outputs' unit.

    Raises ValueError on shapes that differ or no samples.
    """
    z, y = np.asarray(measured, dtype=float), np.asarray(model, dtype=float)
    if z.shape != y.shape or z.ndim != 2 or len(z) == 0:
        raise ValueError(f"measured and model must be the same (n, m) with n ≥ 1, got {z.shape} and {y.shape}")
    # Channels by rows: sums over one run through memory.
    z, y = np.ascontiguousarray(z.T), np.ascontiguousarray(y.T)
    error = z - y
    mean_square = float(np.mean(error * error))
    scale = float(np.sqrt(np.mean(y * y)) + np.sqrt(np.mean(z * z)))
    mean_z, mean_y = z.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    bias = (mean_z - mean_y) ** 2
    from_z, from_y = z - mean_z, y - mean_y
    sz, sy = np.sqrt(np.mean(from_z * from_z, axis=1)), np.sqrt(np.mean(from_y * from_y, axis=1))
    variance = (sz - sy) ** 2
    covariance = 2 * (sz * sy - np.mean(from_z * from_y, axis=1))
    total = mean_square * len(z)
    share = [float(np.sum(v)) / total if total > 0 else float("nan") for v in (bias, variance, covariance)]
    tic = float(np.sqrt(mean_square)) / scale if scale > 0 else 0.0
    return Fit(tic, share[0], share[1], share[2], float(np.sqrt(total)), z.shape[1])


def theil_attitude(measured: ArrayLike, model: ArrayLike) -> Fit:
    """TIC of unit quaternions (n, 4), scalar last, with `rms` the rotation angle in **degrees**.

    The model is put on the measurement's hemisphere. The coefficient flatters: TIC ≈ α_rms/4 for an error α in rad."""
    z, y = np.asarray(measured, dtype=float), np.array(model, dtype=float)
    y[np.sum(z * y, axis=1) < 0] *= -1.0
    fit = theil(z, y)
    degrees = float(np.degrees(np.sqrt(np.mean(angle_between(z, y) ** 2))))
    return Fit(fit.tic, fit.bias, fit.variance, fit.covariance, degrees, fit.n_samples)
