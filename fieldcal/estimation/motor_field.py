"""The magnetic field of motors and their wires: does the magnetometer's length go with the current?

A current I along fixed wires adds the field k I to every reading, k fixed in sensor axes. At one attitude only its part
along the local field changes the length; a manoeuvre shows all three. Whatever a constant ellipsoid can explain (hard
and soft iron that the calibration left) is fitted beside k, so that it is not taken for the current's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import fdtrc

from fieldcal.estimation.faults import Fault
from fieldcal.estimation.statistics import independent_samples, least_squares_covariance
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

REPORTED_SHARE = 0.02
"""Share of the local field, about 1° of heading, that the current's field may reach before it is reported."""

FATAL_SHARE = 0.10
"""Share beyond which no constant hard iron describes the magnetometer: about 6° of heading."""

SIGNIFICANT_P = 1e-4
"""Probability, without any influence of the current, of a slope as large as the one found."""

FEWEST_SAMPLES = 100
SPAN_PERCENTILES = (1.0, 99.0)
"""Percentiles between which the current is said to range: a spike is no range."""

ELLIPSOID_PARAMETERS = 9
"""Parameters of the constant ellipsoid: symmetric matrix and offset."""

MAX_ITERATIONS = 50

SMALLEST_SINGULAR_VALUE = 1e-3
"""Relative singular value of the regression below which a combination of parameters is left at 0: the flight did not
show it."""

CONVERGED_STEP, LARGEST_PARAMETER = 1e-6, 10.0
"""Last step and largest parameter, in local fields, of a solution."""

COMPONENT_SD, FATAL_SD = 3.0, 2.0
"""A component counts from so many sd on; a share refuses when it is so many sd beyond `FATAL_SHARE`."""


@dataclass(frozen=True)
class MotorField:
    """What the current adds to the field.

    `slope` (3,): field per unit of drive, sensor axes, in the field's unit; `slope_sd` (3,). `span`: range of the
    drive (1st to 99th percentile). `share`: length of slope times span over the local field, of its components along
    the covariance's principal axes only those beyond three sd; `share_sd`. `correlation`: of the length's residual with
    the part that the drive explains, constant ellipsoid taken out of both; `independent`: how many independent samples
    the residual is worth; `p_value`: of slope = 0.
    """

    slope: Array
    slope_sd: Array
    span: float
    share: float
    share_sd: float
    correlation: float
    independent: float
    p_value: float


def motor_field(field: ArrayLike, drive: ArrayLike, strength: float) -> MotorField | None:
    """Field per unit of current (or throttle) from the length of the calibrated magnetometer.

    |(1 + S) h + b − k u| = f is solved for the symmetric S, b and k, u the drive less its mean, by repeated regression
    on directions e alone: eᵀS e + b·e − u k·e. (Least squares over S proper has its minimum at S = −1, where no reading
    is left: the derivative e·h contains the residual itself.) k is tested with Wald's F under the covariance of
    coloured residuals (`statistics`), its denominator the independent samples less the twelve parameters.

    Parameters
    ----------
    field : (n, 3) array
        Calibrated readings h in sensor axes, in order of time.
    drive : (n,) array
        Current or throttle at the same times; its unit is the slope's.
    strength : float
        f, length of the local field, in the unit of `field`.

    Returns
    -------
    MotorField or None
        None where nothing can be said: fewer than 100 samples, readings that are not finite, a drive that stands, or a
        fit that does not converge.
    """
    h, u = np.asarray(field, dtype=float) / strength, np.asarray(drive, dtype=float)
    if len(h) < FEWEST_SAMPLES or not np.isfinite(h).all():
        return None
    low, high = np.percentile(u, SPAN_PERCENTILES)
    span = float(high - low)
    if span <= 0.0:
        return None
    u = (u - u.mean()) / span
    theta = np.zeros(ELLIPSOID_PARAMETERS + 3)
    for _ in range(MAX_ITERATIONS):
        residual, jacobian = _residual(h, u, theta)
        step = np.linalg.lstsq(jacobian, residual, rcond=SMALLEST_SINGULAR_VALUE)[0]
        theta = theta - step
        if np.abs(step).max() < CONVERGED_STEP or not np.abs(theta).max() < LARGEST_PARAMETER:
            break
    if not (np.abs(step).max() < CONVERGED_STEP and np.abs(theta).max() < LARGEST_PARAMETER):
        return None
    residual, jacobian = _residual(h, u, theta)
    covariance = least_squares_covariance(jacobian[:, None, :], residual[:, None])[1][
        ELLIPSOID_PARAMETERS:, ELLIPSOID_PARAMETERS:
    ]
    k, independent = theta[ELLIPSOID_PARAMETERS:], independent_samples(residual)
    variance, axes = np.linalg.eigh(covariance)
    sd = np.sqrt(np.maximum(variance, 0.0))
    part = np.where(np.abs(k @ axes) > COMPONENT_SD * sd, k @ axes, 0.0)
    share = float(np.linalg.norm(part))
    wald = float(k @ np.linalg.pinv(covariance, hermitian=True) @ k) / 3.0
    return MotorField(
        slope=k * strength / span,
        slope_sd=np.sqrt(np.diagonal(covariance)) * strength / span,
        span=span,
        share=share,
        share_sd=float(np.linalg.norm(part * sd)) / share if share > 0.0 else 0.0,
        correlation=_correlation(residual, jacobian, k),
        independent=independent,
        p_value=float(fdtrc(3.0, max(independent - len(theta), 1.0), wald)),
    )


def _residual(h: Array, u: Array, theta: Array) -> tuple[Array, Array]:
    """|h(θ)| − 1, (n,), and its regressors (n, 12); θ: S xx yy zz xy xz yz, b, k, in units of f and of the span."""
    xx, yy, zz, xy, xz, yz = theta[:6]
    soft = np.eye(3) + np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    corrected = h @ soft.T + theta[6:9] - u[:, None] * theta[9:]
    length = np.linalg.norm(corrected, axis=1)
    e = corrected / np.maximum(length, np.finfo(float).tiny)[:, None]
    crossed = [2.0 * e[:, i] * e[:, j] for i, j in ((0, 1), (0, 2), (1, 2))]
    return length - 1.0, np.column_stack([e * e, *crossed, e, -u[:, None] * e])


def _correlation(residual: Array, jacobian: Array, k: Array) -> float:
    """Multiple correlation with the drive's three columns once the constant ellipsoid is out of everything."""
    y = residual - jacobian[:, ELLIPSOID_PARAMETERS:] @ k  # what the residual would be without k
    constant = jacobian[:, :ELLIPSOID_PARAMETERS]
    left = y - constant @ np.linalg.lstsq(constant, y, rcond=None)[0]
    total = float(left @ left)
    return float(np.sqrt(max(0.0, 1.0 - float(residual @ residual) / total))) if total > 0.0 else 0.0


def motor_fault(found: MotorField, drive: str, drive_unit: str, field_unit: str) -> Fault | None:
    """The fault that a `MotorField` is: None unless it is significant and beyond the share that is reported; fatal
    where it is surely beyond `FATAL_SHARE`. Units are words for the sentence."""
    if found.p_value > SIGNIFICANT_P or found.share <= REPORTED_SHARE:
        return None
    fatal = found.share - FATAL_SD * found.share_sd > FATAL_SHARE
    slope = ", ".join(f"{v:.3g}" for v in found.slope)
    slope_unit = ("local fields" if field_unit == "norm" else field_unit) + f" per {drive_unit or f'full {drive}'}"
    sentence = (
        f"The magnetometer's field goes with the {drive}: by {100 * found.share:.1f} % of the local field"
        f" (sd {100 * found.share_sd:.1f} %) over its range of {found.span:.3g}{drive_unit and ' ' + drive_unit},"
        f" ({slope}) {slope_unit} along x, y, z (correlation {found.correlation:.2f},"
        f" {found.independent:.0f} independent samples). "
        + ("No constant calibration describes it. " if fatal else "")
        + "Move the magnetometer away from the power wires, or twist them."
    )
    return Fault(
        "magnetometer",
        "",
        ReasonCode.MOTOR_FIELD,
        found.share,
        FATAL_SHARE if fatal else REPORTED_SHARE,
        fatal,
        sentence,
    )
