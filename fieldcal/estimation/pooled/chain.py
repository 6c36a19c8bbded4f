"""A unit's constants over its sessions: a fixed-interval smoother in information form.

The state x of a session is the constants at the reference temperature and their slopes on temperature. Constants walk
from session to session, slopes stay. What a session says is N x = g (information N, which may be singular). Two filters
run towards each other (Fraser & Potter, 1969); neither ever inverts N, so that what no flight shows stays unknown: a
direction with information zero keeps it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fieldcal.estimation.normal_equations import after_errors, scaling
from fieldcal.geometry.rotation import Array

UNSEEN = 1e-9
"""Of information scaled to unit diagonal: an eigenvalue below it is none."""
UNSEEN_SHARE = 1e-3
"""Of a direction without information: a parameter with more of it is not determined."""


@dataclass(frozen=True)
class Known:
    """N x = g: `information` (d, d), `right` (d,)."""

    information: Array
    right: Array

    @classmethod
    def nothing(cls, size: int) -> Known:
        return cls(np.zeros((size, size)), np.zeros(size))

    def __add__(self, other: Known) -> Known:
        return Known(self.information + other.information, self.right + other.right)

    def loosened(self, variance: Array) -> Known:
        """After independent errors of a variance (d,) were added: (N⁻¹ + V)⁻¹; infinite: nothing remains known of the
        parameter but what it shares with others."""
        n, g = self.information, self.right
        for i in np.flatnonzero(np.isinf(variance)):
            if n[i, i] > 0.0:
                row = n[i] / n[i, i]
                n, g = n - np.outer(row, n[i]), g - row * g[i]
                n[i], n[:, i], g[i] = 0.0, 0.0, 0.0
        at = np.flatnonzero((variance > 0.0) & np.isfinite(variance))
        if len(at) == 0:
            return Known(n, g)
        root = np.sqrt(variance[at])
        seen = n[:, at] * root
        return Known(*after_errors(n, g, seen, root[:, None] * seen[at], root * g[at]))

    def estimate(self) -> Estimate:
        """The state and its covariance; infinite variance of what is not determined."""
        scale = scaling(np.diagonal(self.information))
        value, vector = np.linalg.eigh(self.information * np.outer(scale, scale))
        seen = value > UNSEEN
        root = scale[:, None] * vector[:, seen] / np.sqrt(value[seen])
        covariance = root @ root.T
        unseen = (scale == 0.0) | (np.sum(vector[:, ~seen] ** 2, axis=1) > UNSEEN_SHARE**2)
        state = covariance @ self.right
        covariance[unseen], covariance[:, unseen], state[unseen] = 0.0, 0.0, np.nan
        covariance[unseen, unseen] = np.inf
        return Estimate(state, covariance)


@dataclass(frozen=True)
class Estimate:
    """`state` (d,), NaN where it is not determined, and `covariance` (d, d), infinite on the diagonal there."""

    state: Array
    covariance: Array

    def of(self, combination: Array) -> tuple[float, float]:
        """Value and variance of a combination (d,) of the state; (NaN, inf) where it is not determined."""
        at = np.flatnonzero(combination)
        own = self.covariance[np.ix_(at, at)]
        if not np.isfinite(np.diagonal(own)).all():
            return np.nan, np.inf
        weight = combination[at]
        return float(weight @ self.state[at]), float(weight @ own @ weight)


@dataclass(frozen=True)
class Chain:
    """What each session is told by the others: `before` and `after` it, at its own time, without it.

    `own` what each says itself of the constants that it shares with the others (its scatter in it); `day` (m,);
    `walk` (d,) variance a day; `jump` (m − 1, d) more variance between a session and the next."""

    day: Array
    own: tuple[Known, ...]
    before: tuple[Known, ...]
    after: tuple[Known, ...]
    walk: Array
    jump: Array

    @classmethod
    def of(cls, day: Array, own: list[Known], walk: Array, jump: Array, first: Known) -> Chain:
        """Of what sessions say themselves; `first`: what is known of the state beforehand (of slopes)."""
        between = [walk * (b - a) + jump[k] for k, (a, b) in enumerate(pairwise(day))]
        before, after = [first], [Known.nothing(len(walk))]
        for known, variance in zip(own[:-1], between, strict=True):
            before.append((before[-1] + known).loosened(variance))
        for known, variance in zip(own[:0:-1], between[::-1], strict=True):
            after.append((after[-1] + known).loosened(variance))
        return cls(day, tuple(own), tuple(before), tuple(after[::-1]), walk, jump)

    def others(self, k: int) -> Known:
        """What the other sessions say of the constants at session k."""
        return self.before[k] + self.after[k]

    def at(self, day: float) -> Known:
        """What all say of the constants at any time."""
        k = int(np.searchsorted(self.day, day, side="right")) - 1
        if k < 0:
            # Forwards the first session knows its prior alone, which holds for any time.
            return self.before[0] + (self.after[0] + self.own[0]).loosened(self.walk * (self.day[0] - day))
        past = (self.before[k] + self.own[k]).loosened(self.walk * (day - self.day[k]))
        if k + 1 == len(self.day):
            return past
        future = self.after[k + 1] + self.own[k + 1]
        return past + future.loosened(self.walk * (self.day[k + 1] - day) + self.jump[k])
