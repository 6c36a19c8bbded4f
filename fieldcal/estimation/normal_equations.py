"""Normal equations of named parameters about a reference point, and what may be done to them without inventing
information: a direction that is not determined stays so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from fieldcal.geometry.rotation import Array

Name: TypeAlias = tuple[str, str, str]
"""Sensor, parameter, axis."""
ROUNDING = 1e-10
"""Of scaled information: an eigenvalue below it is none."""


@dataclass(frozen=True)
class NormalEquations:
    """N (φ − φ₀) = g: `information` N (p, p), `right` g (p,), `reference` φ₀ (p,), parameters in the order of `names`.
    N may be singular."""

    names: tuple[Name, ...]
    reference: Array
    right: Array
    information: Array

    @classmethod
    def of_triangle(cls, names: Sequence[Name], reference: Array, right: Array, triangle: Array) -> NormalEquations:
        """By the lower triangle of N, row by row, (p(p + 1)/2,)."""
        lower = np.zeros((len(names), len(names)))
        lower[np.tril_indices(len(names))] = triangle
        return cls(tuple(names), reference, right, lower + np.tril(lower, -1).T)

    def triangle(self) -> list[list[float]]:
        """Rows of N up to their diagonal."""
        return [row[: place + 1].tolist() for place, row in enumerate(self.information)]

    def of(self, names: Sequence[Name]) -> NormalEquations:
        """These parameters alone, in this order, whatever the others are: the Schur complement. An other one that is
        not determined itself takes with it what is known only beside it."""
        at = np.array([self.names.index(name) for name in names], dtype=np.int64)
        rest = np.setdiff1d(np.arange(len(self.names)), at)
        kept, kept_right = self.information[np.ix_(at, at)], self.right[at]
        if len(rest) and np.any(self.information[rest]):
            across = self.information[np.ix_(at, rest)]
            inverse = pseudo_inverse(self.information[np.ix_(rest, rest)])
            kept = without_rounding(kept - across @ inverse @ across.T, np.diagonal(kept))
            kept_right = projected(kept, kept_right - across @ inverse @ self.right[rest])
        return NormalEquations(tuple(names), self.reference[at], kept_right, kept)

    def as_function(self, names: Sequence[Name], reference: Array, jacobian: Array) -> NormalEquations:
        """Of as many other parameters, `jacobian` (p, p) = ∂(other)/∂(own), which are `reference` (p,) at φ₀."""
        back = np.linalg.inv(jacobian)
        return NormalEquations(tuple(names), reference, back.T @ self.right, back.T @ self.information @ back)

    def doubted(self, covariance: Array) -> NormalEquations:
        """With errors of a covariance (p, p) on top: (N⁻¹ + V)⁻¹ by Woodbury, which asks for no inverse of N."""
        value, vector = np.linalg.eigh(covariance)
        root = vector * np.sqrt(np.maximum(value, 0.0))
        root = root[:, value > 0.0]
        seen = self.information @ root
        information, right = after_errors(self.information, self.right, seen, root.T @ seen, root.T @ self.right)
        return replace(self, information=information, right=right)

    def moved(self, reference: Array) -> NormalEquations:
        """The same about another point (p,)."""
        return replace(self, reference=reference, right=self.right + self.information @ (self.reference - reference))


def after_errors(information: Array, right: Array, seen: Array, inner: Array, by: Array) -> tuple[Array, Array]:
    """N (p, p) and g (p,) after independent errors of a covariance R Rᵀ were added to what they tell: (N⁻¹ + R Rᵀ)⁻¹ by
    Woodbury, from N R `seen` (p, k), Rᵀ N R `inner` (k, k) and Rᵀ g `by` (k,)."""
    solved = np.linalg.solve(np.eye(len(by)) + inner, np.column_stack([seen.T, by]))
    n = information - seen @ solved[:, :-1]
    return 0.5 * (n + n.T), right - seen @ solved[:, -1]


def scaling(diagonal: Array) -> Array:
    """1/√ of a diagonal; 0 where it is."""
    return np.where(diagonal > 0.0, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)


def pseudo_inverse(information: Array) -> Array:
    """Of information scaled to unit diagonal; directions without information stay without variance too."""
    scale = scaling(np.diagonal(information))
    inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=ROUNDING, hermitian=True)
    return np.asarray(inverse * np.outer(scale, scale))


def without_rounding(information: Array, before: Array) -> Array:
    """Information (p, p) that is a difference of two, whose minuend had the diagonal `before` (p,): what may be
    rounding becomes exactly zero."""
    scale = scaling(before)
    value, vector = np.linalg.eigh(0.5 * (information + information.T) * np.outer(scale, scale))
    kept = vector[:, value > ROUNDING] * np.sqrt(value[value > ROUNDING])
    back = np.where(scale > 0.0, 1.0 / np.where(scale > 0.0, scale, 1.0), 0.0)
    root = back[:, None] * kept
    return np.asarray(root @ root.T)


def projected(information: Array, right: Array) -> Array:
    """A right-hand side (p,) without what no information (p, p) stands behind."""
    return np.asarray(information @ (pseudo_inverse(information) @ right))
