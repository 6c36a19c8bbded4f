"""`fieldcal.fit_ellipsoid`: scale and bias of a triad that sensed a vector of known length, judged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation import ellipsoid
from fieldcal.estimation.ellipsoid import TriadFit
from fieldcal.estimation.ellipsoid_refusals import require_determined
from fieldcal.geometry.rotation import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, kw_only=True)
class EllipsoidFit(TriadFit):
    """A triad's constants z = Λ z_d + b and what is known of them.

    Attributes
    ----------
    scale : (3, 3) array
        Λ, unit of the magnitude per logged unit, diagonal but for method "li_full"; polarity in its sign.
    bias : (3,) array
        b, unit of the magnitude.
    covariance : (6, 6) array
        Of (λx, λy, λz, bx, by, bz), for residuals as coloured as they are; `covariance_white` as if they were white.
    residual_rms : float
        Rms of |z|/f − 1.
    condition : float
        Condition number of the column-normalised Jacobian: 1.6 for the whole sphere.
    n_samples, iterations : int
    share_used : float
        Mean robust weight.
    readings : (n, 3) array
        What was fitted, as logged.
    magnitude : float
        f.

    Examples
    --------
    >>> import numpy as np
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> fit = fieldcal.fit_ellipsoid(flight.counts["magnetometer"], 1.0, polarity=(1, 1, -1))
    >>> (fit.scale_sd / abs(fit.scale_diagonal)).round(3)
    array([0.011, 0.004, 0.004])
    >>> bool(abs(np.linalg.norm(fit.apply(flight.counts["magnetometer"]), axis=1) - 1.0).max() < 0.05)
    True
    """

    readings: Array = field(repr=False)
    magnitude: float

    @property
    def scale_sd(self) -> Array:
        """One standard deviation of (λx, λy, λz), (3,)."""
        return np.sqrt(np.diagonal(self.covariance)[:3])

    @property
    def bias_sd(self) -> Array:
        """One standard deviation of b, (3,)."""
        return np.sqrt(np.diagonal(self.covariance)[3:])

    def plot(self) -> list[Axes]:
        """How far the calibrated length is off at each reading, and which directions were sensed."""
        from fieldcal.plots.sphere import plot_sphere

        return plot_sphere(self.apply(self.readings), self.magnitude, f"Ellipsoid fit, {self.n_samples} readings")


def fit_ellipsoid(
    measured: ArrayLike,
    magnitude: float,
    *,
    method: str = "robust",
    polarity: ArrayLike = (1.0, 1.0, 1.0),
    max_scale_sd: float = 0.05,
    max_condition: float = 50.0,
    max_residual: float = 0.1,
) -> EllipsoidFit:
    """Estimate triad scale and bias from readings of a vector of known length.

    Turned through many attitudes without other acceleration, an ideal triad draws a sphere of radius `magnitude`; scale
    and bias turn it into an axis-aligned ellipsoid, z = Λ z_d + b (Eq. 5). The fit is Li and Griffiths' constrained
    eigenproblem (Eq. 6–8, with the θ10 term corrected), then a robust refinement in logged units, which also gives the
    covariance. A fit that the readings do not determine is refused, as in the pipeline; infinite limits accept any.

    Parameters
    ----------
    measured : (n, 3) array
        Logged readings z_d, any one unit, sensor axes, finite; n > 9. Keep only samples where gravity (or the local
        field) dominates: this function does not select. Give "robust" *unsmoothed* readings.
    magnitude : float
        Length f of the sensed vector, in the unit wanted for the result. Positive.
    method : {"robust", "li", "li_full", "two_step", "tls"}
        The refinement, or an algebraic fit alone; "li_full" has cross-axis terms.
    polarity : (3,) of ±1
        Sign of each scale.
    max_scale_sd : float
        Greatest relative standard deviation of a scale.
    max_condition : float
        Greatest condition number of the column-normalised Jacobian.
    max_residual : float
        Greatest rms of \\|z\\|/f − 1.

    Returns
    -------
    EllipsoidFit

    Raises
    ------
    ValueError
        Wrong shape, non-finite reading, non-positive `magnitude`, unknown method: the caller's error.
    UnusableFlight
        `ellipsoid_degenerate`: the readings do not curve like an ellipsoid at all (single attitude, plane).
        `too_little_motion`, `scale_uncertain`, `not_a_sphere`: beyond a limit. `err.measured` has the numbers.
    EstimationError
        `ellipsoid_diverged`: enough information, yet no minimum was reached.

    Notes
    -----
    Lengths cannot see a rotation of the triad nor the sign of a scale: polarity is configuration.

    References
    ----------
    Li & Griffiths (2004); Gebre-Egziabher et al. (2001, 2007); Grauer et al., AIAA 2009-2064, Eq. 6–8 (corrected).

    Examples
    --------
    >>> import numpy as np
    >>> import fieldcal
    >>> u = np.random.default_rng(1).normal(size=(100, 3))
    >>> sphere = u / np.linalg.norm(u, axis=1, keepdims=True)
    >>> fit = fieldcal.fit_ellipsoid((sphere - 0.2) / 1e-4, 1.0)
    >>> bool(np.allclose(fit.scale_diagonal, 1e-4) and np.allclose(fit.bias, 0.2))
    True
    >>> fieldcal.fit_ellipsoid(sphere[sphere[:, 2] > 0.5], 1.0, max_condition=5.0)
    Traceback (most recent call last):
    ...
    fieldcal.errors.UnusableFlight: Too little of the sphere was seen: ...
    """
    z = np.asarray(measured, dtype=float)
    fit = ellipsoid.fit_ellipsoid(z, magnitude, method=method, polarity=polarity)
    require_determined(fit, max_condition=max_condition, max_scale_sd=max_scale_sd, max_residual=max_residual)
    return EllipsoidFit(**vars(fit), readings=z, magnitude=float(magnitude))
