"""What the joint estimator's scores lack beside the quadratic form, as residuals are in logged units and noise is in
the sensitivities too: corrections of the gradient on the triads' scales.

Without them the gyroscope's scales are drawn off by some standard deviations on a 40 s flight at the paper's noise;
with them by 0.1 at most, which is what the attitude's own error does in second order: it shortens the predicted vectors
by its variance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fieldcal.estimation.joint.measurement_model import SENSED, Trajectory, body_jumps
from fieldcal.estimation.joint.problem import Model, State
from fieldcal.geometry.rotation import Array


def logged_units(model: Model, state: State, path: Trajectory, walk: float) -> Array:
    """Gradient (3,) on the gyroscope's λ' that makes its residual one in logged units.

    A jump c of the attitude is gyroscope noise of c/λ logged units; as an angle it would shrink with λ, and with it the
    rates (the attenuation of a noisy regressor). ∂/∂λ_i of −½Σ(c_i/λ_i)²/σ² is Σc_i²/(λ_i walk Δt)."""
    knots = model.knots
    square = np.sum(body_jumps(state, path) ** 2 / (walk * knots.interval_s)[:, None], axis=0)
    # Noise makes one each; more is misfit that the walk's bound keeps from being noise, and no reason to move.
    return np.asarray(np.minimum(square, knots.joined.sum()) / state.values["gyroscope"][:3])


def within_intervals(
    model: Model, state: State, layout: Mapping[str, slice], reaction: tuple[Array, Array], response: Array
) -> Array:
    """Gradient (p,), for a walk of one, that undoes what gyroscope noise within an interval does to scales.

    Between knots the attitude is the integrated one: its noise is in the rows' residuals, in their sensitivity to the
    gyroscope's λ_i, and in the vector predicted for them. The score lacks tr_i/λ_i of a gyroscope's axis and has
    tr_j/λ_j of a row j too much, traces of the whitened rows' covariance, knots eliminated."""
    rows = 3 * len(model.rows)
    left = np.maximum(reaction[1][-1] - np.einsum("kci,kc->i", reaction[0], response[:, SENSED]), 0.0)[rows:]
    out = np.zeros(len(reaction[1]) - 1)
    for i, name in enumerate(("gyroscope", *model.rows)):
        own = layout[name].start + np.arange(3)
        out[own] = (1.0 if i == 0 else -1.0) * left[3 * i : 3 * i + 3] / state.values[name][:3]
    return out
