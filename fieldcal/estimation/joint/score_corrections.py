"""Corrections of the gradient on the triads' scales: the scores have terms that the quadratic form lacks, since
residuals are in logged units and the sensitivities contain noise too.

Without them the gyroscope's scales are biased by some standard deviations on a 40 s flight at the paper's noise; with
them by 0.1 at most. That rest is the attitude error in second order: it shortens the predicted vectors by its
variance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fieldcal.estimation.joint.measurement_model import SENSED, body_jumps
from fieldcal.estimation.joint.problem import Model, State, Trajectory
from fieldcal.geometry.rotation import Array


def logged_units(model: Model, state: State, path: Trajectory, walk: float) -> Array:
    """Gradient (3,) on the gyroscope's λ' that turns its residual into one in logged units.

    A jump c of the attitude is gyroscope noise of c/λ logged units; as an angle it would be smaller the smaller λ is,
    which would draw λ down (the attenuation of a noisy regressor). ∂/∂λ_i of −½Σ(c_i/λ_i)²/σ² is Σc_i²/(λ_i walk
    Δt)."""
    knots = model.knots
    square = np.sum(body_jumps(state, path) ** 2 / (walk * knots.interval_s)[:, None], axis=0)
    # Noise makes 1 of each interval. More is misfit, kept out of the noise by the bound on the walk: no reason to move.
    return np.asarray(np.minimum(square, knots.joined.sum()) / state.values["gyroscope"][:3])


def within_intervals(
    model: Model, state: State, layout: Mapping[str, slice], reaction: tuple[Array, Array], response: Array
) -> Array:
    """Gradient (p,), for a walk of one, that undoes the bias of scales by gyroscope noise within an interval.

    Between knots the attitude is the integrated one: its noise is in the residuals of the rows, in their sensitivity to
    the gyroscope's λ_i, and in the vector predicted for them. The score lacks tr_i/λ_i of a gyroscope's axis and has
    tr_j/λ_j too much of a residual j: traces of the covariance of the whitened rows, knots eliminated."""
    rows = 3 * len(model.vectors)
    left = np.maximum(reaction[1][-1] - np.einsum("kci,kc->i", reaction[0], response[:, SENSED]), 0.0)[rows:]
    out = np.zeros(len(reaction[1]) - 1)
    for i, name in enumerate(("gyroscope", *model.vectors)):
        scales = layout[name].start + np.arange(3)
        out[scales] = (1.0 if i == 0 else -1.0) * left[3 * i : 3 * i + 3] / state.values[name][:3]
    return out
