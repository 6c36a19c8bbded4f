"""What is known beforehand of the constants, of a receiver and of the field."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fieldcal.estimation.by_velocity.problem import TRIADS, of_other_form
from fieldcal.estimation.joint.problem import PriorConstants
from fieldcal.geometry.rotation import Array

LAG_S, LAG_SD_S = 0.12, 0.15
ARM_SD_M = 0.5
SMOOTHING_SD_S2 = 1e-3  # that of a mean over 0.15 s
# Of a gyroscope's bias, as it warms: 0.05 °/s a minute.
DRIFT_SD_RADPS2 = 1.5e-5
DELAY_SD_S = 0.05  # of a magnetometer behind the gyroscope
# Of the field's dip and declination where its place is known: a model's error and a vehicle's steel; elsewhere.
FIELD_SD_RAD, UNKNOWN_FIELD_SD_RAD = 0.03, 0.5


def known_beforehand(
    values: Mapping[str, Array], layout: Mapping[str, slice], priors: Mapping[str, PriorConstants], *, field_known: bool
) -> tuple[Array, Array]:
    """Information (p, p) and expected values (p,) of the unknowns in `layout`, in their units.

    Of a triad without a prior nothing is known, and its value in `values` is expected; a magnetometer's is turned into
    the form in which it is estimated, logged = z / λ − b / λ. `field_known`: whether the field's direction is the
    place's."""
    p = max(columns.stop for columns in layout.values())
    information, expected = np.zeros((p, p)), np.zeros(p)
    for name, columns in layout.items():
        if name in priors:
            value, covariance = np.r_[priors[name].scale, priors[name].bias], priors[name].covariance
            if name == "magnetometer":
                value, jacobian = of_other_form(value)
                covariance = jacobian @ covariance @ jacobian.T
            expected[columns] = value
            information[columns, columns] = np.linalg.inv(covariance)
        elif name in TRIADS:
            expected[columns] = values[name]
    for name, value, sd in (
        ("drift", 0.0, DRIFT_SD_RADPS2),
        ("field", 0.0, FIELD_SD_RAD if field_known else UNKNOWN_FIELD_SD_RAD),
        ("delay", 0.0, DELAY_SD_S),
        ("lag", LAG_S, LAG_SD_S),
        ("smoothing", 0.0, SMOOTHING_SD_S2),
        ("arm", 0.0, ARM_SD_M),
    ):
        if name in layout:
            at = np.arange(layout[name].start, layout[name].stop)
            information[at, at], expected[at] = sd**-2, value
    return information, expected
