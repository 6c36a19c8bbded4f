"""What a record says of the constants by a receiver's velocity, whatever was known beforehand: its normal equations."""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.by_velocity.fit import VelocityFit
from fieldcal.estimation.by_velocity.problem import TRIADS, of_other_form
from fieldcal.estimation.joint.information import AXES, GAIN, ZERO
from fieldcal.estimation.normal_equations import Name, NormalEquations


def observed(fit: VelocityFit) -> NormalEquations:
    """Of `gain` 1/λ and `zero` of each triad, logged units; lag, arm and field eliminated, whatever they are.

    The prior stands beside the knots, so that the information without it is that of the record; at the solution the
    record's gradient is what `pull` says."""
    sizes = {name: columns.stop - columns.start for name, columns in fit.layout.items()}
    names = tuple((name, "", str(k)) for name, size in sizes.items() for k in range(size))
    theta = np.concatenate([fit.state.values[name] for name in fit.layout])
    own = NormalEquations(names, theta, fit.pull, fit.information)
    triads = [name for name in TRIADS if name in fit.layout]
    own = own.of([name for name in names if name[0] in triads])
    published: list[Name] = []
    value, jacobian = np.zeros(6 * len(triads)), np.zeros((6 * len(triads), 6 * len(triads)))
    for place, name in enumerate(triads):
        published += [(name, parameter, axis) for parameter in (GAIN, ZERO) for axis in AXES]
        own_form = fit.state.values[name]
        at = slice(6 * place, 6 * place + 6)
        is_gain = name == "magnetometer"
        value[at], jacobian[at, at] = (own_form, np.eye(6)) if is_gain else of_other_form(own_form)
    return own.as_function(published, value, jacobian)
