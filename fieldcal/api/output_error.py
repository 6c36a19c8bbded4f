"""`fieldcal.fit_output_error`: a gyroscope's constants from measured attitudes, judged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.gyroscope import output_error
from fieldcal.estimation.gyroscope.equation_error import GyroFit
from fieldcal.estimation.joint.initialise import gyro_from_attitude
from fieldcal.geometry.rotation import Array, continuous
from fieldcal.reason_codes import ReasonCode

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, kw_only=True)
class OutputErrorFit(GyroFit):
    """A gyroscope's constants ω = λ∘ω_d + b and what is known of them.

    Attributes
    ----------
    scale : (3,) array
        λ, rad/s per logged unit.
    bias : (3,) array
        b, rad/s.
    covariance : (6, 6) array
        Of (λ, b), for residuals as coloured as they are; `covariance_white` as if they were white.
    residual_rms : float
        Rms attitude error angle, rad.
    n_samples, iterations : int
    t : (n,) array
        Stamps, s.
    attitude_error : (n, 3) array
        Rotation from the integrated to the measured attitude, rad, inertial axes.
    rate : (n, 3) array
        Calibrated rates, rad/s.
    stretch : (n,) array
        Numbers of the stretches that were integrated from one initial attitude.

    Examples
    --------
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> fit = fieldcal.fit_output_error(flight.t, flight.q, flight.counts["gyroscope"])
    >>> (fit.scale_sd / abs(fit.scale)).round(3)
    array([0.004, 0.004, 0.003])
    """

    t: Array = field(repr=False)
    attitude_error: Array = field(repr=False)
    rate: Array = field(repr=False)
    stretch: Array = field(repr=False)

    @property
    def scale_sd(self) -> Array:
        """One standard deviation of λ, (3,)."""
        return np.sqrt(np.diagonal(self.covariance)[:3])

    @property
    def bias_sd(self) -> Array:
        """One standard deviation of b, (3,), rad/s."""
        return np.sqrt(np.diagonal(self.covariance)[3:])

    def apply(self, logged: ArrayLike) -> Array:
        """Calibrated rates (n, 3), rad/s, of logged ones (n, 3)."""
        return np.asarray(logged, dtype=float) * self.scale + self.bias

    def plot(self) -> list[Axes]:
        """The calibrated rates, and by how much their integral misses the measured attitude."""
        from fieldcal.plots.attitude import plot_attitude_error

        title = f"Output error, {np.degrees(self.residual_rms):.2g}° rms"
        return plot_attitude_error(self.t, self.rate, self.attitude_error, self.stretch, title)


def fit_output_error(
    t: ArrayLike,
    q: ArrayLike,
    rate_logged: ArrayLike,
    *,
    start: GyroFit | None = None,
    segment: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    stretch_s: float = 15.0,
    initial_attitude: str = "estimated",
    max_scale_sd: float = 0.05,
) -> OutputErrorFit:
    """Estimate gyroscope scale and bias by integrating the rates and matching measured attitudes.

    q̇ = ½ Ξ(q) ω with ω = λ∘ω_d + b (Eq. 5, 10) is integrated with the real stamps over stretches of at most
    `stretch_s`; Gauss–Newton moves λ and b until the attitude error log(q ⊗ q_model⁻¹) is least. Each stretch's initial
    attitude is eliminated, so that what gyroscope noise does to a long integral does not count as scale.

    Parameters
    ----------
    t : (n,) array
        Real stamps, s, rising.
    q : (n, 4) array
        Measured attitude, NED to the gyroscope's axes, scalar last, from any source.
    rate_logged : (n, 3) array
        Gyroscope as logged, ω_d, any unit, finite.
    start : GyroFit, optional
        Where to begin; else equation error (Eq. 11) on both sides low-passed alike.
    segment : (n,) array, optional
        Numbers of contiguous stretches; nothing is integrated across a boundary.
    weights : (n,) array, optional
        Relative trust in each attitude.
    stretch_s : float
        Longest integration from one initial attitude, s.
    initial_attitude : {"estimated", "fixed"}
        "fixed" starts each stretch at its first measured attitude (the paper).
    max_scale_sd : float
        Greatest relative standard deviation of a scale that is accepted.

    Returns
    -------
    OutputErrorFit

    Raises
    ------
    ValueError
        Wrong shapes: the caller's error.
    UnusableFlight
        `gyro_not_excited`: an axis did not turn. `scale_uncertain`: beyond `max_scale_sd`; `err.measured` has the
        numbers.
    EstimationError
        `output_error_diverged`: the integrated gyroscope never came near the attitude.

    Notes
    -----
    The attitude's own errors count as noise; what moves with the motion itself (a wrong magnetometer scale behind `q`)
    cannot be seen here and is not in the covariance. Numbers are not those of the pipeline to the last digit, whose
    start and stretches come from its own stages.

    References
    ----------
    Grauer et al., AIAA 2009-2064, Eq. 10–15.

    Examples
    --------
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> fit = fieldcal.fit_output_error(flight.t, flight.q, flight.counts["gyroscope"])
    >>> (fit.scale / flight.experiment.scale["gyroscope"]).round(2)
    array([1.  , 0.99, 1.  ])
    """
    t, q, logged = np.asarray(t, dtype=float), continuous(q), np.asarray(rate_logged, dtype=float)
    own = np.zeros(len(t), dtype=np.int64) if segment is None else np.asarray(segment)
    if q.shape != (len(t), 4) or logged.shape != (len(t), 3) or len(own) != len(t):
        raise ValueError(f"(n,), (n, 4), (n, 3) wanted, got {t.shape}, {q.shape}, {logged.shape}")
    if not (np.ptp(logged, axis=0) > 0.0).all():  # its scale would be anything, and its sd nothing
        raise UnusableFlight(
            ReasonCode.GYRO_NOT_EXCITED, "A gyroscope axis reads one constant value: stuck, or never turned."
        )
    begin = gyro_from_attitude(t, own, logged, q) if start is None else start
    fit = output_error.fit_output_error(
        t,
        q,
        logged,
        begin,
        segment=own,
        stretch_s=stretch_s,
        initial_attitude=initial_attitude,
        weights=weights,
        robust=initial_attitude == "estimated",
    )
    relative = np.sqrt(np.diagonal(fit.covariance)[:3]) / np.abs(fit.scale)
    if not (relative <= max_scale_sd).all():
        raise UnusableFlight(
            ReasonCode.SCALE_UNCERTAIN,
            f"A scale is uncertain by {100 * relative.max():.3g} % (one sd); at most {100 * max_scale_sd:.3g} % is"
            " accepted. Turn further about every axis.",
            {"scale_relative_sd": [float(v) for v in relative]},
        )
    rate = logged * fit.scale + fit.bias
    trust = np.ones(len(t)) if weights is None else np.asarray(weights, dtype=float)
    stretch = output_error.shooting_segments(t, own, stretch_s)
    error, _ = output_error.attitude_error(t, q, rate, stretch, trust, fixed=initial_attitude == "fixed")
    return OutputErrorFit(**vars(fit), t=t, attitude_error=error, rate=rate, stretch=stretch)
