"""When an ellipsoid fit is refused: the recording does not determine the triad, or contradicts it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.ellipsoid import TriadFit
from fieldcal.reason_codes import ReasonCode


def require_determined(
    fit: TriadFit,
    *,
    max_condition: float,
    max_scale_sd: float,
    max_residual: float,
    nominal_scale: ArrayLike | None = None,
) -> None:
    """Refuse a calibration that the recording does not determine.

    Checks, all four: condition number, claimed relative sd of the scales, rms of |z|/f − 1, and (where a nominal scale
    is known) each scale within a factor of two of it. At a collapsed solution any one of them alone can look healthy.

    Raises
    ------
    UnusableFlight
        `too_little_motion`, `scale_uncertain`, `not_a_sphere` or `scale_not_nominal`; `measured` has all the numbers.
    """
    measured = fit.measured()
    relative = max(fit.scale_relative_sd)
    if not fit.condition <= max_condition:
        raise UnusableFlight(
            ReasonCode.TOO_LITTLE_MOTION,
            f"Too little of the sphere was seen: condition number {fit.condition:.3g}, at most {max_condition:.3g} is"
            " accepted. Tilt the vehicle further about every axis.",
            measured,
        )
    if nominal_scale is not None:
        ratio = np.abs(fit.scale_diagonal) / np.abs(np.asarray(nominal_scale, dtype=float))
        measured["scale_over_nominal"] = [float(v) for v in ratio]
        if (ratio < 0.5).any() or (ratio > 2.0).any():
            raise UnusableFlight(
                ReasonCode.SCALE_NOT_NOMINAL,
                f"A scale is {ratio.min():.3g} to {ratio.max():.3g} times its nominal value, outside 0.5 to 2: wrong"
                " unit, wrong field strength, or a collapsed fit.",
                measured,
            )
    if not relative <= max_scale_sd:
        uncertain = (
            f"uncertain by {100 * relative:.3g} % (one sd)" if np.isfinite(relative) else "not determined at all"
        )
        raise UnusableFlight(
            ReasonCode.SCALE_UNCERTAIN,
            f"A scale is {uncertain}; at most {100 * max_scale_sd:.3g} % is accepted.",
            measured,
        )
    if not fit.residual_rms <= max_residual:
        raise UnusableFlight(
            ReasonCode.NOT_A_SPHERE,
            f"The calibrated length varies by {100 * fit.residual_rms:.3g} % rms, above {100 * max_residual:.3g} %:"
            " another field or other accelerations were sensed.",
            measured,
        )
