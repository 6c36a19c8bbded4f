"""Covariance of the joint estimate from coloured residuals, and advice which motion would make it smaller."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fieldcal.estimation.joint.measurement_model import SENSED, Rows, sums_by_interval
from fieldcal.estimation.joint.problem import Model, State
from fieldcal.estimation.statistics import coloured_information, variance_by_blocks
from fieldcal.geometry.rotation import Array

ADVICE_RELATIVE_SD = 0.01  # of a scale; a smaller one needs no advice
TURNS = ("roll", "pitch", "yaw")
STEEP_FIELD_RAD = np.pi / 4
# Turns that change the component of gravity, or of a steep field, along each body axis; and of a level field.
TURNS_FOR_STEEP_VECTOR = (("pitch",), ("roll",), ("roll", "pitch"))
TURNS_FOR_LEVEL_VECTOR = (("yaw",), ("yaw",), ("roll", "pitch"))


@dataclass(frozen=True)
class RowSums:
    """Sums over the rows of each interval, whitened, knots eliminated: `sensitivity` (K, r + 3, p), of which the last
    three lines are ∂(integrated attitude at the interval's end)/∂θ; `residual` (K, r + 3) and number of readings
    `count` (K, r + 3), zero in those lines; `score` (K, p) of the rows."""

    sensitivity: Array
    residual: Array
    count: Array
    score: Array


def sums_of_rows(
    model: Model, chunks: Iterator[tuple[slice, Rows, Array]], response: Array, whitening: Array
) -> RowSums:
    """Of `joint.measurement_model.sensitivities`, by the knots' `response` (K, s, p) to the parameters; `whitening`
    (m, r) robust weights over the density of the noise at low frequency."""
    k, r, p = len(response), whitening.shape[1], response.shape[2]
    sensitivity, residual, count = np.zeros((k, r + 3, p)), np.zeros((k, r + 3)), np.zeros((k, r + 3))
    score = np.zeros((k, p))
    for knot_span, rows, ends in chunks:
        at = model.at[rows.span]
        knot, share = model.knots.of_sample[at], model.knots.share[at, None, None]
        after = np.minimum(knot + 1, k - 1)
        between = (1.0 - share) * response[knot][:, SENSED] + share * response[after][:, SENSED]
        root = np.sqrt(whitening[rows.span])
        seen = (rows.by_parameter - rows.by_knot @ between) * root[..., None]
        by_interval = sums_by_interval(model, seen.reshape(len(at), r * p), rows.span, knot_span)
        sensitivity[knot_span, :r] = by_interval.reshape(len(by_interval), r, p)
        sensitivity[knot_span, r:] += ends
        left = rows.residual * root
        residual[knot_span, :r] = sums_by_interval(model, left, rows.span, knot_span)
        score[knot_span] += sums_by_interval(model, np.einsum("mrp,mr->mp", seen, left), rows.span, knot_span)
        count[knot_span, :r] = sums_by_interval(model, (root > 0).astype(float), rows.span, knot_span)
    return RowSums(sensitivity, residual, count, score)


@dataclass(frozen=True)
class Noise:
    """What the residuals show of the noise beyond the model's: `excess` (p, p) of the scores' covariance over the
    information, by correlation over longer times than an interval; `score` (K, p) by interval, at times `elapsed_s`
    (K,)."""

    excess: Array
    score: Array
    elapsed_s: Array

    def enlargement(self, combination: Array, variance: Array) -> Array:
        """Factors (r,), at least 1, on the sd of linear estimates.

        Correlation of the noise within an interval is in the whitening already. Correlation over longer times (a field
        that varies from place to place, a temperature) is measured on means by interval: M = ΣΣ S̄ᵀ𝓡S̄ instead of
        ΣS̄ᵀS̄ for each residual of the rows, S̄ the sensitivity with the knots eliminated. Noise unlike the model's
        (strong for some seconds and weak for others, a translation that swings at one frequency) is measured by the
        scores S̄ᵀr of blocks of time, all residuals together (`variance_by_blocks`). Neither ever makes a standard
        deviation smaller.

        Parameters
        ----------
        combination : (p, r) array
            The estimates' errors are combinationᵀ times the sum of the scores: the inverse information gives those of
            the parameters.
        variance : (r,) array
            Theirs if the noise were as the model has it.
        """
        coloured = variance + np.einsum("pr,pq,qr->r", combination, self.excess, combination)
        by_blocks = variance_by_blocks(self.score @ combination, self.elapsed_s)
        return np.asarray(np.sqrt(np.maximum(1.0, np.maximum(coloured, by_blocks) / variance)))


def noise_of(
    model: Model,
    rows: RowSums,
    response: Array,
    jumps: tuple[Array, Array],
    process: tuple[Array, Array],
    others: tuple[Array, Array] | None = None,
) -> Noise:
    """Of all residuals together.

    Parameters
    ----------
    rows : RowSums
        At the solution.
    response : (K, s, p) array
        Knots' response N_xx⁻¹N_xθ to the parameters.
    jumps : (K−1, 3), (K−1,) arrays
        Attitude jumps at the joints, and 1/their sd: coloured where the gyroscope's bias drifts.
    process : (K, c, p), (K, c) arrays
        Whitened sensitivities, knots eliminated, and residuals of the translation's process. Their colour is not used:
        the fit alone colours them.
    others : (K, c, p), (K, c) arrays, optional
        The same of other measurements at the knots (VPS poses).
    """
    r, p = rows.residual.shape[1] - 3, response.shape[2]
    sensitivity, residual, score = rows.sensitivity.copy(), rows.residual.copy(), rows.score.copy()
    residual[:-1, r:] += jumps[0] * jumps[1][:, None]
    sensitivity[:-1, r:] += np.diff(response[:, :3], axis=0)
    sensitivity[:-1, r:] *= jumps[1][:, None, None]
    for seen, left in ((sensitivity[:, r:], residual[:, r:]), process, *([] if others is None else [others])):
        score += np.einsum("kcp,kc->kp", seen, left)
    scale = 1.0 / np.sqrt(np.maximum(rows.count, 1.0))
    sensitivity, residual = sensitivity * scale[..., None], residual * scale
    excess = np.zeros((p, p))
    for row in range(r + 3):
        s, e = sensitivity[:, row], residual[:, row]
        variance = float(np.mean(e**2))
        if variance > 0.0:
            excess += coloured_information(s[:, None, :], e[:, None]) / variance - s.T @ s
    if others is not None:
        seen, left = others
        variance = float(np.mean(left[left != 0.0] ** 2)) if left.any() else 1.0
        excess += coloured_information(seen, left) / variance - np.einsum("kcp,kcq->pq", seen, seen)
    elapsed = np.r_[0.0, np.cumsum(model.knots.interval_s * model.knots.joined)]
    return Noise(excess, score, elapsed)


def inverse_information(information: Array) -> Array:
    """Inverse (p, p) of an information matrix scaled to unit diagonal; positive by the prior in it."""
    scale = 1.0 / np.sqrt(np.diagonal(information))
    return np.asarray(np.linalg.pinv(information * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale))


def advice(model: Model, state: State, layout: Mapping[str, slice], covariance: Array, axes: Array) -> str:
    """Which scales are uncertain and which motion would help, in a sentence or two; empty where all are within 1 %.

    A gyroscope's scale is observable when the vehicle turns about its axis; a vector triad's when the component of the
    sensed vector along it changes. `axes` (3, 3) turns sensor axes into nose, starboard, underside."""
    weak = []
    for name, columns in layout.items():
        if name not in model.triads:
            continue
        variance = np.diagonal(covariance)[columns.start : columns.start + 3]
        relative = np.sqrt(variance) / np.abs(state.values[name][:3])
        weak += [(float(sd), name, i) for i, sd in enumerate(relative) if sd > ADVICE_RELATIVE_SD]
    if not weak:
        return ""
    (sd, name, axis), *others = sorted(weak, reverse=True)
    body = int(np.argmax(np.abs(axes[:, axis])))
    if name == "gyroscope":
        turns: tuple[str, ...] = (TURNS[body],)
    else:
        level = name == "magnetometer" and abs(float(state.values["dip"][0])) < STEEP_FIELD_RAD
        turns = (TURNS_FOR_LEVEL_VECTOR if level else TURNS_FOR_STEEP_VECTOR)[body]
    text = f"The {name}'s {'xyz'[axis]} scale is the weakest (sd {100 * sd:.1f} %): add 60° of {' and of '.join(turns)}"
    text += " either way, several times."
    if others:
        text += " Above 1 % too: " + ", ".join(f"{n} {'xyz'[i]} {100 * v:.1f} %" for v, n, i in others) + "."
    return text
