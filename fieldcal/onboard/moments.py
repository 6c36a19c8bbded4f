"""Moments of a triad's readings to the fourth order: all that an ellipsoid's fit needs, in fixed memory, mergeable.

The same sums as in `c/fieldcal_onboard.c`, in the same order. Arrays of moments are (…, 35): the number of readings,
then the sums of x^a y^b z^c of `EXPONENTS`; of a triad whose scale is diagonal only the first 25 are kept, the others
are 0.
"""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.geometry.rotation import Array

AXIS_ALIGNED = 24
"""Sums for a diagonal scale; one of degree four in three axes, or odd in two, it does not need."""
FULL = 34
"""Sums for a symmetric scale matrix: all of degree one to four."""

# fmt: off
EXPONENTS: tuple[tuple[int, int, int], ...] = (
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2), (0, 1, 1), (1, 0, 1), (1, 1, 0),
    (3, 0, 0), (2, 1, 0), (2, 0, 1), (1, 2, 0), (0, 3, 0), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3), (4, 0, 0),
    (0, 4, 0), (0, 0, 4), (0, 2, 2), (2, 0, 2), (2, 2, 0),
    (1, 1, 1), (3, 1, 0), (3, 0, 1), (1, 3, 0), (0, 3, 1), (1, 0, 3), (0, 1, 3), (2, 1, 1), (1, 2, 1), (1, 1, 2),
)
# fmt: on
PLACE = {exponents: k for k, exponents in enumerate(EXPONENTS)}
DEGREE = np.sum(EXPONENTS, axis=1)


def lowered(k: int, axis: int, by: int) -> int:
    """Where the moment stands that has `by` less of an axis than moment k."""
    own = list(EXPONENTS[k])
    own[axis] -= by
    return PLACE[own[0], own[1], own[2]]


def sums_of(x: Array, sums: int) -> Array:
    """The sums (24 or 34) over readings x (n, 3) less their centre, in float64 of products in x's own width."""
    a, b, c = x.T
    aa, bb, cc = a * a, b * b, c * c
    terms = [a, b, c, aa, bb, cc, b * c, a * c, a * b]
    terms += [aa * a, aa * b, aa * c, bb * a, bb * b, bb * c, cc * a, cc * b, cc * c]
    terms += [aa * aa, bb * bb, cc * cc, bb * cc, aa * cc, aa * bb]
    if sums == FULL:
        ab, ac, bc = a * b, a * c, b * c
        terms += [ab * c, aa * ab, aa * ac, bb * ab, bb * bc, cc * ac, cc * bc, aa * bc, bb * ac, cc * ab]
    return np.array([np.sum(term, dtype=np.float64) for term in terms])


def translate(moments: Array, by: ArrayLike) -> Array:
    """Moments (…, 35) about a point `by` (…, 3) further on: exact, as the binomial theorem is."""
    m, step = np.array(moments, dtype=float), np.asarray(by, dtype=float)
    for axis in range(3):
        for k in range(len(EXPONENTS) - 1, 0, -1):  # from the end: what each is made of is still as it was
            degree = EXPONENTS[k][axis]
            for j in range(1, degree + 1):
                m[..., k] += comb(degree, j) * (-step[..., axis]) ** j * m[..., lowered(k, axis, j)]
    return m


def without_noise(moments: Array, variance: Array) -> Array:
    """Moments (35,) less what noise of a variance (3,) adds to their expectation: Hermite polynomials of the
    readings."""
    m = moments.copy()
    for axis in range(3):
        for k in range(len(EXPONENTS) - 1, 0, -1):
            degree = EXPONENTS[k][axis]
            if degree >= 2:
                m[k] -= comb(degree, 2) * variance[axis] * m[lowered(k, axis, 2)]
            if degree == 4:
                m[k] += 3.0 * variance[axis] ** 2 * m[lowered(k, axis, 4)]
    return m


def noise_slope(clean: Array, variance: Array) -> Array:
    """Derivative of `without_noise` by a common factor of the variance, at what it gave."""
    out = np.zeros_like(clean)
    for axis in range(3):
        for k in range(len(EXPONENTS)):
            degree = EXPONENTS[k][axis]
            if degree >= 2:
                out[k] -= comb(degree, 2) * variance[axis] * clean[lowered(k, axis, 2)]
    return out
