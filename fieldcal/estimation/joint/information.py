"""What a record says of the constants, whatever was known beforehand: the joint estimate's normal equations without the
prior, in the sensors' own units."""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.joint.covariance import Noise
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.estimation.joint.problem import CROSS, TERMS, TRIADS, off_diagonal
from fieldcal.estimation.normal_equations import ROUNDING, Name, NormalEquations, scaling
from fieldcal.geometry.rotation import Array

AXES = ("x", "y", "z")
GAIN, ZERO, CROSS_AXIS, SLOPE = "gain", "zero", "cross", "zero_per_degc"
LEVER_ARM, DELAY, G_SENSITIVITY = "lever_arm", "delay", "g_sensitivity"
CONSTANTS = (*TRIADS, *TERMS, "lever_arm")
"""Parts of θ that outlast a record; the others (dip, clock and mounting of a VPS) are eliminated."""
ENLARGEMENT_ROUNDS = 8
EPS = 4.0 * np.finfo(float).eps
LEAST_DIGITS = 1e3
"""Of the information with the prior a share EPS is rounding: where less than so many times that remains when the prior
is taken out, nothing remains."""


def observed(fit: JointFit, axes: Array) -> NormalEquations:
    """What the record says of its constants; `axes` (3, 3) turns sensor axes into body axes (for the lever arm).

    Parameters of the answer: `gain` 1/λ, logged unit per calibrated unit, and `zero`, the reading of nothing, logged
    unit: a reading is linear in both. `cross`: row-normalised off-diagonal elements of the matrix. `zero_per_degc`,
    `g_sensitivity`, logged unit; `delay`, s; `lever_arm`, m, body axes.

    Linearised where the fit ended, in centred readings. The prior is taken out of the information exactly: it stands
    beside the knots, so that N = N_record + N_prior still holds once they are eliminated; of the gradient, zero at the
    solution, the prior's part with its sign reversed remains. Coloured noise enlarges variances as it does those of the
    estimate, but by eigenvectors instead of parameters, so that a combination that is not determined stays the one that
    it is.
    """
    p = len(fit.information)
    constant = np.zeros(p, dtype=bool)
    for name, columns in fit.layout.items():
        constant[columns] = name in CONSTANTS
    known = np.where(np.outer(constant, constant), fit.known, 0.0)
    information = fit.information - known
    rounding = EPS * np.diagonal(fit.information)
    diagonal = np.where(np.diagonal(information) > LEAST_DIGITS * rounding, np.diagonal(information), 0.0)
    scale = scaling(diagonal)
    least = max(ROUNDING, float(np.max(rounding * scale**2)) * p)
    value, vector = np.linalg.eigh(information * np.outer(scale, scale))
    kept = value > least
    value, direction = value[kept], scale[:, None] * vector[:, kept]
    right = direction.T @ np.where(constant, -fit.pull, 0.0)
    if fit.noise is not None:
        larger = _enlargement(fit.noise, direction, value)
        value, right = value / larger, right / larger
    back = np.sqrt(diagonal)[:, None] * vector[:, kept]
    names = tuple(
        (name, "", str(k)) for name, columns in fit.layout.items() for k in range(columns.stop - columns.start)
    )
    theta = np.concatenate([fit.state.values[name] for name in fit.layout])
    own = NormalEquations(names, theta, back @ right, (back * value) @ back.T).doubted(fit.doubt)
    own = own.of([name for name in names if name[0] in CONSTANTS])
    return own.as_function(*_published(fit, axes))


def _enlargement(noise: Noise, direction: Array, value: Array) -> Array:
    """Factors (r,) on the variances 1/`value` (r,) along `direction` (p, r): as the noise is along each and, where that
    is not enough, so that the parameters' variances are enlarged as the estimate's are."""
    along = direction / value
    inverse = along @ direction.T
    seen = np.diagonal(inverse) > 0.0
    wanted = noise.enlargement(inverse[:, seen], np.diagonal(inverse)[seen]) ** 2 * np.diagonal(inverse)[seen]
    larger = noise.enlargement(along, 1.0 / value) ** 2
    variance = (along * direction)[seen]  # of each parameter by each direction
    for _ in range(ENLARGEMENT_ROUNDS):
        part = variance * larger
        share = (part / part.sum(axis=1, keepdims=True)) ** 2
        larger = larger * np.maximum(1.0, share.T @ (wanted / part.sum(axis=1)) / share.sum(axis=0))
    return np.asarray(larger)


def _published(fit: JointFit, axes: Array) -> tuple[list[Name], Array, Array]:
    """Names, values and ∂φ/∂θ of the constants, in the order of θ."""
    layout = [name for name in fit.layout if name in CONSTANTS]
    sizes = [fit.layout[name].stop - fit.layout[name].start for name in layout]
    ends = np.cumsum(sizes)
    at = {name: slice(end - size, end) for name, end, size in zip(layout, ends, sizes, strict=True)}
    names: list[Name] = []
    value, jacobian = np.zeros(ends[-1]), np.zeros((ends[-1], ends[-1]))
    for name in layout:
        scaled, columns = fit.state.values[name], at[name]
        sensor = name.split("_")[0]
        if name in TRIADS:
            names += [(name, parameter, axis) for parameter in (GAIN, ZERO) for axis in AXES]
            triad, cross = fit.model.triads[name], at.get(f"{name}_cross")
            e = np.zeros((3, 3)) if cross is None else off_diagonal(name, fit.state.values[f"{name}_cross"])
            mix, w = np.linalg.inv(np.eye(3) + e), scaled[3:] / scaled[:3]
            value[columns] = np.r_[triad.spread / scaled[:3], triad.centre - triad.spread * (mix @ w)]
            gain, zero = np.arange(3) + columns.start, np.arange(3, 6) + columns.start
            jacobian[gain, gain] = -triad.spread / scaled[:3] ** 2
            by_bias = -triad.spread[:, None] * mix / scaled[:3]
            jacobian[np.ix_(zero, zero)], jacobian[np.ix_(zero, gain)] = by_bias, -by_bias * w
            if cross is not None:
                for k, (i, j) in enumerate(CROSS[name]):
                    jacobian[zero, cross.start + k] = triad.spread * mix[:, i] * (mix @ w)[j]
        elif name == "lever_arm":
            names += [("accelerometer", LEVER_ARM, axis) for axis in AXES]
            value[columns], jacobian[columns, columns] = axes @ scaled, axes
        else:
            triad = fit.model.triads[sensor]
            if name.endswith("_cross"):
                of_axes, parameter = [AXES[i] + AXES[j] for i, j in CROSS[sensor]], CROSS_AXIS
                factor = np.array([triad.spread[i] / triad.spread[j] for i, j in CROSS[sensor]])
            elif name.endswith("_temperature"):
                of_axes, parameter, factor = list(AXES), SLOPE, -triad.spread
            elif name.endswith("_g_sensitivity"):
                of_axes, parameter = [a + b for a in AXES for b in AXES], G_SENSITIVITY
                factor = -np.repeat(triad.spread, 3)
            else:
                of_axes, parameter, factor = [""], DELAY, np.ones(1)
            names += [(sensor, parameter, axis) for axis in of_axes]
            value[columns], jacobian[columns, columns] = factor * scaled, np.diag(factor)
    return names, value, jacobian
