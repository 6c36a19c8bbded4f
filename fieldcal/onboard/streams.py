"""The streams: fed reading by reading or in pieces, as the C on board; the same numbers to a float's rounding."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.geometry.rotation import Array
from fieldcal.names import Triple
from fieldcal.onboard import rates
from fieldcal.onboard.ellipsoid import Limits, MomentsFit, fit_moments
from fieldcal.onboard.moments import AXIS_ALIGNED, EXPONENTS, FULL, sums_of, translate
from fieldcal.onboard.noise import NoiseStream
from fieldcal.onboard.rates import RatesFit

LARGEST = 1e8
"""Of a reading less its centre: its fourth power is a float."""


class Moments:
    """Moments of one vector triad's readings: start, feed, solve, merge.

    Parameters
    ----------
    centre : (3,) array, optional
        What is taken off each reading; the first one unless given.
    sums : {34, 24}
        With or without those that only a full scale matrix needs.
    in_mean : int
        Readings that are averaged before their noise is told (`noise.readings_in_mean`).
    single : bool
        Readings and their products rounded to floats, as on board.

    Attributes
    ----------
    n_samples : int
    values : (35,) array
        Number and sums, `moments.EXPONENTS`.
    noise : NoiseStream

    Examples
    --------
    >>> import numpy as np
    >>> import fieldcal
    >>> from fieldcal.onboard import Limits, Moments
    >>> readings = fieldcal.simulate(seed=1).counts["magnetometer"]
    >>> first, second = Moments(), Moments()
    >>> first.feed(readings[:4000]), second.feed(readings[4000:])
    (None, None)
    >>> first.merge(second)
    >>> fit = first.solve(Limits(magnitude=1.0, polarity=(1, 1, -1)))
    >>> fit.reason_code is None, (np.diagonal(fit.scale_sd) / abs(np.diagonal(fit.scale)) * 100).round(1)
    (True, array([1. , 0.4, 0.4]))
    """

    def __init__(
        self, centre: ArrayLike | None = None, *, sums: int = FULL, in_mean: int = 2, single: bool = False
    ) -> None:
        if sums not in (AXIS_ALIGNED, FULL):
            raise ValueError(f"sums is {AXIS_ALIGNED} or {FULL}, not {sums}")
        self.sums = sums
        self.dtype = np.dtype(np.float32 if single else np.float64)
        self.centre = None if centre is None else np.asarray(centre, dtype=self.dtype)
        self.values: Array = np.zeros(len(EXPONENTS))
        self.noise = NoiseStream(in_mean, self.dtype)

    @property
    def n_samples(self) -> int:
        return int(self.values[0])

    def feed(self, readings: ArrayLike) -> None:
        """Readings (n, 3) or one (3,), as logged, that follow on those before; one that is not finite, or too large for
        its fourth power, is left out, and the next does not follow on."""
        z = np.atleast_2d(np.asarray(readings, dtype=self.dtype))
        finite = np.isfinite(z).all(axis=1)
        if self.centre is None:
            if not finite.any():
                return
            self.centre = z[int(np.argmax(finite))].copy()
        x = z - self.centre
        with np.errstate(invalid="ignore"):
            fed = finite & (np.abs(x) < LARGEST).all(axis=1)
        bounds = np.flatnonzero(np.diff(fed)) + 1
        for start, end in zip([0, *bounds], [*bounds, len(x)], strict=True):
            if end > start and fed[start]:
                self._feed_run(x[start:end])
            else:
                self.gap()

    def _feed_run(self, x: Array) -> None:
        self.values[0] += len(x)
        self.values[1 : 1 + self.sums] += sums_of(x, self.sums)
        self.noise.feed(x)

    def gap(self) -> None:
        """The next reading does not follow on the last: their difference is none of the noise."""
        self.noise.gap()

    def merge(self, other: Moments) -> None:
        """Add another's readings, whatever its centre.

        Raises
        ------
        ValueError
            The other has too few sums.
        """
        if other.sums < self.sums:
            raise ValueError("what holds no mixed moments can only be merged into what holds none either")
        if other.centre is None:
            return
        if self.centre is None:
            self.centre = other.centre.astype(self.dtype)
        by = self.centre.astype(float) - other.centre.astype(float)
        self.values[: 1 + self.sums] += translate(other.values, by)[: 1 + self.sums]
        self.noise.merge(other.noise)

    def solve(self, limits: Limits) -> MomentsFit:
        """Scale and bias of the triad, judged (`ellipsoid.fit_moments`).

        Raises
        ------
        ValueError
            A full matrix is asked of the sums for a diagonal one.
        """
        if limits.full and self.sums < FULL:
            raise ValueError(f"a full scale matrix needs {FULL} sums, not {self.sums}")
        centre = np.zeros(3) if self.centre is None else self.centre.astype(float)
        return fit_moments(self.values, centre, self.noise.squares, self.noise.n_differences, limits)


class RateEquations:
    """The gyroscope's equations from attitudes and readings: start, feed, solve, merge.

    Parameters
    ----------
    block_samples : int
        Attitudes from which one derivative is formed, 3 to 256.
    forgetting : float
        Factor a block; 1: nothing is forgotten.
    centre : (3,) array, optional
        What is taken off each reading; the first one unless given.
    in_mean : int
        Readings that are averaged before their noise is told (`noise.readings_in_mean`).
    single : bool
        Attitudes and readings rounded to floats, as on board.
    max_gap_us : float
        So long after the last sample a new block begins.

    Examples
    --------
    >>> import numpy as np
    >>> import fieldcal
    >>> from fieldcal.onboard import RateEquations
    >>> flight = fieldcal.simulate(seed=1, noise=False)
    >>> equations = RateEquations(block_samples=18)
    >>> equations.feed(np.rint(flight.t * 1e6), flight.q, flight.counts["gyroscope"])
    >>> fit = equations.solve(polarity=(-1, 1, 1))
    >>> (fit.scale * 1e3).round(4)
    array([-0.222 ,  0.2897,  0.3793])
    """

    def __init__(
        self,
        block_samples: int,
        forgetting: float = 1.0,
        *,
        centre: ArrayLike | None = None,
        in_mean: int = 2,
        single: bool = False,
        max_gap_us: float = 50_000.0,
    ) -> None:
        if not 3 <= block_samples <= 256 or not 0.0 < forgetting <= 1.0:
            raise ValueError(f"block_samples is 3 to 256 and forgetting in (0, 1], not {block_samples}, {forgetting}")
        self.block_samples, self.forgetting, self.max_gap_us = block_samples, forgetting, max_gap_us
        self.dtype = np.dtype(np.float32 if single else np.float64)
        self.centre = None if centre is None else np.asarray(centre, dtype=self.dtype)
        self.values: Array = np.zeros(rates.SUMS)
        self.noise = NoiseStream(in_mean, self.dtype)
        self.n_samples = 0
        self._last_us: float | None = None
        self.gap()

    def gap(self) -> None:
        """What comes next does not follow on what came before: a new block begins."""
        self._pending: Array = np.empty((0, 8))
        self._before: tuple[Array, Array] | None = None
        self.noise.gap()

    def feed(self, t_us: ArrayLike, q: ArrayLike, readings: ArrayLike) -> None:
        """Stamps (n,), µs, attitudes (n, 4) and readings (n, 3) as logged; a sample that is not finite is left out, and
        there, as after a gap, a new block begins."""
        t = np.atleast_1d(np.asarray(t_us, dtype=float))
        e = np.atleast_2d(np.asarray(q, dtype=self.dtype))
        z = np.atleast_2d(np.asarray(readings, dtype=self.dtype))
        finite = np.isfinite(e).all(axis=1) & np.isfinite(z).all(axis=1)
        if self.centre is None and finite.any():
            self.centre = z[int(np.argmax(finite))].copy()
        before = np.concatenate([[t[0] if self._last_us is None else self._last_us], t[:-1]]) if len(t) else t
        starts = np.flatnonzero((t - before > self.max_gap_us) | (np.diff(finite, prepend=finite[:1])))
        bounds = [0, *starts[starts > 0].tolist(), len(t)]
        for a, b in pairwise(bounds):
            if b > a and (a in starts or not finite[a]):
                self.gap()
            if b > a and finite[a] and self.centre is not None:
                self._feed_run(t[a:b], e[a:b], z[a:b] - self.centre)
                self._last_us = float(t[b - 1])

    def _feed_run(self, t: Array, q: Array, x: Array) -> None:
        self.noise.feed(x)
        self.n_samples += len(x)
        m = self.block_samples
        run = np.concatenate([self._pending, np.column_stack([t, q, x])])
        whole = len(run) // m
        self._pending = run[whole * m :]
        if not whole:
            return
        blocks = run[: whole * m].reshape(whole, m, 8)
        mean, rate, usable = rates.equations_of_blocks(blocks[:, :, 0] * 1e-6, blocks[:, :, 1:5], blocks[:, :, 5:])
        follows = np.concatenate([[self._before is not None], usable[:-1]]) & usable
        before = (np.zeros(3), np.zeros(3)) if self._before is None else self._before
        terms = rates.terms_of(mean, rate, follows, before)[usable]
        if self.forgetting == 1.0:
            self.values += terms.sum(axis=0)
        else:
            for term in terms:
                self.values *= self.forgetting
                self.values[rates.SQUARES] *= self.forgetting
                self.values += term
        self._before = (mean[-1], rate[-1]) if usable[-1] else None

    def merge(self, other: RateEquations) -> None:
        """Add another's equations, whatever its centre.

        Raises
        ------
        ValueError
            Blocks of another length, or something was forgotten.
        """
        if self.forgetting < 1.0 or other.forgetting < 1.0 or self.block_samples != other.block_samples:
            raise ValueError("equations are merged where blocks are as long and nothing was forgotten")
        if other.centre is None:
            return
        if self.centre is None:
            self.centre = other.centre.astype(self.dtype)
        self.values += rates.recentred(other.values, other.centre.astype(float) - self.centre.astype(float))
        self.noise.merge(other.noise)
        self.n_samples += other.n_samples
        self.gap()

    def solve(self, polarity: Triple = (1.0, 1.0, 1.0), max_scale_sd: float = 0.05) -> RatesFit:
        """Scale and bias of the gyroscope's axes, judged (`rates.fit_rates`)."""
        return rates.fit_rates(
            self.values,
            np.zeros(3) if self.centre is None else self.centre.astype(float),
            self.noise.squares,
            self.noise.n_differences,
            noise_kept=rates.noise_kept(self.block_samples),
            n_samples=self.n_samples,
            polarity=polarity,
            max_scale_sd=max_scale_sd,
        )
